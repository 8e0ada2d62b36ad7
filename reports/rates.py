"""Rates and statistics of rows: fractions with confidence intervals, pooled rates, quantiles, groups, and texts."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int

from marsyard.reports.column_values import numbers
from marsyard.reports.statistics.clustered_cases import ClusteredCases
from marsyard.reports.statistics.proportions import Interval, proportion_interval
from marsyard.reports.statistics.samples import is_interpolated
from marsyard.reports.wording import NOTHING, number, percent


def terrain_groups(frame: pd.DataFrame) -> Int[np.ndarray, " n"] | None:
    """Return each case's terrain index from 0; None if no terrain is known. An unknown terrain has its own index."""
    if "terrain" not in frame or bool(frame["terrain"].isna().all()):
        return None
    codes, terrain_names = pd.factorize(frame["terrain"])
    groups = np.array(codes, dtype=np.int64)
    is_unknown = groups < 0
    groups[is_unknown] = len(terrain_names) + np.arange(int(is_unknown.sum()))
    return groups


#: Confidence of the two-sided intervals.
CONFIDENCE = 0.9
#: Number of bootstrap samples.
_N_RESAMPLES = 1000
#: Fixed seed of the bootstrap, for reproducible reports.
_SEED = 2005


@dataclass(frozen=True)
class CaseFraction:
    """A fraction of cases with its two-sided intervals at `CONFIDENCE`; `fraction` is NaN for no cases.

    - n, hits, fraction: number of cases, number of counted cases, and their fraction
    - lower, upper: bounds of the Clopper-Pearson interval, for independent cases
    - shared_lower, shared_upper: bounds of the interval that allows for shared terrains; None if no terrain is shared
    """

    n: int
    hits: int
    fraction: float
    lower: float
    upper: float
    shared_lower: float | None = None
    shared_upper: float | None = None

    @property
    def clustered_interval(self) -> tuple[float, float]:
        """The interval that allows for shared terrains; that for independent cases if no terrain is shared."""
        if self.shared_lower is None or self.shared_upper is None:
            return self.lower, self.upper
        return self.shared_lower, self.shared_upper


def fraction_of(mask: Bool[np.ndarray, " n"], frame: pd.DataFrame) -> CaseFraction:
    """Compute the fraction of the cases of `frame` that a mask selects."""
    n, hits = mask.size, int(mask.sum())
    if n == 0:
        return CaseFraction(0, 0, math.nan, 0.0, 1.0)
    groups, clustered = terrain_groups(frame), None
    if groups is not None and int(groups.max()) + 1 < n:
        # a two-sided interval consists of two one-sided bounds
        risk, cases = 0.5 * (1.0 - CONFIDENCE), ClusteredCases.of(mask, groups)
        clustered = 1.0 - cases.max_failure_rate(risk), 1.0 - cases.min_failure_rate(risk)
    return CaseFraction(n, hits, hits / n, *proportion_interval(hits, n, CONFIDENCE), *(clustered or (None, None)))


def flag_fraction(frame: pd.DataFrame, name: str, *, value: bool = True) -> CaseFraction:
    """Compute the fraction of rows whose flag equals `value`."""
    return fraction_of(frame[name].eq(value).fillna(False).to_numpy(dtype=np.bool_), frame)


@dataclass(frozen=True)
class PooledRate:
    """A fraction of items (pixels or features, for example), pooled over cases; items of one case are correlated.

    - hits, total, fraction: number of counted items, number of all items, and the fraction
    - lower, upper: bootstrap interval over cases, or over shared terrains; NaN if no item is counted
    - flights, flights_hit: number of cases (flights) with at least one item, and with at least one counted item
    """

    hits: int
    total: int
    fraction: float
    lower: float
    upper: float
    flights: int
    flights_hit: int


def pooled_rate(frame: pd.DataFrame, hits: str, of: str) -> PooledRate:
    """Compute the fraction of items that are counted: the sum of the column `hits` / the sum of the column `of`.

    Each column contains a number of items per case; missing numbers are 0.
    """
    hit_counts, item_counts = (np.nan_to_num(numbers(frame, name)) for name in (hits, of))
    has_items = item_counts > 0
    cases, cases_hit = int(has_items.sum()), int((has_items & (hit_counts > 0)).sum())
    total = int(item_counts.sum())
    if total == 0:
        return PooledRate(0, 0, math.nan, math.nan, math.nan, 0, 0)
    lower = upper = math.nan
    if cases_hit and cases > 1:
        groups = terrain_groups(frame[has_items])
        # resample terrains, or cases if there is at most one terrain
        clusters = np.arange(cases) if groups is None or int(groups.max()) < 1 else groups
        weights = bootstrap_weights(clusters, np.random.default_rng(_SEED))[1:]
        sums = weights @ item_counts[has_items]
        lower, upper = percentile_interval((weights @ hit_counts[has_items])[sums > 0] / sums[sums > 0])
    return PooledRate(int(hit_counts.sum()), total, float(hit_counts.sum() / total), lower, upper, cases, cases_hit)


