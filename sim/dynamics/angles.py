"""Attitude and body rates from angles of yaw, pitch and roll and their rates."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation


def turning(
    angles_rad: Float64[np.ndarray, "n 3"], rates_rad_s: Float64[np.ndarray, "n 3"]
) -> tuple[Rotation, Float64[np.ndarray, "n 3"]]:
    """Attitudes, and angular velocities in body axes, of rows (yaw, pitch, roll).

    From the world's axes the body turns by yaw about z, then by pitch about its y and by roll about its x.
    """
    yaw_rate, pitch_rate, roll_rate = rates_rad_s.T
    _, pitch, roll = angles_rad.T
    rates = np.stack(
        [
            roll_rate - yaw_rate * np.sin(pitch),
            pitch_rate * np.cos(roll) + yaw_rate * np.cos(pitch) * np.sin(roll),
            -pitch_rate * np.sin(roll) + yaw_rate * np.cos(pitch) * np.cos(roll),
        ],
        axis=-1,
    )
    return Rotation.from_euler("ZYX", angles_rad), rates
