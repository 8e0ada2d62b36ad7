"""Inertial navigation: propagation of attitude, velocity and displacement from the increments of an inertial unit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from marsyard.sim.frames import accumulate_quaternions
from marsyard.sim.measurements import ImuIncrements
from marsyard.sim.sensor.instrument import Times, Vector, Vectors


@dataclass(frozen=True)
class InertialSolution:
    """Attitude, velocity and displacement propagated from inertial increments; times are time tags of the unit.

    - attitudes: rotations from body to world axes at the sample boundaries
    - velocities_m_s, displacements_m: at the sample boundaries, world axes; displacement from the first boundary
    """

    increments: ImuIncrements
    attitudes: Rotation
    velocities_m_s: Float64[np.ndarray, "m 3"]
    displacements_m: Float64[np.ndarray, "m 3"]

    @classmethod
    def propagate(
        cls, increments: ImuIncrements, attitude: Rotation, velocity_m_s: Vector, gravity_m_s2: float
    ) -> InertialSolution:
        """Propagate from an estimated attitude and velocity at the first boundary, with gravity along world -z."""
        steps = Rotation.from_rotvec(increments.delta_angles_rad).as_quat()
        attitudes = Rotation.from_quat(accumulate_quaternions(np.concatenate([attitude.as_quat()[None], steps])))
        gravity = np.array([0.0, 0.0, -gravity_m_s2])
        delta_velocities = attitudes[:-1].apply(increments.delta_velocities_m_s) + gravity * increments.period_s
        velocities = velocity_m_s + _cumulative_sums(delta_velocities)
        delta_positions = 0.5 * (velocities[1:] + velocities[:-1]) * increments.period_s
        return cls(increments, attitudes, velocities, _cumulative_sums(delta_positions))

    def attitude(self, times_s: Times) -> Rotation:
        """Interpolate attitudes at time tags with a constant rate between samples."""
        interval, fraction = self._locate(times_s)
        rotation_vectors = fraction[:, None] * self.increments.delta_angles_rad[interval]
        return self.attitudes[interval] * Rotation.from_rotvec(rotation_vectors)

    def velocity(self, times_s: Times) -> Vectors:
        """Interpolate velocities at time tags linearly between samples, world axes."""
        interval, fraction = self._locate(times_s)
        before, after = self.velocities_m_s[interval], self.velocities_m_s[interval + 1]
        return np.asarray(before + fraction[:, None] * (after - before))

    def mean_velocities(self, times_s: Times) -> Float64[np.ndarray, "intervals 3"]:
        """Compute mean velocities between successive time tags, world axes; constant acceleration in a sample."""
        interval, fraction = self._locate(times_s)
        before, after = self.velocities_m_s[interval], self.velocities_m_s[interval + 1]
        elapsed = fraction[:, None] * self.increments.period_s
        displacements = self.displacements_m[interval] + elapsed * (before + 0.5 * fraction[:, None] * (after - before))
        return np.asarray(np.diff(displacements, axis=0) / np.diff(times_s)[:, None])

    def _locate(self, times_s: Times) -> tuple[np.ndarray, Times]:
        """Return the interval of each time and the elapsed fraction. Raises ValueError outside the time tags."""
        tags = self.increments.times_s
        if times_s.size and (times_s.min() < tags[0] or times_s.max() > tags[-1]):
            raise ValueError(
                f"requested times {times_s.min():.4f} s to {times_s.max():.4f} s are outside the navigation solution, "
                f"{tags[0]:.4f} s to {tags[-1]:.4f} s"
            )
        # use the last of several equal tags, so that no interval has zero length
        interval = np.minimum(np.searchsorted(tags, times_s, side="right"), tags.size - 1) - 1
        length = np.maximum(tags[interval + 1] - tags[interval], np.finfo(float).tiny)
        return interval, np.minimum((times_s - tags[interval]) / length, 1.0)


def _cumulative_sums(steps: Vectors) -> Float64[np.ndarray, "m 3"]:
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
