"""Compiled kernels of the terrain: evaluation, refinement and height bounds of the B-spline, and levels of samples."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

#: A level of the pyramid, shape (side, side, 2): height and albedo; side is a power of two.
Level = NDArray[np.float32]
#: Values of one quantity on a periodic grid, shape (side, side).
Grid = NDArray[np.float32]
Array = NDArray[np.float64]
#: One number for each of four successive control values.
Weights = tuple[float, float, float, float]


@njit(cache=True, inline="always")
def bspline_weights(t: float) -> tuple[Weights, Weights]:
    """Compute the weights of the four control values around a point at fraction t of a cell, and their derivatives."""
    s = 1.0 - t
    t2 = t * t
    s2 = s * s
    w0 = s2 * s / 6.0
    w3 = t2 * t / 6.0
    w1 = (2.0 / 3.0) - 0.5 * t2 * (2.0 - t)
    w2 = 1.0 - w0 - w1 - w3
    d0 = -0.5 * s2
    d3 = 0.5 * t2
    d1 = t * (1.5 * t - 2.0)
    d2 = -d0 - d1 - d3
    return (w0, w1, w2, w3), (d0, d1, d2, d3)


@njit(cache=True, inline="always")
def sample(field: Level, inverse_spacing: float, x: float, y: float) -> tuple[float, float, float, float]:
    """Evaluate height, its slopes along x and y, and albedo of one periodic level at one position."""
    side = field.shape[0]
    mask = side - 1
    gx = x * inverse_spacing
    gy = y * inverse_spacing
    fx, fy = math.floor(gx), math.floor(gy)
    j, i = int(fx), int(fy)
    (wx0, wx1, wx2, wx3), (dx0, dx1, dx2, dx3) = bspline_weights(gx - fx)
    wy, dy = bspline_weights(gy - fy)
    j0, j1, j2, j3 = (j - 1) & mask, j & mask, (j + 1) & mask, (j + 2) & mask
    height, slope_x, slope_y, albedo = 0.0, 0.0, 0.0, 0.0
    for k in range(4):
        row = field[(i + k - 1) & mask]
        h0, h1, h2, h3 = row[j0, 0], row[j1, 0], row[j2, 0], row[j3, 0]
        row_height = wx0 * h0 + wx1 * h1 + wx2 * h2 + wx3 * h3
        height += wy[k] * row_height
        slope_y += dy[k] * row_height
        slope_x += wy[k] * (dx0 * h0 + dx1 * h1 + dx2 * h2 + dx3 * h3)
        albedo += wy[k] * (wx0 * row[j0, 1] + wx1 * row[j1, 1] + wx2 * row[j2, 1] + wx3 * row[j3, 1])
    return height, slope_x * inverse_spacing, slope_y * inverse_spacing, albedo


@njit(cache=True, inline="always")
def collapse(field: Level, gy: float, out: Array) -> None:
    """Reduce a level to cubic splines in x on the line y = `gy` (in samples); `out` are their control values."""
    mask = field.shape[0] - 1
    fy = math.floor(gy)
    i = int(fy)
    wy, _dy = bspline_weights(gy - fy)
    for j in range(field.shape[1]):
        for c in range(2):
            out[j, c] = (
                wy[0] * field[(i - 1) & mask, j, c]
                + wy[1] * field[i & mask, j, c]
                + wy[2] * field[(i + 1) & mask, j, c]
                + wy[3] * field[(i + 2) & mask, j, c]
            )


@njit(cache=True)
def evaluate_field(field: Level, spacing: float, x: Array, y: Array) -> Array:
    """Evaluate height, slopes and albedo at many positions; shape (n, 4)."""
    out = np.empty((x.size, 4), dtype=np.float64)
    inverse_spacing = 1.0 / spacing
    for n in range(x.size):
        out[n, 0], out[n, 1], out[n, 2], out[n, 3] = sample(field, inverse_spacing, x[n], y[n])
    return out


#: Block size of the height bounds, in samples; smaller blocks do not speed up ray tracing.
CEILING_BLOCK = 4


@njit(cache=True)
def block_ceilings(field: Level) -> NDArray[np.float32]:
    """Compute an upper height bound of each block of samples: the maximum of all control values that affect it.

    Block (a, b) covers the samples ``CEILING_BLOCK * a`` to ``CEILING_BLOCK * (a + 1)`` along y; b is the same along x.
    """
    side = field.shape[0]
    mask = side - 1
    count = side // CEILING_BLOCK
    ceiling = np.empty((count, count), dtype=np.float32)
    highest = np.empty(side, dtype=np.float32)
    for a in range(count):
        highest[:] = field[(a * CEILING_BLOCK - 1) & mask, :, 0]
        for k in range(CEILING_BLOCK + 2):
            row = field[(a * CEILING_BLOCK + k) & mask]
            for j in range(side):
                highest[j] = max(highest[j], row[j, 0])
        for b in range(count):
            bound = highest[(b * CEILING_BLOCK - 1) & mask]
            for k in range(CEILING_BLOCK + 2):
                bound = max(bound, highest[(b * CEILING_BLOCK + k) & mask])
            ceiling[a, b] = bound
    return ceiling


@njit(cache=True)
def reduce_level(fine: Level) -> Level:
    """Compute the next coarser level: binomial filter (1 4 6 4 1)/16 along x and y, every second sample, periodic."""
    side = fine.shape[0]
    half = side // 2
    mask = side - 1
    weights = np.array([1.0, 4.0, 6.0, 4.0, 1.0], dtype=np.float32) / np.float32(16.0)
    half_width = np.empty((side, half, 2), dtype=np.float32)
    # a row with two samples of the opposite end on each side
    row = np.empty((side + 4, 2), dtype=np.float32)
    for i in range(side):
        row[:2], row[2:-2], row[-2:] = fine[i, -2:], fine[i], fine[i, :2]
        for j in range(half):
            for c in range(2):
                outer, inner = row[2 * j, c] + row[2 * j + 4, c], row[2 * j + 1, c] + row[2 * j + 3, c]
                half_width[i, j, c] = weights[0] * outer + weights[1] * inner + weights[2] * row[2 * j + 2, c]
    coarse = np.zeros((half, half, 2), dtype=np.float32)
    for i in range(half):
        for k in range(5):
            source = (2 * i + k - 2) & mask
            for j in range(half):
                for c in range(2):
                    coarse[i, j, c] += weights[k] * half_width[source, j, c]
    return coarse


@njit(cache=True)
def add_refined(fine: Grid, coarse: Grid) -> None:
    """Upsample a coarse grid of cubic B-spline coefficients by two (exact subdivision), and add it to the fine grid."""
    side = coarse.shape[0]
    row = np.empty(side, dtype=np.float32)
    one_eighth, six_eighths, half = np.float32(0.125), np.float32(0.75), np.float32(0.5)
    for i in range(2 * side):
        k = i // 2
        current = coarse[k]
        following = coarse[(k + 1) % side]
        if i % 2 == 0:
            previous = coarse[k - 1]
            for j in range(side):
                row[j] = one_eighth * (previous[j] + following[j]) + six_eighths * current[j]
        else:
            for j in range(side):
                row[j] = half * (current[j] + following[j])
        fine_row = fine[i]
        for j in range(side - 1):
            fine_row[2 * j] += one_eighth * (row[j - 1] + row[j + 1]) + six_eighths * row[j]
            fine_row[2 * j + 1] += half * (row[j] + row[j + 1])
        fine_row[2 * side - 2] += one_eighth * (row[side - 2] + row[0]) + six_eighths * row[side - 1]
        fine_row[2 * side - 1] += half * (row[side - 1] + row[0])


@njit(cache=True)
def interleave_samples(height: Grid, albedo: Grid, scale: float, samples: Level) -> None:
    """Interleave height and albedo; the albedo is scaled and limited to 1."""
    for i in range(height.shape[0]):
        for j in range(height.shape[0]):
            samples[i, j, 0] = height[i, j]
            samples[i, j, 1] = min(scale * albedo[i, j], 1.0)
