"""What instruments and scenarios know of any motion: true states at any time of its span."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from marsyard.sim.dynamics.state import State


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
        return self.motion(np.array([time_s])).state(0)

    def motion(self, times_s: Float64[np.ndarray, "n"]) -> Motion:
        """Truth at many times. Raises ValueError outside of the span."""
        ...


@dataclass(frozen=True)
class Resting(Trajectory):
    """A body that does not move.

    Attributes
    ----------
    position_m, attitude
        Of the body, world axes.
    gravity_m_s2
        Acceleration of gravity.
    """

    position_m: Float64[np.ndarray, "3"]
    attitude: Rotation
    gravity_m_s2: float

    @property
    def span_s(self) -> tuple[float, float]:
        """All times."""
        return -np.inf, np.inf

    def motion(self, times_s: Float64[np.ndarray, "n"]) -> Motion:
        """Truth at many times."""
        count = times_s.size
        still = np.zeros((count, 3))
        force = self.attitude.inv().apply(np.array([0.0, 0.0, self.gravity_m_s2]))
        return Motion(
            times_s=times_s,
            positions_m=np.tile(self.position_m, (count, 1)),
            velocities_m_s=still,
            attitudes=Rotation.concatenate([self.attitude] * count) if count else Rotation.from_quat(np.zeros((0, 4))),
            body_rates_rad_s=still,
            specific_forces_m_s2=np.tile(force, (count, 1)),
        )
