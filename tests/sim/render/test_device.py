"""Tests of the device that computes images: selection, arrays, compiled programs, equal results with any threads."""

import gc
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import Photometry, PixelRays, Renderer, Scene, Sun, Texture
from marsyard.sim.render.arrays import clip, compiled, larger, smaller, to_device, to_host, vectors_to_device, where
from marsyard.sim.render.backend import RenderingError
from marsyard.sim.render.device import Array3f, Float, Float64, Int32, select_device
from marsyard.sim.render.primary import trace_primary_rays
from marsyard.sim.render.shading import shade
from marsyard.sim.terrain import Surface
from marsyard.sim.terrain.rocks import PlacedRock, RockField, RockParameters
from marsyard.sim.terrain.surface import ALIGNMENT_BYTES, empty_aligned
from tests.sim.scenes import descent_camera, rocks_near

HAS_GPU = dr.has_backend(dr.JitBackend.CUDA)


def test_unknown_or_missing_device_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MARSYARD_RENDER_DEVICE", "opencl")
    with pytest.raises(RenderingError, match="MARSYARD_RENDER_DEVICE is 'opencl'; allowed: llvm, cuda"):
        select_device()
    monkeypatch.setenv("MARSYARD_RENDER_DEVICE", "CUDA")
    monkeypatch.setattr(dr, "has_backend", lambda backend: backend is not dr.JitBackend.CUDA)
    with pytest.raises(RenderingError, match=r"the device cuda .* does not work; it needs a graphics processor"):
        select_device()
    monkeypatch.delenv("MARSYARD_RENDER_DEVICE")
    assert select_device() == "llvm"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--render-device", "opencl", "list"), "'opencl' is not one of 'llvm', 'cuda'"),
        pytest.param(
            ("--render-device", "cuda", "list"),
            "the device cuda of MARSYARD_RENDER_DEVICE does not work",
            marks=pytest.mark.skipif(HAS_GPU, reason="this machine has a graphics processor"),
        ),
    ],
)
def test_command_line_reports_an_unusable_device(arguments: tuple[str, ...], message: str) -> None:
    run = subprocess.run(
        [sys.executable, "-m", "marsyard", *arguments], capture_output=True, text=True, timeout=60, check=False
    )
    assert run.returncode == 2
    assert message in " ".join(run.stderr.replace("│", " ").split())
    assert "Traceback" not in run.stderr


def test_aligned_memory_is_shared_and_other_memory_is_copied() -> None:
    aligned = empty_aligned((3, 5), np.float32)
    assert aligned.ctypes.data % ALIGNMENT_BYTES == 0
    aligned[:] = np.arange(15.0).reshape(3, 5)
    shared, copy = to_device(Float, aligned, share=True), to_device(Float, aligned)
    unaligned = to_device(Float, aligned.reshape(-1)[1:], share=True)
    aligned += 1.0
    np.testing.assert_array_equal(to_host(shared), np.arange(1.0, 16.0))
    np.testing.assert_array_equal(to_host(copy), np.arange(15.0))
    np.testing.assert_array_equal(to_host(unaligned), np.arange(1.0, 15.0))


def test_vectors_keep_their_components() -> None:
    vectors = np.arange(12.0, dtype=np.float32).reshape(4, 3)
    device_vectors = vectors_to_device(Array3f, vectors)
    np.testing.assert_array_equal(to_host(device_vectors.y), vectors[:, 1])
    np.testing.assert_array_equal(to_host(device_vectors), vectors)


def test_selections_equal_those_of_numpy() -> None:
    a, b = np.array([-2.0, 0.5, np.inf, 3.0]), np.array([1.0, 0.5, 2.0, -np.inf])
    x, y = to_device(Float, a), to_device(Float, b)
    np.testing.assert_array_equal(to_host(larger(x, y)), np.maximum(a, b))
    np.testing.assert_array_equal(to_host(smaller(x, y)), np.minimum(a, b))
    np.testing.assert_array_equal(to_host(clip(x, -1.0, 1.0)), np.clip(a, -1.0, 1.0))
    calls = []

    def compute() -> Float:
        calls.append(1)
        return 2.0 * x

    result = where(to_device(Int32, np.arange(4)) % 2 == 0, compute, y)
    np.testing.assert_array_equal(to_host(result), np.where(np.arange(4) % 2 == 0, 2.0 * a, b))
    assert calls


