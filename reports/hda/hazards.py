"""Sites chosen and hazards missed: `hda-hazardous` and whatever else has sites, against the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from marsyard.reports.answers import CONFIDENCE, Share, share_of
from marsyard.reports.columns import numbers
from marsyard.reports.hda.rows import Rate, flag, interval_text, is_landing, rate, rate_text, share_text
from marsyard.reports.plates import plate
from marsyard.reports.section import Block, Section, Subject
from marsyard.reports.sections import Grid
from marsyard.reports.statistics.samples import quantile_bounds
from marsyard.reports.svg import MARKERS, SERIES, in_page_style, new_axes
from marsyard.reports.wording import NOTHING, number, stated
from marsyard.scenarios.landing.confusion import CLASS_NAMES, CLASSES

#: What is true of the ground that both pictures show, best first.
GROUNDS = ("safe place with room about it", "safe place without room", "no safe place")
#: What became of the search.
ANSWERS = ("safe site, truly safe", "site, not safe", "no safe site", "not converged", "not finished")


@dataclass(frozen=True)
class HazardClass:
    """Hazards of one size.

    Attributes
    ----------
    kind
        `roughness` (their height) or `slope`.
    low, high
        Bounds in units of the lander's limit; infinite for the last class.
    called_safe, unflagged
        Footprints that the map calls safe, and those under which it has no hazard before growth, of all in the class.
    """

    kind: str
    low: float
    high: float
    called_safe: Rate
    unflagged: Rate


def hazards_section(subject: Subject) -> Section | None:
    """Sites against truth, hazards missed by size, distances; None where rows hold no sites."""
    frame = subject.frame
    if not is_landing(frame):
        return None
    shares, classes = site_shares(frame), hazard_classes(frame)
    blocks = [
        Block(heading="Sites", grid=_shares_grid(shares)),
        Block(heading="By what is there", grid=_outcomes(frame), note=_OUTCOMES_NOTE),
    ]
    distances = {
        "site, where one was reported": _known(frame[flag(frame, "site_reported")], "site_hazard_distance_m"),
        "touchdown": _known(frame, "touchdown_hazard_distance_m"),
    }
    if any(values.size for values in distances.values()):
        caption = "Share of places at least so far from the nearest one where the lander would not stand safely."
        figure = plate(distance_figure(distances), "distances", caption)
        blocks.append(Block(heading="Distance to true hazards", plates=[figure], grid=_distance_grid(distances)))
    data: dict[str, object] = {
        "shares": {name: asdict(one) for name, one in shares.items()},
        "outcomes": outcome_counts(frame),
    }
    if classes:
        rates = {name: rate(frame, *columns) for name, columns in RATES.items()}
        figure = plate(class_figure(classes), "classes", "Hazards by size: called safe, and not flagged.")
        blocks += [
            Block(heading="Hazards missed, by height and slope", plates=[figure], grid=_class_grid(classes)),
            Block(grid=_rates_grid(rates), note=_CLASSES_NOTE),
        ]
        data |= {
            "rates": {name: asdict(one) for name, one in rates.items()},
            "classes": [asdict(one) for one in classes],
        }
    return Section("sites", "Sites", "Sites and hazards against the truth", blocks, data)


#: Rates of footprints over all flights, by their names: hits and of what.
RATES: Mapping[str, tuple[str, str]] = {
    "truly safe, with a hazard of the map under them (false alarms)": ("false_alarms", "footprints_truly_safe"),
    "called safe by the map, not truly safe": ("footprints_called_safe_unsafe", "footprints_called_safe"),
    "called safe, with a hazard of twice the roughness limit, three cells across": (
        "gross_called_safe",
        "footprints_called_safe",
    ),
    "such hazards, called safe": ("gross_called_safe", "gross"),
    "such hazards, with no hazard of the map under them": ("gross_unflagged", "gross"),
}
_OUTCOMES_NOTE = (
    "Flights by what is true of the ground that both pictures show. Room: every place within a lander's radius is safe "
    "too. Where the algorithm does not converge the a-priori site is what is left; it is reported as such."
)
_CLASSES_NOTE = (
    "A footprint is what lies under the lander at a place of a lattice, a tenth of a diameter apart: those of a flight "
    f"overlap. Its roughness is the height of its highest hazard. Intervals: {stated(CONFIDENCE)}, by bootstrap over "
    "flights, or terrains where flights share them; none where no flight has a hit. Flagged: a cell under the lander "
    "is a hazard before growth. Called safe: after growth, border and holes."
)


def site_shares(frame: pd.DataFrame) -> dict[str, Share]:
    """How often the answer was right, by what was asked for; those alone that had cases."""
    reported, none, roomy, landed = (
        flag(frame, name) for name in ("site_reported", "none_exists", "roomy_exists", "landed")
    )
    refused, safe = flag(frame, "no_site_reported"), flag(frame, "site_safe")
    narrow, right = flag(frame, "safe_exists") & ~roomy, refused | (reported & safe)
    shares = {
        "chosen sites that are truly safe": share_of(safe[reported], frame[reported]),
        "'no safe site', where none exists": share_of(refused[none], frame[none]),
        "a site reported, where none exists": share_of(reported[none], frame[none]),
        "a site found, where one has room about it": share_of(reported[roomy], frame[roomy]),
        "a truly safe site or 'no safe site', where safe sites have no room": share_of(right[narrow], frame[narrow]),
        "ground mapped, of all flights": share_of(flag(frame, "converged"), frame),
        "landings on safe ground": share_of(flag(frame, "touchdown_safe")[landed], frame[landed]),
    }
    return {name: one for name, one in shares.items() if one.n}


def outcome_counts(frame: pd.DataFrame) -> dict[str, dict[str, int]]:
    """Flights by what is true (`GROUNDS`) and what became of them (`ANSWERS`)."""
    roomy, exists, none = (flag(frame, name) for name in ("roomy_exists", "safe_exists", "none_exists"))
    answers = _answers(frame)
    truths = dict(zip(GROUNDS, (roomy, exists & ~roomy, none), strict=True))
    return {
        ground: {answer: int((of_ground & given).sum()) for answer, given in answers.items()}
        for ground, of_ground in truths.items()
    }


def _answers(frame: pd.DataFrame) -> dict[str, Bool[np.ndarray, " n"]]:
    reported, safe, refused = (flag(frame, name) for name in ("site_reported", "site_safe", "no_site_reported"))
    finished = frame["site_reported"].notna().to_numpy(dtype=np.bool_)
    columns = (reported & safe, reported & ~safe, refused, finished & ~reported & ~refused, ~finished)
    return dict(zip(ANSWERS, columns, strict=True))


def hazard_classes(frame: pd.DataFrame) -> list[HazardClass]:
    """Missed hazards by size, in order; none where rows do not count them."""
    edges = (0.0, *CLASSES, float("inf"))
    found = []
    for kind in ("roughness", "slope"):
        for name, low, high in zip(CLASS_NAMES, edges[:-1], edges[1:], strict=True):
            column = f"footprints_{kind}_{name}"
            if column in frame:
                called, unflagged = (rate(frame, f"{column}_{part}", column) for part in ("safe", "unflagged"))
                found.append(HazardClass(kind, low, high, called, unflagged))
    return found


@in_page_style
def class_figure(classes: Sequence[HazardClass]) -> Figure:
    """Shares called safe and not flagged against the hazards' size, roughness and slope apart."""
    figure = Figure(figsize=(7.2, 3.3), layout="constrained")
    for axes, kind in zip(figure.subplots(1, 2, sharey=True), ("roughness", "slope"), strict=True):
        ours = [one for one in classes if one.kind == kind]
        places = np.arange(len(ours))
        for shift, (part, name) in enumerate((("called_safe", "called safe"), ("unflagged", "not flagged"))):
            rates: list[Rate] = [getattr(one, part) for one in ours]
            shares = np.array([one.share for one in rates])
            bounds = np.array([[one.lower, one.upper] for one in rates]).reshape(-1, 2)
            spread = np.abs(np.nan_to_num(bounds - shares[:, None])).T
            axes.errorbar(
                places + 0.16 * shift - 0.08,
                shares,
                spread,
                linestyle="",
                marker=MARKERS[shift],
                color=SERIES[shift],
                capsize=2.5,
                label=name,
            )
        axes.set_xticks(places, [_class_name(one) for one in ours])
        axes.set(title=f"by {kind}", xlabel="over the lander's limit", ylim=(-0.03, 1.03))
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    figure.axes[0].set_ylabel("share of footprints")
    figure.axes[1].legend(loc="upper right")
    return figure