def bootstrap_weights(groups: np.ndarray, rng: np.random.Generator) -> Float[np.ndarray, "resamples n"]:
    """Draw groups with replacement and return the multiplicity of each case; the first row is the sample itself."""
    n_groups = int(groups.max()) + 1
    multiplicities = rng.multinomial(n_groups, np.full(n_groups, 1.0 / n_groups), size=_N_RESAMPLES)
    return np.concatenate([np.ones((1, groups.size)), multiplicities[:, groups]]).astype(np.float64)


def percentile_interval(resampled: Float[np.ndarray, " b"]) -> Interval:
    """Compute the two-sided percentile interval of a resampled statistic."""
    low, high = np.quantile(resampled, (0.5 * (1.0 - CONFIDENCE), 0.5 * (1.0 + CONFIDENCE)))
    return float(low), float(high)


def finite_values(frame: pd.DataFrame, column: str, scale: float = 1.0) -> Float[np.ndarray, " n"]:
    """Return the finite numbers of a column, multiplied by `scale`."""
    values = numbers(frame, column)
    return np.asarray(scale * values[np.isfinite(values)])


def varies(frame: pd.DataFrame, name: str) -> bool:
    """Whether a column of numbers has more than one value."""
    values = finite_values(frame, name)
    return values.size > 1 and bool(np.ptp(values) > 0.0)


def rms(values: Float[np.ndarray, " n"]) -> float:
    """Compute the root mean square; NaN for no values."""
    return float(np.sqrt(np.mean(values**2))) if values.size else math.nan


def quantile(values: Float[np.ndarray, " n"], probability: float) -> float:
    """Compute a quantile; NaN if no value lies beyond it, which would be an extrapolation.

    Minimum (0), median and maximum (1) exist in every sample.
    """
    is_known = values.size > 0 and (probability in (0.0, 0.5, 1.0) or is_interpolated(values.size, probability))
    return float(np.quantile(values, probability)) if is_known else math.nan


def group_by_size(frame: pd.DataFrame, column: str, size: str, first: str) -> Iterator[tuple[str, float, pd.DataFrame]]:
    """Group rows by kind (values of `column`) and by the numbers in the column `size`; yield kind, size and rows.

    The groups are sorted by kind, then by size; the kind named `first` precedes all others.
    """
    sizes = numbers(frame, size)
    for kind in sorted(frame[column].dropna().unique(), key=lambda name: (name != first, str(name))):
        has_kind = frame[column].eq(kind).fillna(False).to_numpy(dtype=np.bool_)
        for value in np.unique(sizes[has_kind]):
            has_size = np.isnan(sizes) if np.isnan(value) else sizes == value
            yield str(kind), float(value), frame[has_kind & has_size]


def fraction_text(fraction: CaseFraction) -> str:
    """Format hits, cases and fraction: ``19 of 20: 95.00 %``."""
    return f"{fraction.hits:,} of {fraction.n:,}: {percent(fraction.fraction)}" if fraction.n else NOTHING


def interval_text(fraction: CaseFraction, *, shared: bool = False) -> str:
    """Format the interval of a fraction for independent cases, or allowing for `shared` terrains."""
    if not fraction.n:
        return NOTHING
    return range_text(*fraction.clustered_interval) if shared else range_text(fraction.lower, fraction.upper)


def range_text(lower: float, upper: float) -> str:
    """Format two bounds of a fraction."""
    return f"{percent(lower)} to {percent(upper)}"


def rate_text(rate: PooledRate) -> str:
    """Format a rate with its interval: ``2.0 % (1.1 % to 3.2 %)``."""
    if rate.total == 0:
        return NOTHING
    text = percent(rate.fraction)
    return text if math.isnan(rate.lower) else f"{text} ({range_text(rate.lower, rate.upper)})"


def median_text(values: Float[np.ndarray, " n"], digits: int | None) -> str:
    """Format the median, and minimum to maximum in brackets; one number for equal values, a dash for no values.

    digits: number of decimals; None for those of `number`
    """
    if values.size == 0:
        return NOTHING
    low, median, high = (
        number(float(value)) if digits is None else f"{value:.{digits}f}".replace("-", "−")
        for value in (values.min(), np.median(values), values.max())
    )
    return median if low == high else f"{median} ({low} to {high})"
