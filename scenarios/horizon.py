"""Relief on the horizon of a terrain: hills of its site, and swells of the plain."""

from collections.abc import Sequence
from zlib import crc32

import numpy as np
from jaxtyping import Float64
from numpy.random import Generator

from marsyard.sim.render.skyline import Relief
from marsyard.sim.terrain import Surface
from marsyard.sim.terrain.sites import Hill

#: Steps of azimuth around the horizon.
_AZIMUTHS = 8192
#: RMS irregularity of a hill's outline relative to its height, and Hurst exponent of all outlines (assumed).
_IRREGULARITY, _HURST = 0.25, 1.3
#: Swells of the plain: RMS height and distance, metres, and size, radians (assumed).
_SWELL_M, _SWELL_DISTANCE_M, _SWELL_RAD = 4.0, 3000.0, 0.3
#: Albedo of hills relative to the plain's; assumed.
_HILL_ALBEDO = 0.85
_MARS_RADIUS_M = 3.39e6


def horizon_relief(hills: Sequence[Hill], surface: Surface, extinction_m: float, albedo: float) -> Relief:
    """Compute the relief on the horizon of a terrain: the hills of its site, in front of them the swells of the plain.

    Hills are Gaussian domes with an irregular outline, lower by the curvature of the planet. Outlines and swells are
    equal in all images of a terrain, and differ between terrains. `extinction_m` is that of the air at the ground,
    `albedo` that of the plain.
    """
    rng = np.random.default_rng(crc32(surface.levels[-1].tobytes()))
    azimuth = 2.0 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS
    layers = sorted(hills, key=lambda hill: -hill.distance_m)
    heights = [_draw_outline(hill, azimuth, rng) for hill in layers]
    heights.append(_SWELL_M * _draw_irregularity(_SWELL_RAD, rng))
    distances = np.array([*(hill.distance_m for hill in layers), _SWELL_DISTANCE_M])
    # the plain curves away from its tangent plane by distance^2 / (2 radius)
    elevations = np.stack(heights) / distances[:, None] - distances[:, None] / (2.0 * _MARS_RADIUS_M)
    # the steepest slope of a Gaussian of standard deviation depth / 4 is 0.61 height / (depth / 4)
    depths = np.array([*(hill.depth_m for hill in layers), _SWELL_DISTANCE_M])
    steepness = 0.61 * distances / (0.25 * depths)
    return Relief(elevations.astype(np.float32), np.exp(-extinction_m * distances), steepness, _HILL_ALBEDO * albedo)


def _draw_outline(
    hill: Hill, azimuth: Float64[np.ndarray, "azimuths"], rng: Generator
) -> Float64[np.ndarray, "azimuths"]:
    """Draw the height of a hill's upper edge, metres: an irregular Gaussian of standard deviation width / 4."""
    angle = (azimuth - np.radians(hill.azimuth_deg) + np.pi) % (2.0 * np.pi) - np.pi
    dome = np.exp(-2.0 * (2.0 * angle * hill.distance_m / hill.width_m) ** 2)
    irregularity = _draw_irregularity(0.25 * hill.width_m / hill.distance_m, rng)
    return np.asarray(hill.height_m * dome * np.maximum(1.0 + _IRREGULARITY * irregularity, 0.0))


def _draw_irregularity(largest_rad: float, rng: Generator) -> Float64[np.ndarray, "azimuths"]:
    """Draw a fractal line around the horizon with the RMS 1 and the exponent `_HURST`, white above `largest_rad`."""
    waves = np.arange(_AZIMUTHS // 2 + 1)
    amplitude = (waves**2 + (2.0 * np.pi / largest_rad) ** 2) ** (-0.5 * (_HURST + 0.5))
    amplitude[0] = 0.0
    line = np.fft.irfft(amplitude * (rng.standard_normal((len(waves), 2)) @ (1.0, 1.0j)))
    return np.asarray(line / line.std())
