"""The radial polynomial of CAHVOR and CAHVORE and its inverse.

Both models move a ray from its "distance" chi off the optical axis (for a perspective lens its angle's tangent) to

    f(chi) = (1 + rho0) chi + rho1 chi^3 + rho2 chi^5

(Gennery 2006, "Generalized camera calibration including fish-eye lenses", IJCV 68(3): mu = rho0 + rho1 tau + rho2 tau^2
with tau = chi^2). The polynomial means something only as far as it grows: beyond its first maximum the picture would
fold back.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

_NEWTON_STEPS = 12
_BISECTIONS = 70
_UNLIMITED_TAU = 1e30


@dataclass(frozen=True)
class RadialPolynomial:
    """f(chi) = k1 chi + k3 chi^3 + k5 chi^5 with k1 > 0."""

    k1: float
    k3: float
    k5: float

    @cached_property
    def tau_limit(self) -> float:
        """chi^2 where f stops growing; infinite if it never does, or only at right angles to rounding."""
        limit = self._first_maximum()
        return limit if limit < _UNLIMITED_TAU else np.inf

    def _first_maximum(self) -> float:
        if self.k5 == 0:
            return -self.k1 / (3 * self.k3) if self.k3 < 0 else np.inf
        discriminant = 9 * self.k3**2 - 20 * self.k5 * self.k1
        if discriminant < 0:
            return np.inf
        # The two roots of k1 + 3 k3 tau + 5 k5 tau^2, in the form without cancellation.
        half = -0.5 * (3 * self.k3 + np.copysign(np.sqrt(discriminant), self.k3))
        roots = [half / (5 * self.k5), self.k1 / half if half else -np.inf]
        return min((float(root) for root in roots if root > 0), default=np.inf)

    @cached_property
    def distorted_tau_limit(self) -> float:
        """f(chi)^2 where f stops growing."""
        tau = self.tau_limit
        return tau * self.gain(tau) ** 2 if np.isfinite(tau) else np.inf

    def gain(self, tau: float) -> float:
        """f(chi) / chi for one tau = chi^2."""
        return self.k1 + tau * (self.k3 + tau * self.k5)

    def undistortion(self, distorted_tau: Vector) -> Vector:
        """The ratio chi / f(chi), shape (n,), given f(chi)^2, shape (n,); NaN beyond the range in which f grows.

        Solved for the ratio g itself, which stays finite on the axis: g (k1 + s (k3 + s k5)) = 1 with s = f^2 g^2.
        Newton from g = 1 / k1 approaches from one side where the polynomial bends one way; what it leaves is bisected.
        """
        reached = distorted_tau < self.distorted_tau_limit
        tau = np.where(reached, distorted_tau, 0.0)
        ratio = np.full_like(tau, 1 / self.k1)
        step = np.zeros_like(tau)
        for _ in range(_NEWTON_STEPS):
            s = tau * ratio * ratio
            excess = ratio * (self.k1 + s * (self.k3 + s * self.k5)) - 1
            step = excess / (self.k1 + s * (3 * self.k3 + s * (5 * self.k5)))
            ratio -= step
            if not np.any(np.abs(step) > 1e-9 * ratio):  # the error is of the step's square
                break
        upper = np.sqrt(self.tau_limit / tau)
        stuck = ~((np.abs(step) <= 1e-9 * ratio) & (ratio > 0) & (ratio <= upper))
        if np.any(stuck):
            ratio[stuck] = self._bisected(tau[stuck], upper[stuck])
        ratio[~reached] = np.nan
        return ratio

    def _bisected(self, tau: Vector, upper: Vector) -> Vector:
        low = np.zeros_like(tau)
        high = np.where(np.isfinite(upper), upper, 1.0)
        growing = ~np.isfinite(upper)
        while np.any(growing):
            high[growing] *= 2
            growing &= self._excess(tau, high) < 0
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            above = self._excess(tau, middle) > 0
            high = np.where(above, middle, high)
            low = np.where(above, low, middle)
        return 0.5 * (low + high)

    def _excess(self, tau: Vector, ratio: Vector) -> Vector:
        s = tau * ratio * ratio
        return ratio * (self.k1 + s * (self.k3 + s * self.k5)) - 1
