"""True motion of a body: its state at an instant, at many instants, and over a span of time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.frames import rigid


@dataclass(frozen=True)
class State:
    """True state of a body at one instant.

    - position_m, velocity_m_s: of the body frame's origin, world axes
    - attitude: rotation from body to world axes
    - body_rate_rad_s: angular velocity relative to the world, body axes
    - specific_force_m_s2: acceleration less gravity at the body's origin, body axes; an ideal accelerometer's reading
    """

    time_s: float
    position_m: Float64[np.ndarray, "3"]
    velocity_m_s: Float64[np.ndarray, "3"]
    attitude: Rotation
    body_rate_rad_s: Float64[np.ndarray, "3"]
    specific_force_m_s2: Float64[np.ndarray, "3"]

    @property
    def world_from_body(self) -> RigidTransform:
        """Pose of the body."""
        return rigid(self.attitude, self.position_m)


@dataclass(frozen=True)
class Motion:
    """True states at many instants, one in each row; axes as in `State`."""

    times_s: Float64[np.ndarray, "n"]
    positions_m: Float64[np.ndarray, "n 3"]
    velocities_m_s: Float64[np.ndarray, "n 3"]
    attitudes: Rotation
    body_rates_rad_s: Float64[np.ndarray, "n 3"]
    specific_forces_m_s2: Float64[np.ndarray, "n 3"]

    def state(self, row: int) -> State:
        """True state at one of the instants."""
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
    """A consistent motion: velocity, body rate and specific force are derivatives of position and attitude."""

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last time at which the motion is defined; infinite for a motion given by a formula."""
        ...

    def state(self, time_s: float) -> State:
        """True state at a time. Raises ValueError outside of the span."""
        return self.motion(np.array([time_s])).state(0)

    def motion(self, times_s: Float64[np.ndarray, "n"]) -> Motion:
        """True states at many times. Raises ValueError outside of the span."""
        ...


@dataclass(frozen=True)
class Resting(Trajectory):
    """A body at rest in the world."""

    position_m: Float64[np.ndarray, "3"]
    attitude: Rotation
    gravity_m_s2: float

    @property
    def span_s(self) -> tuple[float, float]:
        """All times."""
        return -np.inf, np.inf

    def motion(self, times_s: Float64[np.ndarray, "n"]) -> Motion:
        """True states at many times."""
        count = times_s.size
        zeros = np.zeros((count, 3))
        force = self.attitude.inv().apply(np.array([0.0, 0.0, self.gravity_m_s2]))
        return Motion(
            times_s=times_s,
            positions_m=np.tile(self.position_m, (count, 1)),
            velocities_m_s=zeros,
            attitudes=Rotation.concatenate([self.attitude] * count) if count else Rotation.from_quat(np.zeros((0, 4))),
            body_rates_rad_s=zeros,
            specific_forces_m_s2=np.tile(force, (count, 1)),
        )


def attitudes_and_body_rates(
    angles_rad: Float64[np.ndarray, "n 3"], rates_rad_s: Float64[np.ndarray, "n 3"]
) -> tuple[Rotation, Float64[np.ndarray, "n 3"]]:
    """Attitudes, and angular velocities in body axes, from Euler angles (yaw, pitch, roll) and their rates.

    The rotation sequence is yaw about z, pitch about the new y axis, roll about the new x axis.
    """
    yaw_rate, pitch_rate, roll_rate = rates_rad_s.T
    _, pitch, roll = angles_rad.T
    rates = [
        roll_rate - yaw_rate * np.sin(pitch),
        pitch_rate * np.cos(roll) + yaw_rate * np.cos(pitch) * np.sin(roll),
        -pitch_rate * np.sin(roll) + yaw_rate * np.cos(pitch) * np.cos(roll),
    ]
    return Rotation.from_euler("ZYX", angles_rad), np.stack(rates, axis=-1)
