"""Strips of rays: buffers for vectorised loops over rays.

The compiler vectorises a loop over rays if the loop has no branches, accesses rows of one buffer at a fixed distance,
and has a constant upper bound: `for k in range(min(width, STRIP))`. Values from other arrays are therefore first copied
into rows of the buffer, ray by ray.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from marsyard.sim.render.kernels.structs import Array32, Longs
from marsyard.sim.terrain.kernels import Array, Level, bspline_weights

#: Control values around the positions of a strip, the positions' fractions of a cell, and a buffer for indices.
CellBuffers = tuple[Array32, Array, Longs]
#: The nine elements of a 3 x 3 matrix, row by row.
Matrix = tuple[float, float, float, float, float, float, float, float, float]

#: Rays per strip: the buffers fit in the processor's first-level cache.
STRIP = 128
#: Distance between successive rows of a buffer; longer than a strip, so that rows do not share cache lines.
ROW = STRIP + 8
#: Size of the buffer of control values: heights and albedos, four rows of four around each position.
CELLS = 2 * 16 * ROW


@njit(cache=True)
def allocate_cells() -> CellBuffers:
    """Allocate buffers for the control values around the positions of a strip."""
    return np.empty(CELLS, dtype=np.float32), np.empty(2 * ROW), np.empty(STRIP, dtype=np.int64)


@njit(cache=True, inline="always")
def unpack_matrix(matrix: Array) -> Matrix:
    """Unpack a 3 x 3 matrix before a loop."""
    (a, b, c), (d, e, f) = (matrix[0, 0], matrix[0, 1], matrix[0, 2]), (matrix[1, 0], matrix[1, 1], matrix[1, 2])
    return a, b, c, d, e, f, matrix[2, 0], matrix[2, 1], matrix[2, 2]


@njit(cache=True, inline="always")
def rotate(m: Matrix, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Multiply a matrix by a vector."""
    return (m[0] * x + m[1] * y + m[2] * z, m[3] * x + m[4] * y + m[5] * z, m[6] * x + m[7] * y + m[8] * z)


@njit(cache=True, error_model="numpy")
def fetch_cells(
    field: Level, scale: float, x: Array, y: Array, indices: Longs, count: int, cells: Array32, fractions: Array
) -> None:
    """Copy the sixteen control values around each position, and its fractions of a cell, into rows.

    `indices` contains the indices of the `count` positions; `scale` is samples per metre. `cells` and `fractions` are
    outputs with `CELLS` and 2 `ROW` elements; column k belongs to position k.
    """
    side = field.shape[0]
    mask = side - 1
    # a height and an albedo, 32 bits each, are copied as one integer of 64 bits
    pairs = field.reshape(-1).view(np.int64)
    copies = cells.view(np.int64)
    for m in range(count):
        k = indices[m]
        gx, gy = x[k] * scale, y[k] * scale
        fx, fy = math.floor(gx), math.floor(gy)
        fractions[k], fractions[ROW + k] = gx - fx, gy - fy
        j, i = int(fx), int(fy)
        j0, j1, j2, j3 = (j - 1) & mask, j & mask, (j + 1) & mask, (j + 2) & mask
        for row in range(4):
            line = ((i + row - 1) & mask) * side
            entry = np.uint64(4 * row * ROW + k)
            copies[entry] = pairs[np.uint64(line + j0)]
            copies[entry + np.uint64(ROW)] = pairs[np.uint64(line + j1)]
            copies[entry + np.uint64(2 * ROW)] = pairs[np.uint64(line + j2)]
            copies[entry + np.uint64(3 * ROW)] = pairs[np.uint64(line + j3)]


@njit(cache=True)
def fetch_levels(
    levels: tuple[Level, ...],
    inverse_spacing: float,
    level_of: Longs,
    indices: Longs,
    count: int,
    x: Array,
    y: Array,
    buffers: CellBuffers,
) -> None:
    """Call `fetch_cells` for positions on different terrain levels; the last of the buffers is overwritten."""
    cells, fractions, on_level = buffers
    lowest, highest = len(levels) - 1, 0
    for m in range(count):
        lowest = min(lowest, level_of[indices[m]])
        highest = max(highest, level_of[indices[m]])
    if lowest == highest:
        fetch_cells(levels[lowest], inverse_spacing / (1 << lowest), x, y, indices, count, cells, fractions)
        return
    for level in range(lowest, highest + 1):
        selected = 0
        for m in range(count):
            on_level[selected] = indices[m]
            selected += level_of[indices[m]] == level
        fetch_cells(levels[level], inverse_spacing / (1 << level), x, y, on_level, selected, cells, fractions)


@njit(cache=True, inline="always")
def spline(cells: Array32, fractions: Array, k: int) -> tuple[float, float, float, float]:
    """Height, slopes along x and y per sample, and albedo at the k-th position.

    The sums and their order are those of `marsyard.sim.terrain.kernels.sample`, so that results are identical.
    """
    wx0, wx1, wx2, wx3, dx0, dx1, dx2, dx3 = bspline_weights(fractions[k])
    wy0, wy1, wy2, wy3, dy0, dy1, dy2, dy3 = bspline_weights(fractions[ROW + k])
    height, slope_x, slope_y, albedo = 0.0, 0.0, 0.0, 0.0
    for first, weight, derivative in ((0, wy0, dy0), (8 * ROW, wy1, dy1), (16 * ROW, wy2, dy2), (24 * ROW, wy3, dy3)):
        h0, a0 = cells[first + 2 * k], cells[first + 2 * k + 1]
        h1, a1 = cells[first + 2 * ROW + 2 * k], cells[first + 2 * ROW + 2 * k + 1]
        h2, a2 = cells[first + 4 * ROW + 2 * k], cells[first + 4 * ROW + 2 * k + 1]
        h3, a3 = cells[first + 6 * ROW + 2 * k], cells[first + 6 * ROW + 2 * k + 1]
        row_height = wx0 * h0 + wx1 * h1 + wx2 * h2 + wx3 * h3
        height += weight * row_height
        slope_y += derivative * row_height
        slope_x += weight * (dx0 * h0 + dx1 * h1 + dx2 * h2 + dx3 * h3)
        albedo += weight * (wx0 * a0 + wx1 * a1 + wx2 * a2 + wx3 * a3)
    return height, slope_x, slope_y, albedo
