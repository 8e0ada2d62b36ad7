"""A bounding volume hierarchy over triangles: what stands in the way of a ray.

Triangles are sorted along a Morton curve and taken in runs of `LEAF` as the leaves of a complete binary tree, whose
boxes are built bottom-up: a million triangles in a fraction of a second, the same tree every time.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from marsyard.sim.render.kernels.intersection import hit_triangle
from marsyard.sim.terrain.kernels import Array

Longs = NDArray[np.int64]
Boxes = NDArray[np.float32]
#: Triangles, their order along the curve, and the boxes of the tree's nodes: node k has the children 2 k + 1, 2 k + 2.
Hierarchy = tuple[Array, Longs, Boxes]
#: A side of a frustum: its outward normal, where it lies along that, and which numbers of a box make its innermost
#: corner.
Plane = tuple[float, float, float, float, int, int, int]
#: Triangles of a leaf.
LEAF = 4
#: Deep enough for 2**40 triangles.
_STACK = 64


@njit(cache=True)
def _spread(value: int) -> int:
    """The bits of a number of 20 bits, three apart."""
    value &= 0xFFFFF
    value = (value | value << 32) & 0x1F00000000FFFF
    value = (value | value << 16) & 0x1F0000FF0000FF
    value = (value | value << 8) & 0x100F00F00F00F00F
    value = (value | value << 4) & 0x10C30C30C30C30C3
    return (value | value << 2) & 0x1249249249249249


@njit(cache=True)
def morton_codes(triangles: Array) -> Longs:
    """Place of each triangle's middle along a Morton curve through the cube that holds them all."""
    count = triangles.shape[0]
    low = np.full(3, np.inf)
    high = np.full(3, -np.inf)
    for n in range(count):
        for axis in range(3):
            middle = (triangles[n, 0, axis] + triangles[n, 1, axis] + triangles[n, 2, axis]) / 3.0
            low[axis] = min(low[axis], middle)
            high[axis] = max(high[axis], middle)
    side = max(high[0] - low[0], high[1] - low[1], high[2] - low[2], 1e-12)
    codes = np.empty(count, dtype=np.int64)
    for n in range(count):
        code = 0
        for axis in range(3):
            middle = (triangles[n, 0, axis] + triangles[n, 1, axis] + triangles[n, 2, axis]) / 3.0
            code |= _spread(int((middle - low[axis]) / side * 1048575.0)) << axis
        codes[n] = code
    return codes


@njit(cache=True)
def node_boxes(triangles: Array, order: Longs) -> Boxes:
    """Boxes (low x, y, z, high x, y, z) of a complete tree over the triangles in this order."""
    leaves = 1
    while leaves * LEAF < order.size:
        leaves *= 2
    boxes = np.empty((2 * leaves - 1, 6), dtype=np.float32)
    for leaf in range(leaves):
        node = leaves - 1 + leaf
        if leaf > 0 and leaf * LEAF >= order.size:
            # holds nothing: a point of the leaf before, which makes no box above it larger
            boxes[node, :3] = boxes[node - 1, :3]
            boxes[node, 3:] = boxes[node - 1, :3]
            continue
        for axis in range(3):
            low = math.inf
            high = -math.inf
            for k in range(leaf * LEAF, min((leaf + 1) * LEAF, order.size)):
                for corner in range(3):
                    value = triangles[order[k], corner, axis]
                    low = min(low, value)
                    high = max(high, value)
            # rounded outwards to single precision
            boxes[node, axis] = np.float32(low - 1e-6 * abs(low) - 1e-9)
            boxes[node, axis + 3] = np.float32(high + 1e-6 * abs(high) + 1e-9)
    for node in range(leaves - 2, -1, -1):
        for axis in range(3):
            boxes[node, axis] = min(boxes[2 * node + 1, axis], boxes[2 * node + 2, axis])
            boxes[node, axis + 3] = max(boxes[2 * node + 1, axis + 3], boxes[2 * node + 2, axis + 3])
    return boxes


@njit(cache=True, inline="always")
def _entry(boxes: Boxes, node: int, x: float, y: float, z: float, ix: float, iy: float, iz: float) -> float:
    """Distance at which a ray enters a node's box, 0 from within; infinite where it does not."""
    a = (boxes[node, 0] - x) * ix
    b = (boxes[node, 3] - x) * ix
    near = min(a, b)
    far = max(a, b)
    a = (boxes[node, 1] - y) * iy
    b = (boxes[node, 4] - y) * iy
    near = max(near, min(a, b))
    far = min(far, max(a, b))
    a = (boxes[node, 2] - z) * iz
    b = (boxes[node, 5] - z) * iz
    near = max(max(near, min(a, b)), 0.0)
    far = min(far, max(a, b))
    return near if far >= near else math.inf


