"""Tests of the division of pixels among threads: each pixel is computed once, and images are bitwise equal."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import Photometry, PixelRays, Renderer, Scene, Sun, Texture
from marsyard.sim.render.renderer import run_in_parts
from marsyard.sim.terrain import Surface
from marsyard.sim.terrain.rocks import PlacedRock, RockField, RockParameters
from tests.sim.scenes import descent_camera, rocks_near


@pytest.mark.parametrize(("pixels", "count"), [(100_001, 1), (100_001, 2), (99_999, 7), (20_001, 3), (5, 2)])
def test_every_pixel_belongs_to_one_part(pixels: int, count: int) -> None:
    """A part is a slice of the pixels, computed by one of `count` threads."""
    visits = np.zeros(pixels, dtype=np.int64)

    def visit(pixels_of_part: slice) -> None:
        visits[pixels_of_part] += 1

    run_in_parts(visit, pixels, count)
    np.testing.assert_array_equal(visits, 1)


def test_exception_in_a_thread_is_raised() -> None:
    def fail(pixels_of_part: slice) -> None:
        if pixels_of_part.start > 0:
            raise ValueError("the second half")

    with pytest.raises(ValueError, match="the second half"):
        run_in_parts(fail, 100_000, 2)


def test_images_do_not_depend_on_threads(renderer: Renderer, terrain: Surface, monkeypatch: pytest.MonkeyPatch) -> None:
    rock = PlacedRock(name="rock", east_m=380.0, north_m=205.0, diameter_m=30.0, shape=3, yaw_deg=20.0)
    field = RockField.draw(terrain, RockParameters(abundance=0.0, placed=(rock,)), np.random.default_rng(1))
    rocks = rocks_near(field, 380.0, 205.0, 60.0, 200.0, albedo=0.15)
    layers: dict[str, Any] = {"ground_texture": Texture(3.0, (0.03,) * 6), "object_texture": Texture(0.5, (0.05,) * 3)}
    scene = Scene(terrain, (380.0, 200.0), Sun(direction(2.0, 0.6)), Photometry(), rocks, **layers)
    rays = PixelRays.from_camera(descent_camera().crop(400, 400, (161, 161)))
    pose = rigid(Rotation.from_euler("x", 4.0, degrees=True), np.array([380.0, 200.0, 400.0]))
    monkeypatch.setattr("marsyard.sim.render.renderer.run_in_parts", partial(run_in_parts, threads=1))
    one_thread = renderer.render(scene, rays, pose)
    assert np.any(one_thread.body >= 0)
    monkeypatch.setattr("marsyard.sim.render.renderer.run_in_parts", partial(run_in_parts, threads=3))
    three_threads = renderer.render(scene, rays, pose)
    for name in ("radiance", "range_m", "body", "normal"):
        np.testing.assert_array_equal(getattr(one_thread, name), getattr(three_threads, name))
