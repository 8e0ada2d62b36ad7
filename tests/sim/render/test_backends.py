"""Tests of the rendering backends: equal images and errors for missing backends."""

import ctypes
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from marsyard.sim.render.backend import DepthRenderer, RenderingError, default_backend

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


def test_load_replaces_the_previous_geometry() -> None:
    """Depths of level ground and of a triangle above its centre are exact, for any load order.

    The rendered number of a triangle is its object number plus 1; the number of ground is 0.
    """
    corners = np.array([[-30.0, -30.0, 0.0], [30.0, -30.0, 0.0], [30.0, 30.0, 0.0], [-30.0, 30.0, 0.0]])
    ground = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    triangle = np.array([[[-9.0, -9.0, 4.0], [9.0, -9.0, 4.0], [0.0, 9.0, 4.0]]])
    renderer = DepthRenderer(64, default_backend())
    with pytest.raises(RenderingError, match="no mesh"):
        renderer.draw(*_make_depth_view(20.0))
    no_triangles = (np.empty((0, 3, 3)), np.empty(0, dtype=np.int64))
    for triangles, number in (
        ((triangle, np.array([70000])), 70001),
        (no_triangles, 0),
        ((triangle, np.array([5])), 6),
    ):
        renderer.load(ground, *triangles)
        for height in (20.0, 10.0):
            depth, numbers = renderer.draw(*_make_depth_view(height))
            # The tolerance is the resolution of a 24-bit depth between 1 and 100 m.
            assert depth[32, 32] == pytest.approx(height - (4.0 if number else 0.0), abs=1e-3)
            assert depth[2, 2] == pytest.approx(height, abs=1e-3)
            assert numbers.size == 0 if number == 0 else (numbers[32, 32], numbers[2, 2]) == (number, 0)
    renderer.close()


def test_second_backend_in_one_process_is_rejected() -> None:
    program = (
        "from marsyard.sim.render.backend import DepthRenderer, RenderingError\n"
        "import OpenGL\n"
        "try:\n    DepthRenderer(64, 'egl')\nexcept RenderingError as error:\n    print(error)\n"
    )
    environment = os.environ | {"PYOPENGL_PLATFORM": "osmesa"}
    run = subprocess.run(
        [sys.executable, "-c", program], check=True, env=environment, capture_output=True, text=True, timeout=60
    )
    assert "already uses OpenGL through osmesa" in run.stdout


@pytest.mark.slow
def test_python_without_assertions_is_rejected() -> None:
    program = (
        "from marsyard.sim.render.backend import DepthRenderer, RenderingError\n"
        "try:\n    DepthRenderer(64, 'osmesa')\nexcept RenderingError as error:\n    print(error)\n"
    )
    run = subprocess.run([sys.executable, "-O", "-c", program], check=True, capture_output=True, text=True, timeout=60)
    assert "without -O" in run.stdout
