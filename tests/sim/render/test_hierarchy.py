"""Tests of the renderer's data structures: triangle hierarchy, levels of the ground, freed memory."""

import subprocess
import sys

import numpy as np
import pytest

from benchmarks.validation.raycast import cast_triangles
from marsyard.sim.render import Objects
from marsyard.sim.render.arrays import to_device, to_host, vectors_to_device
from marsyard.sim.render.device import Array3f64, Bool, Float64, Int32
from marsyard.sim.render.rays import Ray
from marsyard.sim.render.spline import Terrain, evaluate
from marsyard.sim.render.triangles import FEW_RAYS, first_hits, nearest_hit
from marsyard.sim.terrain import Surface

EYE = np.array([0.3, -0.2, 1.1])


def _make_triangles(scale: float) -> Objects:
    """Make triangles with sizes of about 0.03 m to 0.6 m, times a scale, in all directions."""
    rng = np.random.default_rng(6)
    centres = rng.uniform(-12.0, 12.0, (1500, 1, 3))
    sizes = scale * 10.0 ** rng.uniform(-1.5, -0.2, (1500, 1, 1))
    corners = (centres + sizes * rng.normal(size=(1500, 3, 3))).reshape(-1, 3)
    faces = np.arange(4500, dtype=np.int32).reshape(-1, 3)
    return Objects.of_mesh(corners, np.zeros_like(corners), faces, np.zeros(1500, dtype=np.int32), albedo=0.1)


def _draw_rays(rng: np.random.Generator, count: int) -> np.ndarray:
    rays = rng.normal(size=(count, 3))
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def test_nearest_triangle_equals_exhaustive_search() -> None:
    objects = _make_triangles(4.0)  # many rays hit several triangles
    rays = _draw_rays(np.random.default_rng(7), 800)
    expected = cast_triangles(objects, np.broadcast_to(EYE, rays.shape), rays, nearest=0.0)
    tree = objects.hierarchy(np.arange(1500), EYE)
    assert tree is not None
    ray = Ray(Array3f64(*EYE.tolist()), vectors_to_device(Array3f64, rays))
    hit = nearest_hit(tree, ray, Float64(np.inf), Bool(True))
    assert 0.05 < np.mean(np.isfinite(expected)) < 0.9
    np.testing.assert_allclose(to_host(hit.t), expected, rtol=1e-9)
    # the number is that of the triangle; the point is the weighted sum of its corners
    number, second, third = (to_host(values) for values in (hit.number, hit.second, hit.third))
    is_hit = np.isfinite(expected)
    np.testing.assert_array_equal(number >= 0, is_hit)
    a, b, c = objects.triangles[number[is_hit]].transpose(1, 0, 2)
    points = a + second[is_hit, None] * (b - a) + third[is_hit, None] * (c - a)
    np.testing.assert_allclose(points, EYE + expected[is_hit, None] * rays[is_hit], atol=1e-9)
    # a hit at or beyond the limit does not count
    limits = np.where(is_hit, expected * (1.0 + 1e-5 * np.where(np.arange(800) % 2, 1.0, -1.0)), 1.0)
    limited = to_host(nearest_hit(tree, ray, to_device(Float64, limits), Bool(True)).number)
    np.testing.assert_array_equal(limited >= 0, is_hit & (limits > expected))


def test_few_rays_and_parallel_rays_equal_exhaustive_search() -> None:
    objects = _make_triangles(4.0)
    rays = _draw_rays(np.random.default_rng(9), 50)
    distances, numbers = first_hits(objects.triangles, EYE[None], rays)
    expected = cast_triangles(objects, np.broadcast_to(EYE, rays.shape), rays, nearest=0.0)
    np.testing.assert_allclose(distances, expected, rtol=1e-9)
    np.testing.assert_array_equal(numbers >= 0, np.isfinite(expected))
    assert first_hits(objects.triangles[:0], EYE[None], rays)[1].tolist() == [-1] * 50
    assert [values.size for values in first_hits(objects.triangles, EYE[None], rays[:0])] == [0, 0]
    origins = np.random.default_rng(10).uniform(-12.0, 12.0, (500, 3))
    parallel = np.broadcast_to(rays[0], origins.shape)
    expected = cast_triangles(objects, origins, parallel, nearest=0.0)
    assert 0.1 < np.isfinite(expected).mean() < 0.95
    # many rays are searched in a hierarchy, few are tested against all triangles: both find the same triangles
    distances, numbers = first_hits(objects.triangles, origins, rays[:1])
    np.testing.assert_allclose(distances, expected, rtol=1e-9)
    few = first_hits(objects.triangles, origins[:FEW_RAYS], rays[:1])[1]
    np.testing.assert_array_equal(numbers[:FEW_RAYS], few)


def test_hierarchy_contains_the_listed_triangles_only() -> None:
    """The number of triangles is no multiple of that of a leaf, and the centre of the rays is distant."""
    objects = _make_triangles(4.0)
    offset = np.array([3000.0, -2000.0, 100.0])
    moved = Objects.of_mesh(
        (objects.triangles + offset).reshape(-1, 3),
        np.zeros((4500, 3)),
        np.arange(4500, dtype=np.int32).reshape(-1, 3),
        np.zeros(1500, dtype=np.int32),
        albedo=0.1,
    )
    listed = np.sort(np.random.default_rng(11).permutation(1500)[:301])
    tree = moved.hierarchy(listed, EYE + offset)
    assert tree is not None
    assert moved.hierarchy(np.arange(0), EYE) is None
    rays = _draw_rays(np.random.default_rng(12), 800)
    ray = Ray(Array3f64(*(EYE + offset).tolist()), vectors_to_device(Array3f64, rays))
    hit = nearest_hit(tree, ray, Float64(np.inf), Bool(True))
    expected, number = first_hits(objects.triangles[listed], EYE[None], rays)
    np.testing.assert_allclose(to_host(hit.t), expected, rtol=1e-6)
    np.testing.assert_array_equal(to_host(hit.number), np.where(number >= 0, listed[number], -1))


SIDE, SPACING_M = 64, 0.5
SAMPLES = np.random.default_rng(3).normal(size=(SIDE, SIDE, 2)).astype(np.float32)
SURFACE = Surface.from_samples(SAMPLES + np.array([2000.0, 0.0], dtype=np.float32), SPACING_M)


def test_spline_equals_the_surface() -> None:
    """Heights have the precision of the samples, also at an altitude of 2 km; slopes and albedo have single precision.

    The positions are inside the terrain, on its border and in other periods.
    """
    rng = np.random.default_rng(4)
    x, y = rng.uniform(-40.0, 40.0, (2, 1000))
    x[:4], y[:4] = [0.0, -0.25, 31.75, 32.0], [31.9, 0.0, -0.1, 16.0]
    levels = rng.integers(0, len(SURFACE.levels), 1000)
    terrain = Terrain.of_surface(SURFACE, ceilings=False)
    positions = (to_device(Float64, values) for values in (x, y))
    result = evaluate(terrain, to_device(Int32, levels), *positions)
    values = np.stack([to_host(v) for v in (result.height, result.slope_x, result.slope_y, result.albedo)], axis=1)
    expected = np.stack([SURFACE.evaluate(*at) for at in zip(x, y, levels, strict=True)])
    # the resolution of heights near 2000 m in single precision is 1.2e-4 m
    np.testing.assert_allclose(values[:, 0], expected[:, 0], atol=1e-6, rtol=0.0)
    np.testing.assert_allclose(values[:, 1:], expected[:, 1:], atol=3e-6, rtol=0.0)


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
