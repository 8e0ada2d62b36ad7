"""Initial state of inertial navigation: errors of position, velocity and attitude at the start of localisation."""

from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field
from scipy.spatial.transform import Rotation

from marsyard.algorithms.localisation.interface import InitialState
from marsyard.sim.dynamics import State
from marsyard.sim.error_sources import ErrorSource
from marsyard.sim.parameters import NonNegative, Parameters

#: Error budgets reduce these errors to a tenth instead of zero: the filter begins with their standard deviations.
INITIAL = ErrorSource("initial", "initial state", remaining=0.1)


class InitialErrors(Parameters):
    """Errors of inertial navigation at the start of localisation; all are normally distributed.

    The horizontal position error is truncated at `horizontal_max_m` (3.2 km, Mars 2020). The attitude is that of the
    star tracker, propagated through entry. Standard deviations are assumed. Errors of the initial state are independent
    of each other and of the inertial unit's errors.
    """

    horizontal_sd_m: Annotated[
        NonNegative, INITIAL, Field(description="sd per axis before truncation, m (assumed)")
    ] = 1000.0
    horizontal_max_m: Annotated[float, Field(gt=0.0, description="largest horizontal position error, m")] = 3200.0
    vertical_sd_m: Annotated[NonNegative, INITIAL, Field(description="sd of the height, m (assumed)")] = 100.0
    velocity_sd_m_s: Annotated[NonNegative, INITIAL, Field(description="sd per axis, m/s (assumed)")] = 1.0
    attitude_sd_deg: Annotated[NonNegative, INITIAL, Field(description="sd per axis, deg (assumed)")] = 0.1

    def covariance(self) -> Float64[np.ndarray, "9 9"]:
        """Compute the covariance of position (m), velocity (m/s) and attitude (rad) as drawn, with the truncation."""
        horizontal = self.horizontal_sd_m**2 * self._truncated_variance()
        attitude = np.radians(self.attitude_sd_deg) ** 2
        position = [horizontal, horizontal, self.vertical_sd_m**2]
        return np.diag([*position, *[self.velocity_sd_m_s**2] * 3, *[attitude] * 3])

    def draw(self, truth: State, time_s: float, gravity_m_s2: float, rng: np.random.Generator) -> InitialState:
        """Draw the initial state; `time_s` is the time of the true state on the clock of the inertial unit."""
        position, velocity, attitude = rng.standard_normal((3, 3))
        angle, quantile = 2.0 * np.pi * rng.random(), rng.random()
        # inverse of the distribution of the radius, 1 - exp(-r^2 / (2 sd^2)), truncated
        radius = self.horizontal_sd_m * np.sqrt(-2.0 * np.log1p(quantile * np.expm1(-self._truncation())))
        error = np.array([radius * np.cos(angle), radius * np.sin(angle), self.vertical_sd_m * position[2]])
        rotation = Rotation.from_rotvec(np.radians(self.attitude_sd_deg) * attitude)
        return InitialState(
            time_s=time_s,
            position_m=truth.position_m - error,
            velocity_m_s=truth.velocity_m_s - self.velocity_sd_m_s * velocity,
            # the error e is defined by true attitude = exp(e) estimated attitude
            world_from_body=rotation.inv() * truth.attitude,
            covariance=self.covariance(),
            gravity_m_s2=gravity_m_s2,
        )

    def _truncation(self) -> float:
        """Return k = (maximum / sd)^2 / 2; the radius^2 / (2 sd^2) is exponentially distributed up to k."""
        sd_m = max(self.horizontal_sd_m, 1e-6 * self.horizontal_max_m)  # not 0
        return 0.5 * (self.horizontal_max_m / sd_m) ** 2

    def _truncated_variance(self) -> float:
        """Compute the mean of an exponential distribution truncated at k, 1 - k / (e^k - 1): variance / sd^2."""
        k = min(self._truncation(), 700.0)  # e^k is finite
        return float(1.0 - k / np.expm1(k))
