"""How many features are tracked against the change between the pictures: the landing paper's limits as knees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from marsyard.reports.columns import numbers
from marsyard.reports.hda.rows import Rate, flag, is_landing, rate, rate_text
from marsyard.reports.plates import plate
from marsyard.reports.section import Block, Section, Subject
from marsyard.reports.sections import Grid
from marsyard.reports.svg import MUTED, REQUIREMENT, SERIES, in_page_style
from marsyard.reports.wording import NOTHING, percent

#: Share of features below which tracking is no longer good.
GOOD = 0.9
#: A change below this share of the paper's limit is none: what is read back of a change that was not asked for.
_NONE = 0.02
_FEWEST_SIZES = 3


@dataclass(frozen=True)
class Change:
    """A change between the pictures: its column, name, what its numbers are multiplied by, unit, the paper's limit."""

    column: str
    name: str
    scale: float
    unit: str
    paper: float


CHANGES = (
    Change("roll_deg", "roll about the optical axis", 1.0, "deg", 10.0),
    Change("pitch_deg", "pitch", 1.0, "deg", 20.0),
    Change("yaw_deg", "yaw", 1.0, "deg", 20.0),
    Change("height_change_share", "change of height", 100.0, "%", 20.0),
)


@dataclass(frozen=True)
class AtSize:
    """Tracking with one change of one size.

    Attributes
    ----------
    size
        In the change's unit, signed.
    tracked
        Features that both pictures show and that were tracked rightly.
    flights, good
        Flights, and those in which `GOOD` of the features were.
    """

    size: float
    tracked: Rate
    flights: int
    good: int


@dataclass(frozen=True)
class Curve:
    """A curve of one change, and its knees.

    Attributes
    ----------
    change
        What changes.
    points
        By size, among them none at all.
    knee_up, knee_down
        Largest change upwards and downwards up to which the interpolated share stays at `GOOD`; infinite where it never
        falls below, NaN where the side was not flown.
    """

    change: Change
    points: Sequence[AtSize]
    knee_up: float
    knee_down: float


def limits_section(subject: Subject) -> Section | None:
    """The curves; None where flights do not change one thing at a time."""
    found = curves(subject.frame)
    if not found:
        return None
    caption = "Features tracked rightly, of those that both pictures show; red: the paper's limits; grey: 90 %."
    text = (
        "The paper (section II.A): features can be tracked when the change of attitude is less than 10 deg in roll "
        "about the optical axis and less than 20 deg in pitch and yaw, and that of altitude less than 20 %."
    )
    knees = [
        [
            one.change.name,
            f"{one.change.paper:g} {one.change.unit}",
            _knee_text(one, one.knee_up, 1.0),
            _knee_text(one, one.knee_down, -1.0),
            percent(_worst_within(one)),
        ]
        for one in found
    ]
    head = ["Change", "Paper's limit", "Knee", "Knee, downwards", "Least share within the paper's limit"]
    rows = [
        [one.change.name, f"{at.size:g} {one.change.unit}", f"{at.flights:,}", rate_text(at.tracked), f"{at.good:,}"]
        for one in found
        for at in one.points
    ]
    note = (
        "Knee: the largest change up to which the share, interpolated between sizes flown, stays at 90 %; '>' where it "
        "never falls below. Tracked rightly: accepted, and within 1 px of the true place."
    )
    blocks = [
        Block(text=text, plates=[plate(limits_figure(found), "limits", caption, wide=True)]),
        Block(heading="Knees", grid=Grid(head, knees), note=note),
        Block(
            heading="By size", grid=Grid(["Change", "Size", "Flights", "Tracked rightly", "Flights with 90 %"], rows)
        ),
    ]
    data = {"curves": [asdict(one) for one in found]}
    return Section("limits", "Limits", "Tracking by change between the pictures", blocks, data)


