"""Tests that images do not depend on the number of threads: they are bitwise equal."""

from typing import Any

import drjit as dr
import numpy as np
from scipy.spatial.transform import Rotation

from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import Photometry, PixelRays, Renderer, Scene, Sun, Texture
from marsyard.sim.terrain import Surface
from marsyard.sim.terrain.rocks import PlacedRock, RockField, RockParameters
from tests.sim.scenes import descent_camera, rocks_near


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
