"""Bodies of triangles: the spheres around them, and some of them taken from all."""

import numpy as np

from marsyard.sim.render import Objects

#: Triangles of each body.
COUNTS = (5, 1, 80, 3)


def _bodies() -> Objects:
    rng = np.random.default_rng(4)
    names = np.repeat(np.array([7, 3, 12, 3], dtype=np.int32), COUNTS)
    faces = np.arange(3 * names.size, dtype=np.int32).reshape(-1, 3)
    places = np.repeat(50.0 * rng.normal(size=(4, 3)), 3 * np.array(COUNTS), axis=0)
    vertices = places + rng.normal(0.0, 1.0, (3 * names.size, 3))
    return Objects.of_mesh(vertices, rng.normal(size=vertices.shape), faces, names, albedo=0.2)


def test_spheres_enclose_their_bodies_tightly() -> None:
    objects = _bodies()
    for body, sphere in enumerate(objects.spheres):
        corners = objects.triangles[objects.body_of_triangle == body].reshape(-1, 3)
        np.testing.assert_array_equal(sphere[:3], 0.5 * (corners.min(axis=0) + corners.max(axis=0)))
        assert np.linalg.norm(corners - sphere[:3], axis=1).max() == np.float64(sphere[3])
    assert Objects.none().spheres.shape == (0, 4)


def test_only_selects_bodies() -> None:
    objects = _bodies()
    kept = np.array([True, False, False, True])
    some = objects.only(kept)
    wanted = kept[objects.body_of_triangle]
    np.testing.assert_array_equal(some.triangles, objects.triangles[wanted])
    np.testing.assert_array_equal(some.normals, objects.normals[wanted])
    assert some.first_triangle.tolist() == [0, 5, 8]
    assert some.names.tolist() == [7, 3]
    np.testing.assert_array_equal(some.spheres, objects.spheres[kept])
    assert len(objects.only(np.zeros(4, dtype=bool))) == 0


def test_cone_selects_facing_triangles_of_bodies_within_it() -> None:
    """A triangle faces a place that lies on the side from which its corners run counter-clockwise."""
    objects = _bodies()
    eye = objects.spheres[2, :3] + np.array([0.0, 0.0, 200.0])
    found = objects.in_cone(eye, np.array([0.0, 0.0, -1.0]), 1e-3)
    first, second, third = objects.triangles.transpose(1, 0, 2)
    facing = np.einsum("ij,ij->i", np.cross(second - first, third - first), eye - first) > 0.0
    meant = objects.body_of_triangle == 2
    assert 20 < np.count_nonzero(facing & meant) < 60
    assert set(np.flatnonzero(facing & meant)) <= set(found)
    assert facing[found].all()
    assert (np.diff(found) > 0).all()
