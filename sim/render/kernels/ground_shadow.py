"""Compiled kernel of the ground's shadow: a sweep over the rows of a periodic grid that begins on the sun's side.

Each row needs the result of the row before it.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array32 = NDArray[np.float32]
#: Height below all ground, metres: shadow height before the sweep has met ground.
_BELOW_GROUND_M = -1e9
#: Unit of the stored distances of shadow casters, in rows of the grid.
CASTER_UNIT_ROWS = 4


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

    Outputs are `shadow`, the shadow height, and `caster_distance` in units of `CASTER_UNIT_ROWS` rows, rounded up, at
    most 255.
    """
    rows, columns = height.shape
    row_mask, column_mask = rows - 1, columns - 1
    whole_columns = math.floor(shift)
    fraction = np.float32(shift - whole_columns)
    weight = np.float32(1.0) - fraction
    row_drop = np.float32(drop)
    shadow_row = np.full(columns, np.float32(_BELOW_GROUND_M), dtype=np.float32)
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