def test_no_scene_is_collected_while_a_function_is_traced() -> None:
    """A collected scene would free arrays, for which Dr.Jit aborts the process during a trace."""
    states = []

    @compiled
    def double(values: Float) -> Float:
        states.append(gc.isenabled())
        if len(states) == 2:
            raise ValueError
        return 2.0 * values

    values = to_device(Float, np.array([1.0, 2.0]))
    np.testing.assert_array_equal(to_host(double(values)), [2.0, 4.0])
    assert gc.isenabled()
    # another type is traced again
    with pytest.raises(RuntimeError):
        double(to_device(Float64, np.array([1.0])))
    assert states == [False, False]
    assert gc.isenabled()


def _render(renderer: Renderer, surface: Surface, size_px: int, elevation_rad: float, height_m: float) -> np.ndarray:
    scene = Scene(surface, (380.0, 200.0), Sun(direction(1.0, elevation_rad)), Photometry())
    pose = rigid(Rotation.from_euler("x", 6.0, degrees=True), np.array([380.0, 200.0, height_m]))
    return renderer.render(scene, PixelRays.from_camera(descent_camera(size_px)), pose).radiance


def test_programs_are_traced_once_for_images_of_all_sizes_and_scenes(renderer: Renderer, terrain: Surface) -> None:
    """A new trace for another size, sun or pose would take seconds in each case."""
    _render(renderer, terrain, 96, 0.5, 700.0)
    counts = trace_primary_rays.frozen.n_recordings, shade.frozen.n_recordings
    _render(renderer, terrain, 128, 0.6, 900.0)
    _render(renderer, terrain, 57, 0.45, 1100.0)
    assert (trace_primary_rays.frozen.n_recordings, shade.frozen.n_recordings) == counts


def test_images_do_not_depend_on_threads(renderer: Renderer, terrain: Surface) -> None:
    rock = PlacedRock(name="rock", east_m=380.0, north_m=205.0, diameter_m=30.0, shape=3, yaw_deg=20.0)
    field = RockField.draw(terrain, RockParameters(abundance=0.0, placed=(rock,)), np.random.default_rng(1))
    rocks = rocks_near(field, 380.0, 205.0, 60.0, 200.0, albedo=0.15)
    layers: dict[str, Any] = {"ground_texture": Texture(3.0, (0.03,) * 6), "object_texture": Texture(0.5, (0.05,) * 3)}
    scene = Scene(terrain, (380.0, 200.0), Sun(direction(2.0, 0.6)), Photometry(), rocks, **layers)
    rays = PixelRays.from_camera(descent_camera().crop(400, 400, (161, 161)))
    pose = rigid(Rotation.from_euler("x", 4.0, degrees=True), np.array([380.0, 200.0, 400.0]))
    threads = dr.thread_count()
    images = []
    for count in (1, 3):
        dr.set_thread_count(count)
        images.append(renderer.render(scene, rays, pose))
    dr.set_thread_count(threads)
    one_thread, three_threads = images
    assert np.any(one_thread.body >= 0)
    for name in ("radiance", "range_m", "body", "normal"):
        np.testing.assert_array_equal(getattr(one_thread, name), getattr(three_threads, name))


DEVICE_SCRIPT = """
import sys
import numpy as np
from marsyard.sim.render import process_renderer
from marsyard.sim.render.backend import default_backend
from marsyard.sim.terrain import TerrainParameters, synthesise
from tests.sim.render.test_device import _render

surface = synthesise(TerrainParameters(samples=512, rms_slope_deg=6.0, outer_scale_m=400.0), np.random.default_rng(1))
np.save(sys.argv[1], _render(process_renderer(default_backend()), surface, 256, 0.3, 900.0))
"""


@pytest.mark.skipif(not HAS_GPU, reason="needs a graphics processor of NVIDIA")
def test_graphics_processor_gives_the_images_of_the_processor(tmp_path: Path) -> None:
    images = []
    for device in ("llvm", "cuda"):
        path, environment = tmp_path / f"{device}.npy", os.environ | {"MARSYARD_RENDER_DEVICE": device}
        subprocess.run([sys.executable, "-c", DEVICE_SCRIPT, str(path)], check=True, env=environment, timeout=300)
        images.append(np.load(path))
    # at edges a rounding difference can select another surface
    assert np.mean(np.abs(images[1] - images[0]) < 1e-5) > 0.999
