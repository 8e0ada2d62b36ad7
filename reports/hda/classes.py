"""Missed hazards by size, and tracked features by the change between the pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from marsyard.reports.figures import RateLine, draw_rates
from marsyard.reports.hda.sections import PAPER, landing_rows
from marsyard.reports.kinds import Drawn, Rows
from marsyard.reports.rates import CONFIDENCE, PooledRate, flag, pooled_rate, rate_text
from marsyard.reports.section import MUTED, REQUIREMENT, Block, Grid, Section, Subject, build_grid, in_page_style, plate
from marsyard.reports.wording import NOTHING, format_fraction, note_text, numbers, percent
from marsyard.scenarios.landing.pictures import CLASS_NAMES, CLASSES


@dataclass(frozen=True)
class HazardClass:
    """Hazards of one size class.

    kind: `roughness` (their height) or `slope`
    low, high: bounds in units of the lander's limit
    called_safe, unflagged: footprints that the map calls safe, and those without a hazard of the map before growth
    """

    kind: str
    low: float
    high: float
    called_safe: PooledRate
    unflagged: PooledRate

    @property
    def name(self) -> str:
        """The bounds in words."""
        if self.low == 0.0:
            return f"< {self.high:g}"
        return f"> {self.low:g}" if math.isinf(self.high) else f"{self.low:g} to {self.high:g}"


#: Rates of footprints over all flights by name: columns of hits and of all.
RATES: Mapping[str, tuple[str, str]] = {
    "truly safe, with a hazard of the map under them (false alarms)": ("false_alarms", "footprints_truly_safe"),
    "called safe by the map, not truly safe": ("footprints_called_safe_unsafe", "footprints_called_safe"),
    "called safe, with a hazard of twice the roughness limit, three cells across": (
        "gross_hazards_called_safe",
        "footprints_called_safe",
    ),
    "such hazards, called safe": ("gross_hazards_called_safe", "gross_hazards"),
    "such hazards, with no hazard of the map under them": ("gross_hazards_unflagged", "gross_hazards"),
}


def hazard_classes(frame: Rows) -> list[HazardClass]:
    """Missed hazards by size; empty if rows do not count them."""
    edges = (0.0, *CLASSES, math.inf)
    rows = []
    for kind in ("roughness", "slope"):
        for name, low, high in zip(CLASS_NAMES, edges[:-1], edges[1:], strict=True):
            column = f"footprints_{kind}_{name}"
            if column in frame:
                called, unflagged = (pooled_rate(frame, f"{column}_{part}", column) for part in ("safe", "unflagged"))
                rows.append(HazardClass(kind, low, high, called, unflagged))
    return rows


def draw_classes(frame: Rows, subject: Subject, key: str) -> Drawn:
    """Missed hazards by size, and rates of footprints; nothing if rows do not count them."""
    classes = hazard_classes(frame)
    if not classes:
        return [], {}
    rates = {name: pooled_rate(frame, *columns) for name, columns in RATES.items()}
    figure = plate(class_figure(classes), key, "Hazards by size: called safe, and not flagged.")
    by_class = build_grid(
        [one for one in classes if one.called_safe.of],
        {
            "By": lambda one: one.kind,
            "Over the limit": lambda one: one.name,
            "Footprints in flights": lambda one: f"{one.called_safe.of:,} in {one.called_safe.flights:,}",
            "Called safe": lambda one: rate_text(one.called_safe),
            "Not flagged": lambda one: rate_text(one.unflagged),
            "Flights with one not flagged": lambda one: f"{one.unflagged.flights_hit:,} of {one.unflagged.flights:,}",
        },
    )
    rows = [[name, f"{one.hits:,} of {one.of:,}", rate_text(one)] for name, one in rates.items()]
    counted = Grid(["Footprints", "Counted", f"Share ({format_fraction(CONFIDENCE)} interval)"], rows)
    blocks = [
        Block(heading="Hazards missed, by height and slope", plates=[figure], grid=by_class),
        Block(grid=counted, note=note_text("hda.classes", confidence=format_fraction(CONFIDENCE))),
    ]
    data = {"rates": {name: asdict(one) for name, one in rates.items()}, "classes": [asdict(one) for one in classes]}
    return blocks, data


@in_page_style
def class_figure(classes: Sequence[HazardClass]) -> Figure:
    """Fractions called safe and not flagged against the hazards' size, by roughness and by slope."""
    figure = Figure(figsize=(7.2, 3.3), layout="constrained")
    for axes, kind in zip(figure.subplots(1, 2, sharey=True), ("roughness", "slope"), strict=True):
        ours = [one for one in classes if one.kind == kind]
        places = np.arange(len(ours))
        called = RateLine("called safe", (places - 0.08).tolist(), [one.called_safe for one in ours])
        unflagged = RateLine("not flagged", (places + 0.08).tolist(), [one.unflagged for one in ours])
        draw_rates(axes, (called, unflagged), linestyle="")
        axes.set_xticks(places, [one.name for one in ours])
        axes.set(title=f"by {kind}", xlabel="over the lander's limit")
    figure.axes[0].set_ylabel("share of footprints")
    figure.axes[1].legend(loc="upper right")
    return figure


#: Minimum fraction of features for good tracking.
GOOD = 0.9
#: Changes below this fraction of the paper's limit count as none.
_NONE = 0.02
_MIN_SIZES = 3


@dataclass(frozen=True)
class AtSize:
    """Correctly tracked features of flights with a signed size of change; `good` flights track at least `GOOD`."""

    size: float
    tracked: PooledRate
    flights: int
    good: int


