"""Kernels that prepare the pinhole views drawn by OpenGL: angles of camera rays, depth conversion, ground mesh."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from marsyard.sim.render.kernels.structs import Array32, Longs
from marsyard.sim.terrain.kernels import Array, Level, sample


@njit(cache=True, error_model="numpy")
def pixel_angles(directions: Array) -> Array32:
    """Square root of each pixel's solid angle, radians, from the unit vectors along all rays, (rows, columns, 3).

    The sides of a pixel are central differences of the unit vectors, one-sided differences at the border.
    """
    rows, columns = directions.shape[:2]
    angles = np.empty((rows, columns), dtype=np.float32)
    for i in range(rows):
        above, below = max(i - 1, 0), min(i + 1, rows - 1)
        row_step = float(below - above)
        for j in range(columns):
            left, right = max(j - 1, 0), min(j + 1, columns - 1)
            column_step = float(right - left)
            ax = (directions[i, right, 0] - directions[i, left, 0]) / column_step
            ay = (directions[i, right, 1] - directions[i, left, 1]) / column_step
            az = (directions[i, right, 2] - directions[i, left, 2]) / column_step
            bx = (directions[below, j, 0] - directions[above, j, 0]) / row_step
            by = (directions[below, j, 1] - directions[above, j, 1]) / row_step
            bz = (directions[below, j, 2] - directions[above, j, 2]) / row_step
            x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            angles[i, j] = math.sqrt(math.sqrt(x * x + y * y + z * z))
    return angles


@njit(cache=True)
def sum_of_vectors(directions: Array32) -> tuple[float, float, float]:
    """Sum of vectors, shape (n, 3)."""
    x, y, z = 0.0, 0.0, 0.0
    for n in range(directions.shape[0]):
        x += directions[n, 0]
        y += directions[n, 1]
        z += directions[n, 2]
    return x, y, z


@njit(cache=True)
def min_component(directions: Array32, axis: Array) -> float:
    """Minimum component of vectors, shape (n, 3), along an axis."""
    lowest = math.inf
    for n in range(directions.shape[0]):
        lowest = min(lowest, directions[n, 0] * axis[0] + directions[n, 1] * axis[1] + directions[n, 2] * axis[2])
    return lowest


@njit(cache=True, error_model="numpy")
def max_image_radius(directions: Array, view: Array) -> float:
    """Maximum absolute image coordinate (x or y) of rays, shape (rows, columns, 3), at a focal length of 1.

    The rows of `view` are the right, down and forward axes of the view.
    """
    largest = 0.0
    for i in range(directions.shape[0]):
        for j in range(directions.shape[1]):
            x, y, z = directions[i, j, 0], directions[i, j, 1], directions[i, j, 2]
            right = view[0, 0] * x + view[0, 1] * y + view[0, 2] * z
            down = view[1, 0] * x + view[1, 1] * y + view[1, 2] * z
            forward = view[2, 0] * x + view[2, 1] * y + view[2, 2] * z
            largest = max(largest, abs(right / forward), abs(down / forward))
    return largest


@njit(cache=True, error_model="numpy")
def depth_in_metres(depth_buffer: Array32, near: float, far: float) -> Array32:
    """Convert OpenGL's depths to depth along the axis, metres, 0 where there is no surface; reverse the order of rows.

    `depth_buffer` is 0 at `near`, and 1 at `far` and where there is no surface; its first row is the lowest.
    """
    rows, columns = depth_buffer.shape
    depth = np.empty((rows, columns), dtype=np.float32)
    # all operations in single precision
    minus_two, one, zero = np.float32(-2.0), np.float32(1.0), np.float32(0.0)
    difference, total, product = np.float32(far - near), np.float32(far + near), np.float32(2.0 * near * far)
    for i in range(rows):
        source, output = depth_buffer[rows - 1 - i], depth[i]
        for j in range(columns):
            value = product / ((minus_two * source[j] + one) * difference + total)
            output[j] = zero if source[j] == one else value
    return depth


@njit(cache=True)
def spans_in_hull(x: Array, y: Array, hull: Array) -> Longs:
    """Select the cells of a grid that overlap a convex polygon; return first and end cell of each strip, (strips, 2).

    A strip lies between two successive lines of y. `x` and `y` are increasing; `hull` contains the polygon's corners in
    order, shape (corners, 2).
    """
    spans = np.empty((y.size - 1, 2), dtype=np.int64)
    for strip in range(y.size - 1):
        low, high = y[strip], y[strip + 1]
        min_x, max_x = math.inf, -math.inf
        for k in range(hull.shape[0]):
            x0, y0 = hull[k - 1, 0], hull[k - 1, 1]
            x1, y1 = hull[k, 0], hull[k, 1]
            if min(y0, y1) > high or max(y0, y1) < low:
                continue
            # the part of the polygon's side inside the strip
            for strip_y, corner_x in ((low, x0), (high, x1)):
                edge_x = corner_x if y0 == y1 else x0 + min(max((strip_y - y0) / (y1 - y0), 0.0), 1.0) * (x1 - x0)
                min_x = min(min_x, edge_x)
                max_x = max(max_x, edge_x)
        first = min(max(int(np.searchsorted(x, min_x, side="right")) - 1, 0), x.size - 1)
        spans[strip, 0] = first
        spans[strip, 1] = min(max(int(np.searchsorted(x, max_x)), first), x.size - 1)
    return spans


@njit(cache=True)
def build_mesh(
    levels: tuple[Level, ...], spacing: float, x: Array, y: Array, level_of_x: Longs, level_of_y: Longs, spans: Longs
) -> tuple[Array, NDArray[np.uint32]]:
    """Triangulate the selected cells of a grid: vertices, metres, and faces, counter-clockwise seen from above.

    `level_of_x` and `level_of_y` are the terrain levels of the grid lines; a vertex has the height of the coarser level
    of its two lines. `spans` are those of `spans_in_hull`.
    """
    lines = y.size
    # the vertices of a line are the corners of the selected cells on both sides of it
    left = np.full(lines, x.size, dtype=np.int64)
    right = np.full(lines, -1, dtype=np.int64)
    cells = 0
    for strip in range(lines - 1):
        first, end = spans[strip, 0], spans[strip, 1]
        cells += end - first
        for line in range(strip, strip + 2):
            if end > first:
                left[line] = min(left[line], first)
                right[line] = max(right[line], end)
    # index of the vertex in column 0 of each line, if the line began there
    starts = np.empty(lines, dtype=np.int64)
    count = 0
    for line in range(lines):
        starts[line] = count - left[line]
        count += max(right[line] + 1 - left[line], 0)
    vertices = np.empty((count, 3))
    for line in range(lines):
        for column in range(left[line], right[line] + 1):
            level = max(level_of_x[column], level_of_y[line])
            inverse_spacing = 1.0 / (spacing * 2.0**level)
            height, _slope_x, _slope_y, _albedo = sample(levels[level], inverse_spacing, x[column], y[line])
            n = starts[line] + column
            vertices[n, 0], vertices[n, 1], vertices[n, 2] = x[column], y[line], height
    faces = np.empty((2 * cells, 3), dtype=np.uint32)
    n = 0
    for strip in range(lines - 1):
        for cell in range(spans[strip, 0], spans[strip, 1]):
            lower, upper = starts[strip] + cell, starts[strip + 1] + cell
            # the two triangles of a cell are successive, so that OpenGL transforms their common vertices once
            faces[n, 0], faces[n, 1], faces[n, 2] = lower, lower + 1, upper + 1
            faces[n + 1, 0], faces[n + 1, 1], faces[n + 1, 2] = lower, upper + 1, upper
            n += 2
    return vertices, faces
