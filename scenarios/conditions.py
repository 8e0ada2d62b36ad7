"""Columns of a case: conditions computed from the simulated objects, and provenance of the pictures."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float64, UInt16

from marsyard.scenarios.interface import Scalar
from marsyard.sim.dynamics import State
from marsyard.sim.kernel_cache import processor_features
from marsyard.sim.render import process_renderer
from marsyard.sim.render.backend import Backend


def sun_columns(direction: Float64[np.ndarray, "3"]) -> dict[str, Scalar]:
    """Return the sun's azimuth, clockwise from north, and elevation from its direction in world axes."""
    return {
        "sun_azimuth_deg": float(np.degrees(np.arctan2(direction[0], direction[1])) % 360.0),
        "sun_elevation_deg": float(np.degrees(np.arcsin(np.clip(direction[2], -1.0, 1.0)))),
    }


def off_nadir_deg(state: State) -> float:
    """Return the angle between the body's camera axis and nadir."""
    return float(np.degrees(np.arccos(np.clip(state.attitude.as_matrix()[2, 2], -1.0, 1.0))))


def attitude_rate_deg_s(state: State) -> float:
    """Return the magnitude of the body rate."""
    return float(np.degrees(np.linalg.norm(state.body_rate_rad_s)))


def hash_images(pictures: Iterable[UInt16[np.ndarray, "rows columns"]]) -> str:
    """Compute the SHA-256 of the counts of pictures."""
    return hashlib.sha256(b"".join(counts.tobytes() for counts in pictures)).hexdigest()


def picture_columns(backend: Backend, image_hash: str) -> dict[str, Scalar]:
    """Return the columns of pictures with this hash that a backend rendered."""
    return {
        "image_hash": image_hash,
        "gl_backend": backend,
        "gl_version": process_renderer(backend).description(),
        "processor_features": processor_features(),
    }
