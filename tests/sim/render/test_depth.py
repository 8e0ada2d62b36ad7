"""Test of the conversion from OpenGL depths to metres."""

import numpy as np

from marsyard.sim.render.kernels.views import depth_in_metres


def test_perspective_depths_convert_to_metres() -> None:
    """OpenGL stores ``f (z - n) / (z (f - n))`` for a depth z between n and f, lowest row first."""
    near, far = 3.0, 900.0
    true = np.geomspace(4.0, 60.0, 15).reshape(5, 3)
    stored = far * (true - near) / (true * (far - near))
    stored[1, 2] = 1.0
    result = depth_in_metres(stored[::-1].astype(np.float32), near, far)
    assert result[1, 2] == 0.0
    true[1, 2] = 0.0
    # Single precision of 1 - n / z: 6e-8 z / n of z.
    np.testing.assert_allclose(result, true, rtol=3e-6)
