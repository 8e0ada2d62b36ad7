"""Figures of a terrain, as they are measured from terrain models and pictures of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from sim.terrain.surface import ALBEDO, HEIGHT, Surface

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


#: West, south, east and north borders of a part of a terrain, metres.
Area = tuple[float, float, float, float]


def terrain_statistics(surface: Surface, area: Area | None = None) -> TerrainStatistics:
    """All figures of a terrain, or of a part of it; a slope is NaN where that is too small for its baseline."""
    base = _part(surface.levels[0], surface.spacing_m, area)
    return TerrainStatistics(
        albedo=float(base[..., ALBEDO].mean(dtype=np.float64)),
        mean_slope_30_m_deg=mean_slope_deg(surface, 30.0, area),
        mean_slope_90_m_deg=mean_slope_deg(surface, 90.0, area),
        relief_m=float(np.ptp(base[..., HEIGHT])),
        contrast=image_contrast(surface, CONTRAST_PIXEL_M, area),
    )


def mean_slope_deg(surface: Surface, baseline_m: float, area: Area | None = None) -> float:
    """Mean absolute slope along lines to the east and to the north over a baseline, degrees.

    The slope from a terrain model's posts a baseline apart, ``atan(|z(x + L) - z(x)| / L)``: the bidirectional slope of
    the MER landing site studies (Golombek et al. 2003; Kirk et al. 2003). The slope of a plane's steepest
    descent is larger, on average by a factor of pi / 2 for small slopes in random directions. NaN where the terrain
    is not twice as wide as the baseline.
    """
    step = 1
    while surface.spacing_m * 2 * step <= baseline_m / 8.0:
        step *= 2
    spacing = surface.spacing_m * step
    z = _part(surface.levels[0][::step, ::step, HEIGHT], spacing, area)
    lag = round(baseline_m / spacing)
    if lag < 1 or 2 * lag > min(z.shape):
        return float("nan")
    if area is None:
        rises = [np.roll(z, -lag, axis=axis) - z for axis in (0, 1)]
    else:
        rises = [z[lag:] - z[:-lag], z[:, lag:] - z[:, :-lag]]
    slopes = [np.degrees(np.arctan(np.abs(rise) / (lag * spacing))).mean(dtype=np.float64) for rise in rises]
    return float(np.mean(slopes))


def _part(values: np.ndarray, spacing_m: float, area: Area | None) -> np.ndarray:
    """The samples within an area, rows and columns first."""
    if area is None:
        return values
    west, south, east, north = (border / spacing_m for border in area)
    return values[int(np.ceil(south)) : int(north) + 1, int(np.ceil(west)) : int(east) + 1]


def image_contrast(surface: Surface, pixel_m: float, area: Area | None = None) -> float:
    """RMS over mean of the brightness seen from straight above, over the whole terrain or a part of it.

    Each pixel takes slope and albedo of the pyramid's level whose samples are about as far apart as pixels. The
    brightness is Lunar-Lambert's under the sun 45 deg high in the west and an even sky; shadows and
    detector are left out.
    """
    level = min(max(round(np.log2(pixel_m / surface.spacing_m)), 0), len(surface.levels) - 1)
    picture = nadir_picture(surface, level, np.radians(270.0), np.radians(CONTRAST_SUN_ELEVATION_DEG))
    seen = _part(picture, surface.spacing_m * 2.0**level, area)
    return float(seen.std() / seen.mean())


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
    brightness: Float64[np.ndarray, "rows columns"] = field[..., ALBEDO] * (
        direct + CONTRAST_SKY_SHARE * 0.5 * (1.0 + up)
    )
    return brightness
