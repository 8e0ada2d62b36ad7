"""Where the helicopter came down: Table II of the landing paper beside ours."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.figure import Figure

from marsyard.reports.answers import CONFIDENCE, share_of
from marsyard.reports.columns import numbers
from marsyard.reports.hda.rows import flag, interval_text, is_landing, share_text
from marsyard.reports.plates import plate
from marsyard.reports.populations import terrain_groups
from marsyard.reports.section import Block, Section, Subject
from marsyard.reports.sections import Grid
from marsyard.reports.statistics.proportions import Interval
from marsyard.reports.statistics.samples import mean_interval
from marsyard.reports.svg import REQUIREMENT, SERIES, in_page_style, new_axes
from marsyard.reports.wording import NOTHING, number, stated

#: Table II: run, position error, deviations of northing and easting (m), run time (s). Run 2 is missing there.
TABLE_2 = ((1, 1.21, 0.70, 0.43, 1.8), (3, 1.20, 0.61, 0.47, 1.9), (4, 0.89, 0.39, 0.35, 1.7))
#: Columns of our errors and how they are called.
ERRORS: Mapping[str, str] = MappingProxyType(
    {
        "touchdown_error_gps_m": "by averaged GPS, as the paper",
        "touchdown_error_m": "by truth",
        "touchdown_error_believed_m": "as the filter believes",
    }
)
_DEVIATIONS = ("gps_deviation_north_m", "gps_deviation_east_m")


def touchdown_section(subject: Subject) -> Section | None:
    """Errors and safety of the touchdown; None where nothing landed."""
    frame = subject.frame
    if not is_landing(frame):
        return None
    landed = frame[flag(frame, "landed")]
    errors = {name: _known(landed, name) for name in ERRORS}
    if not errors["touchdown_error_gps_m"].size or not errors["touchdown_error_m"].size:
        return None
    caption = "Share of landings nearer to the site than so much; vertical: the paper's three runs, by averaged GPS."
    figure = plate(touchdown_figure(errors), "touchdown", caption)
    means = {name: _interval(landed, name) for name, values in errors.items() if values.size}
    note = (
        "By averaged GPS: distance of the receiver's averaged solutions after landing from the site's coordinates, as "
        "the paper measured it. By truth: of the true touchdown from where these coordinates led, the navigation's "
        "error at the first picture taken off. Deviations: the receiver's own. Intervals of means: "
        f"{stated(CONFIDENCE)}."
    )
    on_site, at_touchdown = (share_of(flag(landed, name), landed) for name in ("site_safe", "touchdown_safe"))
    outcome = Grid(
        ["", "Landings", f"{stated(CONFIDENCE)} interval"],
        [
            ["came down on ground that is safe", share_text(at_touchdown), interval_text(at_touchdown)],
            ["the site itself was safe", share_text(on_site), interval_text(on_site)],
        ],
    )
    data = {
        "landings": len(landed),
        "mean_m": {name: float(values.mean()) for name, values in errors.items() if values.size},
        "mean_interval_m": means,
        "deviations_m": {name: float(_known(landed, name).mean()) for name in _DEVIATIONS if _known(landed, name).size},
        "touchdown_safe": at_touchdown.share,
        "paper_m": {str(run): error for run, error, *_ in TABLE_2},
    }
    blocks = [
        Block(plates=[figure]),
        Block(heading="Table II", grid=_grid(landed, errors), note=note),
        Block(heading="Ground under the helicopter", grid=outcome),
    ]
    return Section("touchdown", "Touchdown", "Touchdown, beside Table II", blocks, data)


def _grid(landed: pd.DataFrame, errors: Mapping[str, np.ndarray]) -> Grid:
    head = [
        "",
        "Landings",
        "Position error (m)",
        "90 % of errors (m)",
        "Northing dev. (m)",
        "Easting dev. (m)",
        "Run time",
    ]
    rows = [
        [f"paper, run {run}", "1", f"{error:.2f}", NOTHING, f"{north:.2f}", f"{east:.2f}", f"{taken:.1f} s"]
        for run, error, north, east, taken in TABLE_2
    ]
    mean = np.mean([row[1:] for row in TABLE_2], axis=0)
    rows.append(["paper, mean", "3", f"{mean[0]:.2f}", NOTHING, f"{mean[1]:.2f}", f"{mean[2]:.2f}", f"{mean[3]:.1f} s"])
    deviations = [_mean(_known(landed, name)) for name in _DEVIATIONS]
    taken = _known(landed, "estimation_time_s")
    for name, values in errors.items():
        if values.size:
            bounds = _interval(landed, name)
            told = f"mean {number(float(values.mean()))} ({number(bounds[0])} to {number(bounds[1])})"
            spread = " to ".join(number(float(one)) for one in np.quantile(values, (0.05, 0.95)))
            run_time = f"{1e3 * float(np.median(taken)):.0f} ms here" if taken.size else NOTHING
            rows.append([f"ours, {ERRORS[name]}", f"{values.size:,}", told, spread, *deviations, run_time])
    return Grid(head, rows)


@in_page_style
def touchdown_figure(errors: Mapping[str, Float[np.ndarray, " n"]]) -> Figure:
    """Shares of landings within each distance, by each measure."""
    figure, axes = new_axes(6.4, 3.4)
    for (name, values), colour, line in zip(errors.items(), SERIES, ("-", "--", ":"), strict=False):
        if values.size:
            ordered = np.concatenate([[0.0], np.sort(values)])
            share = np.arange(ordered.size) / values.size
            axes.plot(ordered, share, drawstyle="steps-post", color=colour, linestyle=line, label=ERRORS[name])
    for number_of_run, error, *_ in TABLE_2:
        label = "paper, runs 1, 3, 4" if number_of_run == 1 else None
        axes.axvline(error, color=REQUIREMENT, linewidth=0.9, linestyle="-.", label=label)
    axes.set(xlabel="distance of the touchdown from the site (m)", ylabel="share of landings", ylim=(0.0, 1.03))
    axes.set_xlim(left=0.0)
    axes.legend(loc="lower right")
    return figure


def _known(frame: pd.DataFrame, name: str) -> Float[np.ndarray, " n"]:
    values = numbers(frame, name)
    return np.asarray(values[np.isfinite(values)])


def _interval(frame: pd.DataFrame, name: str) -> Interval:
    """The interval of a column's mean, which allows for shared terrains."""
    values, groups = numbers(frame, name), terrain_groups(frame)
    finite = np.isfinite(values)
    return mean_interval(values[finite], CONFIDENCE, None if groups is None else groups[finite])


def _mean(values: Float[np.ndarray, " n"]) -> str:
    return f"{values.mean():.2f}" if values.size else NOTHING
