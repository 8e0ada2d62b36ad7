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

from marsyard.sim.camera import kernels

Vector = NDArray[np.float64]

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

    @property
    def coefficients(self) -> tuple[float, float, float]:
        """k1, k3 and k5."""
        return self.k1, self.k3, self.k5

    @cached_property
    def limits(self) -> tuple[float, float]:
        """chi^2 and f(chi)^2 where f stops growing."""
        return float(self.tau_limit), float(self.distorted_tau_limit)

    def gain(self, tau: float) -> float:
        """f(chi) / chi for one tau = chi^2."""
        return self.k1 + tau * (self.k3 + tau * self.k5)

    def undistortion(self, distorted_tau: Vector) -> Vector:
        """The ratio chi / f(chi), shape (n,), given f(chi)^2, shape (n,); NaN beyond the range in which f grows.

        Solved for the ratio g itself, which stays finite on the axis: g (k1 + s (k3 + s k5)) = 1 with s = f^2 g^2.
        Newton from g = 1 / k1 approaches from one side where the polynomial bends one way; what it leaves is bisected.
        """
        return np.asarray(kernels.undistortion(self.coefficients, self.limits, distorted_tau))
