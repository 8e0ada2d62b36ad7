"""Tests of points on a rock: ray intersection, outline, occlusion and shadow."""

import numpy as np
import pytest
import trimesh

from marsyard.scenarios.rover.points import (
    RockOutline,
    find_self_occlusion,
    find_self_shadow,
    patch_normal,
    ray_distances,
    triangles_near_line,
)


@pytest.fixture(scope="module")
def sphere() -> np.ndarray:
    """Triangles of a sphere of radius 0.5 about (5, 0, 0.5)."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    return np.asarray(np.asarray(mesh.triangles, dtype=np.float64) + np.array([5.0, 0.0, 0.5]))


def test_ray_distances_match_a_sphere(sphere: np.ndarray) -> None:
    eye = np.array([0.0, 0.0, 1.5])
    rng = np.random.default_rng(1)
    aims = np.array([5.0, 0.0, 0.5]) + 0.35 * rng.uniform(-1.0, 1.0, (40, 3))
    directions = (aims - eye) / np.linalg.norm(aims - eye, axis=1, keepdims=True)
    offset = eye - np.array([5.0, 0.0, 0.5])
    b = directions @ offset
    exact = -b - np.sqrt(b * b - offset @ offset + 0.25)
    # The 512 flat triangles are up to 0.1 % of the radius inside the sphere; oblique rays increase the error.
    np.testing.assert_allclose(ray_distances(sphere, eye, directions), exact, atol=4e-3)
    assert np.isinf(ray_distances(sphere, eye, -directions[:1])[0])


def test_points_lie_on_the_visible_face(sphere: np.ndarray) -> None:
    eye = np.array([0.0, 0.0, 1.5])
    sight = RockOutline.from_triangles(sphere, eye, 0.0)
    middle = sight.point(0.0, 0.5)
    assert np.linalg.norm(middle - [5.0, 0.0, 0.5]) == pytest.approx(0.5, abs=1e-3)
    assert middle[0] < 4.6
    # Right of the view along +x is -y.
    assert sight.point(0.8, 0.5)[1] < -0.3 < 0.3 < sight.point(-0.8, 0.5)[1]
    assert sight.point(0.0, 0.9)[2] > middle[2] > sight.point(0.0, 0.1)[2]


def test_far_side_is_hidden_and_shadow_side_is_dark(sphere: np.ndarray) -> None:
    near, far = np.array([4.5, 0.0, 0.5]), np.array([5.5, 0.0, 0.5])
    points, eye = np.stack([near, far]), np.array([0.0, 0.0, 1.5])
    assert find_self_occlusion(sphere, points, eye).tolist() == [False, True]
    west = np.array([-np.cos(0.5), 0.0, np.sin(0.5)])
    assert find_self_shadow(sphere, points, west).tolist() == [False, True]


def test_normals_match_the_sphere(sphere: np.ndarray) -> None:
    eye, middle = np.array([0.0, 0.0, 0.5]), np.array([5.0, 0.0, 0.5])
    sight = RockOutline.from_triangles(sphere, eye, 0.0)
    for across in (-0.9, -0.5, 0.0, 0.7):
        point = sight.point(across, 0.5)
        normal = patch_normal(sphere, eye, point, 0.01)
        assert np.linalg.norm(normal) == pytest.approx(1.0)
        # A triangle of the sphere is 3.5 deg wide.
        assert normal @ (point - middle) / np.linalg.norm(point - middle) > np.cos(np.radians(3.5))


def test_selection_near_a_ray_contains_all_hits(sphere: np.ndarray) -> None:
    eye, reach = np.array([0.0, 0.0, 0.5]), 0.03
    rng = np.random.default_rng(2)
    for point in RockOutline.from_triangles(sphere, eye, 0.0).point(0.4, 0.7), np.array([5.0, 0.4, 0.8]):
        near = triangles_near_line(sphere, eye, point, reach)
        assert 0 < len(near) < 0.2 * len(sphere)
        ahead = (point - eye) / np.linalg.norm(point - eye)
        rays = ahead + np.tan(reach) * rng.uniform(-0.7, 0.7, (200, 3))
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        rays = rays[rays @ ahead > np.cos(reach)]
        np.testing.assert_array_equal(ray_distances(near, eye, rays), ray_distances(sphere, eye, rays))
