"""Orient the triangles of a mesh: counter-clockwise seen from outside, with outward normals.

Images, range and landing site truth use only triangles that face the observer: inverted triangles would be invisible.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from marsyard.sim.render.triangles import first_hits

Vertices = Float64[np.ndarray, "vertices 3"]
#: Indices of the vertices of each triangle.
Faces = Int64[np.ndarray, "faces 3"]
#: Number of the body of each triangle.
Bodies = Int64[np.ndarray, "faces"]
#: Volume of a closed body divided by that of its bounding cube, below which the body is a folded surface.
_MIN_VOLUME_FRACTION = 1e-9
#: Direction of the rays of the inside test, which is parallel to no edge of usual bodies.
_DIRECTION = np.array([0.36235, 0.51847, 0.77453]) / np.linalg.norm([0.36235, 0.51847, 0.77453])


def orient_triangles(
    triangles: Float64[np.ndarray, "faces 3 3"],
) -> tuple[Float64[np.ndarray, "oriented 3 3"], Float64[np.ndarray, "oriented 3 3"]]:
    """Return triangles that are counter-clockwise seen from outside, and smooth outward normals at their corners.

    A body is a set of triangles connected by edges that exactly two triangles share. Within a body the triangles get
    one common winding. A closed body is oriented outwards by the sign of its volume; the wall of a cavity (a closed
    body inside an odd number of other closed bodies) is oriented into the cavity. All other surfaces (open, or without
    an orientation, such as a Moebius strip) become two-sided: each triangle also occurs with the opposite winding.

    Triangles with two equal corners are removed, and repeated triangles become one. Normals are smooth within a body.
    """
    import trimesh

    vertices, corners = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    faces = _remove_repeated(corners.reshape(-1, 3).astype(np.int64))
    if len(faces) == 0:
        return np.zeros((0, 3, 3)), np.zeros((0, 3, 3))
    faces, body, is_orientable = _unify_winding(faces)
    is_closed = is_orientable & _closed_bodies(faces, body)
    volumes = _volumes(vertices, faces, body)
    spans = np.array([np.ptp(vertices[faces[members]].reshape(-1, 3), axis=0).max() for members in _members(body)])
    is_closed &= np.abs(volumes) > _MIN_VOLUME_FRACTION * spans**3
    is_cavity = _nesting_depths(vertices, faces, body, volumes, is_closed) % 2 == 1
    is_inverted = is_closed & ((volumes < 0.0) ^ is_cavity)
    faces = np.where(is_inverted[body][:, None], faces[:, ::-1], faces)
    is_open = ~is_closed[body]
    faces = np.concatenate([faces, faces[is_open][:, ::-1]])
    body = np.concatenate([body, body[is_open] + len(is_closed)])
    # a vertex of each body and side, so that normals are not averaged over several bodies or over both sides
    keys, merged = np.unique(body[:, None] * len(vertices) + faces, return_inverse=True)
    mesh = trimesh.Trimesh(vertices[keys % len(vertices)], merged.reshape(-1, 3), process=False)
    # the arrays of trimesh are read-only, which rotations do not accept
    normals = np.array(mesh.vertex_normals, dtype=np.float64)[np.array(mesh.faces)]
    return vertices[faces], normals


def _remove_repeated(faces: Faces) -> Faces:
    """Remove triangles with two equal corners, and all but the first of the triangles with equal corners."""
    ordered = np.sort(faces, axis=1)
    is_valid = (ordered[:, 0] != ordered[:, 1]) & (ordered[:, 1] != ordered[:, 2])
    # numbers of the pairs of indices, because sorting rows is several times slower than sorting numbers
    size = int(faces.max()) + 1
    _, pairs = np.unique(ordered[is_valid][:, 0] * size + ordered[is_valid][:, 1], return_inverse=True)
    _, first = np.unique(pairs * size + ordered[is_valid][:, 2], return_index=True)
    return np.asarray(faces[is_valid][np.sort(first)])


def _edges(faces: Faces) -> tuple[Int64[np.ndarray, "edges"], Bool[np.ndarray, "edges"]]:
    """Return a number for each of the three edges of each triangle, equal for shared edges, and whether it ascends.

    An edge ascends if the index of its first vertex, in the winding of the triangle, is smaller than the second.
    """
    starts, ends = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    pairs = np.minimum(starts, ends) * (int(faces.max()) + 1) + np.maximum(starts, ends)
    _, numbers = np.unique(pairs, return_inverse=True)
    return numbers.astype(np.int64), starts < ends


def _unify_winding(faces: Faces) -> tuple[Faces, Bodies, Bool[np.ndarray, "bodies"]]:
    """Give the triangles of each body one winding; return them, their bodies, and whether each body has an orientation.

    The graph has two nodes for each triangle k: 2 k, as it is, and 2 k + 1, reversed. An edge that triangles k and m
    share links the nodes that agree: 2 k with 2 m and 2 k + 1 with 2 m + 1 if both have the same winding, else 2 k with
    2 m + 1 and 2 k + 1 with 2 m. An orientable body is therefore two components, one for each winding. The two nodes of
    a triangle are in one component only if its body has no orientation.
    """
    numbers, is_ascending = _edges(faces)
    order = np.argsort(numbers, kind="stable")
    counts = np.bincount(numbers)
    first = (np.cumsum(counts) - counts)[counts == 2]
    left, right = order[first], order[first + 1]  # the two edges of equal number; edge n is one of triangle n // 3
    # two triangles with the same winding pass their common edge in opposite directions
    differs = (is_ascending[left] == is_ascending[right]).astype(np.int64)
    rows, columns = 2 * (left // 3), 2 * (right // 3)
    nodes = 2 * len(faces)
    links = np.concatenate([rows, rows + 1]), np.concatenate([columns + differs, columns + 1 - differs])
    graph = coo_array((np.ones(len(links[0]), dtype=np.int8), links), shape=(nodes, nodes))
    # the component of each triangle as it is, and reversed
    states = np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64).reshape(-1, 2)
    _, body = np.unique(states.min(axis=1), return_inverse=True)
    is_orientable = np.ones(int(body.max()) + 1, dtype=np.bool_)
    is_orientable[body[states[:, 0] == states[:, 1]]] = False
    is_reversed = states[:, 0] > states[:, 1]
    return np.where(is_reversed[:, None], faces[:, ::-1], faces), body.astype(np.int64), is_orientable


def _closed_bodies(faces: Faces, body: Bodies) -> Bool[np.ndarray, "bodies"]:
    """Return whether each edge of a body belongs to exactly two of its triangles."""
    numbers, _ = _edges(faces)
    body_of_edge = body.repeat(3)
    keys, counts = np.unique(body_of_edge * (int(numbers.max()) + 1) + numbers, return_counts=True)
    is_closed = np.ones(int(body.max()) + 1, dtype=np.bool_)
    is_closed[(keys // (int(numbers.max()) + 1))[counts != 2]] = False
    return is_closed


def _volumes(vertices: Vertices, faces: Faces, body: Bodies) -> Float64[np.ndarray, "bodies"]:
    """Return the signed volume of each body, positive if oriented outwards."""
    # relative to a vertex of the body, because large coordinates cost digits
    _, first = np.unique(body, return_index=True)
    a, b, c = np.moveaxis(vertices[faces] - vertices[faces[first, 0]][body][:, None], 1, 0)
    return np.bincount(body, np.einsum("ij,ij->i", a, np.cross(b, c))) / 6.0


def _members(body: Bodies) -> list[Int64[np.ndarray, "members"]]:
    """Return the triangles of each body."""
    return np.split(np.argsort(body, kind="stable"), np.cumsum(np.bincount(body))[:-1])


def _nesting_depths(
    vertices: Vertices,
    faces: Faces,
    body: Bodies,
    volumes: Float64[np.ndarray, "bodies"],
    is_closed: Bool[np.ndarray, "bodies"],
) -> Int64[np.ndarray, "bodies"]:
    """Return for each closed body the number of closed bodies that contain all its vertices."""
    members = _members(body)
    depths = np.zeros(len(members), dtype=np.int64)
    if np.count_nonzero(is_closed) < 2:
        return depths
    for outer, inner in _nested_boxes(vertices, faces, members, is_closed):
        points = vertices[np.unique(faces[members[inner]])]
        triangles = vertices[faces[members[outer]]]
        depths[inner] += _contains(triangles if volumes[outer] > 0.0 else triangles[:, ::-1].copy(), points)
    return depths


def _nested_boxes(
    vertices: Vertices, faces: Faces, members: list[Int64[np.ndarray, "members"]], is_closed: Bool[np.ndarray, "bodies"]
) -> Iterator[tuple[int, int]]:
    """Yield pairs of closed bodies, if the bounding box of the first contains that of the second."""
    closed = np.flatnonzero(is_closed)
    corners = [vertices[faces[members[number]]].reshape(-1, 3) for number in closed]
    low, high = np.array([c.min(axis=0) for c in corners]), np.array([c.max(axis=0) for c in corners])
    order = np.argsort(low[:, 0])
    starts = low[order, 0]
    for k, number in enumerate(closed):
        candidates = order[np.searchsorted(starts, low[k, 0], side="right") : np.searchsorted(starts, high[k, 0])]
        is_inside = np.all((low[candidates] > low[k]) & (high[candidates] < high[k]), axis=1)
        for inner in candidates[is_inside]:
            yield int(number), int(closed[inner])


def _contains(triangles: Float64[np.ndarray, "faces 3 3"], points: Float64[np.ndarray, "points 3"]) -> bool:
    """Return whether a closed body that is oriented outwards contains all points.

    A ray from a point inside leaves the body through the first triangle that it hits.
    """
    _, numbers = first_hits(triangles, points, _DIRECTION[None])
    a, b, c = np.moveaxis(triangles[numbers], 1, 0)
    return bool(np.all(numbers >= 0) and np.all(np.cross(b - a, c - a) @ _DIRECTION > 0.0))
