"""Periodic grids of numbers on the device, and their interpolation at positions: maps that repeat over all the ground.

The side of a grid is a power of two, as that of the terrain, so the index of a position needs no division.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from marsyard.sim.render.arrays import Values, to_device
from marsyard.sim.render.device import Float, Float64, Int32, UInt8, UInt32


@dataclass(frozen=True, eq=False)
class PeriodicGrid:
    """A periodic grid of numbers on the device.

    - values: the numbers, row by row; y increases with the row, x with the column
    - log2_side: logarithm to the base 2 of the numbers along a side
    - per_metre: cells per metre; the first number is at x = y = 0
    """

    values: Values
    log2_side: Values
    per_metre: Values

    @classmethod
    def of(cls, values: np.ndarray, per_metre: float, *, share: bool = False) -> PeriodicGrid:
        """Copy a grid, shape (side, side), to the device."""
        kind = UInt8 if values.dtype == np.uint8 else Float
        side = len(values)
        return cls(to_device(kind, values, share=share), UInt32(side.bit_length() - 1), Float64(per_metre))

    def neighbours(self, x: Values, y: Values, active: Values) -> tuple[list[Values], Values, Values]:
        """Return the values south-west, south-east, north-west, north-east of positions, and fractions of a cell."""
        grid_x, grid_y = x * self.per_metre, y * self.per_metre
        floor_x, floor_y = dr.floor(grid_x), dr.floor(grid_y)
        # the side is a power of two: the lowest bits of an index, also of a negative one, are its remainder
        column, row, mask = Int32(floor_x), Int32(floor_y), Int32((UInt32(1) << self.log2_side) - 1)
        columns = [UInt32((column + offset) & mask) for offset in (0, 1)]
        row_offsets = [UInt32((row + offset) & mask) << self.log2_side for offset in (0, 1)]
        values = [
            dr.gather(type(self.values), self.values, first + j, active) for first in row_offsets for j in columns
        ]
        return values, grid_x - floor_x, grid_y - floor_y

    def interpolate(self, x: Values, y: Values, active: Values = True, kind: Any = Float) -> Values:
        """Interpolate the grid bilinearly at positions, metres, with single or double precision."""
        corners, fraction_x, fraction_y = self.neighbours(x, y, active)
        south_west, south_east, north_west, north_east = map(kind, corners)
        fx, fy = kind(fraction_x), kind(fraction_y)
        return dr.lerp(dr.lerp(south_west, south_east, fx), dr.lerp(north_west, north_east, fx), fy)
