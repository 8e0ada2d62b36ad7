"""Errors and answers by what the case was like: a table for each condition, cut into bins of as many cases each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from scipy import stats

from marsyard.reports.columns import axis_columns, label, numbers, split_unit
from marsyard.reports.populations import is_flag, members, terrain_groups
from marsyard.reports.rates import CONFIDENCE, Share, range_text, share_of
from marsyard.reports.section import Block, Grid, Section, Subject, grid_of
from marsyard.reports.statistics.samples import quantile_bounds
from marsyard.reports.wording import number, percent, stated

#: Beginnings of the columns by which errors are sorted, in the order of the page; the first column of each counts.
CONDITIONS = (
    "altitude_1",
    "altitude_m",
    "attitude_rate_max",
    "off_nadir_max",
    "site",
    "terrain_kind",
    "relief",
    "rms_slope",
    "sun_elevation",
    "horizontal_speed",
    "camera",
    "rock_diameter",
    "slip_mean",
    "tilt_max",
    "pose_error_share",
)
#: Kinds up to this many are told one by one if each has so many cases on average; numbers of more values are cut into
#: bins.
MOST_KINDS, CASES_PER_KIND = 12, 10
#: Cases in a bin, at least where there are enough for two; and most bins of a condition.
CASES_PER_BIN, MOST_BINS = 40, 5
QUANTILE = 0.99


@dataclass(frozen=True)
class Bin:
    """Cases of one condition.

    Attributes
    ----------
    name
        What they have in common.
    answered
        The share that was answered.
    means, sds
        Mean and standard deviation of the error's signed parts, in the order of `axis_columns`; NaN for too few.
    quantile_bound
        Upper bound of the magnitude's 99 % quantile at 90 % confidence; infinite where the cases are too few.
    largest
        The largest magnitude; NaN for none.
    """

    name: str
    answered: Share
    means: Sequence[float]
    sds: Sequence[float]
    quantile_bound: float
    largest: float


def conditions_section(subject: Subject) -> Section | None:
    """Errors by condition; None where the rows hold no errors, no answers or no condition that varies."""
    frame, metric = subject.frame, subject.metric
    if metric is None or not is_flag(frame, "answered"):
        return None
    tables = {column: [_bin(frame[chosen], metric, name) for name, chosen in bins] for column, bins in cuts(frame)}
    spread = [terrain_spread(frame, part) for part in _parts(frame, metric)]
    known = [one for one in spread if one is not None]
    if not tables and not known:
        return None
    blocks = [Block(heading=f"By {label(column)}", grid=_grid(frame, metric, bins)) for column, bins in tables.items()]
    if known:
        blocks.append(Block(heading="By terrain", grid=_spread_grid(known), note=_SPREAD_NOTE))
    note = (
        "Bins hold as many cases each. Answered: with its two-sided Clopper-Pearson interval at "
        f"{stated(CONFIDENCE)} confidence, which allows for shared terrains. Mean and standard deviation of the errors "
        f"of the answers. Bound: what the {stated(QUANTILE)} quantile of the magnitude does not exceed, at "
        f"{stated(CONFIDENCE)} confidence (order statistics); it takes 230 answers, or as many terrains where they are "
        "shared."
    )
    data: dict[str, Any] = {column: [asdict(one) for one in bins] for column, bins in tables.items()}
    data["between_terrains"] = [asdict(one) for one in known]
    title = "Errors and answers by condition"
    return Section("conditions", "Conditions", title, [*blocks, Block(note=note)], data)


def cuts(frame: pd.DataFrame) -> Iterator[tuple[str, list[tuple[str, Bool[np.ndarray, " n"]]]]]:
    """Every condition that varies: its column, and its bins with their names and members."""
    for start in CONDITIONS:
        columns = [str(name) for name in frame.columns if name == start or str(name).startswith(f"{start}_")]
        for column in columns[:1]:
            kinds = frame[column].dropna().nunique()
            if 2 <= kinds <= MOST_KINDS and len(frame) >= CASES_PER_KIND * kinds:
                yield column, _kinds(frame[column])
            elif kinds > 2 and pd.api.types.is_numeric_dtype(frame[column].dtype):
                yield column, _bins(numbers(frame, column))


@dataclass(frozen=True)
class TerrainSpread:
    """One part of the error between and within terrains: analysis of variance with terrains as random effects.

    Attributes
    ----------
    part
        The error's column.
    terrains
        Terrains with an answer.
    within_sd, between_sd
        Standard deviations of single errors about their terrain's mean, and of the terrains' means in the long run.
    share
        Part of the variance that lies between terrains, 0 to 1 (intraclass correlation; 0 where none shows).
    p_value
        Probability of means so different were terrains all alike (F-test).
    """

    part: str
    terrains: int
    within_sd: float
    between_sd: float
    share: float
    p_value: float


_SPREAD_NOTE = (
    "Analysis of variance over the answers: how much errors on one terrain differ, and how much more terrains do. A "
    "small p says that terrains matter."
)


def terrain_spread(frame: pd.DataFrame, part: str) -> TerrainSpread | None:
    """The spread of errors between terrains; None where no terrain has two answers, or one alone has any."""
    groups = terrain_groups(frame)
    values = numbers(frame, part)
    known = np.isfinite(values) & members(frame, "valid")
    if groups is None or not known.any():
        return None
    _, index = np.unique(groups[known], return_inverse=True)
    errors, sizes = values[known], np.bincount(index).astype(np.float64)
    n, k = errors.size, sizes.size
    if k < 2 or n == k:
        return None
    means = np.bincount(index, weights=errors) / sizes
    within = float(((errors - means[index]) ** 2).sum()) / (n - k)
    between = float((sizes * (means - errors.mean()) ** 2).sum()) / (k - 1)
    size = (n - float((sizes**2).sum()) / n) / (k - 1)
    variance = max(between - within, 0.0) / size
    return TerrainSpread(
        part=part,
        terrains=k,
        within_sd=float(np.sqrt(within)),
        between_sd=float(np.sqrt(variance)),
        share=variance / (variance + within) if variance + within > 0.0 else 0.0,
        p_value=float(stats.f.sf(between / within, k - 1, n - k)) if within > 0.0 else float("nan"),
    )


def _spread_grid(spread: Sequence[TerrainSpread]) -> Grid:
    return grid_of(
        spread,
        {
            "": lambda one: label(one.part),
            "Terrains": lambda one: f"{one.terrains:,}",
            "SD within": lambda one: number(one.within_sd),
            "SD between": lambda one: number(one.between_sd),
            "Share of variance between": lambda one: percent(one.share),
            "p": lambda one: number(one.p_value),
        },
    )


def _kinds(values: pd.Series) -> list[tuple[str, Bool[np.ndarray, " n"]]]:
    found = sorted(values.dropna().unique(), key=lambda value: (isinstance(value, str), value))
    return [(_plain(value), values.eq(value).fillna(False).to_numpy(dtype=np.bool_)) for value in found]


def _bins(values: Float[np.ndarray, " n"]) -> list[tuple[str, Bool[np.ndarray, " n"]]]:
    """Bins of as many cases each; cases without a value are in none."""
    known = values[np.isfinite(values)]
    count = int(np.clip(known.size // CASES_PER_BIN, 2, MOST_BINS))
    edges = np.unique(np.quantile(known, np.linspace(0.0, 1.0, count + 1)))
    places = np.digitize(values, edges[1:-1])
    ranges = pairwise(edges.tolist())
    return [
        (f"{number(low)} to {number(high)}", np.isfinite(values) & (places == k))
        for k, (low, high) in enumerate(ranges)
    ]


def _bin(chosen: pd.DataFrame, metric: str, name: str) -> Bin:
    answered = members(chosen, "valid")
    valid = chosen[answered]
    magnitude, groups = np.abs(numbers(valid, metric)), terrain_groups(valid)
    finite = np.isfinite(magnitude)
    magnitude, shared = magnitude[finite], None if groups is None else groups[finite]
    parts = [numbers(valid, part) for part in _parts(chosen, metric)]
    parts = [part[np.isfinite(part)] for part in parts]
    return Bin(
        name=name,
        answered=share_of(answered, chosen),
        means=[float(part.mean()) if part.size else float("nan") for part in parts],
        sds=[float(part.std(ddof=1)) if part.size > 1 else float("nan") for part in parts],
        quantile_bound=quantile_bounds(magnitude, QUANTILE, CONFIDENCE, shared)[1],
        largest=float(magnitude.max()) if magnitude.size else float("nan"),
    )


def _grid(frame: pd.DataFrame, metric: str, bins: Sequence[Bin]) -> Grid:
    columns = _parts(frame, metric)
    axes = [""] if columns == [metric] else [f" {split_unit(part)[0].rsplit('_', 1)[-1]}" for part in columns]
    unit = split_unit(metric)[1]
    head = ["", "Cases", "Answered", "Interval"]
    head += [f"{what}{axis} ({unit})" for axis in axes for what in ("Mean", "SD")]
    head += [f"{stated(QUANTILE)} bound", "Largest"]
    rows = []
    for one in bins:
        of_parts = [number(value) for pair in zip(one.means, one.sds, strict=True) for value in pair]
        share = one.answered
        ends = [number(one.quantile_bound) if np.isfinite(one.quantile_bound) else "n too small", number(one.largest)]
        interval = range_text(share.sound_lower, share.sound_upper)
        rows.append([one.name, f"{share.n:,}", percent(share.share), interval, *of_parts, *ends])
    return Grid(head, rows)


def _parts(frame: pd.DataFrame, metric: str) -> list[str]:
    """The metric's signed parts; the metric itself where it has none."""
    return axis_columns(metric, [str(name) for name in frame.columns]) or [metric]


def _plain(value: object) -> str:
    return str(int(value)) if isinstance(value, float | np.floating) and float(value).is_integer() else str(value)
