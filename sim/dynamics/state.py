"""The true state of a vehicle at an instant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.frames import rigid


@dataclass(frozen=True)
class State:
    """Truth at one instant.

    Attributes
    ----------
    time_s
        Time, seconds.
    position_m, velocity_m_s
        Of the body frame's origin, world axes.
    attitude
        Rotation from body to world axes.
    body_rate_rad_s
        Angular velocity of the body relative to the world, body axes.
    specific_force_m_s2
        What an ideal accelerometer at the body's origin feels: acceleration less gravity, body axes.
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
