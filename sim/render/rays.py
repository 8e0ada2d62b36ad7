"""Rays on the device, the camera's pose, and the grid of pixels that the rays belong to."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np

from marsyard.sim.render.arrays import Values
from marsyard.sim.render.device import Array3f, Array3f64, Float, Float64, Int32, Matrix3f64, UInt32


@dataclass(eq=False)
class Ray:
    """Rays in world axes: origins, metres (also relative to a point near them), and unit directions."""

    origin: Values
    direction: Values


@dataclass(frozen=True, eq=False)
class Pose:
    """Rotation matrix from body to world axes, and world position of the camera's centre of projection."""

    rotation: Values
    position: Values

    @classmethod
    def of(cls, rotation: np.ndarray, position: np.ndarray) -> Pose:
        """Copy a rotation matrix and a position to the device."""
        return cls(Matrix3f64(*rotation.ravel().tolist()), Array3f64(*position.tolist()))


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays in body axes: unit directions, origins relative to the camera's centre (None: all 0), pixel angles, rad."""

    directions: Values
    origins: Values | None
    pixel_angles: Values

    def in_world(self, pose: Pose) -> Ray:
        """Transform the rays to world axes."""
        offset = 0.0 if self.origins is None else pose.rotation @ Array3f64(self.origins)
        return Ray(pose.position + offset, pose.rotation @ Array3f64(self.directions))

    def select(self, index: Values) -> Rays:
        """Return some of the rays."""
        origins = None if self.origins is None else dr.gather(Array3f, self.origins, index)
        return Rays(dr.gather(Array3f, self.directions, index), origins, dr.gather(Float, self.pixel_angles, index))


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
