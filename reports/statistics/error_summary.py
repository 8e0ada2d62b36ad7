"""Summary of errors: mean, standard deviation, quantiles, circular errors, and their prediction ellipse."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import stats

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


#: Minimum number of points of an ellipse.
_MIN_FOR_ELLIPSE = 5


@dataclass(frozen=True)
class ErrorEllipse:
    """Ellipse that contains the next error with a specified probability, for normally distributed errors.

    - centre: mean error; semi_major, semi_minor: semi-axes, in the errors' unit
    - angle_deg: angle of the major axis from the first component towards the second, -90 (excluded) to 90 degrees
    - probability: probability that the next error lies inside
    - inside: fraction of the sample inside; it differs from the probability if the errors are not normal
    """

    centre: tuple[float, float]
    semi_major: float
    semi_minor: float
    angle_deg: float
    probability: float
    inside: float

    @property
    def half_extent(self) -> float:
        """Half the side of the smallest square centred on zero error that contains the ellipse."""
        angle = math.radians(self.angle_deg)
        x = math.hypot(self.semi_major * math.cos(angle), self.semi_minor * math.sin(angle))
        y = math.hypot(self.semi_major * math.sin(angle), self.semi_minor * math.cos(angle))
        return max(abs(self.centre[0]) + x, abs(self.centre[1]) + y)


def error_ellipse(errors: Float[np.ndarray, "n 2"], probability: float) -> ErrorEllipse | None:
    """Compute the prediction ellipse of two-dimensional errors; None for fewer than five errors or if all are equal.

    The sample has the mean m and the covariance S. For a new error e of the same normal distribution,
    (e - m)' S^-1 (e - m) is distributed as 2 (n - 1) (n + 1) / (n (n - 2)) times F(2, n - 2) (Hotelling; Chew,
    "Confidence, prediction and tolerance regions for the multivariate normal distribution", J. Amer. Statist. Assoc.
    61, 1966). On average, the fraction of future errors inside equals the probability, also for small n.
    """
    finite = errors[np.isfinite(errors).all(axis=1)]
    n = len(finite)
    if n < _MIN_FOR_ELLIPSE:
        return None
    centre = finite.mean(axis=0)
    eigenvalues, axes = np.linalg.eigh(np.cov(finite.T))
    if eigenvalues[1] <= 0.0:
        return None
    factor = 2.0 * (n - 1.0) * (n + 1.0) / (n * (n - 2.0)) * float(stats.f.ppf(probability, 2, n - 2))
    variances = np.maximum(eigenvalues, 0.0)
    principal = (finite - centre) @ axes
    with np.errstate(divide="ignore", invalid="ignore"):
        squared_distances = np.where(variances > 0.0, principal**2 / variances, 0.0).sum(axis=1)
    # `eigh` sorts the eigenvalues in ascending order; the second axis is the major axis
    angle = math.degrees(math.atan2(axes[1, 1], axes[0, 1]))
    return ErrorEllipse(
        centre=(float(centre[0]), float(centre[1])),
        semi_major=math.sqrt(factor * variances[1]),
        semi_minor=math.sqrt(factor * variances[0]),
        angle_deg=angle - 180.0 * math.ceil((angle - 90.0) / 180.0),
        probability=probability,
        inside=float((squared_distances <= factor).mean()),
    )
