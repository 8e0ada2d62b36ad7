"""Metres from OpenGL's depths."""

import numpy as np

from marsyard.sim.render.kernels.views import depth_in_metres


def test_depths_of_a_perspective_become_metres() -> None:
    """OpenGL keeps ``f (z - n) / (z (f - n))`` of a depth z between n and f, its lowest row first."""
    near, far = 3.0, 900.0
    true = np.geomspace(4.0, 60.0, 15).reshape(5, 3)
    kept = far * (true - near) / (true * (far - near))
    kept[1, 2] = 1.0
    found = depth_in_metres(kept[::-1].astype(np.float32), near, far)
    assert found[1, 2] == 0.0
    true[1, 2] = 0.0
    # single precision of a depth kept as 1 - n / z: 6e-8 z / n of z
    np.testing.assert_allclose(found, true, rtol=3e-6)
