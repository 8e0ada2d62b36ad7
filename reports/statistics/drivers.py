"""Dependence of a response on a condition: rank correlation and fraction of variance, each with an interval.

If cases share terrains, the number of cases is divided by 1 + (m - 1) r_x r_y. Here m is the number of cases per
terrain, and r_x and r_y are the intraclass correlations of condition and response. Source: Scott & Holt, "The effect of
two-stage sampling on ordinary least squares methods", J. Amer. Statist. Assoc. 77, 1982.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import optimize, stats

#: Minimum number of cases with condition and response for an estimate.
MIN_CASES = 20
#: Minimum number of pairs of a rank correlation without an interval.
_MIN_PAIRS = 4
#: Number of cases per bin for the fraction of variance, and the maximum number of bins.
_CASES_PER_BIN, _MAX_BINS = 15, 20
#: Number of events below which the p-value of a flag is not that of the F-test alone, and number of permutations.
_FEW_EVENTS, _PERMUTATIONS = 30, 20_000


@dataclass(frozen=True)
class Driver:
    """Effect of a condition on a response.

    - n, effective_n: number of cases with condition and response, and the equivalent number of independent cases
    - correlation, lower, upper: Spearman's rank correlation and its interval
    - fraction, fraction_lower, fraction_upper: first-order sensitivity index and its interval: the fraction (0 to 1) of
      the variance of the response's ranks that the condition alone explains, for any form of the curve
    - p_value: p-value of the null hypothesis that the condition has no effect, by the F-test of the bins; for a flag
      with few events, which the F-test finds significant too often, the larger one of this and of a permutation test
    """

    n: int
    effective_n: float
    correlation: float
    lower: float
    upper: float
    fraction: float
    fraction_lower: float
    fraction_upper: float
    p_value: float


def estimate_driver(
    condition: Float[np.ndarray, " n"],
    response: Float[np.ndarray, " n"],
    groups: Int[np.ndarray, " n"] | None,
    confidence: float,
) -> Driver | None:
    """Estimate the effect of a condition on a response; None for fewer than 20 cases with both, or for constant values.

    - condition, response: NaN where missing
    - groups: terrain of each case; None if no terrain is shared
    - confidence: confidence of the two-sided intervals

    Correlation: Fisher's z with Bonett & Wright's variance (Psychometrika 65, 2000). Fraction of variance: ranks of the
    response in bins with equal numbers of cases ("given data" estimate of the first-order index: Plischke, Borgonovo &
    Smith, Eur. J. Oper. Res. 226, 2013), corrected for bias as Kelley's epsilon squared (Proc. Nat. Acad. Sci. 21,
    1935), with the interval of the noncentral F distribution.
    """
    finite = np.isfinite(condition) & np.isfinite(response)
    n = int(finite.sum())
    if n < MIN_CASES or np.ptp(condition[finite]) == 0.0 or np.ptp(response[finite]) == 0.0:
        return None
    x, y = stats.rankdata(condition[finite]), stats.rankdata(response[finite])
    effective_n = float(n)
    if groups is not None:
        index = np.unique(groups[finite], return_inverse=True)[1]
        sizes = np.bincount(index).astype(np.float64)
        # mean number of cases on the terrain of a case
        size = float((sizes**2).sum() / sizes.sum())
        r_x, r_y = (_estimate_intraclass_correlation(values, index, sizes) for values in (x, y))
        effective_n = n / max(1.0, 1.0 + (size - 1.0) * r_x * r_y)
    correlation = float(np.corrcoef(x, y)[0, 1])
    # Fisher's z has the variance (1 + r^2 / 2) / (n - 3)
    half_width = float(stats.norm.ppf(0.5 * (1.0 + confidence)))
    half_width *= math.sqrt((1.0 + 0.5 * correlation**2) / max(effective_n - 3.0, 1.0))
    centre = math.atanh(float(np.clip(correlation, -1.0 + 1e-12, 1.0 - 1e-12)))
    lower, upper = math.tanh(centre - half_width), math.tanh(centre + half_width)
    return Driver(
        n, effective_n, correlation, lower, upper, *_estimate_explained_fraction(x, y, effective_n, confidence)
    )


def explained_fraction(condition: Float[np.ndarray, " n"], response: Float[np.ndarray, " n"]) -> float:
    """Estimate `Driver.fraction` of independent cases; 0 for fewer than four cases with both, or constant values."""
    finite = np.isfinite(condition) & np.isfinite(response)
    n = int(finite.sum())
    if n < _MIN_PAIRS or np.ptp(condition[finite]) == 0.0 or np.ptp(response[finite]) == 0.0:
        return 0.0
    x, y = stats.rankdata(condition[finite]), stats.rankdata(response[finite])
    bins, between, total = _sum_squares(_divide_into_bins(x), y)
    return max(0.0, (between - (bins - 1.0) * (total - between) / (n - bins)) / total)


def _divide_into_bins(x: Float[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Divide the ranks x into at least two bins with equal numbers of cases; return the bin of each case, from 0."""
    max_bins = int(np.clip(x.size // _CASES_PER_BIN, 2, _MAX_BINS))
    edges = np.unique(np.quantile(x, np.linspace(0.0, 1.0, max_bins + 1)))[1:-1]
    # intervals closed on the left, so that each value of a condition with two values has its own bin
    bin_index = np.unique(np.searchsorted(edges, x, side="right"), return_inverse=True)[1]
    if bin_index.max() == 0:
        bin_index = np.unique(x, return_inverse=True)[1] if np.unique(x).size <= max_bins else (x > x.min()).astype(int)
    return np.asarray(bin_index, dtype=np.int64)


def _sum_squares(bin_index: Int[np.ndarray, " n"], y: Float[np.ndarray, " n"]) -> tuple[int, float, float]:
    """Return the number of bins, and the sums of squares of y between them and in all."""
    means = np.bincount(bin_index, weights=y) / np.bincount(bin_index)
    total = float(((y - y.mean()) ** 2).sum())
    between = float((np.bincount(bin_index) * (means - y.mean()) ** 2).sum())
    return int(bin_index.max()) + 1, between, total


def _permutation_p_value(bin_index: Int[np.ndarray, " n"], event: Bool[np.ndarray, " n"]) -> float:
    """Return the probability that random cases with these events differ at least as much between the bins."""
    sizes, observed = np.bincount(bin_index), np.bincount(bin_index, weights=event)
    counts = np.random.default_rng(0).multivariate_hypergeometric(sizes, int(event.sum()), _PERMUTATIONS)
    # the sum of squares between the bins, without constants
    is_larger = (counts**2 / sizes).sum(axis=1) >= (observed**2 / sizes).sum() * (1.0 - 1e-12)
    return float((1 + is_larger.sum()) / (1 + _PERMUTATIONS))


class _ExplainedFraction(NamedTuple):
    """Fraction of a variance between bins, its interval, and its p-value; see `Driver`."""

    fraction: float
    lower: float
    upper: float
    p_value: float


def _estimate_explained_fraction(
    x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"], effective_n: float, confidence: float
) -> _ExplainedFraction:
    """Estimate the fraction of the variance of the ranks y between bins of the ranks x."""
    bin_index, is_high = _divide_into_bins(x), y > y.min()
    bins, between, total = _sum_squares(bin_index, y)
    is_flag = np.ptp(y[is_high]) == 0.0
    has_few_events = is_flag and min(is_high.sum(), y.size - is_high.sum()) < _FEW_EVENTS
    permutation_p = _permutation_p_value(bin_index, is_high) if has_few_events else 0.0
    if between >= (1.0 - 1e-9) * total:
        return _ExplainedFraction(1.0, 1.0, 1.0, permutation_p)
    within_degrees = max(effective_n - bins, 1.0)  # degrees of freedom within bins
    within = total - between
    f_ratio = between / (bins - 1.0) / (within / within_degrees)
    # epsilon squared: the chance part of the sum of squares between bins is subtracted
    fraction = max(0.0, (between - (bins - 1.0) * within / within_degrees) / total)

    def cdf_minus_level(value: float, level: float) -> float:
        """Return the distribution function of the F ratio at a noncentrality `value`, minus a level."""
        cdf = (
            stats.ncf.cdf(f_ratio, bins - 1.0, within_degrees, value)
            if value
            else stats.f.cdf(f_ratio, bins - 1.0, within_degrees)
        )
        return float(cdf) - level

    def find_fraction(level: float) -> float:
        """Find the fraction of variance whose F ratio is at most the observed one with the probability `level`."""
        high = max(1.0, f_ratio * (bins - 1.0))
        while cdf_minus_level(high, level) > 0.0:
            high *= 2.0
        # the noncentrality divided by n is the variance between bins divided by the variance within
        ratio_of_variances = 0.0
        if cdf_minus_level(0.0, level) > 0.0:
            root = float(optimize.brentq(cdf_minus_level, 0.0, high, args=(level,), xtol=1e-4 * high, rtol=1e-4))
            ratio_of_variances = root / effective_n
        return ratio_of_variances / (1.0 + ratio_of_variances)

    tail = 0.5 * (1.0 - confidence)
    p_value = max(float(stats.f.sf(f_ratio, bins - 1.0, within_degrees)), permutation_p)
    return _ExplainedFraction(fraction, find_fraction(1.0 - tail), find_fraction(tail), p_value)


def _estimate_intraclass_correlation(
    values: Float[np.ndarray, " n"], index: Int[np.ndarray, " n"], sizes: Float[np.ndarray, " groups"]
) -> float:
    """Estimate the intraclass correlation (0 to 1) by analysis of variance; 0 if no group has two values."""
    if sizes.size < 2 or sizes.size == values.size:
        return 0.0
    within, between, effective_size = mean_squares(values, index)
    excess = between - within
    return float(np.clip(excess / (excess + effective_size * within), 0.0, 1.0)) if excess > 0.0 else 0.0


def mean_squares(values: Float[np.ndarray, " n"], index: Int[np.ndarray, " n"]) -> tuple[float, float, float]:
    """Return the mean squares within and between at least two groups, and the effective number of values per group.

    The expectation of the second is that of the first plus the effective number times the variance between groups.
    """
    sizes, n = np.bincount(index).astype(np.float64), values.size
    means, degrees = np.bincount(index, weights=values) / sizes, sizes.size - 1
    within = float(((values - means[index]) ** 2).sum()) / (n - sizes.size)
    between = float((sizes * (means - values.mean()) ** 2).sum()) / degrees
    return within, between, (n - float((sizes**2).sum()) / n) / degrees


def rank_correlation(x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]) -> float:
    """Compute Spearman's rank correlation of the finite pairs; NaN for fewer than four pairs or for a constant."""
    finite = np.isfinite(x) & np.isfinite(y)
    if finite.sum() < _MIN_PAIRS:
        return float("nan")
    ranks_x, ranks_y = (stats.rankdata(values[finite]) for values in (x, y))
    return float("nan") if np.ptp(ranks_x) == 0 or np.ptp(ranks_y) == 0 else float(np.corrcoef(ranks_x, ranks_y)[0, 1])
