"""Columns that the rows of several scenarios have: what a case was like, read from the simulated objects."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from marsyard.scenarios.interface import Scalar
from marsyard.sim.dynamics import State


def sun_columns(direction: Float64[np.ndarray, "3"]) -> dict[str, Scalar]:
    """Azimuth of the sun, clockwise from north, and its elevation, from its direction in world axes."""
    return {
        "sun_azimuth_deg": float(np.degrees(np.arctan2(direction[0], direction[1])) % 360.0),
        "sun_elevation_deg": float(np.degrees(np.arcsin(np.clip(direction[2], -1.0, 1.0)))),
    }


def off_nadir_deg(state: State) -> float:
    """Angle between the body's axis, along which the camera looks, and nadir."""
    return float(np.degrees(np.arccos(np.clip(state.attitude.as_matrix()[2, 2], -1.0, 1.0))))


def attitude_rate_deg_s(state: State) -> float:
    """Length of the body rate."""
    return float(np.degrees(np.linalg.norm(state.body_rate_rad_s)))
