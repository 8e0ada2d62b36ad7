"""Visible fraction of the sun's disc: past the ground, past a round body, and through clouds."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from marsyard.sim.render.kernels.structs import Array32, Bytes, GroundShadow, Longs
from marsyard.sim.terrain.kernels import Array, Level, sample

#: Rows of the grid per unit of a shadow's stored reach.
REACH_ROWS = 4
#: Height over a shadow's edge, in spacings of its grid, within which the grid is too coarse.
UNSURE = 0.3
#: Posts along a side of the blocks in which a grid is transposed: both sides of a block stay in the nearest cache.
BLOCK = 32


@njit(cache=True)
def heights_in_rows(field: Level, rows: Longs, columns: Longs, along_x: bool) -> Array32:
    """Control values of height at some rows and columns of a level, with rows along y or along x.

    As many as the level has are taken in order.
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
def sweep_shadow(height: Array32, along: float, drop: float, slip: float, reach: int) -> tuple[Array32, Bytes]:
    """Height of the shadow over every post of a periodic grid: below it the ground hides the centre of the sun.

    A shadow falls by `drop` metres and shifts by `-slip` columns from one row to the one before, away from the sun; the
    ground and the shadow of a row cast the shadow of the row before. Rows run towards the sun where `along` is 1.0,
    away from it where it is -1.0. The longest shadow covers `reach` rows: the sweep starts as many before the first.

    Returns the shadow's height, and the distance of its caster in units of `REACH_ROWS` rows, rounded up.
    """
    rows, columns = height.shape
    row_mask, column_mask = rows - 1, columns - 1
    shadow = np.empty_like(height)
    away = np.empty(height.shape, dtype=np.uint8)
    whole_columns = math.floor(slip)
    fraction = np.float32(slip - whole_columns)
    rest = np.float32(1.0) - fraction
    fall = np.float32(drop)
    before = np.full(columns, np.float32(-1e9), dtype=np.float32)
    caster = np.empty(columns, dtype=np.float32)
    rows_before = np.zeros(columns, dtype=np.int32)
    rows_away = np.empty(columns, dtype=np.int32)
    for k in range(rows + reach):
        step = rows + reach - 1 - k
        i = step & row_mask if along > 0.0 else (rows - 1 - step) & row_mask
        source = (i + 1) & row_mask if along > 0.0 else (i - 1) & row_mask
        for j in range(columns):
            caster[j] = max(height[source, j], before[j])
            rows_away[j] = 0 if height[source, j] >= before[j] else rows_before[j]
        for j in range(columns):
            a = (j + whole_columns) & column_mask
            b = (a + 1) & column_mask
            before[j] = rest * caster[a] + fraction * caster[b] - fall
            rows_before[j] = max(rows_away[a], rows_away[b]) + 1
        if step < rows:
            for j in range(columns):
                shadow[i, j] = before[j]
                away[i, j] = min((rows_before[j] + REACH_ROWS - 1) // REACH_ROWS, 255)
    return shadow, away


@njit(cache=True, inline="always")
def interpolate_bilinear(
    field: Array32, inverse_spacing: float, x: float, y: float
) -> tuple[float, tuple[int, int], tuple[int, int]]:
    """Interpolate a periodic field bilinearly; return the value, and rows and columns of the four posts around."""
    mask = field.shape[0] - 1
    gx, gy = x * inverse_spacing, y * inverse_spacing
    j, i = math.floor(gx), math.floor(gy)
    fx, fy = gx - j, gy - i
    i0, i1, j0, j1 = i & mask, (i + 1) & mask, j & mask, (j + 1) & mask
    south = (1.0 - fx) * field[i0, j0] + fx * field[i0, j1]
    north = (1.0 - fx) * field[i1, j0] + fx * field[i1, j1]
    return (1.0 - fy) * south + fy * north, (i0, i1), (j0, j1)


@njit(cache=True, inline="always")
def shadow_clearance(shadow: GroundShadow, x: float, y: float, z: float) -> tuple[float, float]:
    """Height of a position above the ground's shadow, metres, and distance of the shadow's caster in rows."""
    across, along = (y, x) if shadow.along_x else (x, y)
    edge, (i0, i1), (j0, j1) = interpolate_bilinear(shadow.height, 1.0 / shadow.spacing, across, along)
    away = shadow.reach
    farthest = max(max(away[i0, j0], away[i0, j1]), max(away[i1, j0], away[i1, j1]))
    return z - edge, float(farthest * REACH_ROWS)


@njit(cache=True, inline="always")
def penumbra(shadow: GroundShadow, radius: float, distance: float, rows: float) -> float:
    """Half the depth, metres, of the penumbra past an occluder at a distance plus some rows."""
    return radius * (distance + rows * shadow.row_m) / shadow.across


@njit(cache=True, inline="always")
def disc_above(offset: float) -> float:
    """Fraction of a disc above a straight line that lies `offset` radii below its centre."""
    if offset >= 1.0:
        return 1.0
    return 0.0 if offset <= -1.0 else 0.5 + (offset * math.sqrt(1.0 - offset * offset) + math.asin(offset)) / math.pi


@njit(cache=True, inline="always")
def disc_overlap(first: float, second: float, apart: float) -> float:
    """Fraction of the second disc that the first covers; radii and distance of their centres."""
    if apart >= first + second:
        return 0.0
    if apart <= abs(first - second):
        return min((first / second) ** 2, 1.0)
    alpha = math.acos((apart * apart + first * first - second * second) / (2.0 * apart * first))
    beta = math.acos((apart * apart + second * second - first * first) / (2.0 * apart * second))
    area = first * first * (alpha - 0.5 * math.sin(2.0 * alpha)) + second * second * (beta - 0.5 * math.sin(2.0 * beta))
    return area / (math.pi * second * second)


@njit(cache=True)
def _clearance_ratio(
    field: Level, per_metre: float, position: tuple[float, float, float], sun: Array, t: float
) -> float:
    """Clearance over distance of the line to the sun at a distance."""
    x, y, z = position
    height, _slope_x, _slope_y, _albedo = sample(field, per_metre, x + t * sun[0], y + t * sun[1])
    ratio: float = (z + t * sun[2] - height) / t
    return ratio


@njit(cache=True)
def _min_clearance_ratio(
    field: Level, per_metre: float, position: tuple[float, float, float], sun: Array, nearest: float
) -> float:
    """Least clearance over distance of the line to the sun near a distance: the vertex of a parabola."""
    step = min(0.25 / per_metre, 0.5 * nearest)
    before = _clearance_ratio(field, per_metre, position, sun, nearest - step)
    middle: float = _clearance_ratio(field, per_metre, position, sun, nearest)
    after = _clearance_ratio(field, per_metre, position, sun, nearest + step)
    bend = before - 2.0 * middle + after
    if bend <= 0.0:
        return middle
    vertex = nearest + min(max(0.5 * (before - after) / bend, -1.0), 1.0) * step
    lowest: float = min(middle, _clearance_ratio(field, per_metre, position, sun, vertex))
    return lowest


@njit(cache=True)
def visible_sun_fraction(
    field: Level,
    per_metre: float,
    shadow: GroundShadow,
    position: tuple[float, float, float],
    sun: Array,
    radius: float,
) -> float:
    """Fraction of the sun's disc that a position on the ground sees over the ground, by steps towards the sun.

    The smallest angle between the sun's centre and the ground below it, in radii of the sun, gives the fraction, as if
    the skyline were straight and level across the disc; ground turned away from the sun's centre has none. The search
    ends where the swept shadow shows that the remaining path is clear. `field` is the finest level, `radius` the
    angular radius of the disc.
    """
    x, y, z = position
    spacing = 1.0 / per_metre
    _height, slope_x, slope_y, _albedo = sample(field, per_metre, x, y)
    if sun[2] - slope_x * sun[0] - slope_y * sun[1] <= 0.0:
        return 0.0
    across = shadow.across
    lowest = radius
    nearest = 0.0
    t = 0.25 * spacing
    steps = 0
    farthest = (shadow.highest - z) / max(sun[2] - radius, 1e-3)
    while t < farthest:
        px, py, pz = x + t * sun[0], y + t * sun[1], z + t * sun[2]
        height, _slope_x, _slope_y, _albedo = sample(field, per_metre, px, py)
        clearance = pz - height
        if clearance * across / t < lowest:
            lowest = clearance * across / t
            nearest = t
        if lowest <= -radius:
            return 0.0
        steps += 1
        if steps % 4 == 0:
            clear, rows = shadow_clearance(shadow, px, py, pz)
            if clear > UNSURE * shadow.spacing + penumbra(shadow, radius, t, rows):
                break
        # half the clearance: no slope up to 60 deg is stepped over
        t += max(0.5 * spacing, 0.5 * (clearance - radius * t))
    if lowest < radius:
        lowest = min(lowest, _min_clearance_ratio(field, per_metre, position, sun, nearest) * across)
    fraction: float = disc_above(lowest / radius)
    return fraction
