"""A bounding volume hierarchy over triangles, and the intersection of rays with it.

Triangles are sorted along a Morton curve. Groups of `LEAF` successive triangles are the leaves of a complete binary
tree. The bounding boxes of its nodes are computed bottom-up. The tree is deterministic.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from marsyard.sim.render.kernels.structs import Array32, Longs, Ray
from marsyard.sim.terrain.kernels import Array


class TriangleHit(NamedTuple):
    """Distance along a ray, triangle number (-1 for none), and barycentric weights of its second and third corner."""

    distance: float
    triangle: int
    second: float
    third: float


@njit(cache=True, inline="always")
def hit_triangle(triangles: Array, n: int, ray: Ray) -> tuple[float, float, float]:
    """Intersect a ray with a triangle's plane: distance, and barycentric weights of the second and third corner.

    Moeller & Trumbore (1997). The distance is infinite if the ray is parallel to the plane.
    """
    # a: first corner; u, v: edges from it; s: from it to the ray's origin; p = d x v and q = s x u for the direction d
    ax, ay, az = triangles[n, 0, 0], triangles[n, 0, 1], triangles[n, 0, 2]
    ux, uy, uz = triangles[n, 1, 0] - ax, triangles[n, 1, 1] - ay, triangles[n, 1, 2] - az
    vx, vy, vz = triangles[n, 2, 0] - ax, triangles[n, 2, 1] - ay, triangles[n, 2, 2] - az
    px, py, pz = ray.dy * vz - ray.dz * vy, ray.dz * vx - ray.dx * vz, ray.dx * vy - ray.dy * vx
    determinant = ux * px + uy * py + uz * pz
    if abs(determinant) < 1e-18:
        return math.inf, 0.0, 0.0
    inverse = 1.0 / determinant
    sx, sy, sz = ray.x - ax, ray.y - ay, ray.z - az
    second = (sx * px + sy * py + sz * pz) * inverse
    qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
    third = (ray.dx * qx + ray.dy * qy + ray.dz * qz) * inverse
    return (vx * qx + vy * qy + vz * qz) * inverse, second, third


@njit(cache=True, inline="always")
def nearer_hit(best: TriangleHit, triangles: Array, n: int, ray: Ray, slack: float) -> TriangleHit:
    """Return the hit of the n-th triangle if it is nearer than `best`, else `best`; `slack` enlarges the triangle."""
    t, second, third = hit_triangle(triangles, n, ray)
    is_inside = second >= -slack and third >= -slack and second + third <= 1.0 + slack
    return TriangleHit(t, n, second, third) if 0.0 < t < best.distance and is_inside else best


@njit(cache=True)
def first_hits(triangles: Array, origin: Array, directions: Array) -> tuple[Array, Longs]:
    """Distance to the first triangle on each ray from an origin, and its index; infinite and -1 if there is none.

    All triangles are tested: for few rays, or triangles that are used only once.
    """
    distances, numbers = np.empty(len(directions)), np.empty(len(directions), dtype=np.int64)
    for k in range(len(directions)):
        ray = Ray(origin[0], origin[1], origin[2], directions[k, 0], directions[k, 1], directions[k, 2])
        best = TriangleHit(math.inf, -1, 0.0, 0.0)
        for n in range(len(triangles)):
            best = nearer_hit(best, triangles, n, ray, 0.0)
        distances[k], numbers[k] = best.distance, best.triangle
    return distances, numbers


@njit(cache=True)
def body_spheres(triangles: Array, first_triangle: Longs) -> Array:
    """Bounding sphere of each body: centre of its bounding box, and maximum distance of its corners from the centre.

    `first_triangle` contains the first triangle of each body, and the number of triangles at the end.
    """
    bodies = first_triangle.size - 1
    spheres = np.empty((bodies, 4))
    for body in range(bodies):
        for axis in range(3):
            low = math.inf
            high = -math.inf
            for n in range(first_triangle[body], first_triangle[body + 1]):
                for corner in range(3):
                    low = min(low, triangles[n, corner, axis])
                    high = max(high, triangles[n, corner, axis])
            spheres[body, axis] = 0.5 * (low + high)
        farthest = 0.0
        for n in range(first_triangle[body], first_triangle[body + 1]):
            for corner in range(3):
                x = triangles[n, corner, 0] - spheres[body, 0]
                y = triangles[n, corner, 1] - spheres[body, 1]
                z = triangles[n, corner, 2] - spheres[body, 2]
                farthest = max(farthest, x * x + y * y + z * z)
        spheres[body, 3] = math.sqrt(farthest)
    return spheres


@njit(cache=True)
def select_facing(triangles: Array, numbers: Longs, x: float, y: float, z: float, radius: float) -> Longs:
    """Select the numbers of the triangles that face a position within a radius of x, y, z."""
    selected = np.empty(numbers.size, dtype=np.int64)
    count = 0
    for n in numbers:
        ax, ay, az = triangles[n, 0, 0], triangles[n, 0, 1], triangles[n, 0, 2]
        ux, uy, uz = triangles[n, 1, 0] - ax, triangles[n, 1, 1] - ay, triangles[n, 1, 2] - az
        vx, vy, vz = triangles[n, 2, 0] - ax, triangles[n, 2, 1] - ay, triangles[n, 2, 2] - az
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        selected[count] = n
        largest_offset = radius * math.sqrt(nx * nx + ny * ny + nz * nz)
        count += nx * (x - ax) + ny * (y - ay) + nz * (z - az) + largest_offset > 0.0
    return selected[:count]


#: Triangles, their order along the Morton curve, and the boxes of the nodes: node k has the children 2 k + 1, 2 k + 2.
Hierarchy = tuple[Array, Longs, Array32]
#: A side of a frustum: outward normal, offset along it, and the indices of a box's corner with the smallest offset.
Plane = tuple[float, float, float, float, int, int, int]
#: Triangles per leaf.
LEAF = 4


@njit(cache=True)
def _spread_bits(value: int) -> int:
    """Move bit k of a 20-bit number to bit 3 k (interleaving of Morton codes)."""
    value &= 0xFFFFF
    value = (value | value << 32) & 0x1F00000000FFFF
    value = (value | value << 16) & 0x1F0000FF0000FF
    value = (value | value << 8) & 0x100F00F00F00F00F
    value = (value | value << 4) & 0x10C30C30C30C30C3
    return (value | value << 2) & 0x1249249249249249


@njit(cache=True)
def morton_codes(triangles: Array) -> Longs:
    """Morton code of each triangle's centroid in the cube that contains all centroids, with 20 bits per axis."""
    count = triangles.shape[0]
    low = np.full(3, np.inf)
    high = np.full(3, -np.inf)
    for n in range(count):
        for axis in range(3):
            centroid = (triangles[n, 0, axis] + triangles[n, 1, axis] + triangles[n, 2, axis]) / 3.0
            low[axis] = min(low[axis], centroid)
            high[axis] = max(high[axis], centroid)
    side = max(high[0] - low[0], high[1] - low[1], high[2] - low[2], 1e-12)
    codes = np.empty(count, dtype=np.int64)
    for n in range(count):
        code = 0
        for axis in range(3):
            centroid = (triangles[n, 0, axis] + triangles[n, 1, axis] + triangles[n, 2, axis]) / 3.0
            code |= _spread_bits(int((centroid - low[axis]) / side * 1048575.0)) << axis
        codes[n] = code
    return codes


