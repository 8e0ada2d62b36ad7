"""Summary of a sample of errors: mean, standard deviation, quantiles."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from marsyard.campaigns.json_numbers import Number
from marsyard.reports.statistics.samples import (
    Groups,
    is_interpolated,
    mean_interval,
    quantile_bounds,
    standard_deviation_interval,
)

#: Probabilities of the quantiles of a summary, and confidence of its intervals and bounds.
_QUANTILES, _CONFIDENCE = (0.5, 0.95, 0.99), 0.95


@dataclass(frozen=True)
class Quantile:
    """Quantile of a sample: probability, estimate and one-sided bounds (infinite where n is too small)."""

    probability: Number
    estimate: Number
    lower: Number
    upper: Number


@dataclass(frozen=True)
class ErrorSummary:
    """Summary of a sample of errors; NaN for too few values.

    - n, missing: number of finite values, and of missing values (no answer was reported)
    - mean, mean_lower, mean_upper: mean and its two-sided interval at `confidence`
    - sd, sd_lower, sd_upper: standard deviation (n - 1) and its two-sided interval at `confidence`
    - rms, median: root mean square about zero, median
    - robust_sd: median absolute deviation about the median times 1.4826 (standard deviation for normal values)
    - largest: largest magnitude; quantiles: quantiles with order-statistic bounds at `confidence`
    """

    n: int
    missing: int
    mean: Number
    mean_lower: Number
    mean_upper: Number
    sd: Number
    sd_lower: Number
    sd_upper: Number
    rms: Number
    median: Number
    robust_sd: Number
    largest: Number
    quantiles: tuple[Quantile, ...]
    confidence: Number


def summarize(sample: Float[np.ndarray, " n"], groups: Groups = None) -> ErrorSummary:
    """Summarize a sample of errors; values that are not finite are counted as missing and ignored.

    For radial errors the quantiles 0.5 and 0.95 are the circular error probable and the 95 % radius about the truth.
    """
    values = np.asarray(sample, dtype=np.float64)
    finite, finite_groups = values[np.isfinite(values)], None if groups is None else groups[np.isfinite(values)]
    n, missing = finite.size, values.size - finite.size
    median = float(np.median(finite)) if n else math.nan
    mean_lower, mean_upper = mean_interval(finite, _CONFIDENCE, finite_groups)
    sd_lower, sd_upper = standard_deviation_interval(finite, _CONFIDENCE, finite_groups)
    quantile_results = []
    for probability in _QUANTILES:
        estimate = float(np.quantile(finite, probability)) if is_interpolated(n, probability) else math.nan
        bounds = quantile_bounds(finite, probability, _CONFIDENCE, finite_groups)
        quantile_results.append(Quantile(probability, estimate, *bounds))
    return ErrorSummary(
        n=n,
        missing=missing,
        mean=float(finite.mean()) if n else math.nan,
        mean_lower=mean_lower,
        mean_upper=mean_upper,
        sd=float(finite.std(ddof=1)) if n > 1 else math.nan,
        sd_lower=sd_lower,
        sd_upper=sd_upper,
        rms=float(np.sqrt(np.mean(finite**2))) if n else math.nan,
        median=median,
        robust_sd=1.4826 * float(np.median(np.abs(finite - median))) if n else math.nan,
        largest=float(np.abs(finite).max()) if n else math.nan,
        quantiles=tuple(quantile_results),
        confidence=_CONFIDENCE,
    )


def circular_error(
    errors: Float[np.ndarray, "n 2"], probability: float, confidence: float, groups: Groups = None
) -> Quantile:
    """Compute the radius about zero error that contains a fraction of the errors (0.5: circular error probable).

    The bounds are one-sided order statistics, each at the confidence, for any distribution.
    """
    finite = np.isfinite(errors).all(axis=1)
    radii = np.hypot(*errors[finite].T)
    estimate = float(np.quantile(radii, probability)) if is_interpolated(radii.size, probability) else math.nan
    bounds = quantile_bounds(radii, probability, confidence, None if groups is None else groups[finite])
    return Quantile(probability, estimate, *bounds)