@njit(cache=True)
def nearest_hit(
    tree: Hierarchy, x: float, y: float, z: float, dx: float, dy: float, dz: float, farthest: float
) -> tuple[float, int, float, float]:
    """Distance to the nearest triangle that a ray meets, its number, and the weights of its second and third corner.

    The number is -1 where no triangle is nearer than `farthest`, and the distance then that one.
    """
    triangles, order, boxes = tree
    best = farthest
    best_triangle = -1
    best_second = 0.0
    best_third = 0.0
    if order.size == 0:
        return best, best_triangle, best_second, best_third
    ix = 1.0 / (dx if abs(dx) > 1e-12 else 1e-12)
    iy = 1.0 / (dy if abs(dy) > 1e-12 else 1e-12)
    iz = 1.0 / (dz if abs(dz) > 1e-12 else 1e-12)
    first_leaf = boxes.shape[0] // 2
    stack = np.empty(_STACK, dtype=np.int64)
    entries = np.empty(_STACK)
    stack[0] = 0
    entries[0] = _entry(boxes, 0, x, y, z, ix, iy, iz)
    waiting = 1
    while waiting > 0:
        waiting -= 1
        if entries[waiting] >= best:
            continue
        node = stack[waiting]
        if node < first_leaf:
            left = 2 * node + 1
            to_left = _entry(boxes, left, x, y, z, ix, iy, iz)
            to_right = _entry(boxes, left + 1, x, y, z, ix, iy, iz)
            # the nearer child is looked at first
            near_left = to_left <= to_right
            for turn in range(2):
                is_left = near_left == (turn == 1)
                entry = to_left if is_left else to_right
                if entry < best:
                    stack[waiting] = left if is_left else left + 1
                    entries[waiting] = entry
                    waiting += 1
            continue
        start = (node - first_leaf) * LEAF
        for k in range(start, min(start + LEAF, order.size)):
            t, second, third = hit_triangle(triangles, order[k], x, y, z, dx, dy, dz)
            if 0.0 < t < best and second >= 0.0 and third >= 0.0 and second + third <= 1.0:
                best = t
                best_triangle = order[k]
                best_second = second
                best_third = third
    return best, best_triangle, best_second, best_third


@njit(cache=True, inline="always")
def _box_outside(boxes: Boxes, node: int, plane: Plane) -> bool:
    """Whether a node's box lies wholly outside a side of a frustum."""
    nx, ny, nz, offset, ix, iy, iz = plane
    return bool(nx * boxes[node, ix] + ny * boxes[node, iy] + nz * boxes[node, iz] > offset)


@njit(cache=True, inline="always")
def _triangle_outside(triangles: Array, n: int, plane: Plane) -> bool:
    """Whether a triangle lies wholly outside a side of a frustum."""
    nx, ny, nz, offset, _ix, _iy, _iz = plane
    outside = True
    for corner in range(3):
        outside &= nx * triangles[n, corner, 0] + ny * triangles[n, corner, 1] + nz * triangles[n, corner, 2] > offset
    return outside


@njit(cache=True, inline="always")
def _plane(x: float, y: float, z: float, nx: float, ny: float, nz: float, beyond: float) -> Plane:
    """The plane across a direction, so far beyond a place along it."""
    return (
        nx,
        ny,
        nz,
        nx * x + ny * y + nz * z + beyond,
        0 if nx > 0.0 else 3,
        1 if ny > 0.0 else 4,
        2 if nz > 0.0 else 5,
    )


@njit(cache=True)
def in_beam(
    tree: Hierarchy,
    x: float,
    y: float,
    z: float,
    dx: float,
    dy: float,
    dz: float,
    spread: float,
    farthest: float,
    found: Longs,
) -> int:
    """Lists the triangles that rays of one origin may meet whose directions differ from this one by up to `spread`.

    Returns how many there are, -1 where they are more than `found` holds.
    """
    triangles, order, boxes = tree
    if order.size == 0:
        return 0
    # a frustum around the beam: two directions across it, four sides and the far one
    rx, ry, rz = (dy, -dx, 0.0) if abs(dz) < 0.9 else (0.0, dz, -dy)
    length = math.sqrt(rx * rx + ry * ry + rz * rz)
    rx, ry, rz = rx / length, ry / length, rz / length
    ux, uy, uz = ry * dz - rz * dy, rz * dx - rx * dz, rx * dy - ry * dx
    widening = math.tan(spread)
    sx, sy, sz = widening * dx, widening * dy, widening * dz
    right = _plane(x, y, z, rx - sx, ry - sy, rz - sz, 0.0)
    left = _plane(x, y, z, -rx - sx, -ry - sy, -rz - sz, 0.0)
    above = _plane(x, y, z, ux - sx, uy - sy, uz - sz, 0.0)
    below = _plane(x, y, z, -ux - sx, -uy - sy, -uz - sz, 0.0)
    end = _plane(x, y, z, dx, dy, dz, farthest)
    first_leaf = boxes.shape[0] // 2
    count = 0
    node = 0
    while True:
        missed = (
            _box_outside(boxes, node, right)
            or _box_outside(boxes, node, left)
            or _box_outside(boxes, node, above)
            or _box_outside(boxes, node, below)
            or _box_outside(boxes, node, end)
        )
        if not missed:
            if node < first_leaf:
                node = 2 * node + 1
                continue
            start = (node - first_leaf) * LEAF
            for k in range(start, min(start + LEAF, order.size)):
                n = order[k]
                beside = (
                    _triangle_outside(triangles, n, right)
                    or _triangle_outside(triangles, n, left)
                    or _triangle_outside(triangles, n, above)
                    or _triangle_outside(triangles, n, below)
                )
                if beside:
                    continue
                if count == found.size:
                    return -1
                found[count] = n
                count += 1
        while node > 0 and node % 2 == 0:
            node = (node - 1) // 2
        if node == 0:
            return count
        node += 1
