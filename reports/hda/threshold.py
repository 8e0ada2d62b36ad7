"""False alarms and misses against the threshold of roughness: what the landing paper says of its false positives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from marsyard.reports.answers import Share, share_of
from marsyard.reports.columns import numbers
from marsyard.reports.hda.rows import Rate, flag, is_landing, rate, rate_text, stated_parameter, varies
from marsyard.reports.plates import plate
from marsyard.reports.section import Block, Section, Subject
from marsyard.reports.sections import Grid
from marsyard.reports.svg import MARKERS, REQUIREMENT, SERIES, in_page_style, new_axes
from marsyard.scenarios.landing.parameters import LanderParameters

#: Column of the threshold that the algorithm was given.
THRESHOLD = "max_roughness_m"


@dataclass(frozen=True)
class AtThreshold:
    """What one threshold gives.

    Attributes
    ----------
    threshold_m
        Of roughness.
    flights
        Flights with it.
    false_alarms
        Truly safe footprints with a hazard of the map under them.
    missed
        Footprints that are not truly safe with none.
    called_safe_unsafe
        Footprints that the map calls safe and that are not.
    found, safe
        Flights with a site, of those with one to be found; sites that are truly safe.
    """

    threshold_m: float
    flights: int
    false_alarms: Rate
    missed: Rate
    called_safe_unsafe: Rate
    found: Share
    safe: Share


def threshold_section(subject: Subject) -> Section | None:
    """The curve; None where all cases have one threshold."""
    found = thresholds(subject)
    if not found:
        return None
    limit = lander_limit_m(subject)
    caption = "Shares of footprints against the threshold; dashed: what the lander can stand on."
    head = ["Threshold (m)", "Flights", "False alarms", "Missed", "Called safe, not safe"]
    head += ["Site found, of those with one", "Sites truly safe"]
    rows = [
        [
            f"{one.threshold_m:g}",
            f"{one.flights:,}",
            *(rate_text(each) for each in (one.false_alarms, one.missed, one.called_safe_unsafe)),
            f"{one.found.hits:,} of {one.found.n:,}",
            f"{one.safe.hits:,} of {one.safe.n:,}",
        ]
        for one in found
    ]
    text = (
        "The paper: both results of its Fig. 7 have false positive hazards, caused by a low threshold of roughness and "
        "by noise of the map; a higher one would remove them. It gives no numbers."
    )
    note = (
        "False alarms: of truly safe footprints. Missed: of footprints that are not truly safe, for slope or roughness."
    )
    blocks = [
        Block(text=text, plates=[plate(threshold_figure(found, limit), "threshold", caption)]),
        Block(grid=Grid(head, rows), note=note),
    ]
    data = {"lander_limit_m": limit, "thresholds": [asdict(one) for one in found]}
    return Section("threshold", "Threshold", "False alarms and misses by threshold of roughness", blocks, data)


def thresholds(subject: Subject) -> list[AtThreshold]:
    """Rates by threshold, lowest first; none where it does not vary or footprints are not counted."""
    frame = subject.frame
    if not is_landing(frame) or not varies(frame, THRESHOLD) or "false_alarms" not in frame:
        return []
    unsafe = numbers(frame, "footprints") - numbers(frame, "footprints_truly_safe")
    frame = frame.assign(footprints_not_safe=unsafe)
    found = []
    for value in np.unique(numbers(frame, THRESHOLD)[np.isfinite(numbers(frame, THRESHOLD))]):
        chosen = frame[numbers(frame, THRESHOLD) == value]
        roomy, reported = flag(chosen, "roomy_exists"), flag(chosen, "site_reported")
        found.append(
            AtThreshold(
                threshold_m=float(value),
                flights=len(chosen),
                false_alarms=rate(chosen, "false_alarms", "footprints_truly_safe"),
                missed=rate(chosen, "missed", "footprints_not_safe"),
                called_safe_unsafe=rate(chosen, "footprints_called_safe_unsafe", "footprints_called_safe"),
                found=share_of(reported[roomy], chosen[roomy]),
                safe=share_of(flag(chosen, "site_safe")[reported], chosen[reported]),
            )
        )
    return found


def lander_limit_m(subject: Subject) -> float:
    """The lander's own limit of roughness, as the campaign states it."""
    stated = stated_parameter(subject, "lander", THRESHOLD)
    return float(stated) if isinstance(stated, int | float) else LanderParameters().max_roughness_m


@in_page_style
def threshold_figure(found: Sequence[AtThreshold], limit_m: float) -> Figure:
    """False alarms and misses against the threshold."""
    figure, axes = new_axes(6.4, 3.6)
    kinds = (("false_alarms", "false alarms"), ("missed", "missed"), ("called_safe_unsafe", "called safe, not safe"))
    for k, (part, name) in enumerate(kinds):
        rates: list[Rate] = [getattr(one, part) for one in found]
        shares = np.array([one.share for one in rates])
        bounds = np.array([[one.lower, one.upper] for one in rates])
        spread = np.abs(np.nan_to_num(bounds - shares[:, None])).T
        x = [one.threshold_m for one in found]
        axes.errorbar(x, shares, spread, color=SERIES[k], marker=MARKERS[k], capsize=2.5, elinewidth=0.9, label=name)
    axes.axvline(limit_m, color=REQUIREMENT, linestyle="--", linewidth=1.2, label="the lander's limit")
    axes.set(xlabel="threshold of roughness (m)", ylabel="share of footprints", ylim=(-0.03, 1.03))
    axes.set_xlim(left=0.0)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.legend(loc="upper right")
    return figure
