"""Render a terrain mesh with Blender Cycles: ``PYTHON blender_frame.py GROUND.npz REPEATS`` (`benchmarks.renderers`).

This program does not import Marsyard, because ``bpy`` needs its own environment. It uses one thread. The last line of
the output lists the core-seconds of each frame. The first frame, which builds the acceleration structure of the mesh,
is excluded. The file is not called ``cycles.py``, because that name would hide a module of Blender.
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


def prepare_frame(inputs: Mapping[str, Any]) -> Callable[[], object]:
    """Create the Blender scene from the arrays of `benchmarks.renderers`. Returns a function that renders a frame."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    vertices, faces = inputs["vertices"], inputs["faces"]
    ground = bpy.data.meshes.new("ground")
    ground.vertices.add(len(vertices))
    ground.vertices.foreach_set("co", vertices.ravel())
    ground.loops.add(faces.size)
    ground.loops.foreach_set("vertex_index", faces.ravel())
    ground.polygons.add(len(faces))
    ground.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
    ground.update(calc_edges=True)
    camera = bpy.data.cameras.new("camera")
    camera.sensor_width, camera.lens = float(SIDE_PX), float(inputs["focal_px"])
    camera.clip_start, camera.clip_end = map(float, inputs["range_m"])
    camera_object = bpy.data.objects.new("camera", camera)
    camera_object.matrix_world = mathutils.Matrix(inputs["pose"].tolist())
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy, sun.rotation_mode = 3.0, "QUATERNION"
    sun.rotation_quaternion = mathutils.Vector(inputs["sun"].tolist()).to_track_quat("Z", "Y")
    for item in (bpy.data.objects.new("ground", ground), camera_object, sun):
        scene.collection.objects.link(item)
    scene.camera = camera_object
    scene.render.engine, scene.cycles.device = "CYCLES", "CPU"
    scene.cycles.samples, scene.cycles.use_denoising = SAMPLES, False
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.render.resolution_x = scene.render.resolution_y = SIDE_PX
    scene.render.resolution_percentage = 100
    scene.render.use_persistent_data = True  # the acceleration structure is built once
    return lambda: bpy.ops.render.render()


def main(file: Path, repeats: int) -> None:
    """Render the frames and print their core-seconds."""
    with np.load(file) as arrays:
        render_frame = prepare_frame({name: arrays[name] for name in arrays.files})
    render_frame()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        render_frame()
        times.append(time.process_time() - start)
    print(json.dumps(times))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