@in_page_style
def distance_figure(distances: Mapping[str, Float[np.ndarray, " n"]]) -> Figure:
    """Shares of sites and touchdowns at least so far from a true hazard."""
    figure, axes = new_axes(6.4, 3.2)
    for (name, values), colour, line in zip(distances.items(), SERIES, ("-", "--"), strict=False):
        if values.size:
            ordered = np.concatenate([[0.0], np.sort(values)])
            share = 1.0 - np.arange(ordered.size) / values.size
            axes.plot(ordered, share, drawstyle="steps-post", color=colour, linestyle=line, label=name)
    axes.set(xlabel="distance to the nearest unsafe place (m)", ylabel="share at least so far", ylim=(0.0, 1.03))
    axes.set_xlim(left=0.0)
    axes.legend(loc="upper right")
    return figure


def _shares_grid(shares: Mapping[str, Share]) -> Grid:
    rows = [[name, share_text(one), interval_text(one)] for name, one in shares.items()]
    return Grid(["", "Flights", f"{stated(CONFIDENCE)} interval"], rows)


def _outcomes(frame: pd.DataFrame) -> Grid:
    counts = outcome_counts(frame)
    rows = [[ground, *(f"{of_answer[name]:,}" for name in ANSWERS)] for ground, of_answer in counts.items()]
    return Grid(["The pictures show", *ANSWERS], rows)


