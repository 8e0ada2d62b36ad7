"""Render a small frame with one GL backend and check its depth: ``python -P gl_probe.py osmesa``.

This is a separate program, because PyOpenGL reads the backend from the environment at import, and a defective driver
crashes its process. `marsyard doctor` and the installer run it; it does not import Marsyard. The result is one line of
JSON on standard output.
"""

import json
import os
import sys
from typing import Any

#: Size and focal length of the image, pixels; distances of the near and far clipping planes.
COLUMNS, ROWS, FOCAL_PX = 96, 64, 96.0
NEAR_M, FAR_M = 40.0, 400.0
#: Test planes ``z = -DISTANCE_M + TILT x`` and ``z = -DISTANCE_M + TILT y`` in front of a camera that looks along -z.
DISTANCE_M, TILT = 100.0, 0.5
#: Half of the planes' sides: they fill the image.
HALF_SIDE_M = 400.0
#: Tolerance of the depth, metres; a 24-bit depth buffer resolves 1e-5 m at the test planes.
DEPTH_TOLERANCE_M = 2e-3
#: Tolerance of the offset of the depth sample from the pixel's centre, pixels; larger offsets are reported.
OFFSET_TOLERANCE_PX = 0.01


def probe(backend: str) -> dict[str, Any]:
    """Render two tilted planes with the backend; compare the depth of every pixel with the planes' equations."""
    os.environ["PYOPENGL_PLATFORM"] = backend
    import numpy as np
    import trimesh

    try:
        import pyrender
        from OpenGL import GL
    except (AttributeError, ImportError) as error:
        # PyOpenGL detects a missing library only when it looks up one of its functions
        raise SystemExit(f"cannot load the OpenGL libraries ({error})") from None

    # corners of the planes, and the two triangles that they form
    sides = [-HALF_SIDE_M, HALF_SIDE_M]
    x, y = (axis.ravel() for axis in np.meshgrid(sides, sides))
    triangles = [[0, 1, 3], [0, 3, 2]]
    # coordinates (right, down) of the pixel centres relative to the image centre, pixels
    # pyrender puts the centre of the first pixel at (0.5, 0.5); the y axis of the camera points up
    u, v = np.meshgrid(np.arange(COLUMNS) + 0.5 - COLUMNS / 2, np.arange(ROWS) + 0.5 - ROWS / 2)
    camera = pyrender.IntrinsicsCamera(FOCAL_PX, FOCAL_PX, COLUMNS / 2, ROWS / 2, znear=NEAR_M, zfar=FAR_M)
    renderer = pyrender.OffscreenRenderer(COLUMNS, ROWS)
    offsets_px, errors_m, has_colour = [], [], True
    try:
        for axis, pixels in ((x, u), (y, -v)):
            corners = np.column_stack([x, y, -DISTANCE_M + TILT * axis])
            plane = trimesh.Trimesh(corners, triangles, process=False)
            scene = pyrender.Scene(ambient_light=[1.0, 1.0, 1.0], bg_color=[0.0, 0.0, 0.0, 0.0])
            scene.add(pyrender.Mesh.from_trimesh(plane, smooth=False))
            scene.add(camera, pose=np.eye(4))
            colour, depth = renderer.render(scene)
            # a ray with pixel coordinate s meets the plane at depth DISTANCE_M / (1 + TILT s / FOCAL_PX); solved for s
            sample_positions = (DISTANCE_M / depth - 1.0) * FOCAL_PX / TILT
            offset_px = float(np.mean(sample_positions - pixels))
            offsets_px.append(offset_px)
            errors_m.append(float(np.abs(depth - DISTANCE_M / (1.0 + TILT * (pixels + offset_px) / FOCAL_PX)).max()))
            has_colour = has_colour and bool(colour.any())
        gl_strings = {name: GL.glGetString(getattr(GL, f"GL_{name}")).decode() for name in ("RENDERER", "VERSION")}
    finally:
        renderer.delete()
    return {
        "renderer": gl_strings["RENDERER"],
        "version": gl_strings["VERSION"],
        "depth_error_m": max(errors_m),
        "offset_px": [offsets_px[0], -offsets_px[1]],  # right, down
        "has_colour": has_colour,
    }


if __name__ == "__main__":
    result = probe(sys.argv[1])
    print(json.dumps(result))
    sys.exit(not (result["has_colour"] and result["depth_error_m"] <= DEPTH_TOLERANCE_M))
