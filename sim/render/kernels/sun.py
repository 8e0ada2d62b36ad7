"""Kernels of the visible fraction of the sun's disc: shadows of the ground and of a round body."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from marsyard.sim.render.kernels.structs import Array32, Bytes, GroundShadow, Longs
from marsyard.sim.terrain.kernels import Array, Level, sample

#: Unit of the stored distances of shadow casters, in rows of the grid.
CASTER_UNIT_ROWS = 4
#: Margin at the shadow boundary, in grid spacings, within which the grid of `sweep_shadow` is not accurate enough.
COARSE_GRID_MARGIN = 0.3
#: Side of the blocks in which a grid is transposed: source and destination fit in the processor's first-level cache.
BLOCK = 32


@njit(cache=True)
def heights_in_rows(field: Level, rows: Longs, columns: Longs, along_x: bool) -> Array32:
    """Copy the control values of height at these rows and columns of a level; transpose them if `along_x`.

    If the number of rows is that of the level, all rows and columns are copied in order.
    """
    side = rows.size
    heights = np.empty((side, side), dtype=np.float32)
    if not along_x and side == field.shape[0]:
        heights[:] = field[:, :, 0]
        return heights
    if not along_x:
        for i in range(side):
            for j in range(side):
                heights[i, j] = field[rows[i], columns[j], 0]
        return heights
    for top in range(0, side, BLOCK):
        for left in range(0, side, BLOCK):
            for j in range(left, min(left + BLOCK, side)):
                for i in range(top, min(top + BLOCK, side)):
                    heights[j, i] = field[rows[i], columns[j], 0]
    return heights


@njit(cache=True)
def sweep_shadow(height: Array32, row_sign: float, drop: float, shift: float, max_rows: int) -> tuple[Array32, Bytes]:
    """Height of the shadow over each sample of a periodic grid; below it the ground hides the centre of the sun.

    The shadow height of a row is the maximum of the terrain height and the shadow height of the next row towards the
    sun, minus `drop` metres and shifted by `-shift` columns. `row_sign` is 1.0 if the row number increases towards the
    sun, else -1.0. `max_rows` is the length of the longest shadow in rows; the sweep starts at this distance.

    Returns the shadow height, and the distance of the caster in units of `CASTER_UNIT_ROWS` rows, rounded up.
    """
    rows, columns = height.shape
    row_mask, column_mask = rows - 1, columns - 1
    shadow = np.empty_like(height)
    caster_distance = np.empty(height.shape, dtype=np.uint8)
    whole_columns = math.floor(shift)
    fraction = np.float32(shift - whole_columns)
    weight = np.float32(1.0) - fraction
    row_drop = np.float32(drop)
    shadow_row = np.full(columns, np.float32(-1e9), dtype=np.float32)
    caster = np.empty(columns, dtype=np.float32)
    shadow_rows = np.zeros(columns, dtype=np.int32)
    caster_rows = np.empty(columns, dtype=np.int32)
    for k in range(rows + max_rows):
        step = rows + max_rows - 1 - k
        i = step & row_mask if row_sign > 0.0 else (rows - 1 - step) & row_mask
        source = (i + 1) & row_mask if row_sign > 0.0 else (i - 1) & row_mask
        for j in range(columns):
            caster[j] = max(height[source, j], shadow_row[j])
            caster_rows[j] = 0 if height[source, j] >= shadow_row[j] else shadow_rows[j]
        for j in range(columns):
            left = (j + whole_columns) & column_mask
            right = (left + 1) & column_mask
            shadow_row[j] = weight * caster[left] + fraction * caster[right] - row_drop
            shadow_rows[j] = max(caster_rows[left], caster_rows[right]) + 1
        if step < rows:
            for j in range(columns):
                shadow[i, j] = shadow_row[j]
                caster_distance[i, j] = min((shadow_rows[j] + CASTER_UNIT_ROWS - 1) // CASTER_UNIT_ROWS, 255)
    return shadow, caster_distance


@njit(cache=True, inline="always")
def find_grid_cell(
    side: int, inverse_spacing: float, x: float, y: float
) -> tuple[tuple[int, int], tuple[int, int], float, float]:
    """Return rows and columns of the four samples around a position on a periodic grid, and its fractions of a cell."""
    mask = side - 1
    gx, gy = x * inverse_spacing, y * inverse_spacing
    j, i = math.floor(gx), math.floor(gy)
    return (i & mask, (i + 1) & mask), (j & mask, (j + 1) & mask), gx - j, gy - i


@njit(cache=True, inline="always")
def interpolate_bilinear(
    field: Array32, inverse_spacing: float, x: float, y: float
) -> tuple[float, tuple[int, int], tuple[int, int]]:
    """Interpolate a periodic field bilinearly; return the value, and rows and columns of the four neighbours."""
    (i0, i1), (j0, j1), fx, fy = find_grid_cell(field.shape[0], inverse_spacing, x, y)
    south = (1.0 - fx) * field[i0, j0] + fx * field[i0, j1]
    north = (1.0 - fx) * field[i1, j0] + fx * field[i1, j1]
    return (1.0 - fy) * south + fy * north, (i0, i1), (j0, j1)


@njit(cache=True, inline="always")
def shadow_clearance(shadow: GroundShadow, x: float, y: float, z: float) -> tuple[float, float]:
    """Height of a position above the ground's shadow, metres, and distance of the shadow's caster in rows."""
    column, row = (y, x) if shadow.along_x else (x, y)
    shadow_height, (i0, i1), (j0, j1) = interpolate_bilinear(shadow.height, 1.0 / shadow.spacing, column, row)
    distance = shadow.caster_distance
    farthest = max(max(distance[i0, j0], distance[i0, j1]), max(distance[i1, j0], distance[i1, j1]))
    return z - shadow_height, float(farthest * CASTER_UNIT_ROWS)


@njit(cache=True, inline="always")
def penumbra(shadow: GroundShadow, radius: float, distance: float, rows: float) -> float:
    """Half the depth of the penumbra, metres, for an occluder at `distance` plus `rows` grid rows."""
    return radius * (distance + rows * shadow.row_m) / shadow.cos_elevation


@njit(cache=True, inline="always")
def disc_above(offset: float) -> float:
    """Fraction of a disc above a straight line `offset` radii below its centre."""
    if offset >= 1.0:
        return 1.0
    return 0.0 if offset <= -1.0 else 0.5 + (offset * math.sqrt(1.0 - offset * offset) + math.asin(offset)) / math.pi


@njit(cache=True, inline="always")
def disc_overlap(first: float, second: float, distance: float) -> float:
    """Fraction of the second disc that the first disc covers, from their radii and the distance of their centres."""
    if distance >= first + second:
        return 0.0
    if distance <= abs(first - second):
        return min((first / second) ** 2, 1.0)
    alpha = math.acos((distance * distance + first * first - second * second) / (2.0 * distance * first))
    beta = math.acos((distance * distance + second * second - first * first) / (2.0 * distance * second))
    area = first * first * (alpha - 0.5 * math.sin(2.0 * alpha)) + second * second * (beta - 0.5 * math.sin(2.0 * beta))
    return area / (math.pi * second * second)


@njit(cache=True)
def _clearance_ratio(
    field: Level, per_metre: float, position: tuple[float, float, float], sun: Array, t: float
) -> float:
    """Clearance above the ground divided by distance, at a distance along the line to the sun."""
    x, y, z = position
    height, _slope_x, _slope_y, _albedo = sample(field, per_metre, x + t * sun[0], y + t * sun[1])
    ratio: float = (z + t * sun[2] - height) / t
    return ratio


@njit(cache=True)
def _min_clearance_ratio(
    field: Level, per_metre: float, position: tuple[float, float, float], sun: Array, nearest: float
) -> float:
    """Minimum of the clearance ratio near the distance `nearest`, at the vertex of a parabola."""
    step = min(0.25 / per_metre, 0.5 * nearest)
    ratio0 = _clearance_ratio(field, per_metre, position, sun, nearest - step)
    ratio1: float = _clearance_ratio(field, per_metre, position, sun, nearest)
    ratio2 = _clearance_ratio(field, per_metre, position, sun, nearest + step)
    curvature = ratio0 - 2.0 * ratio1 + ratio2
    if curvature <= 0.0:
        return ratio1
    vertex = nearest + min(max(0.5 * (ratio0 - ratio2) / curvature, -1.0), 1.0) * step
    min_ratio: float = min(ratio1, _clearance_ratio(field, per_metre, position, sun, vertex))
    return min_ratio


@njit(cache=True)
def visible_sun_fraction(
    field: Level,
    per_metre: float,
    shadow: GroundShadow,
    position: tuple[float, float, float],
    sun: Array,
    radius: float,
) -> float:
    """Fraction of the sun's disc that terrain does not hide at a position on the ground, by ray marching.

    The fraction follows from the minimum angle between the sun's centre and the terrain below it, in radii of the sun.
    The skyline is approximated by a horizontal line across the disc. Ground that faces away from the sun has the
    fraction 0. The search ends where the shadow grid shows that the remaining path is clear. `field` is the finest
    terrain level, `radius` the angular radius of the disc.
    """
    x, y, z = position
    spacing = 1.0 / per_metre
    _height, slope_x, slope_y, _albedo = sample(field, per_metre, x, y)
    if sun[2] - slope_x * sun[0] - slope_y * sun[1] <= 0.0:
        return 0.0
    cos_elevation = shadow.cos_elevation
    min_angle = radius
    nearest = 0.0
    t = 0.25 * spacing
    steps = 0
    farthest = (shadow.max_height - z) / max(sun[2] - radius, 1e-3)
    while t < farthest:
        px, py, pz = x + t * sun[0], y + t * sun[1], z + t * sun[2]
        height, _slope_x, _slope_y, _albedo = sample(field, per_metre, px, py)
        clearance = pz - height
        if clearance * cos_elevation / t < min_angle:
            min_angle = clearance * cos_elevation / t
            nearest = t
        if min_angle <= -radius:
            return 0.0
        steps += 1
        if steps % 4 == 0:
            height_above_shadow, rows = shadow_clearance(shadow, px, py, pz)
            if height_above_shadow > COARSE_GRID_MARGIN * shadow.spacing + penumbra(shadow, radius, t, rows):
                break
        # with half the clearance a step does not pass through slopes of up to 60 deg
        t += max(0.5 * spacing, 0.5 * (clearance - radius * t))
    if min_angle < radius:
        min_angle = min(min_angle, _min_clearance_ratio(field, per_metre, position, sun, nearest) * cos_elevation)
    fraction: float = disc_above(min_angle / radius)
    return fraction
