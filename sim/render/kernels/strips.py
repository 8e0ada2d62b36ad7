"""Rays in strips: buffers that let the processor work on several rays at once.

The compiler vectorises a loop over rays if the loop does not branch, reads and writes rows of one buffer at a fixed
distance, and has a fixed bound: `for k in range(min(width, STRIP))`. Values from elsewhere in memory are therefore
copied into rows first, one ray at a time.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from marsyard.sim.render.kernels.structs import Array32, Longs
from marsyard.sim.terrain.kernels import Array, Level, bspline_weights

#: Control values around the positions of a strip, their fractions of a cell, and a buffer for numbers of positions.
FetchedCells = tuple[Array32, Array, Longs]
#: Nine numbers of a matrix, row by row.
Matrix = tuple[float, float, float, float, float, float, float, float, float]

#: Rays of a strip: their buffers stay in the nearest cache.
STRIP = 128
#: Distance from one row of a buffer to the next: a little more, so that rows do not share lines of the cache.
ROW = STRIP + 8
#: Control values around the positions: heights and albedos, four rows of four.
CELLS = 2 * 16 * ROW


@njit(cache=True)
def no_cells() -> FetchedCells:
    """Allocate buffers for the control values around the positions of a strip."""
    return np.empty(CELLS, dtype=np.float32), np.empty(2 * ROW), np.empty(STRIP, dtype=np.int64)


@njit(cache=True, inline="always")
def unpack_matrix(matrix: Array) -> Matrix:
    """Unpack a 3 x 3 matrix, once before a loop."""
    (a, b, c), (d, e, f) = (matrix[0, 0], matrix[0, 1], matrix[0, 2]), (matrix[1, 0], matrix[1, 1], matrix[1, 2])
    return a, b, c, d, e, f, matrix[2, 0], matrix[2, 1], matrix[2, 2]


@njit(cache=True, inline="always")
def rotate(m: Matrix, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Multiply a matrix by a vector."""
    return (m[0] * x + m[1] * y + m[2] * z, m[3] * x + m[4] * y + m[5] * z, m[6] * x + m[7] * y + m[8] * z)


@njit(cache=True, error_model="numpy")
def fetch_cells(
    field: Level, scale: float, x: Array, y: Array, which: Longs, count: int, cells: Array32, fractions: Array
) -> None:
    """Copy the sixteen control values around positions of a level into rows, and their fractions of a cell.

    `which` holds the numbers of the `count` positions; `scale` is samples per metre. `cells` and `fractions` are
    outputs of `CELLS` and 2 `ROW` numbers, each position's at its own number.
    """
    side = field.shape[0]
    mask = side - 1
    pairs = field.reshape(-1).view(np.int64)
    copies = cells.view(np.int64)
    for m in range(count):
        k = which[m]
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
    which: Longs,
    count: int,
    x: Array,
    y: Array,
    fetched: FetchedCells,
) -> None:
    """As `fetch_cells`, each position on its own level; the last array of `fetched` is overwritten."""
    cells, fractions, on_level = fetched
    lowest, highest = len(levels) - 1, 0
    for m in range(count):
        lowest = min(lowest, level_of[which[m]])
        highest = max(highest, level_of[which[m]])
    for level in range(lowest, highest + 1):
        selected = 0
        for m in range(count):
            on_level[selected] = which[m]
            selected += level_of[which[m]] == level
        fetch_cells(levels[level], inverse_spacing / (1 << level), x, y, on_level, selected, cells, fractions)


@njit(cache=True, inline="always")
def spline(cells: Array32, fractions: Array, k: int) -> tuple[float, float, float, float]:
    """Height, slopes along x and y by sample, and albedo at the k-th position.

    The same sums in the same order as `marsyard.sim.terrain.kernels.sample`.
    """
    wx0, wx1, wx2, wx3, dx0, dx1, dx2, dx3 = bspline_weights(fractions[k])
    wy0, wy1, wy2, wy3, dy0, dy1, dy2, dy3 = bspline_weights(fractions[ROW + k])
    height, slope_x, slope_y, albedo = 0.0, 0.0, 0.0, 0.0
    for first, weight, change in ((0, wy0, dy0), (8 * ROW, wy1, dy1), (16 * ROW, wy2, dy2), (24 * ROW, wy3, dy3)):
        h0, a0 = cells[first + 2 * k], cells[first + 2 * k + 1]
        h1, a1 = cells[first + 2 * ROW + 2 * k], cells[first + 2 * ROW + 2 * k + 1]
        h2, a2 = cells[first + 4 * ROW + 2 * k], cells[first + 4 * ROW + 2 * k + 1]
        h3, a3 = cells[first + 6 * ROW + 2 * k], cells[first + 6 * ROW + 2 * k + 1]
        across = wx0 * h0 + wx1 * h1 + wx2 * h2 + wx3 * h3
        height += weight * across
        slope_y += change * across
        slope_x += weight * (dx0 * h0 + dx1 * h1 + dx2 * h2 + dx3 * h3)
        albedo += weight * (wx0 * a0 + wx1 * a1 + wx2 * a2 + wx3 * a3)
    return height, slope_x, slope_y, albedo