@njit(cache=True)
def node_boxes(triangles: Array, order: Longs) -> Array32:
    """Bounding boxes (minimum x, y, z, maximum x, y, z) of a complete tree over the triangles in this order."""
    leaves = 1
    while leaves * LEAF < order.size:
        leaves *= 2
    boxes = np.empty((2 * leaves - 1, 6), dtype=np.float32)
    for leaf in range(leaves):
        node = leaves - 1 + leaf
        if leaf > 0 and leaf * LEAF >= order.size:
            # an empty leaf is a point of the previous leaf, so it does not enlarge its parent's box
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
def _next_node(node: int) -> int:
    """Next node in depth-first order outside this node's subtree; 0 after the last node."""
    while node > 0 and node % 2 == 0:
        node = (node - 1) // 2
    return node + 1 if node > 0 else 0


@njit(cache=True, inline="always")
def _entry_distance(boxes: Array32, node: int, ray: Ray, inverse: tuple[float, float, float]) -> float:
    """Distance at which a ray enters a node's box: 0 if it starts inside, infinite if it misses the box."""
    a, b = (boxes[node, 0] - ray.x) * inverse[0], (boxes[node, 3] - ray.x) * inverse[0]
    near, far = min(a, b), max(a, b)
    a, b = (boxes[node, 1] - ray.y) * inverse[1], (boxes[node, 4] - ray.y) * inverse[1]
    near, far = max(near, min(a, b)), min(far, max(a, b))
    a, b = (boxes[node, 2] - ray.z) * inverse[2], (boxes[node, 5] - ray.z) * inverse[2]
    near, far = max(max(near, min(a, b)), 0.0), min(far, max(a, b))
    return near if far >= near else math.inf


@njit(cache=True, inline="always")
def _invert_component(component: float) -> float:
    """Invert a component of a direction; finite for zero."""
    return 1.0 / (component if abs(component) > 1e-12 else 1e-12)


