"""Sections about descents: the field test, errors at the thrusters' firing, landings, and what drives errors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from scipy import stats

from marsyard.reports import kinds, rates
from marsyard.reports.papers import read_paper
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import (
    MARKERS,
    MUTED,
    REQUIREMENT,
    SERIES,
    Block,
    Grid,
    Section,
    Subject,
    SvgFigure,
    build_grid,
    in_page_style,
    new_axes,
    plate,
)
from marsyard.reports.statistics.samples import quantile_bounds
from marsyard.reports.wording import (
    NOTHING,
    axis_columns,
    count,
    format_fraction,
    label,
    magnitude_label,
    note_text,
    number,
    numbers,
    percent,
    split_unit,
)

#: Rows of the paper's Fig. 11 by (category, run).
FIG_11: Mapping[tuple[str, str], Mapping[str, Any]] = {
    (group["category"], row["run"]): row
    for group in read_paper(Path(__file__).with_name("paper.toml"))["fig_11"]
    for row in group["runs"]
}
#: Minimum large difference from the paper, percentage points.
LARGE_POINTS = 10.0


def field_test_section(subject: Subject) -> Section | None:
    """Field test runs and categories next to the paper's Figs. 10 and 11; None if the rows lack them."""
    frame, bound = subject.frame, subject.bound
    if not {"run", "category"}.issubset(frame.columns) or not rates.is_flag(frame, "answered"):
        return None
    cells = field_cells(subject)
    grid = build_grid(
        cells,
        {
            "Category and run": lambda one: f"{one['category']}: {one['run']}",
            "Triples": lambda one: f"{one['valid'].n:,}",
            "Valid": lambda one: f"{one['valid'].hits:,}",
            "% valid": lambda one: percent(one["valid"].share),
            f"{format_fraction(CONFIDENCE)} interval": lambda one: rates.range_text(
                one["valid"].lower, one["valid"].upper
            ),
            "Paper": lambda one: NOTHING if one["paper_percent"] is None else f"{one['paper_percent']} %",
            "Difference": lambda one: _difference_text(one["difference_points"]),
            "Beyond the bound" if bound is None else f"Beyond {bound:g}": lambda one: (
                NOTHING if one["beyond"] is None else f"{one['beyond']:,}"
            ),
            "Largest error": lambda one: number(one["largest"]),
        },
    )
    blocks = [Block(grid=grid, note=_field_note(cells))]
    plates = scatter_plates(subject)
    if plates:
        note = ""
        if bound is not None and subject.metric is not None:
            note = note_text("dimes.errors", bound=f"{bound:g}", unit=split_unit(subject.metric)[1])
        blocks.append(Block(heading="Errors by category", plates=plates, note=note))
    data = {"cells": [one | {"valid": asdict(one["valid"])} for one in cells]}
    return Section("field-test", "Field test", "Runs and categories, next to the paper's Fig. 11", blocks, data)


def field_cells(subject: Subject) -> list[dict[str, Any]]:
    """Results of every category and run, first in the paper's order, then in the rows' order."""
    frame, blocks = subject.frame, []
    named = frame[["category", "run"]].dropna().drop_duplicates()
    pairs = [(str(category), str(run)) for category, run in named.itertuples(index=False)]
    for category, run in [*(pair for pair in FIG_11 if pair in pairs), *(pair for pair in pairs if pair not in FIG_11)]:
        chosen = frame[frame["category"].eq(category) & frame["run"].eq(run)]
        answered = rates.members(chosen, "valid")
        errors = np.abs(numbers(chosen[answered], subject.metric)) if subject.metric else np.array([])
        errors = errors[np.isfinite(errors)]
        share, paper = rates.fraction_of(answered, chosen), FIG_11.get((category, run), {}).get("percent")
        blocks.append(
            {
                "category": category,
                "run": run,
                "valid": share,
                "beyond": None if subject.bound is None else int((errors > subject.bound).sum()),
                "largest": float(errors.max()) if errors.size else math.nan,
                "paper_percent": paper,
                "difference_points": math.nan if paper is None else 100.0 * share.share - paper,
            }
        )
    return blocks


def _difference_text(points: float) -> str:
    mark = " (large)" if abs(points) > LARGE_POINTS else ""
    return NOTHING if math.isnan(points) else f"{points:+.1f} pp{mark}".replace("-", "−")


