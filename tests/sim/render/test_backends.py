"""Tests of the rendering backends: equal images and errors for missing backends."""

import ctypes
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marsyard.sim.render.backend import RenderingError, default_backend
from marsyard.sim.render.pinhole import DepthRenderer
from marsyard.sim.render.renderer import create_depth_renderer

SCRIPT = """
import sys
import numpy as np
from scipy.spatial.transform import Rotation
from marsyard.sim.camera import Cahv
from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import Photometry, PixelRays, Renderer, Scene, Sun
from marsyard.sim.render.arrays import to_host
from marsyard.sim.terrain import TerrainParameters, synthesise

surface = synthesise(TerrainParameters(samples=256, rms_slope_deg=6.0, outer_scale_m=200.0), np.random.default_rng(1))
camera = Cahv.from_field_of_view(
    horizontal_rad=0.8,
    size=(256, 256),
    centre=np.zeros(3),
    axis=np.array([0.0, 0.0, -1.0]),
    right=np.array([1.0, 0.0, 0.0]),
)
pose = rigid(Rotation.from_euler("zxy", [30.0, 20.0, 15.0], degrees=True), np.array([10.0, 20.0, 1000.0]))
scene = Scene(surface, (10.0, 20.0), Sun(direction(1.0, 0.7)), Photometry())
renderer = Renderer(sys.argv[1])
frame = renderer.render(scene, PixelRays.from_camera(camera), pose)
camera_pose = pose.rotation.as_matrix(), pose.translation
views = renderer._draw_views(scene, PixelRays.from_camera(camera), *camera_pose, 1000.0, np.empty(0, dtype=np.int64))
depth = to_host(views.depth)
np.savez(sys.argv[2], radiance=frame.radiance, distance=frame.range_m, depth=depth)
"""

LIBRARIES = {"osmesa": "libOSMesa.so.8", "egl": "libEGL.so.1"}


def _render_in_process(backend: str, folder: Path) -> dict[str, np.ndarray]:
    try:
        ctypes.CDLL(LIBRARIES[backend])
    except OSError:
        pytest.skip(f"{LIBRARIES[backend]} is not installed: {backend} cannot be compared")
    path = folder / f"{backend}.npz"
    environment = {name: value for name, value in os.environ.items() if name != "PYOPENGL_PLATFORM"}
    subprocess.run([sys.executable, "-c", SCRIPT, backend, str(path)], check=True, env=environment, timeout=120)
    return dict(np.load(path))


@pytest.mark.slow
def test_osmesa_and_egl_render_equal_images(tmp_path: Path) -> None:
    osmesa, egl = _render_in_process("osmesa", tmp_path), _render_in_process("egl", tmp_path)
    # At crests a rounding difference in depth can select the near or the far side.
    assert np.mean(np.abs(egl["distance"] / osmesa["distance"] - 1.0) < 1e-6) > 0.999
    assert np.mean(np.abs(egl["radiance"] / osmesa["radiance"] - 1.0) < 1e-4) > 0.999
    # With EGL multisampling the depth is sampled off the pixel centre. Depths would then differ by the slope times a
    # quarter of a pixel: several tenths of a metre.
    assert np.abs(egl["depth"] - osmesa["depth"]).mean() < 1e-3


def test_unknown_backend_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MARSYARD_GL", "vulkan")
    with pytest.raises(RenderingError, match="'vulkan'; allowed: osmesa, egl"):
        default_backend()


@pytest.mark.parametrize(("libraries", "expected"), [(("OSMesa", "EGL"), "osmesa"), (("EGL",), "egl"), ((), "osmesa")])
def test_default_backend_is_egl_only_without_osmesa(
    monkeypatch: pytest.MonkeyPatch, libraries: tuple[str, ...], expected: str
) -> None:
    from marsyard.sim.render import backend

    monkeypatch.delenv("MARSYARD_GL", raising=False)
    monkeypatch.setattr(backend, "find_library", lambda name: f"lib{name}.so" if name in libraries else None)
    assert backend.default_backend() == expected


