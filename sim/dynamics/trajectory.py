"""What instruments and scenarios know of any motion: true states at any time of its span."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from sim.dynamics.state import State


@dataclass(frozen=True)
class Motion:
    """Truth at many instants; each row is what `State` holds of one.

    Attributes
    ----------
    times_s
        Times, seconds.
    positions_m, velocities_m_s
        Of the body frame's origin, world axes.
    attitudes
        Rotations from body to world axes.
    body_rates_rad_s
        Angular velocity of the body relative to the world, body axes.
    specific_forces_m_s2
        Acceleration less gravity at the body's origin, body axes.
    """

    times_s: Float64[np.ndarray, "n"]
    positions_m: Float64[np.ndarray, "n 3"]
    velocities_m_s: Float64[np.ndarray, "n 3"]
    attitudes: Rotation
    body_rates_rad_s: Float64[np.ndarray, "n 3"]
    specific_forces_m_s2: Float64[np.ndarray, "n 3"]

    def state(self, row: int) -> State:
        """Truth at one of the instants."""
        return State(
            time_s=float(self.times_s[row]),
            position_m=self.positions_m[row],
            velocity_m_s=self.velocities_m_s[row],
            attitude=self.attitudes[row],
            body_rate_rad_s=self.body_rates_rad_s[row],
            specific_force_m_s2=self.specific_forces_m_s2[row],
        )


@runtime_checkable
class Trajectory(Protocol):
    """A motion, consistent in itself: velocity, rate and specific force are derivatives of position and attitude."""

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last time at which the motion is known; infinite where it is given by formula."""
        ...

    def state(self, time_s: float) -> State:
        """Truth at a time. Raises ValueError outside of the span."""
        ...

    def motion(self, times_s: Float64[np.ndarray, "n"]) -> Motion:
        """Truth at many times. Raises ValueError outside of the span."""
        ...
