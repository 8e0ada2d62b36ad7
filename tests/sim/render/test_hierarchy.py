"""Tests of the renderer's data structures: triangle hierarchy, levels of the ground, strips of pixels, freed memory."""

import subprocess
import sys

import numpy as np
import pytest

from benchmarks.validation.raycast import cast_triangles
from marsyard.sim.frames import direction
from marsyard.sim.render import Objects
from marsyard.sim.render.kernels.hierarchy import list_in_beam, nearest_hit
from marsyard.sim.render.kernels.strips import ROW, STRIP, allocate_cells, fetch_levels, spline
from marsyard.sim.render.kernels.structs import Ray
from marsyard.sim.render.renderer import LEVELS, NO_CEILING, ground_struct
from marsyard.sim.terrain import Surface
from marsyard.sim.terrain.kernels import sample

EYE = np.array([0.3, -0.2, 1.1])


def _make_triangles(scale: float) -> Objects:
    """Make triangles with sizes of about 0.03 m to 0.6 m, times a scale, in all directions."""
    rng = np.random.default_rng(6)
    centres = rng.uniform(-12.0, 12.0, (1500, 1, 3))
    sizes = scale * 10.0 ** rng.uniform(-1.5, -0.2, (1500, 1, 1))
    corners = (centres + sizes * rng.normal(size=(1500, 3, 3))).reshape(-1, 3)
    faces = np.arange(4500, dtype=np.int32).reshape(-1, 3)
    return Objects.of_mesh(corners, np.zeros_like(corners), faces, np.zeros(1500, dtype=np.int32), albedo=0.1)


@pytest.fixture(scope="module")
def objects() -> Objects:
    return _make_triangles(1.0)


def _draw_rays(rng: np.random.Generator, count: int) -> np.ndarray:
    rays = rng.normal(size=(count, 3))
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def test_nearest_triangle_equals_exhaustive_search() -> None:
    objects = _make_triangles(4.0)  # many rays hit several triangles
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


@pytest.mark.parametrize("side", [16, 128])
def test_kernels_receive_a_constant_number_of_levels(side: int) -> None:
    surface = Surface.from_samples(np.zeros((side, side, 2), dtype=np.float32), 1.0)
    ground = ground_struct(surface, (0.0, 1.0, 0.0, 1.0, 2.0), ceilings=True)
    levels, top_level = ground.levels, ground.top_level
    assert len(levels) == len(ground.ceilings) == LEVELS
    assert levels[top_level].shape[0] == 16
    assert all(level is expected for level, expected in zip(levels, surface.levels, strict=False))
    # Kernels are compiled for levels of the same array type.
    assert {(level.dtype.str, level.flags.writeable, level.flags.c_contiguous) for level in levels} == {
        ("<f4", False, True)
    }
    assert all(ceiling is expected for ceiling, expected in zip(ground.ceilings, surface.ceilings, strict=False))
    ground_without_ceilings = ground_struct(surface, ground.extent, ceilings=False)
    assert all(ceiling is NO_CEILING for ceiling in ground_without_ceilings.ceilings)


SIDE, SPACING_M = 64, 0.5
SAMPLES = np.random.default_rng(3).normal(size=(SIDE, SIDE, 2)).astype(np.float32)
SURFACE = Surface.from_samples(SAMPLES, SPACING_M)


def test_vectorised_spline_equals_single_evaluation() -> None:
    rng = np.random.default_rng(4)
    # Positions inside the terrain, on its border and in other periods.
    x, y = rng.uniform(-40.0, 40.0, (2, ROW))
    x[:4], y[:4] = [0.0, -0.25, 31.75, 32.0], [31.9, 0.0, -0.1, 16.0]
    level_of = rng.integers(0, len(SURFACE.levels), STRIP)
    indices = np.sort(rng.permutation(STRIP)[:100])
    cells = allocate_cells()
    fetch_levels(SURFACE.levels, 1.0 / SPACING_M, level_of, indices, indices.size, x, y, cells)
    for index in indices:
        scale = 1.0 / SPACING_M / 2.0 ** level_of[index]
        height, slope_x, slope_y, albedo = spline(cells[0], cells[1], int(index))
        expected = sample(SURFACE.levels[level_of[index]], scale, x[index], y[index])
        np.testing.assert_allclose((height, slope_x * scale, slope_y * scale, albedo), expected, rtol=0.0, atol=1e-14)


#: Size of the block, bytes.
SIZE = 20_000_000
#: Allocates and frees a large block. Prints the bytes still in use before and after the memory is returned.
SCRIPT = f"""
import os, sys
from marsyard.sim.render.renderer import keep_freed_memory, return_freed_memory

def resident_bytes():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")

if sys.argv[1] == "keep":
    keep_freed_memory()
before = resident_bytes()
block = b"1" * {SIZE}
del block
after_free = resident_bytes()
return_freed_memory()
print(after_free - before, resident_bytes() - before)
"""


def _measure_memory(mode: str) -> tuple[int, int]:
    """Return the bytes in use after the block is freed, and after the memory is returned to the system."""
    result = subprocess.run([sys.executable, "-c", SCRIPT, mode], capture_output=True, text=True, check=True)
    bytes_after_free, bytes_after_return = map(int, result.stdout.split())
    return bytes_after_free, bytes_after_return


@pytest.mark.slow
def test_process_retains_freed_memory_until_it_is_returned() -> None:
    bytes_after_free, bytes_after_return = _measure_memory("keep")
    assert bytes_after_free > 0.9 * SIZE
    assert bytes_after_return < 0.1 * SIZE
    # By default the C library returns freed memory at once.
    assert _measure_memory("default")[0] < 0.1 * SIZE
