"""Albedo, slopes, relief and image contrast of a terrain, and the published values of sites to compare with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.ndimage import correlate1d

from marsyard.sim.terrain.surface import ALBEDO, HEIGHT, Surface

#: Illumination that defines the contrast: the sun's elevation, and the fraction of diffuse light.
CONTRAST_SUN_ELEVATION_DEG = 45.0
CONTRAST_SKY_FRACTION = 0.15
CONTRAST_LUNAR_FRACTION = 0.55  #: Fraction of Lommel-Seeliger reflection (McEwen 1991).
#: Distance between pixels of a descent image of 1024 x 1024 over 45 deg, binned four times as DIMES uses it, 2 km
#: above the ground: 4 * 2 * 2000 m * tan(22.5 deg) / 1024.
CONTRAST_PIXEL_M = 6.5

Samples = Bool[np.ndarray, "side side"]  #: Mask of a terrain's samples.
Heights = Float32[np.ndarray, "side side"]
#: A cubic B-spline's value at a knot from the three control values there.
_SPLINE_AT_KNOTS = np.array([1.0, 4.0, 1.0]) / 6.0


@dataclass(frozen=True)
class PublishedSite:
    """Published values of a site: minimum and maximum; slopes are those for baselines of 30 m and 90 m.

    - contrast: the publication's words on the contrast of the ground
    """

    albedo: tuple[float, float]
    mean_slope_deg: tuple[float, float]
    relief_m: tuple[float, float] | None
    contrast: str


_MER_SITE = PublishedSite((0.1, 0.3), (1.0, 2.0), None, "MOC: a lower limit, seen through dust")
#: DIMES field test paper, section III.A; it contains common values for the MER landing sites.
PUBLISHED_SITES: dict[str, PublishedSite] = {
    "pisgah": PublishedSite((0.1, 0.1), (2.0, 3.0), None, "very little; like synthesised images of most MER sites"),
    "kelso": PublishedSite((0.5, 0.5), (2.0, 3.0), (200.0, float("inf")), "repetitive"),
    "ivanpah": PublishedSite((0.4, 0.4), (2.0, 3.0), None, "bland; the smoothest of the field sites"),
    "gusev": _MER_SITE,
    "meridiani": _MER_SITE,
}


@dataclass(frozen=True)
class TerrainStatistics:
    """Statistics of one terrain: see `mean_slope_deg` and `image_contrast`; relief is from lowest to highest point."""

    albedo: float
    mean_slope_30_m_deg: float
    mean_slope_90_m_deg: float
    relief_m: float
    contrast: float


def terrain_statistics(surface: Surface, samples: Samples | None = None) -> TerrainStatistics:
    """Compute the statistics over all or selected samples; a slope is NaN if they are too few for its baseline."""
    heights, selection = _heights(surface), samples if samples is not None else np.s_[:]
    return TerrainStatistics(
        albedo=float(surface.levels[0][..., ALBEDO][selection].mean(dtype=np.float64)),
        mean_slope_30_m_deg=_slope_deg(heights, surface.spacing_m, 30.0, samples),
        mean_slope_90_m_deg=_slope_deg(heights, surface.spacing_m, 90.0, samples),
        relief_m=float(np.ptp(heights[selection])),
        contrast=image_contrast(surface, CONTRAST_PIXEL_M, samples),
    )


def _heights(surface: Surface) -> Heights:
    """Evaluate the heights of the surface at its samples: the spline's values, not its control values."""
    heights = surface.levels[0][..., HEIGHT]
    for axis in (0, 1):
        heights = correlate1d(heights, _SPLINE_AT_KNOTS, axis=axis, mode="wrap")
    return np.asarray(heights, dtype=np.float32)


def mean_slope_deg(surface: Surface, baseline_m: float, samples: Samples | None = None) -> float:
    """Compute the mean bidirectional slope: absolute slope along lines to the east and north over a baseline.

    ``atan(|z(x + L) - z(x)| / L)`` for the baseline L, as in the MER landing site studies (Golombek et al. 2003; Kirk
    et al. 2003). The steepest slope of a plane is larger, on average by a factor of pi / 2 for small slopes in random
    directions. Lines begin and end at `samples`. NaN if the terrain, or the bounding box of the samples, is narrower
    than two baselines.
    """
    return _slope_deg(_heights(surface), surface.spacing_m, baseline_m, samples)


