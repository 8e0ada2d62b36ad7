"""Shadow of the ground: a sweep towards the sun over all samples, and rays to the sun where the sweep is too coarse."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import drjit as dr
import numpy as np
from jaxtyping import Int64

from marsyard.sim.render.arrays import Values, clip, larger, smaller
from marsyard.sim.render.cones import Bounds
from marsyard.sim.render.device import Float, Float64, UInt32
from marsyard.sim.render.kernels.ground_shadow import CASTER_UNIT_ROWS, sweep_shadow
from marsyard.sim.render.periodic_grid import PeriodicGrid
from marsyard.sim.render.sky import Sun, disc_above
from marsyard.sim.render.spline import Terrain, evaluate
from marsyard.sim.terrain import Surface
from marsyard.sim.terrain.surface import HEIGHT, empty_aligned

#: Maximum number of samples along a side of the grid on which the ground's shadow is computed.
SHADOW_SIDE = 4096
#: Additional samples at each border of a grid that covers only the visible ground, for interpolation and rounding.
_BORDER_SAMPLES = 4
#: Margin at the shadow boundary, in grid spacings, within which the grid of `sweep_shadow` is not accurate enough.
COARSE_GRID_MARGIN = 0.3
#: Rows of samples that are compared at once in `slope_bounds`.
_BLOCK_ROWS = 64


def slope_bounds(surface: Surface, sun: Sun) -> tuple[float, float]:
    """Compute upper bounds of the slope along x and y; infinite if ground may hide part of the sun."""
    east, north, _ = np.abs(sun.direction)
    height, bound = surface.levels[0][..., HEIGHT], _lower_edge_rise(sun) * surface.spacing_m
    # steps between adjacent control values are upper bounds of the slope times the spacing
    rise_x = rise_y = 0.0
    for first in range(0, len(height), _BLOCK_ROWS):
        rows = height[np.arange(first - 1, min(first + _BLOCK_ROWS, len(height)))]
        rise_x = max(rise_x, float(np.abs(np.diff(rows, axis=1, append=rows[:, :1])).max()))
        rise_y = max(rise_y, float(np.abs(np.diff(rows, axis=0)).max()))
        if rise_x * float(east) + rise_y * float(north) > bound:
            return np.inf, np.inf
    return rise_x / surface.spacing_m, rise_y / surface.spacing_m


def is_sun_above_slopes(sun: Sun, max_slopes: tuple[float, float]) -> bool:
    """Return whether the whole disc of the sun is visible from all ground with at most these slopes along x and y.

    No line between two points of the ground is then as steep as the rays to the lower edge of the disc.
    """
    # products of Python's floats: an infinite slope across the sun's azimuth gives NaN without a warning
    east, north, _ = np.abs(sun.direction).tolist()
    return bool(max_slopes[0] * east + max_slopes[1] * north < _lower_edge_rise(sun))


def _lower_edge_rise(sun: Sun) -> float:
    """Rise of a ray to the lower edge of the sun's disc, per unit length of the ray to its centre."""
    horizontal = float(np.hypot(sun.direction[0], sun.direction[1]))
    elevation = np.arctan2(sun.direction[2], horizontal) - sun.angular_radius_rad
    return horizontal * float(np.tan(max(elevation, 0.0)))


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

    height: PeriodicGrid
    caster_distance: PeriodicGrid
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


def compute_ground_shadow(
    surface: Surface, sun: Sun, height_range_m: tuple[float, float], visible_m: Bounds | None = None
) -> GroundShadow | None:
    """Compute the shadow of the ground by a sweep along the axis nearest to the sun's azimuth; the sun must be up.

    `visible_m` contains minimum and maximum x, then y, of the ground whose shadow is needed; None for all ground. The
    grid of the shadow is that of the finest terrain level with at most `SHADOW_SIDE` samples per side. If it covers a
    part of the ground only, its period is shorter. Returns None for a sun in the zenith. Raises ValueError if every
    level has more samples.
    """
    level = next((number for number, samples in enumerate(surface.levels) if len(samples) <= SHADOW_SIDE), None)
    if level is None:
        sides = ", ".join(str(len(samples)) for samples in surface.levels)
        raise ValueError(f"no level of the terrain has at most {SHADOW_SIDE} samples per side: {sides}")
    field, spacing = surface.levels[level], surface.spacing_m * 2.0**level
    east, north, up = (float(component) for component in sun.direction)
    along_x = abs(east) > abs(north)
    along, across = (east, north) if along_x else (north, east)
    if along == 0.0:
        return None
    # from one row to the next towards the sun, a ray rises by `drop` metres and moves by `shift` columns
    drop, shift = spacing * up / abs(along), across / abs(along)
    height = field[..., HEIGHT]
    max_rows = int(min(np.ceil((height_range_m[1] - height_range_m[0]) / drop) + 1, len(field)))
    if visible_m is not None:
        # rows of the longest path towards the sun, as many rows for shadows that fall on its end, and 10 % of both
        path_rows = 2.2 * max_rows + _BORDER_SAMPLES
        path = spacing * path_rows * np.array([np.sign(along), shift] if along_x else [shift, np.sign(along)])
        bounds = np.reshape(visible_m, (2, 2)) + np.stack([np.minimum(path, 0.0), np.maximum(path, 0.0)], axis=1)
        first = np.floor(bounds[:, 0] / spacing).astype(int) - _BORDER_SAMPLES
        last = np.ceil(bounds[:, 1] / spacing).astype(int) + _BORDER_SAMPLES
        # the period of a grid is a power of two
        count = 1 << int((last - first).max()).bit_length()
        if count < len(field):
            columns, rows = (periodic_window(int(start), count, len(field)) for start in first)
            height = height[np.ix_(rows, columns)]
    height = np.ascontiguousarray(height)
    if along_x:
        height = cv2.transpose(height)
    shadow_height, caster_distance = (empty_aligned(height.shape, kind) for kind in (np.float32, np.uint8))
    sweep_shadow(height, float(np.sign(along)), drop, shift, max_rows, shadow_height, caster_distance)
    return GroundShadow(
        PeriodicGrid.of(shadow_height, 1.0 / spacing, share=True),
        PeriodicGrid.of(caster_distance, 1.0 / spacing, share=True),
        along_x,
        Float64(spacing),
        UInt32(level),
        Float64(spacing / abs(along)),
        Float64(np.hypot(east, north)),
        Float64(height_range_m[1]),
    )


def periodic_window(start: int, count: int, period: int) -> Int64[np.ndarray, "count"]:
    """Return samples of a periodic axis that form a periodic axis with the shorter period `count`.

    Samples `start` to `start + count - 1` are selected. Sample n is entry n modulo `count`, so that coordinates do not
    change. The result contains samples of the original axis, from 0 to `period - 1`.
    """
    entries = np.arange(count)
    samples = start + (entries - start) % count
    return np.asarray(samples % period)


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
