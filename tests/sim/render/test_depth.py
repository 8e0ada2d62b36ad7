"""Test of the conversion from OpenGL depths to metres."""

import numpy as np

from marsyard.sim.render.kernels.views import depth_in_metres


def test_perspective_depths_convert_to_metres() -> None:
    """OpenGL stores `f (z - n) / (z (f - n))` for a depth z between n and f, lowest row first; 1 is empty."""
    near, far = 3.0, 900.0
    depths_m = np.geomspace(4.0, 60.0, 15).reshape(5, 3)
    opengl_depths = far * (depths_m - near) / (depths_m * (far - near))
    opengl_depths[1, 2] = 1.0
    result = depth_in_metres(opengl_depths[::-1].astype(np.float32), near, far)
    assert result[1, 2] == 0.0
    depths_m[1, 2] = 0.0
    # In single precision the rounding of 1 - n / z causes a relative error of 6e-8 z / n in z.
    np.testing.assert_allclose(result, depths_m, rtol=3e-6)