@dataclass(frozen=True)
class Curve:
    """Tracking against one of the changes of `paper.toml`.

    points: by size, including no change
    knee_up, knee_down: largest change with an interpolated fraction of `GOOD`; infinite if it never falls below, NaN if
        that direction was not flown
    """

    change: Mapping[str, Any]
    points: Sequence[AtSize]
    knee_up: float
    knee_down: float

    def knee_text(self, value: float, sign: float) -> str:
        """A knee with its unit."""
        if math.isnan(value):
            return NOTHING
        if math.isinf(value):
            return f"> {max(sign * at.size for at in self.points):g} {self.change['unit']}"
        return f"{value:.1f} {self.change['unit']}"

    @property
    def min_fraction_within_limit(self) -> float:
        """Minimum fraction of all sizes up to the paper's limit."""
        shares = [at.tracked.share for at in self.points if abs(at.size) <= 1.001 * self.change["paper"]]
        return float(np.nanmin(shares)) if shares and not np.all(np.isnan(shares)) else math.nan


def limits_section(subject: Subject) -> Section | None:
    """Features tracked by the change between the pictures; None unless flights change one condition at a time."""
    frame = landing_rows(subject)
    class_curves = [] if frame is None else curves(frame)
    if not class_curves:
        return None
    knees = build_grid(
        class_curves,
        {
            "Change": lambda one: one.change["name"],
            "Paper's limit": lambda one: f"{one.change['paper']:g} {one.change['unit']}",
            "Knee": lambda one: one.knee_text(one.knee_up, 1.0),
            "Knee, negative change": lambda one: one.knee_text(one.knee_down, -1.0),
            "Minimum share within the paper's limit": lambda one: percent(one.min_fraction_within_limit),
        },
    )
    by_size = build_grid(
        [(one.change, at) for one in class_curves for at in one.points],
        {
            "Change": lambda pair: pair[0]["name"],
            "Size": lambda pair: f"{pair[1].size:g} {pair[0]['unit']}",
            "Flights": lambda pair: f"{pair[1].flights:,}",
            "Correctly tracked": lambda pair: rate_text(pair[1].tracked),
            "Flights with 90 %": lambda pair: f"{pair[1].good:,}",
        },
    )
    caption = "Correctly tracked features, of those in both pictures; red: the paper's limits; grey: 90 %."
    blocks = [
        Block(
            text=note_text("hda.limits_text"), plates=[plate(limits_figure(class_curves), "limits", caption, wide=True)]
        ),
        Block(heading="Knees", grid=knees, note=note_text("hda.limits")),
        Block(heading="By size", grid=by_size),
    ]
    data = {"curves": [asdict(one) for one in class_curves]}
    return Section("limits", "Limits", "Tracking by change between the pictures", blocks, data)


def curves(frame: pd.DataFrame) -> list[Curve]:
    """A curve for every change that was flown alone in several sizes; empty if changes were combined."""
    changes = PAPER["changes"]
    if "tracks_correct" not in frame:
        return []
    sizes = [one["scale"] * numbers(frame, one["column"]) for one in changes]
    present = np.stack([np.abs(size) > _NONE * one["paper"] for size, one in zip(sizes, changes, strict=True)])
    flown = np.isfinite(np.stack(sizes)).all(axis=0)
    if not flown.any() or np.any(present[:, flown].sum(axis=0) > 1):
        return []
    still = flown & ~present.any(axis=0)
    rows = []
    for one, size, changed in zip(changes, sizes, present, strict=True):
        chosen = flown & (changed | still)
        rounded = np.where(changed, np.round(size, 1), 0.0)
        if np.unique(rounded[chosen]).size >= _MIN_SIZES:
            points = []
            for value in np.unique(rounded[chosen]):
                flights = frame[chosen & (rounded == value)]
                # a flight without tracks has tracked none of the visible features
                tracked = pooled_rate(flights, "tracks_correct", "features_in_view")
                points.append(AtSize(float(value), tracked, len(flights), int(flag(flights, "tracked_well").sum())))
            rows.append(Curve(one, points, knee(points, 1.0), knee(points, -1.0)))
    return rows


def knee(points: Sequence[AtSize], sign: float) -> float:
    """First change at which the fraction falls below `GOOD`, for positive (1) or negative (-1) changes."""
    side = sorted((sign * at.size, at.tracked.share) for at in points if sign * at.size >= 0.0)
    side = [(size, share) for size, share in side if not math.isnan(share)]
    if len(side) < 2:
        return math.nan
    if side[0][1] < GOOD:
        return side[0][0]
    for (size, share), (next_size, next_share) in pairwise(side):
        if next_share < GOOD:
            return size + (next_size - size) * (share - GOOD) / (share - next_share)
    return math.inf


@in_page_style
def limits_figure(found: Sequence[Curve]) -> Figure:
    """The curves with the paper's limits."""
    figure = Figure(figsize=(9.0, 2.7 if len(found) < 3 else 5.2), layout="constrained")
    columns = min(2, len(found))
    panels = figure.subplots(-(-len(found) // columns), columns, squeeze=False, sharey=True)
    for axes, curve in zip(panels.ravel(), found, strict=False):
        x = [at.size for at in curve.points]
        draw_rates(axes, [RateLine("", x, [at.tracked for at in curve.points])])
        for limit in (-curve.change["paper"], curve.change["paper"]):
            if min(x) <= limit <= max(x):
                axes.axvline(limit, color=REQUIREMENT, linestyle="--", linewidth=1.2)
        axes.axhline(GOOD, color=MUTED, linewidth=0.9, linestyle=":")
        axes.set(title=curve.change["name"], xlabel=f"change ({curve.change['unit']})")
    for axes in panels.ravel()[len(found) :]:
        axes.set_axis_off()
    for axes in panels[:, 0]:
        axes.set_ylabel("features tracked")
    return figure
