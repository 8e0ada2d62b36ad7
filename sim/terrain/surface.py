"""The ground as a smooth, periodic surface with albedo, and statistics of its slopes and relief.

A terrain is *defined* as the uniform cubic B-spline whose control values are the stored samples. It is twice
continuously differentiable, and periodic in x and y. Value and gradient are exact. An independent evaluation is
``scipy.ndimage.map_coordinates(samples, order=3, mode="grid-wrap", prefilter=False)``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64
from numpy.typing import DTypeLike, NDArray
from scipy.ndimage import correlate1d

from marsyard.sim.terrain.kernels import block_ceilings, evaluate_field, reduce_level

HEIGHT, ALBEDO = 0, 1  #: Channels of the stored samples.
Coordinate = Float[np.ndarray, "*batch"] | float  #: One coordinate or many, metres.
_MOMENTS_SIDE = 1024  #: Maximum side of the level from which moments of the albedo are computed.
SMALLEST_LEVEL = 16  #: Samples along each side of the coarsest level.
ALIGNMENT_BYTES = 64  #: Alignment of memory that is shared with the renderer's device: that of vectors of AVX-512.
ROUGHNESS, TEXTURE, ROCKS = 0, 1, 2  #: Channels of the factors of the ground.
UNIFORM = np.ones((1, 1, 3), dtype=np.float32)  #: Factors of uniform ground.


def empty_aligned(shape: tuple[int, ...], kind: DTypeLike) -> NDArray[Any]:
    """Create an uninitialised array in aligned memory, which NumPy and the renderer's device can share."""
    item_bytes = np.dtype(kind).itemsize
    memory = np.empty(math.prod(shape) + ALIGNMENT_BYTES // item_bytes, dtype=kind)
    first = -memory.ctypes.data % ALIGNMENT_BYTES // item_bytes
    return memory[first : first + math.prod(shape)].reshape(shape)


def level_sides(side: int) -> list[int]:
    """Return the side of each level of a pyramid, in samples, from that of the finest level."""
    return [side >> level for level in range((side // SMALLEST_LEVEL).bit_length())]


def empty_pyramid(side: int) -> Float32[np.ndarray, "values"]:
    """Create the uninitialised control values of a pyramid with `side` samples along each side of level 0."""
    return empty_aligned((2 * sum(samples**2 for samples in level_sides(side)),), np.float32)


def split_levels(
    samples: Float32[np.ndarray, "values"], sides: list[int]
) -> tuple[Float32[np.ndarray, "rows columns 2"], ...]:
    """Split the control values of a pyramid into views of its levels."""
    parts = np.split(samples, np.cumsum([2 * side**2 for side in sides[:-1]]))
    return tuple(part.reshape(side, side, 2) for part, side in zip(parts, sides, strict=True))


@dataclass(frozen=True)
class Surface:
    """A periodic terrain surface with a pyramid of levels; coarse levels are for pixels that cover many samples.

    - samples: read-only control values of all levels, finest level first
    - spacing_m: distance between samples at level 0
    - factors: factors of fine relief, fine albedo contrast and rock density on a grid of the same extent; for uniform
      ground a single sample with the factors 1
    """

    samples: Float32[np.ndarray, "values"]
    spacing_m: float
    factors: Float32[np.ndarray, "side side 3"] = field(default_factory=lambda: UNIFORM)

    def __post_init__(self) -> None:
        # for writable arrays numba would compile the kernels again
        self.samples.setflags(write=False)

    @classmethod
    def from_samples(
        cls,
        samples: Float32[np.ndarray, "rows columns 2"],
        spacing_m: float,
        factors: Float32[np.ndarray, "side side 3"] = UNIFORM,
    ) -> Surface:
        """Build the pyramid from level 0; ValueError unless level 0 is a square of 2**k samples per side, k >= 4."""
        side = samples.shape[0]
        if samples.shape[1] != side or side < SMALLEST_LEVEL or side & (side - 1):
            requirement = "a square with a power of two of at least 16 is needed"
            raise ValueError(f"terrain samples have shape {samples.shape}; {requirement}")
        pyramid = empty_pyramid(side)
        split_levels(pyramid, level_sides(side))[0][:] = samples
        return cls.from_pyramid(pyramid, spacing_m, factors)

    @classmethod
    def from_pyramid(
        cls,
        pyramid: Float32[np.ndarray, "values"],
        spacing_m: float,
        factors: Float32[np.ndarray, "side side 3"] = UNIFORM,
    ) -> Surface:
        """Compute the coarse levels of a pyramid of `empty_pyramid` from level 0, in place."""
        surface = cls(pyramid.view(), spacing_m, factors)
        for fine, coarse in pairwise(split_levels(pyramid, [len(level) for level in surface.levels])):
            coarse[:] = reduce_level(fine)
        return surface

    @cached_property
    def levels(self) -> tuple[Float32[np.ndarray, "rows columns 2"], ...]:
        """Control values of height (metres) and albedo of each level.

        Level l has samples every ``spacing_m * 2**l`` metres: row i lies at y = i * spacing, column j at x = j *
        spacing.
        """
        # the number of all samples is between side**2 and 4 / 3 side**2
        side = 1 << ((self.samples.size // 2).bit_length() - 1) // 2
        return split_levels(self.samples, level_sides(side))

    @property
    def period_m(self) -> float:
        """Distance after which the terrain repeats."""
        return float(self.levels[0].shape[0] * self.spacing_m)

    @cached_property
    def ceilings(self) -> tuple[Float32[np.ndarray, "_ _"], ...]:
        """Upper bounds of each level's height, metres, over blocks of `CEILING_BLOCK` samples along each side."""
        return tuple(block_ceilings(level) for level in self.levels)

    @cached_property
    def log_albedo_moments(self) -> tuple[float, float]:
        """Mean and standard deviation of the logarithm of albedo, of a level with at most 1024 samples along a side."""
        level = next(level for level in self.levels if len(level) <= _MOMENTS_SIDE)
        values = np.log(np.maximum(level[..., ALBEDO], 1e-6))
        return float(values.mean(dtype=np.float64)), float(values.std(dtype=np.float64))

    def height(self, x: Coordinate, y: Coordinate, level: int = 0) -> Float[np.ndarray, "*batch"]:
        """Evaluate the height above the datum, metres, at world positions."""
        return self.evaluate(x, y, level)[..., 0]

    def gradient(self, x: Coordinate, y: Coordinate, level: int = 0) -> Float[np.ndarray, "*batch 2"]:
        """Evaluate the slope (dz/dx, dz/dy) at world positions."""
        return self.evaluate(x, y, level)[..., 1:3]

    def albedo(self, x: Coordinate, y: Coordinate, level: int = 0) -> Float[np.ndarray, "*batch"]:
        """Evaluate the albedo at world positions."""
        return self.evaluate(x, y, level)[..., 3]

    def evaluate(self, x: Coordinate, y: Coordinate, level: int = 0) -> Float[np.ndarray, "*batch 4"]:
        """Evaluate height, slopes (dz/dx, dz/dy) and albedo at world positions."""
        x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
        values = evaluate_field(self.levels[level], self.spacing_m * 2.0**level, x.ravel().copy(), y.ravel().copy())
        return np.asarray(values.reshape(*x.shape, 4))


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
