"""Dependence of a response on a condition: rank correlation and fraction of variance, each with an interval.

If cases share terrains, the number of cases is divided by 1 + (m - 1) r_x r_y. Here m is the number of cases per
terrain, and r_x and r_y are the intraclass correlations of condition and response. Source: Scott & Holt, "The effect of
two-stage sampling on ordinary least squares methods", J. Amer. Statist. Assoc. 77, 1982.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import optimize, stats

#: Minimum number of cases.
MIN_CASES = 20
#: Number of cases per bin for the fraction of variance, and the maximum number of bins.
_CASES_PER_BIN, _MAX_BINS = 15, 20


@dataclass(frozen=True)
class Driver:
    """Effect of a condition on a response.

    - n, effective_n: number of cases with condition and response, and the equivalent number of independent cases
    - correlation, lower, upper: Spearman's rank correlation and its interval
    - share, share_lower, share_upper: first-order sensitivity index and its interval: the fraction (0 to 1) of the
      variance of the response's ranks that the condition alone explains, for any form of the curve
    - p_value: p-value of the null hypothesis that the condition has no effect
    """

    n: int
    effective_n: float
    correlation: float
    lower: float
    upper: float
    share: float
    share_lower: float
    share_upper: float
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
    response in bins of equally many cases (the "given data" estimate of the first-order index: Plischke, Borgonovo &
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
        size = float((sizes**2).sum() / sizes.sum())
        r_x, r_y = (_estimate_intraclass_correlation(values, index, sizes) for values in (x, y))
        effective_n = n / max(1.0, 1.0 + (size - 1.0) * r_x * r_y)
    correlation = float(np.corrcoef(x, y)[0, 1])
    half_width = float(stats.norm.ppf(0.5 * (1.0 + confidence)))
    half_width *= math.sqrt((1.0 + 0.5 * correlation**2) / max(effective_n - 3.0, 1.0))
    centre = math.atanh(float(np.clip(correlation, -1.0 + 1e-12, 1.0 - 1e-12)))
    lower, upper = math.tanh(centre - half_width), math.tanh(centre + half_width)
    return Driver(
        n, effective_n, correlation, lower, upper, *_estimate_explained_fraction(x, y, effective_n, confidence)
    )


def _estimate_explained_fraction(
    x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"], effective_n: float, confidence: float
) -> tuple[float, float, float, float]:
    """Estimate the fraction of variance between bins, its interval, and the p-value of the F-test."""
    n = x.size
    max_bins = int(np.clip(n // _CASES_PER_BIN, 2, _MAX_BINS))
    edges = np.unique(np.quantile(x, np.linspace(0.0, 1.0, max_bins + 1)))[1:-1]
    # intervals closed on the left, so that each value of a condition with two values has its own bin
    index = np.unique(np.searchsorted(edges, x, side="right"), return_inverse=True)[1]
    if index.max() == 0:
        index = np.unique(x, return_inverse=True)[1] if np.unique(x).size <= max_bins else (x > x.min()).astype(int)
    bins = int(index.max()) + 1
    means = np.bincount(index, weights=y) / np.bincount(index)
    total = float(((y - y.mean()) ** 2).sum())
    between = float((np.bincount(index) * (means - y.mean()) ** 2).sum())
    if between >= (1.0 - 1e-9) * total:
        return 1.0, 1.0, 1.0, 0.0
    degrees = max(effective_n - bins, 1.0)  # degrees of freedom within bins
    within = total - between
    ratio = between / (bins - 1.0) / (within / degrees)
    fraction = max(0.0, (between - (bins - 1.0) * within / degrees) / total)

    def cdf_minus_level(value: float, level: float) -> float:
        """Return the distribution function of the F ratio at a noncentrality `value`, minus a level."""
        cdf = stats.ncf.cdf(ratio, bins - 1.0, degrees, value) if value else stats.f.cdf(ratio, bins - 1.0, degrees)
        return float(cdf) - level

    bounds: list[float] = []
    tail = 0.5 * (1.0 - confidence)
    for level in (1.0 - tail, tail):
        high = max(1.0, ratio * (bins - 1.0))
        while cdf_minus_level(high, level) > 0.0:
            high *= 2.0
        noncentrality = 0.0
        if cdf_minus_level(0.0, level) > 0.0:
            root = float(optimize.brentq(cdf_minus_level, 0.0, high, args=(level,), xtol=1e-4 * high, rtol=1e-4))
            noncentrality = root / effective_n
        bounds.append(noncentrality / (1.0 + noncentrality))
    return fraction, bounds[0], bounds[1], float(stats.f.sf(ratio, bins - 1.0, degrees))


def _estimate_intraclass_correlation(
    values: Float[np.ndarray, " n"], index: Int[np.ndarray, " n"], sizes: Float[np.ndarray, " groups"]
) -> float:
    """Estimate the intraclass correlation (0 to 1) by analysis of variance; 0 if no group has two values."""
    n, groups = values.size, sizes.size
    if groups < 2 or groups == n:
        return 0.0
    means = np.bincount(index, weights=values) / sizes
    within = float(((values - means[index]) ** 2).sum()) / (n - groups)
    between = float((sizes * (means - values.mean()) ** 2).sum()) / (groups - 1)
    size = (n - float((sizes**2).sum()) / n) / (groups - 1)
    variance = between - within
    return float(np.clip(variance / (variance + size * within), 0.0, 1.0)) if variance > 0.0 else 0.0
