"""A bounding volume hierarchy over triangles, and the intersection of rays with it.

Triangles are sorted along a Morton curve; they are the leaves of a complete binary tree. The bounding boxes of its
nodes are computed bottom-up. The tree is deterministic.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np
from jaxtyping import Float64 as FloatArray
from jaxtyping import Int64

from marsyard.sim.render.arrays import Values, compiled, larger, smaller, to_device, to_host, vectors_to_device, where
from marsyard.sim.render.device import Array3f, Array3f64, Array4f, Bool, Float, Float64, Int32, UInt32
from marsyard.sim.render.rays import Ray

Triangles = FloatArray[np.ndarray, "triangles 3 3"]
#: Relative margin of bounds and of triangles in single precision, larger than rounding errors.
SLACK = 1e-6
#: Bits of a Morton code along each axis; three of them fit into 64 bits.
MORTON_BITS = 20
#: Number of rays up to which testing all triangles takes less time than building their hierarchy.
FEW_RAYS = 256


@dataclass(eq=False)
class TriangleHit:
    """Distance along a ray, triangle number (-1 for none), and barycentric weights of its second and third corner."""

    t: Values
    number: Values
    second: Values
    third: Values


def no_hit(farthest: Values) -> TriangleHit:
    """Return the hit of a ray that meets no triangle up to a distance."""
    return TriangleHit(Float64(farthest), Int32(-1), Float64(0.0), Float64(0.0))


def intersect(ray: Ray, a: Values, b: Values, c: Values) -> tuple[Values, Values, Values]:
    """Intersect rays with the planes of triangles a, b, c: distance, and barycentric weights of b and c.

    Moeller & Trumbore (1997), with the letters of the paper. The results are NaN or infinite for parallel rays.
    """
    edge1, edge2, s = b - a, c - a, ray.origin - a
    p, q = dr.cross(ray.direction, edge2), dr.cross(s, edge1)
    inverse = 1.0 / dr.dot(edge1, p)
    return dr.dot(edge2, q) * inverse, dr.dot(s, p) * inverse, dr.dot(ray.direction, q) * inverse


def is_inside(u: Values, v: Values, slack: float) -> Values:
    """Return whether barycentric weights are those of a point in the triangle; `slack` enlarges the triangle."""
    return (u >= -slack) & (v >= -slack) & (u + v <= 1.0 + slack)


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """A complete binary tree of bounding boxes over triangles along a Morton curve.

    Node k has the children 2 k and 2 k + 1; the root is node 1. The leaves are the triangles, from node `first_leaf`.
    Boxes and leaves have single precision and are relative to `centre`, which should be near the rays' origins.

    - boxes: minimum x, y, z and 0, then maximum x, y, z and 0 of each node
    - leaves: x, y, z and 0 of the three corners of each leaf
    - numbers: number of the triangle of each leaf; the last triangle fills the tree
    - corners: corners of all triangles in world axes, double precision, three for each number
    """

    boxes: Values
    leaves: Values
    numbers: Values
    corners: Values
    centre: Values
    first_leaf: Values

    @classmethod
    def build(
        cls, corners: Values, order: Int64[np.ndarray, "listed"], centre: FloatArray[np.ndarray, "3"]
    ) -> Hierarchy:
        """Build the tree over triangles in the given order; `corners` are those of all triangles on the device."""
        count = 1 << (len(order) - 1).bit_length()
        numbers = to_device(UInt32, np.concatenate([order, np.full(count - len(order), order[-1])]))
        leaves, origin, sides = dr.empty(Float, 12 * count), Array3f64(*centre.tolist()), []
        bounds = _copy_leaves(corners, numbers, dr.arange(UInt32, count), origin, leaves)
        for side, smaller_of in zip(bounds, (np.minimum, np.maximum), strict=True):
            levels = [to_host(side)]
            while len(levels[-1]) > 1:
                levels.append(smaller_of(levels[-1][::2], levels[-1][1::2]))
            sides.append(np.concatenate([levels[-1], *levels[::-1]]))
        return cls(to_device(Float, np.stack(sides, axis=1)), leaves, numbers, corners, origin, UInt32(count))


@compiled
def _copy_leaves(
    corners: Values, numbers: Values, leaf: Values, centre: Values, leaves: Values
) -> tuple[Values, Values]:
    """Copy corners relative to a centre to `leaves` (see `Hierarchy`); return the minimum and maximum of each leaf.

    The bounds have four components, and are rounded outwards.
    """
    low, high = Array4f(dr.inf), Array4f(-dr.inf)
    for k in range(3):
        x, y, z = Array3f(dr.gather(Array3f64, corners, 3 * numbers + k) - centre)
        corner = Array4f(x, y, z, 0.0)
        low, high = smaller(low, corner), larger(high, corner)
        dr.scatter(leaves, corner, 3 * leaf + k)
    return low - SLACK * (1.0 + dr.abs(low)), high + SLACK * (1.0 + dr.abs(high))


def _entry_distance(boxes: Values, node: Values, ray: Ray, inverse: Values, active: Values) -> Values:
    """Distance at which a ray enters a node's box: 0 if it starts inside, infinite if it misses the box."""
    near, far = Float(0.0), Float(dr.inf)
    low, high = (dr.gather(Array4f, boxes, 2 * node + k, active) for k in range(2))
    for axis in range(3):
        first, second = ((side[axis] - ray.origin[axis]) * inverse[axis] for side in (low, high))
        near, far = larger(near, smaller(first, second)), smaller(far, larger(first, second))
    return dr.select(far >= near, near * (1.0 - SLACK), dr.inf)


