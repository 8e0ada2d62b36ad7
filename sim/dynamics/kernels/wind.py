"""Compiled wind as a function of height: mean wind and gusts; `marsyard.sim.dynamics.wind` defines the model."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


class WindField(NamedTuple):
    """Mean wind and gusts as functions of height: see `marsyard.sim.dynamics.wind.Wind`.

    Columns of `waves`: wavenumber, rad/m; amplitudes east, north and up of the cosine; then of the sine, m/s.
    """

    ground_height_m: float
    mean_east_m_s: float
    mean_north_m_s: float
    layer_m: float
    roughness_m: float
    waves: Array


@njit(cache=True)
def compute_wind(height: float, field: WindField) -> tuple[float, float, float]:
    """Compute the east, north and upward wind at a world z, m/s."""
    altitude = max(height - field.ground_height_m, 0.0)
    profile = 1.0
    if altitude < field.layer_m:
        profile = math.log1p(altitude / field.roughness_m) / math.log1p(field.layer_m / field.roughness_m)
    east = profile * field.mean_east_m_s
    north = profile * field.mean_north_m_s
    up = 0.0
    for k in range(field.waves.shape[0]):
        wave = field.waves[k]
        cosine = math.cos(wave[0] * height)
        sine = math.sin(wave[0] * height)
        east += wave[1] * cosine + wave[4] * sine
        north += wave[2] * cosine + wave[5] * sine
        up += wave[3] * cosine + wave[6] * sine
    return east, north, up


@njit(cache=True)
def compute_wind_profile(heights: Array, field: WindField) -> Array:
    """Compute the wind at many heights, a row (east, north, up) each."""
    rows = np.empty((heights.size, 3))
    for i in range(heights.size):
        rows[i] = compute_wind(heights[i], field)
    return rows
