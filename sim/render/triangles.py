"""A bounding volume hierarchy over triangles, and the intersection of rays with it.

Triangles are sorted along a Morton curve. Groups of `LEAF` successive triangles are the leaves of a complete binary
tree. The bounding boxes of its nodes are computed bottom-up. The tree is deterministic.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np
from jaxtyping import Float64 as FloatArray
from jaxtyping import Int64

from marsyard.sim.render.device import (
    Array3f,
    Array3f64,
    Array4f,
    Bool,
    Float,
    Float64,
    Int32,
    UInt32,
    Values,
    larger,
    smaller,
    to_device,
    to_host,
    vectors_to_device,
)
from marsyard.sim.render.ground import Ray

Triangles = FloatArray[np.ndarray, "triangles 3 3"]
#: Triangles per leaf.
LEAF = 4
#: Relative margin of bounds and of triangles in single precision, larger than rounding errors.
SLACK = 1e-6


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
    """A complete binary tree of bounding boxes over triangles along the Morton curve.

    Node k has the children 2 k and 2 k + 1; the root is node 1. The leaves begin at node `first_leaf`. Boxes and
    triangles have single precision and are relative to `centre`, which should be near the rays' origins.

    - boxes: minimum x, y, z and 0, then maximum x, y, z and 0 of each node
    - leaves: corners of the triangles of each leaf: x, y, z and 0 of each corner
    - numbers: number of each triangle of the leaves; the last triangle fills the tree
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
        cls,
        triangles: Triangles,
        corners: Values,
        order: Int64[np.ndarray, "listed"],
        centre: FloatArray[np.ndarray, "3"],
    ) -> Hierarchy:
        """Build the tree over triangles in the given order; `corners` are those of all triangles on the device."""
        leaves = 1
        while leaves * LEAF < len(order):
            leaves *= 2
        padded = np.concatenate([order, np.full(leaves * LEAF - len(order), order[-1])])
        points = np.zeros((len(padded), 3, 4), dtype=np.float32)
        points[..., :3] = triangles[padded] - centre
        sides = []
        for smaller_of, margin in ((np.minimum, -1.0), (np.maximum, 1.0)):
            side = smaller_of(smaller_of(points[:, 0], points[:, 1]), points[:, 2])
            side += np.float32(margin * SLACK) * (1.0 + np.abs(side))
            levels = [smaller_of(smaller_of(side[::4], side[1::4]), smaller_of(side[2::4], side[3::4]))]
            while len(levels[-1]) > 1:
                levels.append(smaller_of(levels[-1][::2], levels[-1][1::2]))
            sides.append(np.concatenate([levels[-1], *levels[::-1]]))
        boxes = np.stack(sides, axis=1)
        return cls(
            to_device(Float, boxes),
            to_device(Float, points),
            to_device(UInt32, padded),
            corners,
            Array3f64(*centre.tolist()),
            UInt32(leaves),
        )


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

    def visit(node: Values, best: Values, leaf_entry: Values, is_active: Values) -> tuple[Values, ...]:
        """Visit a node; `best` is the distance of the nearest hit, `leaf_entry` its triangle's index in the leaves."""
        is_near = is_active & (_entry_distance(tree.boxes, node, local, inverse, is_active) < best)
        is_leaf = is_near & (node >= tree.first_leaf)

        def test(k: Values, best: Values, leaf_entry: Values, is_tested: Values) -> tuple[Values, ...]:
            entry = (node - tree.first_leaf) * LEAF + k
            a, b, c = (dr.gather(Array4f, tree.leaves, 3 * entry + corner, is_tested) for corner in range(3))
            t, u, v = intersect(local, a.xyz, b.xyz, c.xyz)
            is_nearer = is_tested & is_inside(u, v, SLACK) & (t > 0.0) & (t < best)
            best, leaf_entry = dr.select(is_nearer, t, best), dr.select(is_nearer, entry, leaf_entry)
            return k + 1, best, leaf_entry, is_tested & (k < LEAF - 1)

        _, best, leaf_entry, _ = dr.while_loop(
            (UInt32(0), best, leaf_entry, is_leaf), lambda k, best, leaf_entry, is_tested: is_tested, test
        )
        # depth first: the first child, or the next sibling of the node or of its nearest ancestor that has one
        ancestor, descends = node >> dr.tzcnt(~node), is_near & ~is_leaf
        node = dr.select(descends, 2 * node, ancestor + 1)
        return node, best, leaf_entry, is_active & (descends | (ancestor != 0))

    limit = Float(farthest)
    _, best, leaf_entry, _ = dr.while_loop(
        (UInt32(1), Float(limit), UInt32(0), Bool(active)), lambda node, best, leaf_entry, is_active: is_active, visit
    )
    is_hit = active & (best < limit)
    number = dr.gather(UInt32, tree.numbers, leaf_entry, is_hit)
    t, u, v = intersect(ray, *(dr.gather(Array3f64, tree.corners, 3 * number + k, is_hit) for k in range(3)))
    return dr.select(is_hit, TriangleHit(t, Int32(number), u, v), no_hit(dr.inf))


