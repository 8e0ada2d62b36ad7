"""The ground as a smooth, periodic surface with albedo.

A terrain is *defined* as the uniform cubic B-spline whose control values are the stored samples: twice continuously
differentiable, evaluated exactly with its gradient, and reproduced independently by
``scipy.ndimage.map_coordinates(samples, order=3, mode="grid-wrap", prefilter=False)``. It repeats in x and y.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32

from marsyard.sim.terrain.kernels import block_ceilings, evaluate_field, reduce_level

HEIGHT, ALBEDO = 0, 1  #: Channels of the stored samples.
Coordinate = Float[np.ndarray, "*batch"] | float  #: One coordinate or many, metres.
SMALLEST_LEVEL = 16  #: Samples along each side of the coarsest level kept.
ROUGHNESS, TEXTURE, ROCKS = 0, 1, 2  #: Channels of a cover.
UNIFORM = np.ones((1, 1, 3), dtype=np.float32)  #: Cover of ground that is alike everywhere.


@dataclass(frozen=True)
class Surface:
    """A periodic terrain surface with a pyramid of levels, coarser ones for pixels that cover many samples.

    - levels: read-only control values of height (metres) and albedo. Level l has samples every ``spacing_m * 2**l``
      metres: row i lies at y = i * spacing, column j at x = j * spacing
    - spacing_m: distance between samples at level 0
    - cover: factors of fine relief, fine albedo contrast and rock density on a grid of the same extent; one sample of
      ones where the ground is alike everywhere
    """

    levels: tuple[Float32[np.ndarray, "rows columns 2"], ...]
    spacing_m: float
    cover: Float32[np.ndarray, "side side 3"] = field(default_factory=lambda: UNIFORM)

    @classmethod
    def from_samples(
        cls,
        samples: Float32[np.ndarray, "rows columns 2"],
        spacing_m: float,
        cover: Float32[np.ndarray, "side side 3"] = UNIFORM,
    ) -> Surface:
        """Build the pyramid over level 0, a square whose side is a power of two of at least 16; else ValueError."""
        side = samples.shape[0]
        if samples.shape[1] != side or side < SMALLEST_LEVEL or side & (side - 1):
            needed = "a square with a power of two of at least 16 is needed"
            raise ValueError(f"terrain samples have shape {samples.shape}; {needed}")
        levels = [np.ascontiguousarray(samples)]
        while levels[-1].shape[0] > SMALLEST_LEVEL:
            levels.append(reduce_level(levels[-1]))
        for level in levels:
            level.setflags(write=False)
        return cls(tuple(levels), spacing_m, cover)

    @property
    def period_m(self) -> float:
        """Distance after which the terrain repeats."""
        return float(self.levels[0].shape[0] * self.spacing_m)

    @cached_property
    def ceilings(self) -> tuple[Float32[np.ndarray, "_ _"], ...]:
        """Upper bounds of each level's height, metres, over blocks of `CEILING_BLOCK` samples along each side."""
        return tuple(block_ceilings(level) for level in self.levels)

    def height(self, x: Coordinate, y: Coordinate, level: int = 0) -> Float[np.ndarray, "*batch"]:
        """Height above the datum, metres, at world positions."""
        return self._evaluate(x, y, level)[..., 0]

    def gradient(self, x: Coordinate, y: Coordinate, level: int = 0) -> Float[np.ndarray, "*batch 2"]:
        """Slope (dz/dx, dz/dy) at world positions."""
        return self._evaluate(x, y, level)[..., 1:3]

    def albedo(self, x: Coordinate, y: Coordinate, level: int = 0) -> Float[np.ndarray, "*batch"]:
        """Albedo at world positions."""
        return self._evaluate(x, y, level)[..., 3]

    def _evaluate(self, x: Coordinate, y: Coordinate, level: int) -> Float[np.ndarray, "*batch 4"]:
        x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
        values = evaluate_field(self.levels[level], self.spacing_m * 2.0**level, x.ravel().copy(), y.ravel().copy())
        return np.asarray(values.reshape(*x.shape, 4))
