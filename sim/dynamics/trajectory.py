"""True motion of a body: state at one or many instants, the interface `Trajectory`, and a body at rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.frames import rigid

Times = Float64[np.ndarray, "n"]
Vectors = Float64[np.ndarray, "n 3"]


@dataclass(frozen=True)
class State:
    """True state of a body at one instant.

    - position_m, velocity_m_s: of the body frame's origin, world axes
    - attitude: rotation from body to world axes
    - body_rate_rad_s: angular velocity relative to the world, body axes
    - specific_force_m_s2: acceleration minus gravity at the body's origin, body axes: an ideal accelerometer's output
    """

    time_s: float
    position_m: Float64[np.ndarray, "3"]
    velocity_m_s: Float64[np.ndarray, "3"]
    attitude: Rotation
    body_rate_rad_s: Float64[np.ndarray, "3"]
    specific_force_m_s2: Float64[np.ndarray, "3"]

    @property
    def world_from_body(self) -> RigidTransform:
        """Pose of the body in the world."""
        return rigid(self.attitude, self.position_m)


@dataclass(frozen=True)
class Motion:
    """True states at many instants, one in each row; axes as in `State`."""

    times_s: Times
    positions_m: Vectors
    velocities_m_s: Vectors
    attitudes: Rotation
    body_rates_rad_s: Vectors
    specific_forces_m_s2: Vectors

    @classmethod
    def from_accelerations(
        cls,
        times_s: Times,
        derivatives: Sequence[Vectors],
        attitudes: Rotation,
        body_rates_rad_s: Vectors,
        gravity_m_s2: float,
    ) -> Motion:
        """Create the motion from `derivatives`: position, velocity and acceleration in world axes."""
        positions, velocities, accelerations = derivatives
        forces = attitudes.inv().apply(accelerations + np.array([0.0, 0.0, gravity_m_s2]))
        return cls(times_s, positions, velocities, attitudes, body_rates_rad_s, forces)

    def state(self, row: int) -> State:
        """Return the true state of one row."""
        position, velocity, attitude = self.positions_m[row], self.velocities_m_s[row], self.attitudes[row]
        rate, force = self.body_rates_rad_s[row], self.specific_forces_m_s2[row]
        return State(float(self.times_s[row]), position, velocity, attitude, rate, force)


@runtime_checkable
class Trajectory(Protocol):
    """Interface of a true motion, whose velocity, rate and specific force are derivatives of position and attitude."""

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last time at which the motion is defined; can be infinite."""

    def state(self, time_s: float) -> State:
        """Compute the true state at a time. Raises ValueError for a time outside the span."""
        return self.motion(np.array([time_s])).state(0)

    def motion(self, times_s: Times) -> Motion:
        """Compute the true states at many times. Raises ValueError for times outside the span."""


@dataclass(frozen=True)
class Resting(Trajectory):
    """A body at rest in the world."""

    position_m: Float64[np.ndarray, "3"]
    attitude: Rotation
    gravity_m_s2: float

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last time: the motion is defined at all times."""
        return -np.inf, np.inf

    def motion(self, times_s: Times) -> Motion:
        """Return the state at rest for each time."""
        count = times_s.size
        zeros = np.zeros((count, 3))
        forces = np.tile(self.attitude.inv().apply(np.array([0.0, 0.0, self.gravity_m_s2])), (count, 1))
        attitudes = Rotation.concatenate([self.attitude] * count) if count else Rotation.from_quat(np.zeros((0, 4)))
        return Motion(times_s, np.tile(self.position_m, (count, 1)), zeros, attitudes, zeros, forces)


def check_times(times_s: Times, span_s: tuple[float, float], tolerance_s: float = 0.0) -> None:
    """Raise ValueError for a time outside a span."""
    first, last = span_s
    outside = times_s[(times_s < first - tolerance_s) | (times_s > last + tolerance_s)]
    if outside.size:
        raise ValueError(f"time {outside[0]:.6g} s is outside of the motion; allowed: {first:.6g} to {last:.6g} s")


def attitudes_and_body_rates(angles_rad: Vectors, rates_rad_s: Vectors) -> tuple[Rotation, Vectors]:
    """Convert Euler angles (yaw, pitch, roll) and their rates to attitudes and angular velocities in body axes.

    The rotation sequence is yaw about z, pitch about the new y axis, roll about the new x axis.
    """
    yaw_rate, pitch_rate, roll_rate = rates_rad_s.T
    _, pitch, roll = angles_rad.T
    # product of the quaternions of the three rotations: a fifth of the time of `Rotation.from_euler`
    (cy, cp, cr), (sy, sp, sr) = np.cos(0.5 * angles_rad).T, np.sin(0.5 * angles_rad).T
    quaternions = [
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    ]
    rates = [
        roll_rate - yaw_rate * np.sin(pitch),
        pitch_rate * np.cos(roll) + yaw_rate * np.cos(pitch) * np.sin(roll),
        -pitch_rate * np.sin(roll) + yaw_rate * np.cos(pitch) * np.cos(roll),
    ]
    return Rotation.from_quat(np.stack(quaternions, axis=-1)), np.stack(rates, axis=-1)