def _field_note(found: Sequence[Mapping[str, Any]]) -> str:
    """Definitions, the paper's misprints, and cells that differ."""
    definitions = note_text("dimes.field_test")
    if not any(one["paper_percent"] is not None for one in found):
        return definitions
    odd = [
        f"{run}, {category} ({row['valid']} + {row['invalid']} ≠ {row['total']})"
        for (category, run), row in FIG_11.items()
        if row["valid"] + row["invalid"] != row["total"]
    ]
    totals = sum(row["total"] for row in FIG_11.values())
    counts = sum(row["valid"] + row["invalid"] for row in FIG_11.values())
    large = [f"{one['category']}, {one['run']}" for one in found if abs(one["difference_points"]) > LARGE_POINTS]
    apart = f"More than {LARGE_POINTS:g} percentage points apart: {'; '.join(large)}." if large else ""
    return (
        f"{definitions} Misprints of the paper's table: the rows {'; '.join(odd)}; its totals sum to {totals:,}, its "
        f"counts to {counts:,}. We use its totals. Of Pisgah Run 3's same direction it prints 99 %, its counts 97 %. "
        f"{apart or f'No cell is more than {LARGE_POINTS:g} points apart.'}"
    )


def scatter_plates(subject: Subject) -> list[SvgFigure]:
    """Signed errors of each category on equal axes (the paper's Fig. 10)."""
    frame, metric = subject.frame, subject.metric
    parts = axis_columns(metric, [str(name) for name in frame.columns])[:2] if metric else []
    if len(parts) < 2:
        return []
    points = np.column_stack([numbers(frame, part) for part in parts])
    finite = np.isfinite(points).all(axis=1)
    if not finite.any():
        return []
    reach = 1.06 * max(float(np.abs(points[finite]).max()), subject.bound or 0.0)
    categories = [*(category for category, _ in FIG_11), *sorted(frame["category"].dropna().unique())]
    plates = []
    for place, category in enumerate(dict.fromkeys(str(one) for one in categories)):
        chosen = frame[finite & frame["category"].eq(category).to_numpy(dtype=np.bool_)]
        if len(chosen):
            caption = f"{category[:1].upper()}{category[1:]}: {count(len(chosen), 'valid triple')}."
            plates.append(plate(_scatter(chosen, parts, subject, reach), f"fieldtest{place}", caption))
    return plates


@in_page_style
def _scatter(chosen: kinds.Rows, parts: Sequence[str], subject: Subject, reach: float) -> Figure:
    figure, axes = new_axes(4.2, 4.4)
    runs = sorted(str(run) for run in subject.frame["run"].dropna().unique())
    for place, run in enumerate(runs):
        x, y = (numbers(chosen[chosen["run"].eq(run)], part) for part in parts)
        style: dict[str, Any] = {"marker": MARKERS[place % len(MARKERS)], "color": SERIES[place % len(SERIES)]}
        axes.plot(x, y, linestyle="", markersize=4.0, alpha=0.7, markeredgewidth=0.0, label=run, **style)
    if subject.bound is not None:
        axes.add_patch(Circle((0, 0), subject.bound, fill=False, color=REQUIREMENT, linewidth=1.6, linestyle="--"))
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    axes.set(xlabel=label(parts[0]), ylabel=label(parts[1]))
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2, handletextpad=0.2)
    return figure


_FIRING = "firing_velocity_error_m_s"
#: Error of the velocity propagated by the inertial unit to the thrusters' firing near 100 m (section I).
FIRING = kinds.SectionDeclaration(
    "firing",
    "Firing",
    "Error when the thrusters fire",
    rows=lambda subject: None if subject.metric == _FIRING else subject.frame,
    requires=(_FIRING,),
    parts=(
        kinds.Statistics(_FIRING),
        kinds.Quantiles(
            # time that DIMES and the computer have for their answer
            [kinds.Quantity("firing_after_s")],
            {"Minimum": 0.0, "Median": 0.5, "Maximum": 1.0},
            heading="Time from the last picture to the firing",
        ),
    ),
    note="The reported velocity is the mean over the second pair of pictures. The inertial unit adds the change until "
    "the firing; the error is relative to the camera's true velocity then, swinging included.",
)

WITH, WITHOUT = "touchdown_speed_corrected_m_s", "touchdown_speed_uncorrected_m_s"
#: Minimum difference of the speeds by which a landing is helped or harmed, m/s.
NOTABLE_M_S = 1.0
#: Speeds above which the table gives the fraction of cases, m/s.
SPEEDS_M_S = (5.0, 10.0, 15.0, 20.0, 25.0)


def _landing_rows(subject: Subject) -> pd.DataFrame | None:
    speeds = np.column_stack([numbers(subject.frame, name) for name in (WITH, WITHOUT)])
    landed = subject.frame[np.isfinite(speeds).all(axis=1)]
    return landed if len(landed) else None


