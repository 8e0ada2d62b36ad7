"""Tests of the triangle hierarchy against exhaustive search."""

import numpy as np
import pytest

from benchmarks.validation.raycast import cast_triangles
from marsyard.sim.frames import direction
from marsyard.sim.render import Objects
from marsyard.sim.render.kernels.hierarchy import list_in_beam, nearest_hit
from marsyard.sim.render.kernels.structs import Ray

EYE = np.array([0.3, -0.2, 1.1])


@pytest.fixture(scope="module")
def objects() -> Objects:
    """Return triangles with sizes of about 0.03 m to 0.6 m in all directions."""
    rng = np.random.default_rng(6)
    centres = rng.uniform(-12.0, 12.0, (1500, 1, 3))
    corners = (centres + 10.0 ** rng.uniform(-1.5, -0.2, (1500, 1, 1)) * rng.normal(size=(1500, 3, 3))).reshape(-1, 3)
    faces = np.arange(4500, dtype=np.int32).reshape(-1, 3)
    return Objects.of_mesh(corners, np.zeros_like(corners), faces, np.zeros(1500, dtype=np.int32), albedo=0.1)


def _draw_rays(rng: np.random.Generator, count: int) -> np.ndarray:
    rays = rng.normal(size=(count, 3))
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def test_nearest_triangle_equals_exhaustive_search(objects: Objects) -> None:
    rays = _draw_rays(np.random.default_rng(7), 800)
    expected = cast_triangles(objects, np.broadcast_to(EYE, rays.shape), rays, nearest=0.0)
    tree = objects.hierarchy(np.arange(1500))
    result = np.array([nearest_hit(tree, Ray(*EYE, *ray), np.inf).distance for ray in rays])
    assert 0.05 < np.mean(np.isfinite(expected)) < 0.9
    np.testing.assert_allclose(result, expected, rtol=1e-9)


@pytest.mark.parametrize("axis", [*_draw_rays(np.random.default_rng(8), 12), *np.eye(3), *-np.eye(3)], ids=str)
@pytest.mark.parametrize("half_angle", [1e-3, 0.05, 0.5])
def test_beam_lists_all_triangles_hit_by_its_rays(objects: Objects, axis: np.ndarray, half_angle: float) -> None:
    """The list contains all triangles that random rays in the beam hit, and only triangles near the frustum."""
    max_distance_m = 9.0
    rng = np.random.default_rng(9)
    tree = objects.hierarchy(np.arange(1500))
    buffer = np.empty(1500, dtype=np.int64)
    listed_triangles = set(buffer[: list_in_beam(tree, Ray(*EYE, *axis), half_angle, max_distance_m, buffer)].tolist())
    perpendicular = np.cross(axis, _draw_rays(rng, 100))
    perpendicular /= np.linalg.norm(perpendicular, axis=1, keepdims=True)
    angles = half_angle * rng.uniform(0.0, 1.0, (100, 1))
    hit_triangles: set[int] = set()
    for ray in np.cos(angles) * axis + np.sin(angles) * perpendicular:
        hit_triangles |= _list_hits(objects, ray, max_distance_m)
    assert hit_triangles <= listed_triangles
    # Only narrow beams may have no hits; otherwise the test would check nothing.
    assert hit_triangles or half_angle < 0.5
    # The beam lists triangles in a square frustum, which is larger than the cone at its corners.
    centres = objects.triangles.mean(axis=1) - EYE
    size = np.linalg.norm(objects.triangles - objects.triangles.mean(axis=1, keepdims=True), axis=2).max(axis=1)
    axis_distance = centres @ axis
    off_axis_distance = np.linalg.norm(centres - axis_distance[:, None] * axis, axis=1)
    is_near = off_axis_distance <= np.sqrt(2.0) * (np.tan(half_angle) * np.maximum(axis_distance, 0.0) + 2.0 * size)
    assert listed_triangles <= set(np.flatnonzero(is_near).tolist())


def test_beam_reports_an_overflow_of_its_list(objects: Objects) -> None:
    axis, tree = direction(1.0, 0.2), objects.hierarchy(np.arange(1500))
    buffer = np.empty(1500, dtype=np.int64)
    count = list_in_beam(tree, Ray(*EYE, *axis), 0.3, 9.0, buffer)
    assert count > 5
    assert list_in_beam(tree, Ray(*EYE, *axis), 0.3, 9.0, buffer[:count].copy()) == count
    assert list_in_beam(tree, Ray(*EYE, *axis), 0.3, 9.0, buffer[: count - 1].copy()) == -1
    assert list_in_beam(Objects.none().hierarchy(np.arange(0)), Ray(*EYE, *axis), 0.3, 9.0, buffer) == 0


def _list_hits(objects: Objects, ray: np.ndarray, max_distance_m: float) -> set[int]:
    """List the indices of all triangles that a ray from the eye hits up to a distance.

    The barycentric coordinates u and v and the distance t solve a linear system.
    """
    first, second, third = objects.triangles.transpose(1, 0, 2)
    columns = np.stack([second - first, third - first, np.broadcast_to(-ray, first.shape)], axis=2)
    u, v, t = np.linalg.solve(columns, (EYE - first)[:, :, None])[:, :, 0].T
    return set(np.flatnonzero((u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 0.0) & (t < max_distance_m)).tolist())