def nearest_triangles(
    triangles: Triangles, origins: FloatArray[np.ndarray, "rays 3"], direction: FloatArray[np.ndarray, "3"]
) -> Int64[np.ndarray, "rays"]:
    """Find the nearest triangle that the ray from each origin hits; number -1 if there is none."""
    corners = vectors_to_device(Array3f64, triangles.reshape(-1, 3))
    order = np.argsort(morton_codes(triangles), kind="stable")
    tree = Hierarchy.build(triangles, corners, order, triangles.mean(axis=(0, 1)))
    ray = Ray(vectors_to_device(Array3f64, origins), Array3f64(*direction.tolist()))
    return to_host(nearest_hit(tree, ray, Float64(dr.inf), Bool(True)).number).astype(np.int64)


def body_spheres(
    triangles: Triangles, first_triangle: Int64[np.ndarray, "bodies+1"]
) -> FloatArray[np.ndarray, "bodies 4"]:
    """Bounding sphere of each body: centre of its bounding box, and maximum distance of its corners from the centre.

    `first_triangle` contains the first triangle of each body, and the number of triangles at the end.
    """
    first, counts = first_triangle[:-1], np.diff(first_triangle)
    if len(first) == 0:
        return np.empty((0, 4))
    low, high = (ufunc.reduceat(ufunc.reduce(triangles, axis=1), first) for ufunc in (np.minimum, np.maximum))
    centres = 0.5 * (low + high)
    offsets = triangles - np.repeat(centres, counts, axis=0)[:, None]
    squares = np.square(offsets).sum(axis=2).max(axis=1)
    return np.column_stack([centres, np.sqrt(np.maximum.reduceat(squares, first))])


def first_hits(
    triangles: Triangles, origin: FloatArray[np.ndarray, "3"], directions: FloatArray[np.ndarray, "rays 3"]
) -> tuple[FloatArray[np.ndarray, "rays"], Int64[np.ndarray, "rays"]]:
    """Distance to the first triangle on each ray from an origin, and its number; infinite and -1 if there is none.

    All triangles are tested: for few rays, or triangles that are used only once.
    """
    a = triangles[:, 0]
    edge1, edge2, s = triangles[:, 1] - a, triangles[:, 2] - a, origin - a
    q = np.cross(s, edge1)
    p = np.cross(directions[:, None], edge2)
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = np.einsum("na,rna->rn", edge1, p)
        u, v = np.einsum("na,rna->rn", s, p) / determinant, directions @ q.T / determinant
        t = np.einsum("na,na->n", edge2, q) / determinant
        is_hit = (np.abs(determinant) >= 1e-18) & (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 0.0)
    distances = np.where(is_hit, t, np.inf)
    if len(a) == 0:
        return np.full(len(directions), np.inf), np.full(len(directions), -1)
    numbers = distances.argmin(axis=1)
    nearest = distances[np.arange(len(directions)), numbers]
    return nearest, np.where(np.isfinite(nearest), numbers, -1)


def morton_codes(triangles: Triangles) -> Int64[np.ndarray, "triangles"]:
    """Morton code of each triangle's centroid in the cube that contains all centroids, with 20 bits per axis."""
    centroids = triangles.mean(axis=1)
    if len(centroids) == 0:
        return np.empty(0, dtype=np.int64)
    low = centroids.min(axis=0)
    side = max(float((centroids - low).max()), 1e-12)
    codes = ((centroids - low) / side * 1048575.0).astype(np.int64)
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
