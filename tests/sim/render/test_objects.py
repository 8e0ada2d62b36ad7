"""Tests of `Objects`, triangle meshes of several bodies: bounding spheres, and selection by body and by cone."""

import numpy as np

from marsyard.sim.render import Objects

#: Number of triangles of each body.
COUNTS = (5, 1, 80, 3)


def _make_bodies() -> Objects:
    rng = np.random.default_rng(4)
    body_ids = np.repeat(np.array([7, 3, 12, 3], dtype=np.int32), COUNTS)
    faces = np.arange(3 * body_ids.size, dtype=np.int32).reshape(-1, 3)
    positions = np.repeat(50.0 * rng.normal(size=(4, 3)), 3 * np.array(COUNTS), axis=0)
    vertices = positions + rng.normal(0.0, 1.0, (3 * body_ids.size, 3))
    return Objects.of_mesh(vertices, rng.normal(size=vertices.shape), faces, body_ids, albedo=0.2)


def test_spheres_enclose_their_bodies_tightly() -> None:
    objects = _make_bodies()
    for body, sphere in enumerate(objects.spheres):
        corners = objects.triangles[objects.body_of_triangle == body].reshape(-1, 3)
        np.testing.assert_array_equal(sphere[:3], 0.5 * (corners.min(axis=0) + corners.max(axis=0)))
        assert np.linalg.norm(corners - sphere[:3], axis=1).max() == np.float64(sphere[3])
    assert Objects.none().spheres.shape == (0, 4)


def test_subset_contains_the_selected_bodies() -> None:
    objects = _make_bodies()
    is_selected = np.array([True, False, False, True])
    subset = objects.select(is_selected)
    is_expected = is_selected[objects.body_of_triangle]
    np.testing.assert_array_equal(subset.triangles, objects.triangles[is_expected])
    np.testing.assert_array_equal(subset.normals, objects.normals[is_expected])
    assert subset.first_triangle.tolist() == [0, 5, 8]
    assert subset.names.tolist() == [7, 3]
    np.testing.assert_array_equal(subset.spheres, objects.spheres[is_selected])
    assert len(objects.select(np.zeros(4, dtype=bool))) == 0


def test_cone_selects_facing_triangles_of_bodies_within_it() -> None:
    """A triangle faces the eye if its corners appear counter-clockwise from the eye."""
    objects = _make_bodies()
    eye = objects.spheres[2, :3] + np.array([0.0, 0.0, 200.0])
    result = objects.in_cone(eye, np.array([0.0, 0.0, -1.0]), 1e-3)
    first, second, third = objects.triangles.transpose(1, 0, 2)
    is_facing = np.einsum("ij,ij->i", np.cross(second - first, third - first), eye - first) > 0.0
    is_in_cone = objects.body_of_triangle == 2
    assert 20 < np.count_nonzero(is_facing & is_in_cone) < 60
    assert set(np.flatnonzero(is_facing & is_in_cone)) <= set(result)
    assert is_facing[result].all()
    assert (np.diff(result) > 0).all()


def test_cone_with_apex_radius_selects_triangles_that_face_a_point_near_the_apex() -> None:
    objects, radius_m = _make_bodies(), 3.0
    eye = objects.spheres[2, :3] + np.array([0.0, 0.0, 20.0])
    first, second, third = objects.triangles.transpose(1, 0, 2)
    normals = np.cross(second - first, third - first)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # The point of the sphere that is most in front of a triangle.
    is_facing = np.einsum("ij,ij->i", normals, eye + radius_m * normals - first) > 0.0
    is_candidate = objects.body_of_triangle == 2
    axis = np.array([0.0, 0.0, -1.0])
    result, exact = objects.in_cone(eye, axis, 1e-2, radius_m), objects.in_cone(eye, axis, 1e-2)
    np.testing.assert_array_equal(result[is_candidate[result]], np.flatnonzero(is_facing & is_candidate))
    assert set(exact) < set(result)
