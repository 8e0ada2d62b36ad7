"""The visible fraction of the sun's disc: shadows of the ground, of a round body at the camera, and of clouds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from marsyard.sim.render.arrays import Values, clip, larger, smaller, to_device
from marsyard.sim.render.device import Bool, Float, Float64, Int32, UInt8, UInt32
from marsyard.sim.render.kernels.sweep import CASTER_UNIT_ROWS
from marsyard.sim.render.spline import Terrain, evaluate

#: Margin at the shadow boundary, in grid spacings, within which the grid of `sweep_shadow` is not accurate enough.
COARSE_GRID_MARGIN = 0.3


@dataclass(frozen=True, eq=False)
class Grid:
    """A periodic grid of numbers, whose side is a power of two; y increases with the row."""

    values: Values
    log2_side: Values
    per_metre: Values

    @classmethod
    def of(cls, values: np.ndarray, per_metre: float, *, share: bool = False) -> Grid:
        """Copy a grid, shape (side, side), to the device."""
        kind = UInt8 if values.dtype == np.uint8 else Float
        side = len(values)
        return cls(to_device(kind, values, share=share), UInt32(side.bit_length() - 1), Float64(per_metre))

    def neighbours(self, x: Values, y: Values, active: Values) -> tuple[list[Values], Values, Values]:
        """Return the values south-west, south-east, north-west, north-east of positions, and fractions of a cell."""
        grid_x, grid_y = x * self.per_metre, y * self.per_metre
        floor_x, floor_y = dr.floor(grid_x), dr.floor(grid_y)
        column, row, last = Int32(floor_x), Int32(floor_y), Int32((UInt32(1) << self.log2_side) - 1)
        columns = [UInt32((column + offset) & last) for offset in (0, 1)]
        lines = [UInt32((row + offset) & last) << self.log2_side for offset in (0, 1)]
        values = [dr.gather(type(self.values), self.values, line + j, active) for line in lines for j in columns]
        return values, grid_x - floor_x, grid_y - floor_y

    def interpolate(self, x: Values, y: Values, active: Values = True, kind: Any = Float) -> Values:
        """Interpolate the grid bilinearly at positions, metres, with single or double precision."""
        corners, fraction_x, fraction_y = self.neighbours(x, y, active)
        south_west, south_east, north_west, north_east = map(kind, corners)
        fx, fy = kind(fraction_x), kind(fraction_y)
        return dr.lerp(dr.lerp(south_west, south_east, fx), dr.lerp(north_west, north_east, fx), fy)


@dataclass(frozen=True, eq=False)
class GroundShadow:
    """Shadow of the ground on the grid of one terrain level.

    - height: height below which the ground hides the centre of the sun, metres
    - caster_distance: distance of the ground that casts the shadow, in steps of `CASTER_UNIT_ROWS` rows of the grid
    - along_x: whether rows are parallel to x
    - spacing, level: distance between samples, metres, and number of the terrain level
    - row_m: horizontal distance towards the sun from one row to the next, metres
    - cos_elevation: horizontal component of the unit vector to the sun
    - max_height: upper bound of the ground's height, metres
    """

    height: Grid
    caster_distance: Grid
    along_x: bool
    spacing: Values
    level: Values
    row_m: Values
    cos_elevation: Values
    max_height: Values

    def clearance(self, x: Values, y: Values, z: Values, active: Values) -> tuple[Values, Values]:
        """Height of positions above the ground's shadow, metres, and distance of the shadow's caster in rows."""
        column, row = (y, x) if self.along_x else (x, y)
        distances = [UInt32(value) for value in self.caster_distance.neighbours(column, row, active)[0]]
        farthest = dr.maximum(dr.maximum(distances[0], distances[1]), dr.maximum(distances[2], distances[3]))
        height = self.height.interpolate(column, row, active)
        return Float(z - Float64(height)), Float(farthest * CASTER_UNIT_ROWS)

    def half_penumbra(self, radius: Values, distance: Values, rows: Values) -> Values:
        """Half the depth of the penumbra, metres, for an occluder at `distance` plus `rows` grid rows."""
        return radius * (distance + rows * Float(self.row_m)) / Float(self.cos_elevation)


def disc_above(offset: Values) -> Values:
    """Fraction of a disc above a straight line `offset` radii below its centre."""
    offset = clip(offset, -1.0, 1.0)
    return 0.5 + (offset * dr.sqrt(1.0 - offset * offset) + dr.asin(offset)) / dr.pi


def disc_overlap(first: Values, second: Values, distance: Values) -> Values:
    """Fraction of the second disc that the first disc covers, from their radii and the distance of their centres."""
    alpha = dr.acos(clip((distance**2 + first**2 - second**2) / (2.0 * distance * first), -1.0, 1.0))
    beta = dr.acos(clip((distance**2 + second**2 - first**2) / (2.0 * distance * second), -1.0, 1.0))
    lens = first**2 * (alpha - 0.5 * dr.sin(2.0 * alpha)) + second**2 * (beta - 0.5 * dr.sin(2.0 * beta))
    is_inside = distance <= dr.abs(first - second)
    fraction = dr.select(is_inside, smaller((first / second) ** 2, 1.0), lens / (dr.pi * second**2))
    return dr.select(distance >= first + second, 0.0, fraction)


def march_to_sun(
    terrain: Terrain, shadow: GroundShadow, position: Values, sun: Values, radius: Values, active: Values
) -> Values:
    """Fraction of the sun's disc that terrain does not hide at a position on the finest level, by ray marching.

    The fraction follows from the minimum angle between the sun's centre and the terrain below it, in radii of the sun.
    The skyline is approximated by a horizontal line across the disc. Ground that faces away from the sun has the
    fraction 0. The search ends where the shadow grid shows that the remaining path is clear.
    """
    finest, spacing, radius = UInt32(0), Float(terrain.spacing), Float(radius)
    cos_elevation = Float(shadow.cos_elevation)

    def clearance(t: Values, is_active: Values) -> Values:
        x, y, z = position + Float64(t) * sun
        return Float(z - evaluate(terrain, finest, x, y, is_active).height)

    def advance(
        t: Values, min_angle: Values, nearest: Values, steps: Values, is_active: Values
    ) -> tuple[Values, Values, Values, Values, Values]:
        height = clearance(t, is_active)
        angle = height * cos_elevation / t
        nearest, min_angle = dr.select(angle < min_angle, t, nearest), smaller(angle, min_angle)
        is_active &= min_angle > -radius
        is_checked = is_active & (steps % 4 == 3)
        x, y, z = position + Float64(t) * sun
        above_shadow, rows = shadow.clearance(x, y, z, is_checked)
        margin = COARSE_GRID_MARGIN * Float(shadow.spacing) + shadow.half_penumbra(radius, t, rows)
        is_active &= ~is_checked | (above_shadow <= margin)
        # with half the clearance a step does not pass through slopes of up to 60 deg
        t = dr.select(is_active, t + larger(0.5 * spacing, 0.5 * (height - radius * t)), t)
        return t, min_angle, nearest, steps + 1, is_active & (t < farthest)

    slopes = evaluate(terrain, finest, position.x, position.y, active)
    is_facing = Float(sun.z) - slopes.slope_x * Float(sun.x) - slopes.slope_y * Float(sun.y) > 0.0
    farthest = Float((shadow.max_height - position.z) / larger(sun.z - Float64(radius), 1e-3))
    first = 0.25 * spacing
    is_marched = active & is_facing
    _, min_angle, nearest, _, _ = dr.while_loop(
        (first, Float(radius), Float(0.0), UInt32(0), is_marched & (first < farthest)),
        lambda t, min_angle, nearest, steps, is_active: is_active,
        advance,
    )
    # the minimum of the angle near `nearest`, at the vertex of a parabola
    is_refined = is_marched & (min_angle < radius) & (min_angle > -radius)
    step = smaller(0.25 * spacing, 0.5 * nearest)
    before, at, after = (clearance(t, is_refined) / t for t in (nearest - step, nearest, nearest + step))
    curvature = before - 2.0 * at + after
    vertex = nearest + clip(0.5 * (before - after) / curvature, -1.0, 1.0) * step
    is_convex = is_refined & (curvature > 0.0)
    lowest = dr.select(is_convex, smaller(at, clearance(vertex, is_convex) / vertex), at) * cos_elevation
    min_angle = dr.select(is_refined, smaller(min_angle, lowest), min_angle)
    return dr.select(is_facing, disc_above(min_angle / radius), 0.0)


@dataclass(frozen=True, eq=False)
class Clouds:
    """Clouds in a thin layer: cover on a periodic grid, height, displacement to east and north, metres, and opacity."""

    cover: Grid
    height: Values
    east: Values
    north: Values
    opacity: Values

    def transmittance(self, position: Values, sun: Values) -> Values:
        """Fraction of direct sunlight that reaches positions through the layer."""
        path = larger(self.height - position.z, 0.0) / sun.z
        x, y = position.x + path * sun.x - self.east, position.y + path * sun.y - self.north
        return Float(1.0 - self.opacity * self.cover.interpolate(x, y, kind=Float64))


@dataclass(frozen=True, eq=False)
class Footprint:
    """Region of ground that objects may shade: a grid of flags, its west and south border, and cells per metre."""

    cells: Values
    rows: Values
    columns: Values
    west: Values
    south: Values
    per_metre: Values

    def contains(self, x: Values, y: Values) -> Values:
        """Return whether an object may hide the sun from the ground at a position."""
        column, row = (Int32(dr.floor(d * self.per_metre)) for d in (x - self.west, y - self.south))
        is_inside = (row >= 0) & (row < self.rows) & (column >= 0) & (column < self.columns)
        return dr.gather(Bool, self.cells, UInt32(row * self.columns + column), is_inside)