def _make_depth_view(height_m: float) -> tuple[np.ndarray, float, float, float]:
    """Return the pose of a camera that looks down, focal length (pixels), near and far distance (m)."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = height_m
    return pose, 40.0, 1.0, 100.0


def _make_level_ground() -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and faces of a square."""
    corners = np.array([[-30.0, -30.0, 0.0], [30.0, -30.0, 0.0], [30.0, 30.0, 0.0], [-30.0, 30.0, 0.0]])
    return corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint32)


def test_load_replaces_the_previous_geometry() -> None:
    """Depths of level ground and of a triangle above its centre are exact, for any load order.

    The rendered number of a triangle is its object number plus 1; the number of ground is 0.
    """
    ground = _make_level_ground()
    triangle = np.array([[[-9.0, -9.0, 4.0], [9.0, -9.0, 4.0], [0.0, 9.0, 4.0]]])
    renderer = create_depth_renderer(64, default_backend())
    with pytest.raises(RenderingError, match="no mesh"):
        renderer.draw(*_make_depth_view(20.0))
    no_triangles = (np.empty((0, 3, 3)), np.empty(0, dtype=np.int64))
    for triangles, number in (
        ((triangle, np.array([70000])), 70001),
        (no_triangles, 0),
        ((triangle, np.array([5])), 6),
    ):
        renderer.load(*ground, *triangles)
        for height in (20.0, 10.0):
            depth, numbers = renderer.draw(*_make_depth_view(height))
            # The tolerance is the resolution of a 24-bit depth between 1 and 100 m.
            assert depth[32, 32] == pytest.approx(height - (4.0 if number else 0.0), abs=1e-3)
            assert depth[2, 2] == pytest.approx(height, abs=1e-3)
            assert numbers.size == 0 if number == 0 else (numbers[32, 32], numbers[2, 2]) == (number, 0)
    renderer.close()


@pytest.fixture
def small_renderer() -> Iterator[DepthRenderer]:
    renderer = create_depth_renderer(64, default_backend())
    yield renderer
    renderer.close()


def test_views_contain_the_first_triangle_of_each_ray(small_renderer: DepthRenderer) -> None:
    """Depth and number at each pixel's centre equal those of its ray, intersected with all triangles in float64.

    Most triangles are behind the camera, so that the vertex numbers of the others need three bytes.
    """
    rng, eye = np.random.default_rng(4), np.array([0.0, 0.0, 20.0])
    centres = rng.uniform([-8.0, -8.0, 1.0], [8.0, 8.0, 12.0], (40, 3))
    triangles = centres[:, None] + rng.uniform(-4.0, 4.0, (40, 3, 3)) * [1.0, 1.0, 0.2]
    # back faces are not drawn: the normals point upwards
    is_down = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])[:, 2] < 0.0
    triangles[is_down] = triangles[is_down, ::-1]
    hidden = np.tile(eye + np.array([[0.0, 0.0, 5.0], [1.0, 0.0, 5.0], [0.0, 1.0, 5.0]]), (30_000, 1, 1))
    numbers = rng.permutation(100_000)[:30_040]
    small_renderer.load(*_make_level_ground(), np.concatenate([hidden, triangles]), numbers)
    depth, ids = small_renderer.draw(*_make_depth_view(eye[2]))
    x = (np.arange(64) + 0.5 - 32.0) / 40.0
    rays = np.stack([*np.broadcast_arrays(x, -x[:, None], -1.0)], axis=-1)
    # a ray is the sum of the three vectors to the corners with these weights; it meets the plane at 1 / (their sum)
    weights = np.einsum("tij,rcj->trci", np.linalg.inv((triangles - eye).swapaxes(1, 2)), rays)
    distance = 1.0 / weights.sum(axis=-1)
    inside = (weights * distance[..., None]).min(axis=-1)
    hits = np.where(inside > 0.0, distance, eye[2])
    nearest, second = np.partition(hits, 1, axis=0)[:2]
    is_ground = nearest == eye[2]
    # excluded are pixels with an edge or an intersection at their centre, as OpenGL rounds corners to 1/256 pixel
    tested = (np.abs(inside).min(axis=0) > 0.01) & (is_ground | (second - nearest > 0.01))
    expected_ids = np.where(is_ground, 0, numbers[30_000 + hits.argmin(axis=0)] + 1)
    np.testing.assert_array_equal(ids[tested], expected_ids[tested])
    # the resolution of a 24-bit depth between 1 and 100 m, and the rounding of corners on slopes
    np.testing.assert_allclose(depth[tested], nearest[tested], atol=3e-3)
    assert tested.mean() > 0.5
    assert len(np.unique(ids[tested])) > 10