def curves(frame: pd.DataFrame) -> list[Curve]:
    """A curve for every change that was flown in several sizes, alone; none where they come together."""
    if not is_landing(frame) or "tracks_right" not in frame:
        return []
    sizes = {one.column: one.scale * numbers(frame, one.column) for one in CHANGES}
    present = np.stack([np.abs(sizes[one.column]) > _NONE * one.paper for one in CHANGES])
    known = np.isfinite(np.stack(list(sizes.values()))).all(axis=0)
    if not known.any() or np.any(present[:, known].sum(axis=0) > 1):
        return []
    still = known & ~present.any(axis=0)
    found = []
    for one, changed in zip(CHANGES, present, strict=True):
        chosen = known & (changed | still)
        rounded = np.where(changed, np.round(sizes[one.column], 1), 0.0)
        if np.unique(rounded[chosen]).size >= _FEWEST_SIZES:
            found.append(_curve(one, frame, rounded, chosen))
    return found


def _curve(
    change: Change, frame: pd.DataFrame, sizes: Float[np.ndarray, " n"], chosen: Bool[np.ndarray, " n"]
) -> Curve:
    points = []
    for size in np.unique(sizes[chosen]):
        flights = frame[chosen & (sizes == size)]
        # a flight without tracks has tracked none of what was to be seen
        tracked = rate(flights, "tracks_right", "features_in_view")
        points.append(AtSize(float(size), tracked, len(flights), int(flag(flights, "tracked_well").sum())))
    return Curve(change, points, knee(points, 1.0), knee(points, -1.0))


def knee(points: Sequence[AtSize], sign: float) -> float:
    """Where the share falls below `GOOD` for the first time, going from no change upwards (1) or downwards (-1)."""
    side = sorted((sign * at.size, at.tracked.share) for at in points if sign * at.size >= 0.0)
    side = [(size, share) for size, share in side if not np.isnan(share)]
    if len(side) < 2:
        return float("nan")
    if side[0][1] < GOOD:
        return side[0][0]
    for (size, share), (next_size, next_share) in pairwise(side):
        if next_share < GOOD:
            return size + (next_size - size) * (share - GOOD) / (share - next_share)
    return float("inf")


def _knee_text(curve: Curve, value: float, sign: float) -> str:
    if np.isnan(value):
        return NOTHING
    if np.isinf(value):
        return f"> {max(sign * at.size for at in curve.points):g} {curve.change.unit}"
    return f"{value:.1f} {curve.change.unit}"


def _worst_within(curve: Curve) -> float:
    """The least share of all sizes up to the paper's limit, rounded sizes at the limit among them."""
    shares = [at.tracked.share for at in curve.points if abs(at.size) <= 1.001 * curve.change.paper]
    return float(np.nanmin(shares)) if shares and not np.all(np.isnan(shares)) else float("nan")


@in_page_style
def limits_figure(found: Sequence[Curve]) -> Figure:
    """The curves beside each other, with the paper's limits."""
    figure = Figure(figsize=(9.0, 2.7 if len(found) < 3 else 5.2), layout="constrained")
    columns = min(2, len(found))
    axes_of_all = figure.subplots(-(-len(found) // columns), columns, squeeze=False, sharey=True)
    for axes, curve in zip(axes_of_all.ravel(), found, strict=False):
        x = [at.size for at in curve.points]
        shares = np.array([at.tracked.share for at in curve.points])
        bounds = np.array([[at.tracked.lower, at.tracked.upper] for at in curve.points])
        spread = np.abs(np.nan_to_num(bounds - shares[:, None])).T
        axes.errorbar(x, shares, spread, color=SERIES[0], marker="o", markersize=4.5, capsize=2.5, elinewidth=0.9)
        for limit in (-curve.change.paper, curve.change.paper):
            if min(x) <= limit <= max(x):
                axes.axvline(limit, color=REQUIREMENT, linestyle="--", linewidth=1.2)
        axes.axhline(GOOD, color=MUTED, linewidth=0.9, linestyle=":")
        axes.set(title=curve.change.name, xlabel=f"change ({curve.change.unit})", ylim=(-0.03, 1.05))
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    for axes in axes_of_all.ravel()[len(found) :]:
        axes.set_axis_off()
    for axes in axes_of_all[:, 0]:
        axes.set_ylabel("features tracked")
    return figure