def landing_shares(landed: kinds.Rows) -> dict[str, rates.Share]:
    """Landings that the answer helped and harmed, and answers in time for the thrusters' firing."""
    change = numbers(landed, WITH) - numbers(landed, WITHOUT)
    shares = {
        f"slower by more than {NOTABLE_M_S:g} m/s": rates.fraction_of(change < -NOTABLE_M_S, landed),
        f"faster by more than {NOTABLE_M_S:g} m/s": rates.fraction_of(change > NOTABLE_M_S, landed),
    }
    if rates.is_flag(landed, "answer_punctual"):
        name = "computed before the thrusters fired, of all landings"
        shares[name] = rates.fraction_of(rates.flag(landed, "answer_punctual"), landed)
    return shares


def _speeds(landed: kinds.Rows, subject: Subject, key: str) -> kinds.Drawn:
    columns, groups = [numbers(landed, name) for name in (WITH, WITHOUT)], rates.terrain_groups(landed)
    change = columns[0] - columns[1]
    rows = [["mean (m/s)", *(number(float(values.mean())) for values in columns)]]
    for probability in (0.5, 0.95, 0.99):
        texts = []
        for values in columns:
            bound = quantile_bounds(values, probability, CONFIDENCE, groups)[1]
            bounded = f" (≤ {number(bound)})" if np.isfinite(bound) else ""
            texts.append(f"{number(float(np.quantile(values, probability)))}{bounded}")
        rows.append([f"{format_fraction(probability)} quantile (its bound)", *texts])
    rows += [
        [f"faster than {speed:g} m/s", *(percent(float(np.mean(values > speed))) for values in columns)]
        for speed in SPEEDS_M_S
    ]
    helped, harmed, *_ = landing_shares(landed).values()
    data = {
        "landings": len(landed),
        "helped": helped.share,
        "harmed": harmed.share,
        "mean_with_m_s": float(columns[0].mean()),
        "mean_without_m_s": float(columns[1].mean()),
        "largest_gain_m_s": float(-change.min()),
        "largest_loss_m_s": float(change.max()),
    }
    gain, loss = number(data["largest_gain_m_s"]), number(data["largest_loss_m_s"])
    note = note_text("dimes.landing", confidence=format_fraction(CONFIDENCE), gain=gain, loss=loss)
    return [Block(heading="Horizontal speed at touchdown", grid=Grid(["", "With", "Without"], rows), note=note)], data


#: Effect of an estimator's answer on the landing: horizontal speed at touchdown with and without it.
LANDING = kinds.SectionDeclaration(
    "landing",
    "Landing",
    "Horizontal speed at the ground",
    rows=_landing_rows,
    parts=(
        kinds.Distribution(
            (kinds.Quantity(WITH, "with"), kinds.Quantity(WITHOUT, "without")),
            ("horizontal speed at touchdown (m/s)", "share of landings faster"),
            "Fraction of landings with a higher horizontal speed at touchdown.",
            falling=True,
        ),
        kinds.RateTable(landing_shares, cases="Landings", heading="Good and harm", data="shares"),
        kinds.MadeBy(_speeds),
    ),
)

#: Drivers that the paper compares, all of which must vary; and further ones.
ASKED = ("descent_rate_m_s", "altitude_1_m", "attitude_rate_max_deg_s")
FURTHER = ("off_nadir_max_deg", "horizontal_speed_m_s", "sun_elevation_deg")
MIN_CASES = 50
#: The same rows give the same page.
_SEED = 20050815


@dataclass(frozen=True)
class Driver:
    """Effect of one condition on the error's magnitude, each with its interval.

    low, high: 5 % and 95 % quantile of the condition
    coefficient: of a regression on all conditions, in standard deviations of condition and magnitude
    effect: change of the mean magnitude from `low` to `high` in that regression, in the error's unit
    """

    column: str
    low: float
    high: float
    rank_correlation: tuple[float, float, float]
    coefficient: tuple[float, float, float]
    effect: tuple[float, float, float]


def sensitivity_section(subject: Subject) -> Section | None:
    """Rank correlations and a standardised regression of the error on all conditions, with bootstrap intervals.

    None unless the paper's drivers vary and errors suffice. The paper (section III.C): "vertical velocity of the lander
    had much less of an effect on DIMES performance when compared to altitude and attitude rates".
    """
    metric = subject.metric
    drivers = [] if metric is None else rank_effects(subject, metric)
    if metric is None or not drivers:
        return None
    unit = split_unit(metric)[1]
    caption = f"Change of the mean {magnitude_label(metric)} from the 5 % to the 95 % quantile of each condition."
    drawn = plate(effect_figure(drivers, unit), "sensitivity", caption)
    note = note_text("dimes.sensitivity", metric=magnitude_label(metric), confidence=format_fraction(CONFIDENCE))
    rows = [
        [label(one.column), f"{number(one.low)} to {number(one.high)}"]
        + ["{} ({} to {})".format(*map(number, value)) for value in (one.rank_correlation, one.coefficient, one.effect)]
        for one in drivers
    ]
    head = ["", "5 % to 95 %", "Rank correlation", "Standardised coefficient", f"Effect ({unit})"]
    data = {"drivers": [asdict(driver) for driver in drivers]}
    blocks = [Block(plates=[drawn]), Block(grid=Grid(head, rows), note=note)]
    return Section("sensitivity", "Sensitivity", "Drivers of the error", blocks, data)


