"""Compiled mean wind and gusts as a function of height; `marsyard.sim.dynamics.wind` defines and draws them."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
#: Columns of `WindField.waves`: wavenumber, rad/m; amplitudes east, north and up of the cosine, then of the sine, m/s.
WAVENUMBER = 0
COSINE_EAST, COSINE_NORTH, COSINE_UP = 1, 2, 3
SINE_EAST, SINE_NORTH, SINE_UP = 4, 5, 6
#: Number of these columns, and of those with amplitudes.
WAVE_COLUMNS, AMPLITUDES = 7, 6


class WindField(NamedTuple):
    """Mean wind and gusts as functions of height: see `marsyard.sim.dynamics.wind.Wind`.

    - ground_height_m: world z of the ground
    - mean_east_m_s, mean_north_m_s: mean wind above the boundary layer
    - layer_m, roughness_m: depth of the boundary layer, and roughness of the ground
    - waves: gusts, a row per wave (columns `WAVENUMBER` to `SINE_UP`)
    """

    ground_height_m: float
    mean_east_m_s: float
    mean_north_m_s: float
    layer_m: float
    roughness_m: float
    waves: Array


#: Number of fields of a wind field without the waves.
WIND_SCALARS = len(WindField._fields) - 1


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
        cosine = math.cos(wave[WAVENUMBER] * height)
        sine = math.sin(wave[WAVENUMBER] * height)
        east += wave[COSINE_EAST] * cosine + wave[SINE_EAST] * sine
        north += wave[COSINE_NORTH] * cosine + wave[SINE_NORTH] * sine
        up += wave[COSINE_UP] * cosine + wave[SINE_UP] * sine
    return east, north, up


@njit(cache=True)
def compute_wind_profile(heights: Array, field: WindField) -> Array:
    """Compute the wind at many heights, a row (east, north, up) each."""
    rows = np.empty((heights.size, 3))
    for i in range(heights.size):
        rows[i] = compute_wind(heights[i], field)
    return rows
