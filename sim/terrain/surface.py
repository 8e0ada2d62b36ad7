"""The ground as a smooth, periodic surface with albedo.

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
from jaxtyping import Float, Float32
from numpy.typing import DTypeLike, NDArray

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
