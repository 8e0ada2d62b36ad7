"""Strapdown navigation on board: attitude and velocity from an inertial unit's increments.

Position is integrated only for the mean velocity over an interval; it starts at 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from marsyard.sim.sensor.imu import ImuIncrements
from marsyard.sim.sensor.quaternions import running_products


@dataclass(frozen=True)
class NavigationErrors:
    """Errors of navigation at an instant.

    Attributes
    ----------
    attitude_rad
        Small rotation about the world axes from the true attitude to the one that is believed.
    velocity_m_s
        Believed less true velocity, world axes.
    """

    attitude_rad: Float64[np.ndarray, "3"]
    velocity_m_s: Float64[np.ndarray, "3"]

    def believed(
        self, attitude: Rotation, velocity_m_s: Float64[np.ndarray, "3"]
    ) -> tuple[Rotation, Float64[np.ndarray, "3"]]:
        """Attitude and velocity that are believed, given the true ones."""
        return Rotation.from_rotvec(self.attitude_rad) * attitude, velocity_m_s + self.velocity_m_s


@dataclass(frozen=True)
class InertialSolution:
    """Attitude, velocity and displacement as propagated on board; times are the unit's time tags.

    Attributes
    ----------
    increments
        What it was propagated from.
    attitudes
        Rotations from body to world axes at the boundaries of the samples.
    velocities_m_s, displacements_m
        At the boundaries of the samples, world axes; displacement from the first.
    """

    increments: ImuIncrements
    attitudes: Rotation
    velocities_m_s: Float64[np.ndarray, "m 3"]
    displacements_m: Float64[np.ndarray, "m 3"]

    @classmethod
    def propagated(
        cls,
        increments: ImuIncrements,
        attitude: Rotation,
        velocity_m_s: Float64[np.ndarray, "3"],
        gravity_m_s2: float,
    ) -> InertialSolution:
        """The solution from believed attitude and velocity at the first boundary and gravity along world -z.

        Velocity increments are turned by the believed attitude, so that its error tilts the specific force.
        """
        turns = Rotation.from_rotvec(increments.delta_angles_rad).as_quat()
        attitudes = Rotation.from_quat(running_products(np.concatenate([attitude.as_quat()[None], turns])))
        gravity = np.array([0.0, 0.0, -gravity_m_s2])
        gained = attitudes[:-1].apply(increments.delta_velocities_m_s) + gravity * increments.period_s
        velocities = velocity_m_s + _running_sums(gained)
        moved = 0.5 * (velocities[1:] + velocities[:-1]) * increments.period_s
        return cls(increments, attitudes, velocities, _running_sums(moved))

    def attitude(self, times_s: Float64[np.ndarray, "n"]) -> Rotation:
        """Attitudes at time tags; between samples the rate is constant."""
        interval, share = self._placed(times_s)
        return self.attitudes[interval] * Rotation.from_rotvec(
            share[:, None] * self.increments.delta_angles_rad[interval]
        )

    def velocity(self, times_s: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 3"]:
        """Velocities at time tags, world axes; between samples the acceleration is constant."""
        interval, share = self._placed(times_s)
        before, after = self.velocities_m_s[interval], self.velocities_m_s[interval + 1]
        return np.asarray(before + share[:, None] * (after - before))

    def displacement(self, times_s: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 3"]:
        """Displacements from the first boundary to time tags, world axes; between samples acceleration is constant."""
        interval, share = self._placed(times_s)
        before, after = self.velocities_m_s[interval], self.velocities_m_s[interval + 1]
        passed = share[:, None] * self.increments.period_s
        return np.asarray(self.displacements_m[interval] + passed * (before + 0.5 * share[:, None] * (after - before)))

    def mean_velocities(self, times_s: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "intervals 3"]:
        """Mean velocities over the intervals between successive time tags, world axes, one fewer than tags."""
        return np.asarray(np.diff(self.displacement(times_s), axis=0) / np.diff(times_s)[:, None])

    def _placed(self, times_s: Float64[np.ndarray, "n"]) -> tuple[np.ndarray, Float64[np.ndarray, "n"]]:
        """Number of the interval in which each time falls, and the share of it that has passed.

        Raises
        ------
        ValueError
            If a time is tagged before the first sample or after the last.
        """
        tags = self.increments.times_s
        if times_s.size and (times_s.min() < tags[0] or times_s.max() > tags[-1]):
            raise ValueError(
                f"navigation is asked for from {times_s.min():.4f} s to {times_s.max():.4f} s; it is known from "
                f"{tags[0]:.4f} s to {tags[-1]:.4f} s"
            )
        # the last of equal tags, so that no interval is empty
        interval = np.minimum(np.searchsorted(tags, times_s, side="right"), tags.size - 1) - 1
        length = np.maximum(tags[interval + 1] - tags[interval], np.finfo(float).tiny)
        return interval, np.minimum((times_s - tags[interval]) / length, 1.0)


def _running_sums(steps: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "m 3"]:
    """Sums of the first 0, 1, 2, ... n steps."""
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
