"""Kernels over all samples of a terrain: shadow of the ground, range of heights, steepest steps."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from marsyard.sim.terrain.kernels import Level

Array32 = NDArray[np.float32]
Longs = NDArray[np.int64]
#: Unit of the stored distances of shadow casters, in rows of the grid.
CASTER_UNIT_ROWS = 4
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
def sweep_shadow(
    height: Array32,
    row_sign: float,
    drop: float,
    shift: float,
    max_rows: int,
    shadow: Array32,
    caster_distance: NDArray[np.uint8],
) -> None:
    """Height of the shadow over each sample of a periodic grid; below it the ground hides the centre of the sun.

    The shadow height of a row is the maximum of the terrain height and the shadow height of the next row towards the
    sun, minus `drop` metres and shifted by `-shift` columns. `row_sign` is 1.0 if the row number increases towards the
    sun, else -1.0. `max_rows` is the length of the longest shadow in rows; the sweep starts at this distance.

    Outputs are `shadow`, the shadow height, and `caster_distance` in units of `CASTER_UNIT_ROWS` rows, rounded up.
    """
    rows, columns = height.shape
    row_mask, column_mask = rows - 1, columns - 1
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


@njit(cache=True)
def height_range(field: Level) -> tuple[float, float]:
    """Minimum and maximum height of the control values, which bound the surface."""
    # interleaved heights and albedos are processed together so that the loop vectorises
    flat = field.reshape(field.shape[0], -1)
    low = np.full(flat.shape[1], np.inf, dtype=np.float32)
    high = np.full(flat.shape[1], -np.inf, dtype=np.float32)
    for i in range(flat.shape[0]):
        row = flat[i]
        for j in range(row.size):
            low[j] = min(low[j], row[j])
            high[j] = max(high[j], row[j])
    return float(low[::2].min()), float(high[::2].max())


@njit(cache=True)
def max_rises(field: Level, bound: float, along_x: float, along_y: float) -> tuple[float, float]:
    """Maximum height step between adjacent control values, along x and y.

    These steps are upper bounds of the surface's slopes times the spacing. Returns infinity as soon as the sum of both,
    weighted by `along_x` and `along_y`, exceeds `bound`.
    """
    side = field.shape[0]
    step_x = np.zeros(side, dtype=np.float32)
    step_y = np.zeros(side, dtype=np.float32)
    rise_x, rise_y = 0.0, 0.0
    for i in range(side):
        row, previous_row = field[i], field[i - 1]
        step_x[0] = max(step_x[0], abs(row[0, 0] - row[side - 1, 0]))
        for j in range(1, side):
            step_x[j] = max(step_x[j], abs(row[j, 0] - row[j - 1, 0]))
        for j in range(side):
            step_y[j] = max(step_y[j], abs(row[j, 0] - previous_row[j, 0]))
        if i % 64 == 63 or i == side - 1:
            rise_x = float(step_x.max())
            rise_y = float(step_y.max())
            if rise_x * along_x + rise_y * along_y > bound:
                return math.inf, math.inf
    return rise_x, rise_y