def _distance_grid(distances: Mapping[str, Float[np.ndarray, " n"]]) -> Grid:
    rows = []
    for name, values in distances.items():
        if values.size:
            quantiles = [number(float(one)) for one in np.quantile(values, (0.05, 0.5))]
            bound = quantile_bounds(values, 0.05, CONFIDENCE)[0]
            rows.append(
                [
                    name,
                    f"{values.size:,}",
                    number(float(values.min())),
                    *quantiles,
                    NOTHING if math.isinf(bound) else number(bound),
                ]
            )
    return Grid(["Distance (m)", "Cases", "Least", "5 % quantile", "Median", "5 % quantile is at least"], rows)


def _class_grid(classes: Sequence[HazardClass]) -> Grid:
    rows = [
        [
            one.kind,
            _class_name(one),
            f"{one.called_safe.of:,} in {one.called_safe.flights:,}",
            rate_text(one.called_safe),
            rate_text(one.unflagged),
            f"{one.unflagged.flights_hit:,} of {one.unflagged.flights:,}",
        ]
        for one in classes
        if one.called_safe.of
    ]
    head = [
        "By",
        "Over the limit",
        "Footprints in flights",
        "Called safe",
        "Not flagged",
        "Flights with one not flagged",
    ]
    return Grid(head, rows)


def _rates_grid(rates: Mapping[str, Rate]) -> Grid:
    rows = [[name, f"{one.hits:,} of {one.of:,}", rate_text(one)] for name, one in rates.items()]
    return Grid(["Footprints", "Counted", f"Share ({stated(CONFIDENCE)} interval)"], rows)


def _class_name(one: HazardClass) -> str:
    return (
        f"< {one.high:g}"
        if one.low == 0.0
        else f"> {one.low:g}"
        if np.isinf(one.high)
        else f"{one.low:g} to {one.high:g}"
    )


def _known(frame: pd.DataFrame, name: str) -> Float[np.ndarray, " n"]:
    values = numbers(frame, name)
    return np.asarray(values[np.isfinite(values)])
