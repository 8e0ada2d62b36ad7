"""Evaluation of the terrain: cubic B-splines over the levels of a pyramid of samples."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np

from marsyard.sim.render.arrays import Values, to_device
from marsyard.sim.render.device import Array2f, Float, Float64, Int32, UInt32
from marsyard.sim.terrain import Surface


@dataclass(frozen=True, eq=False)
class Terrain:
    """The pyramid of a terrain surface on the device.

    - samples: height (metres) and albedo of the control points of all levels, finest level first
    - first_sample, log2_side: first control point of each level, and logarithm of the number along its side
    - ceilings, first_ceiling: upper bounds of the height by block of each level (`Surface.ceilings`); None where they
      would not save time
    - top_level: number of the coarsest level
    - spacing: distance between the control points of level 0, metres
    """

    samples: Values
    first_sample: Values
    log2_side: Values
    ceilings: Values | None
    first_ceiling: Values | None
    top_level: Values
    spacing: Values

    @classmethod
    def of_surface(cls, surface: Surface, *, ceilings: bool) -> Terrain:
        """Copy the tables of a surface to the device, and share its samples with it."""
        sides = np.array([len(level) for level in surface.levels])
        bounds, first_bound = None, None
        if ceilings:
            bounds = to_device(Float, np.concatenate([bound.reshape(-1) for bound in surface.ceilings]))
            first_bound = _starts([bound.size for bound in surface.ceilings])
        return cls(
            to_device(Float, surface.samples, share=True),
            _starts(sides**2),
            to_device(UInt32, np.log2(sides)),
            bounds,
            first_bound,
            Int32(len(surface.levels) - 1),
            Float64(surface.spacing_m),
        )

    def spacing_at(self, level: Values) -> Values:
        """Return the distance between the control points of a level, metres."""
        return self.spacing * Float64(UInt32(1) << UInt32(level))


def _starts(sizes: np.ndarray | list[int]) -> Values:
    """Return the first element of each of several arrays that follow each other."""
    return to_device(UInt32, np.cumsum([0, *sizes])[:-1])


@dataclass(eq=False)
class Sample:
    """Height (metres), slopes along x and y, and albedo of the terrain at positions."""

    height: Values
    slope_x: Values
    slope_y: Values
    albedo: Values


def bspline_weights(t: Values) -> tuple[list[Values], list[Values]]:
    """Compute the weights of four control points at fraction t of a cell, and their derivatives."""
    s = 1.0 - t
    w0, w3 = s * s * s * (1.0 / 6.0), t * t * t * (1.0 / 6.0)
    w1 = (2.0 / 3.0) - 0.5 * t * t * (2.0 - t)
    d0, d1, d3 = -0.5 * s * s, t * (1.5 * t - 2.0), 0.5 * t * t
    return [w0, w1, 1.0 - w0 - w1 - w3, w3], [d0, d1, -d0 - d1 - d3, d3]


def _weighted_sum(weights: list[Values], values: list[Values]) -> Values:
    total = weights[0] * values[0]
    for weight, value in zip(weights[1:], values[1:], strict=True):
        total = dr.fma(weight, value, total)
    return total


def evaluate(terrain: Terrain, level: Values, x: Values, y: Values, active: Values = True) -> Sample:
    """Evaluate the terrain at positions on levels.

    Weights and slopes have single precision. Height and albedo are the sum of a control point and of differences from
    it, so they have the precision of the control points.
    """
    spacing = terrain.spacing_at(level)
    grid_x, grid_y = x / spacing, y / spacing
    floor_x, floor_y = dr.floor(grid_x), dr.floor(grid_y)
    column, row = Int32(floor_x), Int32(floor_y)
    weights_x, derivatives_x = bspline_weights(Float(grid_x - floor_x))
    weights_y, derivatives_y = bspline_weights(Float(grid_y - floor_y))
    first = dr.gather(UInt32, terrain.first_sample, UInt32(level), active)
    log2_side = dr.gather(UInt32, terrain.log2_side, UInt32(level), active)
    last = Int32((UInt32(1) << log2_side) - 1)
    columns = [UInt32((column + offset) & last) for offset in (-1, 0, 1, 2)]
    lines = [first + (UInt32((row + offset) & last) << log2_side) for offset in (-1, 0, 1, 2)]
    points = [[dr.gather(Array2f, terrain.samples, line + j, active) for j in columns] for line in lines]
    base = points[1][1]
    changes = [[point - base for point in line] for line in points]
    rises = [[change.x for change in line] for line in changes]
    lines_rise = [_weighted_sum(weights_x, line) for line in rises]
    lines_slope = [_weighted_sum(derivatives_x, line) for line in rises]
    lines_albedo = [_weighted_sum(weights_x, [change.y for change in line]) for line in changes]
    per_metre = Float(1.0 / spacing)
    return Sample(
        Float64(base.x) + Float64(_weighted_sum(weights_y, lines_rise)),
        per_metre * _weighted_sum(weights_y, lines_slope),
        per_metre * _weighted_sum(derivatives_y, lines_rise),
        base.y + _weighted_sum(weights_y, lines_albedo),
    )
