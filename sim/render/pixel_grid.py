"""Pixels of an image: rows, columns, neighbours, and the angles that they cover."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr

from marsyard.sim.render.arrays import Values, compiled
from marsyard.sim.render.device import Array3f64, Float, Float64, Int32, UInt32


@dataclass(frozen=True, eq=False)
class PixelGrid:
    """Pixels of an image with their rows and columns."""

    pixel: Values
    row: Values
    column: Values
    rows: Values
    columns: Values

    @classmethod
    def of(cls, pixel: Values, columns: Values, rows: Values) -> PixelGrid:
        """Compute rows and columns of pixels."""
        # an integer division would be slower
        row = UInt32((Float64(pixel) + 0.5) / Float64(columns))
        return cls(pixel, row, pixel - row * columns, rows, columns)

    def neighbour(self, down: int, right: int) -> tuple[Values, Values]:
        """Return the neighbours of the pixels, limited to the image, and whether they are in the image."""
        row, column = Int32(self.row) + down, Int32(self.column) + right
        inside_row = dr.maximum(dr.minimum(row, Int32(self.rows) - 1), 0)
        inside_column = dr.maximum(dr.minimum(column, Int32(self.columns) - 1), 0)
        is_inside = (inside_row == row) & (inside_column == column)
        return UInt32(inside_row) * self.columns + UInt32(inside_column), is_inside

    def derivative(self, vectors: Values, down: int, right: int) -> Values:
        """Change of vectors from pixel to pixel in a direction: a central difference, one-sided at the border."""
        (before, has_before), (after, has_after) = (self.neighbour(sign * down, sign * right) for sign in (-1, 1))
        steps = dr.maximum(dr.select(has_before, UInt32(1), 0) + dr.select(has_after, UInt32(1), 0), 1)
        first, last = (Array3f64(dr.gather(type(vectors), vectors, end)) for end in (before, after))
        return (last - first) / Float64(steps)


@compiled
def pixel_angles(directions: Values, pixel: Values, columns: Values, rows: Values) -> Values:
    """Square root of each pixel's solid angle, radians; the sides of a pixel are differences of the unit vectors."""
    grid = PixelGrid.of(pixel, columns, rows)
    return Float(dr.sqrt(dr.norm(dr.cross(grid.derivative(directions, 1, 0), grid.derivative(directions, 0, 1)))))