def _record_transfers(monkeypatch: pytest.MonkeyPatch, kind: Any) -> list[Any]:
    """Record the meshes (`Primitive`) or shaders (`ShaderProgram`) that pyrender transfers to OpenGL."""
    transfers, transfer = [], kind._add_to_context

    def record(item: Any) -> None:
        transfers.append(item)
        transfer(item)

    monkeypatch.setattr(kind, "_add_to_context", record)
    return transfers


def test_shaders_are_compiled_once_and_meshes_are_kept_for_all_views(
    small_renderer: DepthRenderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every image would use more memory if pyrender or PyOpenGL did not recognise the context."""
    from OpenGL import contextdata
    from pyrender import Primitive
    from pyrender.shader_program import ShaderProgram

    meshes, shaders = (_record_transfers(monkeypatch, kind) for kind in (Primitive, ShaderProgram))
    context_counts = set()
    for loads in (1, 2, 3):
        small_renderer.load(*_make_level_ground(), np.empty((0, 3, 3)), np.empty(0, dtype=np.int64))
        for height_m in (20.0, 10.0):
            small_renderer.draw(*_make_depth_view(height_m))
        assert len(meshes) == loads
        context_counts.add(len(contextdata.storedPointers))
    assert [mesh._in_context() for mesh in meshes] == [False, False, True]
    assert len(shaders) == 1
    assert len(context_counts) == 1


def test_too_many_vertices_are_reported(small_renderer: DepthRenderer, monkeypatch: pytest.MonkeyPatch) -> None:
    """pyrender stores vertex numbers in single precision, which would draw wrong triangles."""
    monkeypatch.setattr("marsyard.sim.render.pinhole._MAX_VERTICES", 6)
    ground, triangle = _make_level_ground(), np.eye(3)[None]
    with pytest.raises(RenderingError, match="7 vertices are visible; maximum 6"):
        small_renderer.load(*ground, triangle, np.array([0]))
    monkeypatch.undo()
    small_renderer.load(*ground, triangle, np.array([0]))


@pytest.mark.parametrize(
    ("options", "backend", "message"),
    [
        ((), "egl", "already uses OpenGL through osmesa"),
        pytest.param(("-O",), "osmesa", "without -O", marks=pytest.mark.slow),
    ],
)
def test_second_backend_and_python_without_assertions_are_rejected(
    options: tuple[str, ...], backend: str, message: str
) -> None:
    program = (
        "import OpenGL\n"
        "from marsyard.sim.render.backend import RenderingError\n"
        "from marsyard.sim.render.renderer import create_depth_renderer\n"
        f"try:\n    create_depth_renderer(64, '{backend}')\nexcept RenderingError as error:\n    print(error)\n"
    )
    command, environment = [sys.executable, *options, "-c", program], os.environ | {"PYOPENGL_PLATFORM": "osmesa"}
    run = subprocess.run(command, check=True, env=environment, capture_output=True, text=True, timeout=60)
    assert message in run.stdout
