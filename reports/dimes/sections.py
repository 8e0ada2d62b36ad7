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

from marsyard.reports.columns import axis_columns, label, magnitude_label, numbers, split_unit
from marsyard.reports.kinds import (
    Distribution,
    Drawn,
    MadeBy,
    Quantiles,
    Quantity,
    RateTable,
    Rows,
    SectionDeclaration,
    Statistics,
)
from marsyard.reports.papers import read_paper
from marsyard.reports.populations import is_flag, members, terrain_groups
from marsyard.reports.rates import (
    CONFIDENCE,
    Share,
    bootstrap_weights,
    flag,
    percentile_interval,
    range_text,
    share_of,
    varies,
)
from marsyard.reports.section import Block, Grid, Plate, Section, Subject, grid_of, plate
from marsyard.reports.statistics.samples import quantile_bounds
from marsyard.reports.svg import MARKERS, MUTED, REQUIREMENT, SERIES, in_page_style, new_axes
from marsyard.reports.wording import NOTHING, count, number, percent, stated

#: Rows of the paper's Fig. 11 by (category, run).
FIG_11: Mapping[tuple[str, str], Mapping[str, Any]] = {
    (group["category"], row["run"]): row
    for group in read_paper(Path(__file__).with_name("paper.toml"))["fig_11"]
    for row in group["runs"]
}
#: Difference from the paper that is called large, percentage points.
LARGE_POINTS = 10.0


def field_test_section(subject: Subject) -> Section | None:
    """The field test's runs and categories next to the paper's (its Fig. 11), and errors by category (its Fig. 10);
    None where the rows do not say which `run` and `category` they are of.
    """
    frame, bound = subject.frame, subject.bound
    if not {"run", "category"}.issubset(frame.columns) or not is_flag(frame, "answered"):
        return None
    found = field_cells(subject)
    grid = grid_of(
        found,
        {
            "Category and run": lambda one: f"{one['category']}: {one['run']}",
            "Triples": lambda one: f"{one['valid'].n:,}",
            "Valid": lambda one: f"{one['valid'].hits:,}",
            "% valid": lambda one: percent(one["valid"].share),
            f"{stated(CONFIDENCE)} interval": lambda one: range_text(one["valid"].lower, one["valid"].upper),
            "Paper": lambda one: NOTHING if one["paper_percent"] is None else f"{one['paper_percent']} %",
            "Difference": lambda one: _points(one["difference_points"]),
            "Beyond the bound" if bound is None else f"Beyond {bound:g}": lambda one: (
                NOTHING if one["beyond"] is None else f"{one['beyond']:,}"
            ),
            "Largest error": lambda one: number(one["largest"]),
        },
    )
    blocks = [Block(grid=grid, note=_field_note(found))]
    plates = scatter_plates(subject)
    if plates:
        note = ""
        if bound is not None and subject.metric is not None:
            note = (
                f"As the paper's Fig. 10: errors of the valid triples; the dashed circle is {bound:g} "
                f"{split_unit(subject.metric)[1]}. East is x, north is y."
            )
        blocks.append(Block(heading="Errors by category", plates=plates, note=note))
    data = {"cells": [one | {"valid": asdict(one["valid"])} for one in found]}
    return Section("field-test", "Field test", "Runs and categories, next to the paper's Fig. 11", blocks, data)


def field_cells(subject: Subject) -> list[dict[str, Any]]:
    """Every category and run, in the paper's order, then in that of the rows: the `Share` with an answer (`valid`),
    answers beyond the bound, the largest error, the paper's per cent valid, and ours less the paper's.
    """
    frame, found = subject.frame, []
    named = frame[["category", "run"]].dropna().drop_duplicates()
    pairs = [(str(category), str(run)) for category, run in named.itertuples(index=False)]
    for category, run in [*(pair for pair in FIG_11 if pair in pairs), *(pair for pair in pairs if pair not in FIG_11)]:
        chosen = frame[frame["category"].eq(category) & frame["run"].eq(run)]
        answered = members(chosen, "valid")
        errors = np.abs(numbers(chosen[answered], subject.metric)) if subject.metric else np.array([])
        errors = errors[np.isfinite(errors)]
        share, paper = share_of(answered, chosen), FIG_11.get((category, run), {}).get("percent")
        found.append(
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
    return found


def _points(difference: float) -> str:
    if math.isnan(difference):
        return NOTHING
    mark = " (large)" if abs(difference) > LARGE_POINTS else ""
    return f"{difference:+.1f} pp{mark}".replace("-", "−")


def _field_note(found: Sequence[Mapping[str, Any]]) -> str:
    """What a reader must know of the table: the paper's misprints, and which cells differ."""
    said = (
        "Difference: ours less the paper's, in percentage points (pp). Intervals: two-sided, Clopper and Pearson, as "
        "for independent triples; triples of a run share its pictures and are not."
    )
    if not any(one["paper_percent"] is not None for one in found):
        return said
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
        f"{said} Misprints of the paper's table: the rows {'; '.join(odd)}; its totals sum to {totals:,}, its counts "
        f"to {counts:,}. Its totals are taken. Of Pisgah Run 3's same direction it prints 99 %, its counts give 97 %. "
        f"{apart or f'No cell is more than {LARGE_POINTS:g} points apart.'}"
    )


