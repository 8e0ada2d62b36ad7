"""Errors in two dimensions: prediction ellipses and circular errors."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import stats

from marsyard.reports.statistics.samples import Groups, Quantile, quantile_bounds

#: Minimum number of points: the factor needs two degrees of freedom beyond the plane's.
FEWEST_OF_ELLIPSE = 5


@dataclass(frozen=True)
class ErrorEllipse:
    """Ellipse that contains the next error with a stated probability, for normal errors.

    centre: mean error.
    semi_major, semi_minor: half axes, in the errors' unit.
    angle_deg: of the major axis from the first component towards the second, from -90 (excluded) to 90 degrees.
    probability: probability that the next error lies inside.
    inside: fraction of these errors that lie inside; differs from the probability where errors are not normal.
    """

    centre: tuple[float, float]
    semi_major: float
    semi_minor: float
    angle_deg: float
    probability: float
    inside: float

    @property
    def reach(self) -> float:
        """Half the side of the smallest square about zero error that contains the ellipse."""
        turn = math.radians(self.angle_deg)
        across = math.hypot(self.semi_major * math.cos(turn), self.semi_minor * math.sin(turn))
        up = math.hypot(self.semi_major * math.sin(turn), self.semi_minor * math.cos(turn))
        return max(abs(self.centre[0]) + across, abs(self.centre[1]) + up)


def error_ellipse(errors: Float[np.ndarray, "n 2"], probability: float) -> ErrorEllipse | None:
    """The prediction ellipse of two-dimensional errors; None for fewer than five or where all lie on a point.

    For a new error e of the same normal distribution, (e - m)' S^-1 (e - m) with the sample's mean and covariance is
    distributed as 2 (n - 1) (n + 1) / (n (n - 2)) times F with 2 and n - 2 degrees of freedom (Hotelling; Chew,
    "Confidence, prediction and tolerance regions for the multivariate normal distribution", J. Amer. Statist. Assoc.
    61, 1966): the share of future errors is the probability on average, however small n is.
    """
    known = errors[np.isfinite(errors).all(axis=1)]
    n = len(known)
    if n < FEWEST_OF_ELLIPSE:
        return None
    centre = known.mean(axis=0)
    values, axes = np.linalg.eigh(np.cov(known.T))
    if values[1] <= 0.0:
        return None
    factor = 2.0 * (n - 1.0) * (n + 1.0) / (n * (n - 2.0)) * float(stats.f.ppf(probability, 2, n - 2))
    variances = np.maximum(values, 0.0)
    turned = (known - centre) @ axes
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = np.where(variances > 0.0, turned**2 / variances, 0.0).sum(axis=1)
    angle = math.degrees(math.atan2(axes[1, 1], axes[0, 1]))
    return ErrorEllipse(
        centre=(float(centre[0]), float(centre[1])),
        semi_major=math.sqrt(factor * variances[1]),
        semi_minor=math.sqrt(factor * variances[0]),
        angle_deg=angle - 180.0 * math.ceil((angle - 90.0) / 180.0),
        probability=probability,
        inside=float((distances <= factor).mean()),
    )


def circular_error(
    errors: Float[np.ndarray, "n 2"], probability: float, confidence: float, groups: Groups = None
) -> Quantile:
    """The radius about the truth that holds a share of the errors (0.5: the circular error probable), with bounds.

    The bounds are order statistics, one-sided each at the confidence: nothing is assumed of the distribution.
    """
    finite = np.isfinite(errors).all(axis=1)
    radii = np.hypot(*errors[finite].T)
    estimate = float(np.quantile(radii, probability)) if radii.size else math.nan
    return Quantile(
        probability,
        estimate,
        *quantile_bounds(radii, probability, confidence, None if groups is None else groups[finite]),
    )
