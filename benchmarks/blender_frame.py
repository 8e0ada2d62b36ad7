"""Render a terrain mesh with Blender Cycles: ``PYTHON blender_frame.py GROUND.npz REPEATS`` (`benchmarks.renderers`).

Does not import Marsyard, because ``bpy`` needs its own environment. The name ``cycles.py`` would hide a module of
Blender. Uses one thread. The last line of the output has the core-seconds of each frame except the first, which builds
the acceleration structure of the mesh.
"""

import json
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import bpy
import mathutils
import numpy as np

#: Side of the frames in pixels, and samples per pixel.
SIDE_PX, SAMPLES = 1024, 16


def prepare_frame(given: Mapping[str, Any]) -> Callable[[], object]:
    """Return a function that renders a frame."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    vertices, faces = given["vertices"], given["faces"]
    ground = bpy.data.meshes.new("ground")
    ground.vertices.add(len(vertices))
    ground.vertices.foreach_set("co", vertices.ravel())
    ground.loops.add(faces.size)
    ground.loops.foreach_set("vertex_index", faces.ravel())
    ground.polygons.add(len(faces))
    ground.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
    ground.update(calc_edges=True)
    camera = bpy.data.cameras.new("camera")
    camera.sensor_width, camera.lens = float(SIDE_PX), float(given["focal_px"])
    camera.clip_start, camera.clip_end = map(float, given["range_m"])
    eye = bpy.data.objects.new("camera", camera)
    eye.matrix_world = mathutils.Matrix(given["pose"].tolist())
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy, sun.rotation_mode = 3.0, "QUATERNION"
    sun.rotation_quaternion = mathutils.Vector(given["sun"].tolist()).to_track_quat("Z", "Y")
    for placed in (bpy.data.objects.new("ground", ground), eye, sun):
        scene.collection.objects.link(placed)
    scene.camera = eye
    scene.render.engine, scene.cycles.device = "CYCLES", "CPU"
    scene.cycles.samples, scene.cycles.use_denoising = SAMPLES, False
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.render.resolution_x = scene.render.resolution_y = SIDE_PX
    scene.render.resolution_percentage = 100
    scene.render.use_persistent_data = True  # the acceleration structure is built once
    return lambda: bpy.ops.render.render()


def main(file: Path, repeats: int) -> None:
    """Render the frames and print their core-seconds."""
    with np.load(file) as stored:
        draw = prepare_frame({name: stored[name] for name in stored.files})
    draw()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        draw()
        times.append(time.process_time() - start)
    print(json.dumps(times))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