def scatter_plates(subject: Subject) -> list[Plate]:
    """Signed errors of each category, on axes of one size (the paper's Fig. 10)."""
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
def _scatter(chosen: Rows, parts: Sequence[str], subject: Subject, reach: float) -> Figure:
    """Errors of one category, marked by run."""
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
#: The error of a velocity after the inertial unit has carried it on to the thrusters' firing near 100 m (section I).
FIRING = SectionDeclaration(
    "firing",
    "Firing",
    "Error when the thrusters fire",
    rows=lambda subject: None if subject.metric == _FIRING else subject.frame,
    requires=(_FIRING,),
    parts=(
        Statistics(_FIRING),
        Quantiles(
            # what DIMES and the computer have for their answer
            [Quantity("firing_after_s")],
            {"Least": 0.0, "Median": 0.5, "Greatest": 1.0},
            heading="Time from the last picture to the firing",
        ),
    ),
    note="The velocity reported is the mean over the second pair of pictures. The inertial unit adds its change until "
    "the firing; the error is held against the camera's true velocity there, swinging included.",
)

WITH, WITHOUT = "touchdown_speed_with_m_s", "touchdown_speed_without_m_s"
#: A landing is helped or harmed where the speeds differ by more than this, m/s.
NOTABLE_M_S = 1.0
#: Speeds above which the table gives the fraction of cases, m/s.
SPEEDS_M_S = (5.0, 10.0, 15.0, 20.0, 25.0)


def _landed(subject: Subject) -> pd.DataFrame | None:
    """Descents whose touchdown is known with the answer and without it."""
    speeds = np.column_stack([numbers(subject.frame, name) for name in (WITH, WITHOUT)])
    landed = subject.frame[np.isfinite(speeds).all(axis=1)]
    return landed if len(landed) else None


def _change(landed: Rows) -> Float[np.ndarray, " n"]:
    return np.asarray(numbers(landed, WITH) - numbers(landed, WITHOUT))


def landing_shares(landed: Rows) -> dict[str, Share]:
    """Landings that the answer helped and harmed, and answers that were there when the thrusters fired."""
    change = _change(landed)
    shares = {
        f"slower by more than {NOTABLE_M_S:g} m/s": share_of(change < -NOTABLE_M_S, landed),
        f"faster by more than {NOTABLE_M_S:g} m/s": share_of(change > NOTABLE_M_S, landed),
    }
    if is_flag(landed, "answer_punctual"):
        in_time = share_of(flag(landed, "answer_punctual"), landed)
        shares["computed before the thrusters fired, of all landings"] = in_time
    return shares


def _speeds(landed: Rows, subject: Subject, key: str) -> Drawn:
    """Mean, quantiles with bounds, and shares above round speeds; gains and losses."""
    del subject, key
    columns, groups, change = (
        [numbers(landed, name) for name in (WITH, WITHOUT)],
        terrain_groups(landed),
        _change(landed),
    )
    rows = [["mean (m/s)", *(number(float(values.mean())) for values in columns)]]
    for probability in (0.5, 0.95, 0.99):
        texts = []
        for values in columns:
            bound = quantile_bounds(values, probability, CONFIDENCE, groups)[1]
            bounded = f" (≤ {number(bound)})" if np.isfinite(bound) else ""
            texts.append(f"{number(float(np.quantile(values, probability)))}{bounded}")
        rows.append([f"{stated(probability)} quantile (its bound)", *texts])
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
    note = (
        "The same descents, with the answer used and not used. Intervals: two-sided, Clopper and Pearson, at "
        f"{stated(CONFIDENCE)} confidence, which allow for shared terrains. Largest gain and loss: {gain} and {loss} "
        "m/s."
    )
    return [Block(heading="Horizontal speed at touchdown", grid=Grid(["", "With", "Without"], rows), note=note)], data


#: What an estimator's answer does to the landing: horizontal speed at touchdown with and without it.
LANDING = SectionDeclaration(
    "landing",
    "Landing",
    "Horizontal speed at the ground",
    rows=_landed,
    parts=(
        Distribution(
            (Quantity(WITH, "with"), Quantity(WITHOUT, "without")),
            ("horizontal speed at touchdown (m/s)", "share of landings faster"),
            "Share of landings with a horizontal speed at touchdown of more than so much.",
            falling=True,
        ),
        RateTable(landing_shares, cases="Landings", heading="Good and harm", data="shares"),
        MadeBy(_speeds),
    ),
)

#: The drivers that the paper compares: all must be there and vary for the section to be shown; and further ones.
ASKED = ("descent_rate_m_s", "altitude_1_m", "attitude_rate_max_deg_s")
FURTHER = ("off_nadir_max_deg", "horizontal_speed_m_s", "sun_elevation_deg")
FEWEST_CASES = 50
#: The same rows give the same page.
_SEED = 20050815


