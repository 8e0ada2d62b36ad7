"""Figures of a terrain, as they are measured from terrain models and pictures of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.ndimage import correlate1d

from marsyard.sim.terrain.surface import ALBEDO, HEIGHT, Surface

#: Light under which contrast is stated: the sun's elevation, and the share of diffuse light.
CONTRAST_SUN_ELEVATION_DEG = 45.0
CONTRAST_SKY_SHARE = 0.15
#: Share of Lommel-Seeliger reflection (McEwen 1991).
CONTRAST_LUNAR_SHARE = 0.55
#: Distance between pixels of a descent picture of 1024 x 1024 over 45 deg, binned four times as DIMES uses it, 2 km
#: above the ground: 4 * 2 * 2000 m * tan(22.5 deg) / 1024.
CONTRAST_PIXEL_M = 6.5


@dataclass(frozen=True)
class TerrainStatistics:
    """Figures of one terrain.

    Attributes
    ----------
    albedo
        Mean albedo.
    mean_slope_30_m_deg, mean_slope_90_m_deg
        Mean slope along lines over that baseline, see `mean_slope_deg`.
    relief_m
        Lowest to highest point.
    contrast
        RMS over mean of a picture from above, see `image_contrast`.
    """

    albedo: float
    mean_slope_30_m_deg: float
    mean_slope_90_m_deg: float
    relief_m: float
    contrast: float


#: Which samples of a terrain figures are computed from; None for all.
Samples = Bool[np.ndarray, "side side"]
#: A cubic B-spline at its knots, from the control values around.
_AT_KNOTS = np.array([1.0, 4.0, 1.0]) / 6.0


def terrain_statistics(surface: Surface, samples: Samples | None = None) -> TerrainStatistics:
    """All figures of a terrain, or of some of its samples; a slope is NaN where they are too few for its baseline."""
    heights, chosen = _heights(surface), samples if samples is not None else np.s_[:]
    return TerrainStatistics(
        albedo=float(surface.levels[0][..., ALBEDO][chosen].mean(dtype=np.float64)),
        mean_slope_30_m_deg=_slope_deg(heights, surface.spacing_m, 30.0, samples),
        mean_slope_90_m_deg=_slope_deg(heights, surface.spacing_m, 90.0, samples),
        relief_m=float(np.ptp(heights[chosen])),
        contrast=image_contrast(surface, CONTRAST_PIXEL_M, samples),
    )


def _heights(surface: Surface) -> Float32[np.ndarray, "side side"]:
    """Heights of the surface at its samples, metres: the spline's values, not its control values."""
    heights = surface.levels[0][..., HEIGHT]
    for axis in (0, 1):
        heights = correlate1d(heights, _AT_KNOTS, axis=axis, mode="wrap")
    return np.asarray(heights, dtype=np.float32)


def mean_slope_deg(surface: Surface, baseline_m: float, samples: Samples | None = None) -> float:
    """Mean absolute slope along lines to the east and to the north over a baseline, degrees.

    The slope from a terrain model's posts a baseline apart, ``atan(|z(x + L) - z(x)| / L)``: the bidirectional slope of
    the MER landing site studies (Golombek et al. 2003; Kirk et al. 2003). The slope of a plane's steepest
    descent is larger, on average by a factor of pi / 2 for small slopes in random directions. NaN where the terrain,
    or the part of it that holds the samples, is not twice as wide as the baseline. Of some samples, the lines
    begin and end at one of them.
    """
    return _slope_deg(_heights(surface), surface.spacing_m, baseline_m, samples)


def _slope_deg(
    heights: Float32[np.ndarray, "side side"], spacing_m: float, baseline_m: float, samples: Samples | None
) -> float:
    step = 1
    while spacing_m * 2 * step <= baseline_m / 8.0:
        step *= 2
    z, chosen = heights[::step, ::step], None if samples is None else samples[::step, ::step]
    if chosen is not None:
        part = _around(chosen)
        z, chosen = z[part], chosen[part]
    lag = round(baseline_m / (spacing_m * step))
    if lag < 1 or 2 * lag > min(z.shape):
        return float("nan")
    if chosen is None:
        rises = [np.roll(z, -lag, axis=axis) - z for axis in (0, 1)]
    else:
        rises = [
            (z[lag:] - z[:-lag])[chosen[lag:] & chosen[:-lag]],
            (z[:, lag:] - z[:, :-lag])[chosen[:, lag:] & chosen[:, :-lag]],
        ]
    if not all(rise.size for rise in rises):
        return float("nan")
    length = lag * spacing_m * step
    return float(np.mean([np.degrees(np.arctan(np.abs(rise) / length)).mean(dtype=np.float64) for rise in rises]))


def _around(chosen: Samples) -> tuple[slice, slice]:
    """The smallest part of a grid that holds all chosen samples."""
    along = [np.flatnonzero(chosen.any(axis=axis)) for axis in (1, 0)]
    rows, columns = (slice(int(some[0]), int(some[-1]) + 1) if some.size else slice(0) for some in along)
    return rows, columns


def image_contrast(surface: Surface, pixel_m: float, samples: Samples | None = None) -> float:
    """RMS over mean of the brightness seen from straight above, over the whole terrain or some of its samples.

    Each pixel takes slope and albedo of the pyramid's level whose samples are about as far apart as pixels. The
    brightness is Lunar-Lambert's under the sun 45 deg high in the west and an even sky; shadows and
    detector are left out. NaN where no sample falls on a pixel.
    """
    level = min(max(round(np.log2(pixel_m / surface.spacing_m)), 0), len(surface.levels) - 1)
    seen = nadir_picture(surface, level, np.radians(270.0), np.radians(CONTRAST_SUN_ELEVATION_DEG)).reshape(-1)
    if samples is not None:
        seen = seen[samples[:: 2**level, :: 2**level].reshape(-1)]
    return float(seen.std() / seen.mean()) if seen.size else float("nan")


def nadir_picture(
    surface: Surface, level: int, sun_azimuth_rad: float, sun_elevation_rad: float
) -> Float64[np.ndarray, "rows columns"]:
    """Radiance factor of one level's samples seen from straight above; row 0 is the terrain's southern edge."""
    field = surface.levels[level].astype(np.float64)
    spacing = surface.spacing_m * 2.0**level
    height = field[..., HEIGHT]
    slope_x = (np.roll(height, -1, axis=1) - np.roll(height, 1, axis=1)) / (2.0 * spacing)
    slope_y = (np.roll(height, -1, axis=0) - np.roll(height, 1, axis=0)) / (2.0 * spacing)
    up = 1.0 / np.sqrt(1.0 + slope_x**2 + slope_y**2)
    level_sun = np.cos(sun_elevation_rad)
    towards = (
        np.sin(sun_elevation_rad)
        - slope_x * np.sin(sun_azimuth_rad) * level_sun
        - slope_y * np.cos(sun_azimuth_rad) * level_sun
    )
    cos_i = np.maximum(towards * up, 0.0)
    direct = 2.0 * CONTRAST_LUNAR_SHARE * cos_i / (cos_i + up) + (1.0 - CONTRAST_LUNAR_SHARE) * cos_i
    return np.asarray(field[..., ALBEDO] * (direct + CONTRAST_SKY_SHARE * 0.5 * (1.0 + up)))
