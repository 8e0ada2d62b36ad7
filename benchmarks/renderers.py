"""Run times of other renderers for the terrain of a descent frame.

pyrender is a dependency. VTK (through PyVista) is measured if it is installed (``pip install .[bench]``). Blender
Cycles is measured if the variable `MARSYARD_BLENDER` names a Python with ``bpy`` (from PyPI, in a separate environment
because it needs an older NumPy). VTK and Blender run in separate processes with their own OpenGL and threads.
"""

from __future__ import annotations

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
from scipy.spatial.transform import Rotation

from benchmarks.pictures import SUN, descent_exposure, descent_pose, descent_scene, on_all_cores
from benchmarks.timing import Measurement, core_seconds
from marsyard.scenarios.descent.exposure import camera_optics
from marsyard.scenarios.descent.parameters import CameraParameters
from marsyard.sim.render.rays import VIEW_SIDE_PX
from marsyard.sim.render.renderer import ground_mesh
from marsyard.sim.render.scene import graded_offsets

#: Side of all frames, pixels.
SIDE_PX = 1024
#: Near and far clipping distances, metres.
NEAR_M, FAR_M = 100.0, 40_000.0
#: Environment variable with the path of a Python that has ``bpy``.
BLENDER = "MARSYARD_BLENDER"


def measure(repeats: int) -> list[Measurement]:
    """A sensor-realistic descent frame against other renderers' shaded frames of the same ground.

    This renderer resolves the terrain's samples, 1.5 m apart, independently of its mesh. The others resolve their mesh:
    lines 3 m apart in the centre, twice as coarse as the terrain. All cast shadows.
    """
    ours = descent_exposure()
    given = _descent_mesh()
    theirs = _pyrender_shaded(given)
    paired = [(core_seconds(ours, 1)[0], core_seconds(theirs, 1)[0]) for _ in range(repeats)]
    timings = [
        Measurement("descent frame with shadows and detector", [mine for mine, _ in paired], limit=0.2),
        *on_all_cores(repeats),
        Measurement("pyrender's shaded frame of a mesh as fine, with shadows", [other for _, other in paired]),
        Measurement("how many times slower that is", [other / mine for mine, other in paired], minimum=3.0),
    ]
    if importlib.util.find_spec("pyvista") is not None:
        command = [sys.executable, "-m", "benchmarks.renderers"]
        timings.append(
            Measurement("PyVista's (VTK's) frame of that mesh, with shadows", _elsewhere(command, given, repeats))
        )
    if BLENDER in os.environ:
        command = [os.environ[BLENDER], str(Path(__file__).with_name("blender_frame.py"))]
        timings.append(Measurement("Blender Cycles' frame of that mesh, 16 samples a pixel", _elsewhere(command, given, 2)))
    return timings


def _descent_mesh() -> dict[str, Any]:
    """Terrain triangles, camera pose (OpenGL axes, equal to the body axes), focal length and sun direction."""
    scene, surface = descent_scene()
    offsets = graded_offsets(scene.mesh_reach_m, 3.0, 1025)
    mesh = ground_mesh(scene.surface, scene.centre_m[0] + offsets, scene.centre_m[1] + offsets)
    return {
        "mesh": mesh,
        "pose": descent_pose(surface).as_matrix(),
        "focal_px": float(camera_optics(CameraParameters()).rays.focal_px[0]),
        "sun": np.asarray(SUN.direction),
    }


def _pyrender_shaded(given: Mapping[str, Any]) -> Callable[[], None]:
    import pyrender

    theirs = pyrender.Scene(ambient_light=(0.1, 0.1, 0.1))
    theirs.add(pyrender.Mesh.from_trimesh(given["mesh"], smooth=True))
    light = np.eye(4)
    light[:3, :3] = Rotation.align_vectors(given["sun"][None], np.array([[0.0, 0.0, 1.0]]))[0].as_matrix()
    theirs.add(pyrender.DirectionalLight(intensity=3.0), pose=light)
    middle = VIEW_SIDE_PX / 2.0
    camera = pyrender.IntrinsicsCamera(given["focal_px"], given["focal_px"], middle, middle, znear=NEAR_M, zfar=FAR_M)
    theirs.add(camera, pose=given["pose"])
    renderer = pyrender.OffscreenRenderer(VIEW_SIDE_PX, VIEW_SIDE_PX)
    _compile_shaders_once(renderer._renderer)
    flags = pyrender.RenderFlags.SHADOWS_DIRECTIONAL
    return lambda: renderer.render(theirs, flags=flags)


def _compile_shaders_once(renderer: Any) -> None:
    """Make pyrender reuse its compiled shaders.

    pyrender finds compiled shaders by the current context. PyOpenGL represents the OSMesa context by a new pointer
    object each time. Without the change, every frame would compile its shaders again and leak about 0.3 MB.
    """
    programs = renderer._program_cache
    compile_program = programs.get_program
    compiled: dict[Any, Any] = {}

    def get_program(
        vertex_shader: str,
        fragment_shader: str,
        geometry_shader: str | None = None,
        defines: dict[str, Any] | None = None,
    ) -> Any:
        key = (vertex_shader, fragment_shader, geometry_shader, tuple(sorted((defines or {}).items())))
        if key not in compiled:
            compiled[key] = compile_program(vertex_shader, fragment_shader, geometry_shader, defines)
        return compiled[key]

    programs.get_program = get_program


def _elsewhere(command: list[str], given: Mapping[str, Any], repeats: int) -> list[float]:
    """Core-seconds of each frame that another process renders from a file."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "ground.npz"
        mesh = given["mesh"]
        arrays = {name: given[name] for name in ("pose", "focal_px", "sun")} | {"range_m": np.array([NEAR_M, FAR_M])}
        np.savez(file, vertices=mesh.vertices.astype(np.float32), faces=mesh.faces.astype(np.int32), **arrays)
        drawn = subprocess.run([*command, str(file), str(repeats)], check=True, capture_output=True, text=True)
    # the last line has the result; other lines are messages of the renderer
    return [float(value) for value in json.loads(drawn.stdout.splitlines()[-1])]


def _vtk(given: Mapping[str, Any]) -> Callable[[], object]:
    import pyvista

    plotter = pyvista.Plotter(off_screen=True, window_size=(SIDE_PX, SIDE_PX), lighting=None)
    plotter.add_mesh(pyvista.PolyData.from_regular_faces(given["vertices"], given["faces"]), smooth_shading=True)
    light = pyvista.Light(light_type="scene light", position=tuple(FAR_M * given["sun"]), focal_point=(0.0, 0.0, 0.0))
    light.positional = False
    plotter.add_light(light)
    plotter.enable_shadows()
    pose = given["pose"]
    plotter.camera.position = pose[:3, 3]
    plotter.camera.focal_point = pose[:3, 3] - pose[:3, 2] * 1000.0
    plotter.camera.up = pose[:3, 1]
    plotter.camera.view_angle = float(np.degrees(2.0 * np.arctan(0.5 * SIDE_PX / float(given["focal_px"]))))
    plotter.camera.clipping_range = (NEAR_M, FAR_M)

    def draw() -> object:
        plotter.render()
        return plotter.screenshot(return_img=True)

    return draw


def _measure_vtk(file: Path, repeats: int) -> None:
    """Render frames with VTK and print the core-seconds of each, summed over all threads."""
    with np.load(file) as stored:
        draw = _vtk({name: stored[name] for name in stored.files})
    print(json.dumps(core_seconds(draw, repeats)))


if __name__ == "__main__":
    _measure_vtk(Path(sys.argv[1]), int(sys.argv[2]))