@dataclass(frozen=True)
class Driver:
    """What one condition does to the magnitude of the error; values with their intervals.

    Attributes
    ----------
    column
        The condition.
    low, high
        Its 5 % and 95 % quantiles.
    rank_correlation
        Spearman's.
    coefficient
        Change of the mean magnitude per standard deviation of the condition, the others held, over the standard
        deviation of the magnitude.
    effect
        Change of the mean magnitude from `low` to `high`, the others held, in the error's unit.
    """

    column: str
    low: float
    high: float
    rank_correlation: tuple[float, float, float]
    coefficient: tuple[float, float, float]
    effect: tuple[float, float, float]


def sensitivity_section(subject: Subject) -> Section | None:
    """What drives the error: rank correlations and a standardised regression on all conditions at once, with bootstrap
    intervals; None where the paper's drivers do not all vary or errors are too few.

    The paper says that "vertical velocity of the lander had much less of an effect on DIMES performance when compared
    to altitude and attitude rates" (section III.C), and flew a helicopter for that.
    """
    metric = subject.metric
    drivers = [] if metric is None else analyse(subject, metric)
    if metric is None or not drivers:
        return None
    unit = split_unit(metric)[1]
    caption = f"Change of the mean {magnitude_label(metric)} from the 5 % to the 95 % quantile of each condition."
    drawn = plate(effect_figure(drivers, unit), "sensitivity", caption)
    note = (
        f"Regression of {magnitude_label(metric)} on all conditions at once, cases with an answer only. Intervals: "
        f"{stated(CONFIDENCE)}, by bootstrap over terrains where cases share them, else over cases. Effect: from the "
        "5 % to the 95 % quantile of the condition, the others held."
    )
    grid = grid_of(
        drivers,
        {
            "": lambda one: label(one.column),
            "5 % to 95 %": lambda one: f"{number(one.low)} to {number(one.high)}",
            "Rank correlation": lambda one: _interval_text(one.rank_correlation),
            "Standardised coefficient": lambda one: _interval_text(one.coefficient),
            f"Effect ({unit})": lambda one: _interval_text(one.effect),
        },
    )
    data = {"drivers": [asdict(driver) for driver in drivers]}
    blocks = [Block(plates=[drawn]), Block(grid=grid, note=note)]
    return Section("sensitivity", "Sensitivity", "What drives the error", blocks, data)


def _interval_text(value: tuple[float, float, float]) -> str:
    return f"{number(value[0])} ({number(value[1])} to {number(value[2])})"


def analyse(subject: Subject, metric: str) -> list[Driver]:
    """The drivers, the paper's first; none where these do not all vary or errors are too few."""
    frame = subject.frame
    magnitude = np.abs(numbers(frame, metric))
    columns = [name for name in (*ASKED, *FURTHER) if varies(frame, name)]
    conditions = np.column_stack([numbers(frame, name) for name in columns]) if columns else np.zeros((len(frame), 0))
    finite = np.isfinite(magnitude) & np.isfinite(conditions).all(axis=1)
    if not set(ASKED) <= set(columns) or finite.sum() < FEWEST_CASES:
        return []
    x, y = conditions[finite], magnitude[finite]
    if np.ptp(y) == 0.0 or (np.ptp(x, axis=0) == 0.0).any():
        return []
    groups = terrain_groups(frame[finite])
    weights = bootstrap_weights(np.arange(y.size) if groups is None else groups, np.random.default_rng(_SEED))
    low, high = np.quantile(x, (0.05, 0.95), axis=0)
    slopes = regressions(x / x.std(axis=0), y, weights)
    ranks = weighted_correlations(stats.rankdata(x, axis=0), stats.rankdata(y), weights)
    # the sample's own value, then the interval over the resamples
    values = [ranks, slopes / y.std(), slopes / x.std(axis=0) * (high - low)]
    intervals = [[(float(one[0, k]), *percentile_interval(one[1:, k])) for one in values] for k in range(len(columns))]
    return [Driver(name, float(low[k]), float(high[k]), *intervals[k]) for k, name in enumerate(columns)]


def regressions(
    x: Float[np.ndarray, "n k"], y: Float[np.ndarray, " n"], weights: Float[np.ndarray, "b n"]
) -> Float[np.ndarray, "b k"]:
    """Slopes of weighted least squares of y on all columns of x with a constant, for every row of weights."""
    design = np.column_stack([np.ones(y.size), x - x.mean(axis=0)])
    normal = np.einsum("bn,ni,nj->bij", weights, design, design, optimize=True)
    right = np.einsum("bn,ni->bi", weights, design * y[:, None])
    # A resample of few terrains may leave a direction without spread: the pseudo-inverse gives it no slope.
    return np.asarray(np.einsum("bij,bj->bi", np.linalg.pinv(normal, hermitian=True), right)[:, 1:])


def weighted_correlations(
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
    """The effects with their intervals, a line each."""
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
