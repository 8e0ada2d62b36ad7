"""Run times of other renderers (pyrender, VTK, Blender Cycles) for the terrain of a descent frame.

pyrender is a dependency. VTK (through PyVista) is measured if it is installed (``pip install .[bench]``). Blender
Cycles is measured if the variable `MARSYARD_BLENDER` names a Python with ``bpy`` (from PyPI, in a separate environment
because it needs an older NumPy). VTK and Blender run in separate processes with their own OpenGL and threads.
"""

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from benchmarks.images import SUN, descent_pose, descent_scene, measure_all_cores, prepare_descent_exposure
from benchmarks.timing import Measurement, core_seconds
from marsyard.scenarios.descent.images import camera_optics
from marsyard.scenarios.descent.parameters import DescentCameraParameters
from marsyard.sim.render import process_renderer
from marsyard.sim.render.backend import default_backend
from marsyard.sim.render.mesh import graded_offsets, ground_mesh
from marsyard.sim.render.pixel_rays import VIEW_SIDE_PX

#: Side of all frames, pixels.
SIDE_PX = 1024
#: Near and far clipping distances, metres.
NEAR_M, FAR_M = 100.0, 40_000.0
#: Environment variable with the path of a Python that has ``bpy``.
BLENDER = "MARSYARD_BLENDER"


def measure(repeats: int) -> list[Measurement]:
    """Measure a descent frame with detector, and shaded frames of the same ground by other renderers.

    Marsyard's renderer resolves the terrain's samples, 1.5 m apart, independently of its mesh. The other renderers
    resolve their mesh: lines 3 m apart in the centre, twice as coarse as the terrain. All renderers draw shadows.
    """
    render_marsyard = prepare_descent_exposure()
    inputs = _make_descent_mesh()
    render_pyrender = _prepare_pyrender(inputs)
    paired_s = [(core_seconds(render_marsyard, 1)[0], core_seconds(render_pyrender, 1)[0]) for _ in range(repeats)]
    measurements = [
        Measurement("descent frame with shadows and detector", [marsyard_s for marsyard_s, _ in paired_s], limit=0.15),
        *measure_all_cores(repeats),
        Measurement("pyrender: frame of the terrain mesh with shadows", [pyrender_s for _, pyrender_s in paired_s]),
        Measurement(
            "pyrender: time divided by that of the descent frame with shadows and detector (ratio)",
            [pyrender_s / marsyard_s for marsyard_s, pyrender_s in paired_s],
            minimum=3.0,
        ),
    ]
    if importlib.util.find_spec("pyvista") is not None:
        command = [sys.executable, "-m", "benchmarks.renderers"]
        times_s = _run_renderer(command, inputs, repeats)
        measurements.append(Measurement("PyVista (VTK): frame of the same mesh with shadows", times_s))
    if BLENDER in os.environ:
        command = [os.environ[BLENDER], str(Path(__file__).with_name("blender_frame.py"))]
        times_s = _run_renderer(command, inputs, 2)
        measurements.append(Measurement("Blender Cycles: frame of the same mesh, 16 samples per pixel", times_s))
    return measurements


def _make_descent_mesh() -> dict[str, Any]:
    """Return terrain triangles, camera pose (OpenGL axes, equal to the body axes), focal length and sun direction."""
    scene, surface = descent_scene()
    offsets = graded_offsets(scene.mesh_half_width_m, 3.0, 1025)  # 1025 lines per axis, 3 m apart in the centre
    vertices, faces = ground_mesh(scene.surface, scene.centre_m[0] + offsets, scene.centre_m[1] + offsets)
    return {
        "mesh": trimesh.Trimesh(vertices, faces, process=False),
        "pose": descent_pose(surface).as_matrix(),
        "focal_px": float(camera_optics(DescentCameraParameters()).rays.focal_px[0]),
        "sun": np.asarray(SUN.direction),
    }


def _prepare_pyrender(inputs: Mapping[str, Any]) -> Callable[[], None]:
    """Return a function that renders the mesh with pyrender."""
    # chooses the backend, and makes pyrender find its compiled shaders again
    process_renderer(default_backend()).description()
    import pyrender

    scene = pyrender.Scene(ambient_light=(0.1, 0.1, 0.1))
    scene.add(pyrender.Mesh.from_trimesh(inputs["mesh"], smooth=True))
    light = np.eye(4)
    light[:3, :3] = Rotation.align_vectors(inputs["sun"][None], np.array([[0.0, 0.0, 1.0]]))[0].as_matrix()
    scene.add(pyrender.DirectionalLight(intensity=3.0), pose=light)
    centre_px = VIEW_SIDE_PX / 2.0
    camera = pyrender.IntrinsicsCamera(
        inputs["focal_px"], inputs["focal_px"], centre_px, centre_px, znear=NEAR_M, zfar=FAR_M
    )
    scene.add(camera, pose=inputs["pose"])
    renderer = pyrender.OffscreenRenderer(VIEW_SIDE_PX, VIEW_SIDE_PX)
    flags = pyrender.RenderFlags.SHADOWS_DIRECTIONAL
    return lambda: renderer.render(scene, flags=flags)


def _run_renderer(command: list[str], inputs: Mapping[str, Any], repeats: int) -> list[float]:
    """Run a renderer in another process on a file of these inputs; return the core-seconds of each frame."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "ground.npz"
        mesh = inputs["mesh"]
        arrays = {name: inputs[name] for name in ("pose", "focal_px", "sun")} | {"range_m": np.array([NEAR_M, FAR_M])}
        np.savez(file, vertices=mesh.vertices.astype(np.float32), faces=mesh.faces.astype(np.int32), **arrays)
        result = subprocess.run([*command, str(file), str(repeats)], check=True, capture_output=True, text=True)
    # the last line contains the result; other lines are messages of the renderer
    return [float(value) for value in json.loads(result.stdout.splitlines()[-1])]


def _prepare_vtk(inputs: Mapping[str, Any]) -> Callable[[], object]:
    """Return a function that renders the mesh with VTK."""
    import pyvista

    plotter = pyvista.Plotter(off_screen=True, window_size=(SIDE_PX, SIDE_PX), lighting=None)
    plotter.add_mesh(pyvista.PolyData.from_regular_faces(inputs["vertices"], inputs["faces"]), smooth_shading=True)
    light = pyvista.Light(light_type="scene light", position=tuple(FAR_M * inputs["sun"]), focal_point=(0.0, 0.0, 0.0))
    light.positional = False
    plotter.add_light(light)
    plotter.enable_shadows()
    pose = inputs["pose"]
    plotter.camera.position = pose[:3, 3]
    plotter.camera.focal_point = pose[:3, 3] - pose[:3, 2] * 1000.0
    plotter.camera.up = pose[:3, 1]
    plotter.camera.view_angle = float(np.degrees(2.0 * np.arctan(0.5 * SIDE_PX / float(inputs["focal_px"]))))
    plotter.camera.clipping_range = (NEAR_M, FAR_M)

    def draw() -> object:
        plotter.render()
        return plotter.screenshot(return_img=True)

    return draw


def _measure_vtk(file: Path, repeats: int) -> None:
    """Render frames with VTK and print the core-seconds of each, summed over all threads."""
    with np.load(file) as arrays:
        draw = _prepare_vtk({name: arrays[name] for name in arrays.files})
    print(json.dumps(core_seconds(draw, repeats)))


if __name__ == "__main__":
    _measure_vtk(Path(sys.argv[1]), int(sys.argv[2]))
