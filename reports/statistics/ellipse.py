"""Prediction ellipse of two-dimensional errors."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import stats

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
