"""Tests of points on a rock: ray intersection, outline, occlusion and shadow."""

import numpy as np
import pytest
import trimesh

from marsyard.scenarios.rover.points import (
    RockOutline,
    enclosing_spheres,
    find_self_occlusion,
    find_self_shadow,
    patch_normal,
    ray_distances,
    spheres_near_line,
)


@pytest.fixture(scope="module")
def sphere() -> np.ndarray:
    """Return the triangles of a sphere with radius 0.5 m and centre (5, 0, 0.5)."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    return np.asarray(np.asarray(mesh.triangles, dtype=np.float64) + np.array([5.0, 0.0, 0.5]))


def test_ray_distances_match_a_sphere(sphere: np.ndarray) -> None:
    eye = np.array([0.0, 0.0, 1.5])
    rng = np.random.default_rng(1)
    aim_points = np.array([5.0, 0.0, 0.5]) + 0.35 * rng.uniform(-1.0, 1.0, (40, 3))
    directions = (aim_points - eye) / np.linalg.norm(aim_points - eye, axis=1, keepdims=True)
    offset = eye - np.array([5.0, 0.0, 0.5])
    # Nearer root of |offset + t * direction| = radius.
    projection = directions @ offset
    exact_distances = -projection - np.sqrt(projection * projection - offset @ offset + 0.25)
    # The 5,120 flat triangles lie inside the sphere by up to 0.1 % of the radius; oblique rays increase the error.
    np.testing.assert_allclose(ray_distances(sphere, eye, directions), exact_distances, atol=4e-3)
    assert np.isinf(ray_distances(sphere, eye, -directions[:1])[0])


def test_outline_points_are_on_the_visible_face(sphere: np.ndarray) -> None:
    eye = np.array([0.0, 0.0, 1.5])
    outline = RockOutline.from_triangles(sphere, eye, 0.0)
    front = outline.point(0.0, 0.5)
    assert np.linalg.norm(front - [5.0, 0.0, 0.5]) == pytest.approx(0.5, abs=1e-3)
    assert front[0] < 4.6
    # Arguments of `point`: from left (-1) to right (1), from foot (0) to top (1). For a view along +x, right is -y.
    assert outline.point(0.8, 0.5)[1] < -0.3 < 0.3 < outline.point(-0.8, 0.5)[1]
    assert outline.point(0.0, 0.9)[2] > front[2] > outline.point(0.0, 0.1)[2]


def test_far_side_is_occluded_and_side_away_from_sun_is_shaded(sphere: np.ndarray) -> None:
    near_point, far_point = np.array([4.5, 0.0, 0.5]), np.array([5.5, 0.0, 0.5])
    points, eye = np.stack([near_point, far_point]), np.array([0.0, 0.0, 1.5])
    assert find_self_occlusion(sphere, points, eye).tolist() == [False, True]
    western_sun = np.array([-np.cos(0.5), 0.0, np.sin(0.5)])
    assert find_self_shadow(sphere, points, western_sun).tolist() == [False, True]


def test_normals_match_the_sphere(sphere: np.ndarray) -> None:
    eye, centre = np.array([0.0, 0.0, 0.5]), np.array([5.0, 0.0, 0.5])
    outline = RockOutline.from_triangles(sphere, eye, 0.0)
    for right_fraction in (-0.9, -0.5, 0.0, 0.7):
        point = outline.point(right_fraction, 0.5)
        normal = patch_normal(sphere, eye, point, 0.01)
        assert np.linalg.norm(normal) == pytest.approx(1.0)
        # A triangle of the sphere is 3.5 deg wide.
        assert normal @ (point - centre) / np.linalg.norm(point - centre) > np.cos(np.radians(3.5))


def test_triangles_near_a_line_contain_all_intersections(sphere: np.ndarray) -> None:
    eye, half_angle_rad = np.array([0.0, 0.0, 0.5]), 0.03
    rng = np.random.default_rng(2)
    for point in RockOutline.from_triangles(sphere, eye, 0.0).point(0.4, 0.7), np.array([5.0, 0.4, 0.8]):
        near_triangles = sphere[spheres_near_line(enclosing_spheres(sphere), eye, point, half_angle_rad)]
        assert 0 < len(near_triangles) < 0.2 * len(sphere)
        central_direction = (point - eye) / np.linalg.norm(point - eye)
        rays = central_direction + np.tan(half_angle_rad) * rng.uniform(-0.7, 0.7, (200, 3))
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        rays = rays[rays @ central_direction > np.cos(half_angle_rad)]
        np.testing.assert_array_equal(ray_distances(near_triangles, eye, rays), ray_distances(sphere, eye, rays))
