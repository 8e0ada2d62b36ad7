"""Tests of relief on the horizon in images."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.sim.camera import Cahv
from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import PixelRays, Renderer, Scene, Sun
from marsyard.sim.render.skyline import Relief
from tests.sim.scenes import FORWARD, LAMBERT, flat_ground

LEVEL = flat_ground(64, 1.0)
#: Attitude of a camera that looks east by north, 3 deg upwards.
UPWARDS = Rotation.from_euler("ZY", [13.0, -3.0], degrees=True)


@pytest.mark.parametrize("transmission", [0.5, 1.0])
def test_relief_hides_the_sky_below_its_upper_edge(renderer: Renderer, transmission: float) -> None:
    """A ridge of constant elevation, seen from two positions: brightness, haze, and the place of its edge."""
    ridge = Relief(np.full((1, 64), 0.05, np.float32), np.array([transmission]), np.zeros(1), 0.4)
    sun, photometry = Sun(direction(0.0, np.radians(60.0))), replace(LAMBERT, sky_radiance=0.05)
    scene = Scene(LEVEL, (8.0, 8.0), sun, photometry, horizon=ridge, mesh_finest_m=0.2, mesh_half_width_m=60.0)
    rays = PixelRays.from_camera(Cahv.from_field_of_view(0.4, (200, 200), **FORWARD))
    for east_m in (8.0, 30.0):
        frame = renderer.render(scene, rays, rigid(UPWARDS, np.array([east_m, 8.0, 1.5])))
        up = rays.directions.reshape(200, 200, 3) @ frame.world_from_body.rotation.as_matrix()[2]
        tangent, is_sky = up / np.sqrt(1.0 - up**2), np.isinf(frame.range_m)
        edge = 0.8 * 0.4 / 200
        assert np.all(frame.radiance[is_sky & (tangent > 0.05 + edge)] == np.float32(0.05))
        # level ground under this sun: A (sin 60 + D), behind air of the sky's brightness
        face = 0.4 * (np.sin(np.radians(60.0)) + photometry.sky_fraction)
        expected = 0.05 + transmission * (face - 0.05)
        np.testing.assert_allclose(
            frame.radiance[is_sky & (tangent > 0.01) & (tangent < 0.05 - edge)], expected, rtol=1e-3
        )