def _slope_deg(heights: Heights, spacing_m: float, baseline_m: float, samples: Samples | None) -> float:
    """Compute `mean_slope_deg` from the heights at the samples of a terrain."""
    # decimate to a spacing of 1/16 to 1/8 of the baseline
    step = 1
    while spacing_m * 2 * step <= baseline_m / 8.0:
        step *= 2
    z, mask = heights[::step, ::step], None if samples is None else samples[::step, ::step]
    if mask is not None:
        # crop to the bounding box of the samples
        axes = [np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0)]
        box = tuple(slice(int(indices[0]), int(indices[-1]) + 1) if indices.size else slice(0) for indices in axes)
        z, mask = z[box], mask[box]
    lag = round(baseline_m / (spacing_m * step))
    if lag < 1 or 2 * lag > min(z.shape):
        return float("nan")
    if mask is None:
        rises = [np.roll(z, -lag, axis=axis) - z for axis in (0, 1)]
    else:
        rises = [
            (z[lag:] - z[:-lag])[mask[lag:] & mask[:-lag]],
            (z[:, lag:] - z[:, :-lag])[mask[:, lag:] & mask[:, :-lag]],
        ]
    if not all(rise.size for rise in rises):
        return float("nan")
    length = lag * spacing_m * step
    return float(np.mean([np.degrees(np.arctan(np.abs(rise) / length)).mean(dtype=np.float64) for rise in rises]))


def image_contrast(surface: Surface, pixel_m: float, samples: Samples | None = None) -> float:
    """Compute the RMS contrast (standard deviation / mean) of a nadir image, over all or selected samples.

    NaN if no pixel contains a selected sample. Each pixel has the slope and albedo of the pyramid level whose spacing
    is nearest to the pixel size. The reflectance is Lunar-Lambert, with the sun at an elevation of 45 deg in the west
    and a uniform sky; shadows and detector are omitted.
    """
    level = min(max(round(np.log2(pixel_m / surface.spacing_m)), 0), len(surface.levels) - 1)
    image = render_nadir_image(surface, level, np.radians(270.0), np.radians(CONTRAST_SUN_ELEVATION_DEG)).reshape(-1)
    if samples is not None:
        image = image[samples[:: 2**level, :: 2**level].reshape(-1)]
    return float(image.std() / image.mean()) if image.size else float("nan")


def render_nadir_image(
    surface: Surface, level: int, sun_azimuth_rad: float, sun_elevation_rad: float
) -> Float64[np.ndarray, "rows columns"]:
    """Compute the radiance factor of one level's samples in nadir view; row 0 is the terrain's southern edge."""
    channels = surface.levels[level].astype(np.float64)
    spacing = surface.spacing_m * 2.0**level
    height = channels[..., HEIGHT]
    slope_x, slope_y = ((np.roll(height, -1, axis) - np.roll(height, 1, axis)) / (2.0 * spacing) for axis in (1, 0))
    # cosines of the emission angle and of the incidence angle
    cos_e = 1.0 / np.sqrt(1.0 + slope_x**2 + slope_y**2)
    east, north = np.sin(sun_azimuth_rad), np.cos(sun_azimuth_rad)
    horizontal, up = np.cos(sun_elevation_rad), np.sin(sun_elevation_rad)
    towards_sun = up - slope_x * east * horizontal - slope_y * north * horizontal
    cos_i = np.maximum(towards_sun * cos_e, 0.0)
    # a uniform sky illuminates a slope with (1 + cos(slope)) / 2 of its irradiance on level ground
    direct = 2.0 * CONTRAST_LUNAR_FRACTION * cos_i / (cos_i + cos_e) + (1.0 - CONTRAST_LUNAR_FRACTION) * cos_i
    return np.asarray(channels[..., ALBEDO] * (direct + CONTRAST_SKY_FRACTION * 0.5 * (1.0 + cos_e)))