def rank_effects(subject: Subject, metric: str) -> list[Driver]:
    """The drivers, the paper's first; empty unless these vary and errors suffice."""
    frame = subject.frame
    magnitude = np.abs(numbers(frame, metric))
    columns = [name for name in (*ASKED, *FURTHER) if rates.varies(frame, name)]
    conditions = np.column_stack([numbers(frame, name) for name in columns]) if columns else np.zeros((len(frame), 0))
    finite = np.isfinite(magnitude) & np.isfinite(conditions).all(axis=1)
    if not set(ASKED) <= set(columns) or finite.sum() < MIN_CASES:
        return []
    x, y = conditions[finite], magnitude[finite]
    if np.ptp(y) == 0.0 or (np.ptp(x, axis=0) == 0.0).any():
        return []
    groups = rates.terrain_groups(frame[finite])
    weights = rates.bootstrap_weights(np.arange(y.size) if groups is None else groups, np.random.default_rng(_SEED))
    low, high = np.quantile(x, (0.05, 0.95), axis=0)
    slopes = regress_weighted(x / x.std(axis=0), y, weights)
    ranks = correlate_weighted(stats.rankdata(x, axis=0), stats.rankdata(y), weights)
    # the sample's own value, then the interval over the resamples
    values = [ranks, slopes / y.std(), slopes / x.std(axis=0) * (high - low)]
    blocks = []
    for k, name in enumerate(columns):
        intervals = [(float(one[0, k]), *rates.percentile_interval(one[1:, k])) for one in values]
        blocks.append(Driver(name, float(low[k]), float(high[k]), *intervals))
    return blocks


def regress_weighted(
    x: Float[np.ndarray, "n k"], y: Float[np.ndarray, " n"], weights: Float[np.ndarray, "b n"]
) -> Float[np.ndarray, "b k"]:
    """Slopes of weighted least squares of y on all columns of x with a constant, for every row of weights."""
    design = np.column_stack([np.ones(y.size), x - x.mean(axis=0)])
    normal = np.einsum("bn,ni,nj->bij", weights, design, design, optimize=True)
    right = np.einsum("bn,ni->bi", weights, design * y[:, None])
    # a resample of few terrains may have no spread along a direction: the pseudo-inverse gives slope 0
    return np.asarray(np.einsum("bij,bj->bi", np.linalg.pinv(normal, hermitian=True), right)[:, 1:])


def correlate_weighted(
    x: Float[np.ndarray, "n k"], y: Float[np.ndarray, " n"], weights: Float[np.ndarray, "b n"]
) -> Float[np.ndarray, "b k"]:
    """Correlations of y with each column of x, for every row of weights; of ranks, ranked once in the whole sample."""
    w = weights / weights.sum(axis=1, keepdims=True)
    x, y = x - x.mean(axis=0), y - y.mean()
    mean_x, mean_y = w @ x, (w @ y)[:, None]
    covariance = w @ (x * y[:, None]) - mean_x * mean_y
    variances = (w @ (x * x) - mean_x**2) * ((w @ (y * y))[:, None] - mean_y**2)
    return np.asarray(covariance / np.sqrt(np.maximum(variances, np.finfo(np.float64).tiny)))


@in_page_style
def effect_figure(drivers: Sequence[Driver], unit: str) -> Figure:
    """The effects with their intervals."""
    figure, axes = new_axes(6.4, 0.9 + 0.36 * len(drivers))
    places = np.arange(len(drivers))
    effects = np.array([driver.effect for driver in drivers])
    axes.hlines(places, effects[:, 1], effects[:, 2], color=SERIES[0], linewidth=5.0, alpha=0.45)
    axes.plot(effects[:, 0], places, "o", color=SERIES[0])
    axes.axvline(0.0, color=MUTED, linewidth=0.8)
    axes.set_yticks(places, [label(driver.column) for driver in drivers])
    axes.set(xlabel=f"change of the mean magnitude ({unit})", ylim=(len(drivers) - 0.5, -0.5))
    axes.grid(visible=False, axis="y")
    return figure