@njit(cache=True)
def nearest_hit(tree: Hierarchy, ray: Ray, farthest: float) -> TriangleHit:
    """Find the nearest triangle that a ray hits; distance `farthest` and number -1 if no hit is nearer than this."""
    triangles, order, boxes = tree
    best = TriangleHit(farthest, -1, 0.0, 0.0)
    if order.size == 0:
        return best
    inverse = (_invert_component(ray.dx), _invert_component(ray.dy), _invert_component(ray.dz))
    first_leaf = boxes.shape[0] // 2
    node = 0
    while True:
        if _entry_distance(boxes, node, ray, inverse) < best.distance:
            if node < first_leaf:
                node = 2 * node + 1
                continue
            start = (node - first_leaf) * LEAF
            for k in range(start, min(start + LEAF, order.size)):
                best = nearer_hit(best, triangles, order[k], ray, 0.0)
        node = _next_node(node)
        if node == 0:
            return best


@njit(cache=True)
def nearest_hits(tree: Hierarchy, origins: Array, direction: Array) -> Longs:
    """Find the nearest triangle that the ray from each origin hits; number -1 if there is none."""
    numbers = np.empty(len(origins), dtype=np.int64)
    for k in range(len(origins)):
        ray = Ray(origins[k, 0], origins[k, 1], origins[k, 2], direction[0], direction[1], direction[2])
        numbers[k] = nearest_hit(tree, ray, math.inf).triangle
    return numbers


@njit(cache=True, inline="always")
def _is_outside_beam(triangles: Array, n: int, sides: tuple[Plane, ...]) -> bool:
    """Return whether a triangle is entirely outside one of a frustum's first four sides; the fifth is the far side."""
    for nx, ny, nz, offset, _ix, _iy, _iz in sides[:4]:
        is_outside = True
        for corner in range(3):
            x, y, z = triangles[n, corner, 0], triangles[n, corner, 1], triangles[n, corner, 2]
            is_outside &= nx * x + ny * y + nz * z > offset
        if is_outside:
            return True
    return False


@njit(cache=True, inline="always")
def _create_plane(ray: Ray, nx: float, ny: float, nz: float, distance: float) -> Plane:
    """Create the plane with this normal at a distance from a ray's origin."""
    offset = nx * ray.x + ny * ray.y + nz * ray.z + distance
    return nx, ny, nz, offset, 0 if nx > 0.0 else 3, 1 if ny > 0.0 else 4, 2 if nz > 0.0 else 5


@njit(cache=True)
def list_in_beam(tree: Hierarchy, ray: Ray, half_angle: float, farthest: float, numbers: Longs) -> int:
    """Write the triangles within an angle of a ray to `numbers`; return the count, or -1 if `numbers` is too small."""
    triangles, order, boxes = tree
    if order.size == 0:
        return 0
    # a frustum around the beam: two perpendicular directions, four lateral sides and the far side
    dx, dy, dz = ray.dx, ray.dy, ray.dz
    rx, ry, rz = (dy, -dx, 0.0) if abs(dz) < 0.9 else (0.0, dz, -dy)
    length = math.sqrt(rx * rx + ry * ry + rz * rz)
    rx, ry, rz = rx / length, ry / length, rz / length
    ux, uy, uz = ry * dz - rz * dy, rz * dx - rx * dz, rx * dy - ry * dx
    tangent = math.tan(half_angle)
    sx, sy, sz = tangent * dx, tangent * dy, tangent * dz
    sides = (
        _create_plane(ray, rx - sx, ry - sy, rz - sz, 0.0),
        _create_plane(ray, -rx - sx, -ry - sy, -rz - sz, 0.0),
        _create_plane(ray, ux - sx, uy - sy, uz - sz, 0.0),
        _create_plane(ray, -ux - sx, -uy - sy, -uz - sz, 0.0),
        _create_plane(ray, dx, dy, dz, farthest),
    )
    first_leaf = boxes.shape[0] // 2
    count = 0
    node = 0
    while True:
        is_outside = False
        for nx, ny, nz, offset, ix, iy, iz in sides:
            is_outside |= nx * boxes[node, ix] + ny * boxes[node, iy] + nz * boxes[node, iz] > offset
        if not is_outside:
            if node < first_leaf:
                node = 2 * node + 1
                continue
            start = (node - first_leaf) * LEAF
            for k in range(start, min(start + LEAF, order.size)):
                if _is_outside_beam(triangles, order[k], sides):
                    continue
                if count == numbers.size:
                    return -1
                numbers[count] = order[k]
                count += 1
        node = _next_node(node)
        if node == 0:
            return count
