"""The ground as a smooth, periodic surface with albedo.

A terrain is *defined* as the uniform cubic B-spline whose control values are the stored samples: twice continuously
differentiable, evaluated exactly and cheaply with its gradient, and reproduced independently by
``scipy.ndimage.map_coordinates(samples, order=3, mode="grid-wrap", prefilter=False)``. It repeats in x and y with
period ``period_m``, so the ground has no edge.

Coarser levels of the same ground, for views in which a pixel covers many samples, form a pyramid: level l has samples
every ``spacing_m * 2**l`` metres, sample (0, 0) at the same place on every level.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32

from marsyard.sim.terrain.kernels import ceiling_of, evaluate_field, reduce_level

#: Channels of the stored samples.
HEIGHT, ALBEDO = 0, 1
#: One coordinate or many, metres.
Coordinate = Float[np.ndarray, "*batch"] | float
#: Samples along each side of the coarsest level kept.
SMALLEST_LEVEL = 16


@dataclass(frozen=True)
class Surface:
    """A periodic terrain surface.

    Attributes
    ----------
    levels
        Control values of height (metres, channel 0) and albedo (channel 1), one array per level of the pyramid, shape
        (rows, columns, 2), read-only. Row i lies at y = i * spacing, column j at x = j * spacing: y grows with the row.
    spacing_m
        Distance between samples at level 0, metres.
    """

    levels: tuple[Float32[np.ndarray, "rows columns 2"], ...]
    spacing_m: float

    @classmethod
    def from_samples(cls, samples: Float32[np.ndarray, "rows columns 2"], spacing_m: float) -> Surface:
        """The surface of these level-0 control values; both sides must be the same power of two, at least 16."""
        side = samples.shape[0]
        if samples.shape[1] != side or side < SMALLEST_LEVEL or side & (side - 1):
            raise ValueError(
                f"terrain samples have shape {samples.shape}; a square with a power of two of at least 16 is needed"
            )
        levels = [np.ascontiguousarray(samples)]
        while levels[-1].shape[0] > SMALLEST_LEVEL:
            levels.append(reduce_level(levels[-1]))
        for level in levels:
            level.setflags(write=False)
        return cls(tuple(levels), spacing_m)

    @property
    def period_m(self) -> float:
        """The distance after which the terrain repeats, metres."""
        return float(self.levels[0].shape[0] * self.spacing_m)

    @cached_property
    def ceilings(self) -> tuple[Float32[np.ndarray, "_ _"], ...]:
        """Upper bounds of each level's height, metres, over blocks of `CEILING_BLOCK` samples along each side."""
        return tuple(ceiling_of(level) for level in self.levels)

    def height(self, x: Coordinate, y: Coordinate, level: int = 0) -> Float[np.ndarray, "*batch"]:
        """Height above the datum, metres, at world positions x, y (metres)."""
        return self._evaluate(x, y, level)[..., 0]

    def gradient(self, x: Coordinate, y: Coordinate, level: int = 0) -> Float[np.ndarray, "*batch 2"]:
        """Slope (dz/dx, dz/dy) at world positions x, y (metres)."""
        return self._evaluate(x, y, level)[..., 1:3]

    def albedo(self, x: Coordinate, y: Coordinate, level: int = 0) -> Float[np.ndarray, "*batch"]:
        """Albedo at world positions x, y (metres)."""
        return self._evaluate(x, y, level)[..., 3]

    def _evaluate(self, x: Coordinate, y: Coordinate, level: int) -> Float[np.ndarray, "*batch 4"]:
        x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
        values = evaluate_field(
            self.levels[level], self.spacing_m * 2.0**level, np.ascontiguousarray(x.ravel()), y.ravel().copy()
        )
        return np.asarray(values.reshape(*x.shape, 4))
