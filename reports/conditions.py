"""Report section on errors and answers by condition: a table for each condition, a row for each of its bins.

A condition is a column such as the sun elevation; a bin is one of its values, or an interval of values.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from scipy import stats

from marsyard.reports import populations, rates
from marsyard.reports.column_selection import axis_columns
from marsyard.reports.column_values import numbers
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Block, Grid, Section, Subject
from marsyard.reports.statistics.drivers import mean_squares
from marsyard.reports.statistics.samples import quantile_bounds
from marsyard.reports.wording import format_fraction, label, note_text, number, percent, plain_value
from marsyard.scenarios.columns import split_unit


@dataclass(frozen=True)
class TerrainVariance:
    """Variance of an error column (`part`) with terrains as random effects.

    - terrains: number of terrains
    - within_sd, between_sd: standard deviations of errors within a terrain, and of the terrains' means
    - fraction: fraction of the variance between terrains (intraclass correlation)
    - p_value: p-value of equal means (F-test); NaN without a variance within terrains
    """

    part: str
    terrains: int
    within_sd: float
    between_sd: float
    fraction: float
    p_value: float


def terrain_variance(frame: pd.DataFrame, column: str) -> TerrainVariance | None:
    """Analyse the variance of an error column with terrains as random effects; None without repeated terrains."""
    groups = rates.terrain_groups(frame)
    values = numbers(frame, column)
    finite = np.isfinite(values) & populations.population_mask(frame, "valid")
    if groups is None or not finite.any():
        return None
    _, index = np.unique(groups[finite], return_inverse=True)
    cases, terrains = index.size, int(index.max()) + 1
    if terrains < 2 or cases == terrains:
        return None
    within, between, effective_size = mean_squares(values[finite], index)
    variance_between = max(between - within, 0.0) / effective_size
    p_value = float(stats.f.sf(between / within, terrains - 1, cases - terrains)) if within > 0.0 else float("nan")
    variance = variance_between + within
    return TerrainVariance(
        part=column,
        terrains=terrains,
        within_sd=float(np.sqrt(within)),
        between_sd=float(np.sqrt(variance_between)),
        fraction=variance_between / variance if variance > 0.0 else 0.0,
        p_value=p_value,
    )


#: Prefixes of the condition columns in the order of the page; the first column with each prefix is used.
CONDITIONS = (
    "altitude_1", "altitude_m", "attitude_rate_max", "off_nadir_max", "site", "relief", "rms_slope",
    "sun_elevation", "sun_azimuth", "image_contrast", "image_patchiness", "dust_opacity", "abundance", "rock_abundance",
    "defocus", "stray_light", "horizontal_speed", "camera", "rock_diameter", "slip_mean", "max_tilt",
    "pose_error_fraction",
)  # fmt: skip
#: A column with at most `MAX_VALUES` values has a row for each value, if the mean number of cases per value is at least
#: `CASES_PER_VALUE`.
MAX_VALUES, CASES_PER_VALUE = 12, 10
#: Other columns of numbers have 2 to `MAX_BINS` intervals with equal numbers of cases, about `CASES_PER_BIN` each.
CASES_PER_BIN, MAX_BINS = 40, 5
#: Quantile of the errors whose upper bound is in the tables.
QUANTILE = 0.99
#: Name of a bin, and mask of its cases.
NamedMask = tuple[str, Bool[np.ndarray, " n"]]
#: Names of the world axes.
_AXIS_NAMES = {"x": "east", "y": "north", "z": "up"}
_TERRAINS_NOTE = note_text("common.terrains")


def conditions_section(subject: Subject) -> Section | None:
    """Create the section on errors by condition; None without errors, answers or a condition that varies."""
    frame, metric = subject.frame, subject.metric
    if metric is None or not populations.is_flag(frame, "answered"):
        return None
    tables = {
        column: [_summarize_bin(frame[mask], metric, name) for name, mask in bins]
        for column, bins in bin_conditions(frame, subject.run.is_condition)
    }
    terrain_rows = [
        row
        for component in _signed_components(frame, metric)
        if (row := terrain_variance(frame, component)) is not None
    ]
    if not tables and not terrain_rows:
        return None
    blocks = [Block(heading=f"By {label(name)}", grid=_bin_grid(frame, metric, bins)) for name, bins in tables.items()]
    if terrain_rows:
        head = ["", "Terrains", "SD within terrains", "SD between terrains", "Fraction between terrains", "p"]
        rows = []
        for row in terrain_rows:
            deviations = [number(row.within_sd), number(row.between_sd)]
            texts = [label(row.part), f"{row.terrains:,}", *deviations, percent(row.fraction)]
            rows.append([*texts, number(row.p_value)])
        blocks.append(Block(heading="By terrain", grid=Grid(head, rows), note=_TERRAINS_NOTE))
    note = note_text("common.conditions", confidence=format_fraction(CONFIDENCE), quantile=format_fraction(QUANTILE))
    data = {**tables, "between_terrains": terrain_rows}
    title = "Errors and answers by condition"
    return Section("conditions", "Conditions", title, [*blocks, Block(note=note)], data)


def bin_conditions(frame: pd.DataFrame, is_condition: Callable[[str], bool]) -> Iterator[tuple[str, list[NamedMask]]]:
    """Yield each condition that varies: its column, and the names and masks of its bins."""
    candidates = [name for name in map(str, frame.columns) if is_condition(name)]
    for prefix in CONDITIONS:
        columns = (name for name in candidates if f"{name.rpartition('.')[2]}_".startswith(f"{prefix}_"))
        column = next(columns, None)
        if column is None:
            continue
        n_values = frame[column].dropna().nunique()
        if 2 <= n_values <= MAX_VALUES and len(frame) >= CASES_PER_VALUE * n_values:
            yield column, _bin_by_value(frame[column])
        elif n_values > 2 and pd.api.types.is_numeric_dtype(frame[column].dtype):
            yield column, _bin_by_interval(numbers(frame, column))


def _bin_by_value(values: pd.Series) -> list[NamedMask]:
    """Create a bin for each value, in order."""
    distinct = sorted(values.dropna().unique(), key=lambda value: (isinstance(value, str), value))
    return [(plain_value(value), values.eq(value).fillna(False).to_numpy(dtype=np.bool_)) for value in distinct]


def _bin_by_interval(values: Float[np.ndarray, " n"]) -> list[NamedMask]:
    """Create bins of about the same number of cases; each contains its lower end, the last one also its upper end."""
    is_finite = np.isfinite(values)
    n_bins = int(np.clip(is_finite.sum() // CASES_PER_BIN, 2, MAX_BINS))
    # quantiles are equal where many cases have the same value
    edges = np.unique(np.quantile(values[is_finite], np.linspace(0.0, 1.0, n_bins + 1)))
    bin_numbers = np.where(is_finite, np.digitize(values, edges[1:-1]), -1)
    names = [f"{number(low)} to {number(high)}" for low, high in pairwise(edges.tolist())]
    return [(name, bin_numbers == index) for index, name in enumerate(names)]


@dataclass(frozen=True)
class BinSummary:
    """Answers and errors of the cases in a bin.

    - answered: fraction of answered cases
    - means, sds: mean and standard deviation of the signed errors, by component; NaN for too few answers
    - quantile_bound: upper confidence bound of the quantile `QUANTILE` of the magnitude; infinite for too few answers
    - largest: largest magnitude; NaN without an answer
    """

    name: str
    answered: rates.CaseFraction
    means: Sequence[float]
    sds: Sequence[float]
    quantile_bound: float
    largest: float


def _summarize_bin(rows: pd.DataFrame, metric: str, name: str) -> BinSummary:
    """Summarize the rows of a bin with this name."""
    is_answered = populations.population_mask(rows, "valid")
    answered_rows = rows[is_answered]
    magnitude, groups = np.abs(numbers(answered_rows, metric)), rates.terrain_groups(answered_rows)
    finite = np.isfinite(magnitude)
    magnitude, finite_groups = magnitude[finite], None if groups is None else groups[finite]
    components = [rates.finite_values(answered_rows, column) for column in _signed_components(rows, metric)]
    _, quantile_bound = quantile_bounds(magnitude, QUANTILE, CONFIDENCE, finite_groups)
    return BinSummary(
        name=name,
        answered=rates.fraction_of(is_answered, rows),
        means=[float(component.mean()) if component.size else float("nan") for component in components],
        sds=[float(component.std(ddof=1)) if component.size > 1 else float("nan") for component in components],
        quantile_bound=quantile_bound,
        largest=float(magnitude.max()) if magnitude.size else float("nan"),
    )


def _bin_grid(frame: pd.DataFrame, metric: str, bins: Sequence[BinSummary]) -> Grid:
    """Create the table of a condition: a row for each of its bins."""
    columns = _signed_components(frame, metric)
    axes = (
        [""]
        if columns == [metric]
        else [f", {_AXIS_NAMES[split_unit(component)[0].rsplit('_', 1)[-1]]}" for component in columns]
    )
    unit = split_unit(metric)[1]
    head = ["", "Cases", "Answered", f"{format_fraction(CONFIDENCE)} interval"]
    head += [f"{statistic}{axis} ({unit})" for axis in axes for statistic in ("Mean", "SD")]
    has_bounds = any(np.isfinite(row.quantile_bound) for row in bins)
    head += [f"Bound of the {format_fraction(QUANTILE)} quantile ({unit})"] if has_bounds else []
    head += [f"Maximum ({unit})"]
    rows = []
    for row in bins:
        component_texts = [number(value) for pair in zip(row.means, row.sds, strict=True) for value in pair]
        answered, bound = row.answered, row.quantile_bound
        last_texts = [number(bound) if np.isfinite(bound) else "too few cases"] if has_bounds else []
        last_texts.append(number(row.largest))
        interval = rates.range_text(*answered.clustered_interval)
        rows.append([row.name, f"{answered.n:,}", percent(answered.fraction), interval, *component_texts, *last_texts])
    return Grid(head, rows)


def _signed_components(frame: pd.DataFrame, metric: str) -> list[str]:
    """Return the columns of the metric's signed components (x, y), or the metric itself if it has none."""
    return axis_columns(metric, [str(name) for name in frame.columns]) or [metric]