def nearest_hit(tree: Hierarchy, ray: Ray, farthest: Values, active: Values) -> TriangleHit:
    """Find the nearest triangle that a ray hits; infinite distance and number -1 if no hit is nearer than `farthest`.

    The tree is searched with single precision; the intersection with the triangle that is found has double precision.
    """
    local = Ray(Array3f(ray.origin - tree.centre), Array3f(ray.direction))
    inverse = Array3f(*(1.0 / dr.select(dr.abs(d) > 1e-12, d, 1e-12) for d in local.direction))

    def visit(node: Values, best: Values, nearest: Values, is_active: Values) -> tuple[Values, ...]:
        """Visit a node; `best` is the distance of the nearest hit, and `nearest` its leaf."""
        is_near = is_active & (_entry_distance(tree.boxes, node, local, inverse, is_active) < best)
        is_leaf, leaf = is_near & (node >= tree.first_leaf), node - tree.first_leaf

        def distance() -> Values:
            a, b, c = (dr.gather(Array4f, tree.leaves, 3 * leaf + corner, is_leaf) for corner in range(3))
            t, u, v = intersect(local, a.xyz, b.xyz, c.xyz)
            return dr.select(is_inside(u, v, SLACK) & (t > 0.0), t, dr.inf)

        t = where(is_leaf, distance, Float(dr.inf))
        nearest, best = dr.select(t < best, leaf, nearest), smaller(t, best)
        # depth first: the first child, or the next sibling of the node or of its nearest ancestor that has one
        ancestor, descends = node >> dr.tzcnt(~node), is_near & ~is_leaf
        node = dr.select(descends, 2 * node, ancestor + 1)
        return node, best, nearest, is_active & (descends | (ancestor != 0))

    limit = Float(farthest)
    _, best, nearest, _ = dr.while_loop(
        (UInt32(1), Float(limit), UInt32(0), Bool(active)), lambda node, best, nearest, is_active: is_active, visit
    )
    is_hit = active & (best < limit)
    number = dr.gather(UInt32, tree.numbers, nearest, is_hit)
    t, u, v = intersect(ray, *(dr.gather(Array3f64, tree.corners, 3 * number + k, is_hit) for k in range(3)))
    return dr.select(is_hit, TriangleHit(t, Int32(number), u, v), no_hit(dr.inf))


def first_hits(
    triangles: Triangles, origins: FloatArray[np.ndarray, "#rays 3"], directions: FloatArray[np.ndarray, "#rays 3"]
) -> tuple[FloatArray[np.ndarray, "rays"], Int64[np.ndarray, "rays"]]:
    """Distance to the first triangle on each ray, and its number; infinite and -1 if there is none.

    One origin, or one direction, may be that of all rays.
    """
    origins, directions = np.broadcast_arrays(origins, directions)
    # Dr.Jit aborts the process for arrays without elements
    if len(triangles) == 0 or len(origins) == 0:
        return np.full(len(origins), np.inf), np.full(len(origins), -1)
    corners = vectors_to_device(Array3f64, triangles.reshape(-1, 3))
    ray = Ray(vectors_to_device(Array3f64, origins), vectors_to_device(Array3f64, directions))
    if len(origins) <= FEW_RAYS:
        distances, numbers = _search_all(corners, UInt32(len(triangles)), ray)
    else:
        order = np.argsort(morton_codes(triangles), kind="stable")
        distances, numbers = _search_tree(Hierarchy.build(corners, order, triangles.mean(axis=(0, 1))), ray)
    return to_host(distances), to_host(numbers).astype(np.int64)


@compiled
def _search_tree(tree: Hierarchy, ray: Ray) -> tuple[Values, Values]:
    """Find the distance and the number of the nearest triangle on each ray in the hierarchy of the triangles."""
    hit = nearest_hit(tree, ray, Float64(dr.inf), Bool(True))
    return hit.t, hit.number


@compiled
def _search_all(corners: Values, count: Values, ray: Ray) -> tuple[Values, Values]:
    """Find the distance and the number of the nearest triangle on each ray by testing all triangles."""

    def test(n: Values, best: Values, number: Values) -> tuple[Values, Values, Values]:
        t, u, v = intersect(ray, *(dr.gather(Array3f64, corners, 3 * n + corner) for corner in range(3)))
        is_nearer = is_inside(u, v, 0.0) & (t > 0.0) & (t < best)
        return n + 1, dr.select(is_nearer, t, best), dr.select(is_nearer, Int32(n), number)

    state = (UInt32(0), Float64(dr.inf), Int32(-1))
    return dr.while_loop(state, lambda n, best, number: n < count, test)[1:]


def morton_codes(triangles: Triangles) -> Int64[np.ndarray, "triangles"]:
    """Morton code of each triangle's centroid in the cube that contains all centroids, with `MORTON_BITS` per axis."""
    if len(triangles) == 0:
        return np.empty(0, dtype=np.int64)
    centroids = (triangles[:, 0] + triangles[:, 1] + triangles[:, 2]) / 3.0
    low = centroids.min(axis=0)
    side = max(float((centroids - low).max()), 1e-12)
    codes = ((centroids - low) / side * (2.0**MORTON_BITS - 1.0)).astype(np.int64)
    # move bit k of each code to bit 3 k
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        codes = (codes | codes << shift) & mask
    return np.asarray(codes[:, 0] | codes[:, 1] << 1 | codes[:, 2] << 2)
