"""Tests of image motion between renderings against the camera model; `make validate` has longer versions."""

from typing import Any

import numpy as np
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from benchmarks.validation.estimators import PATCH, SmoothImage, symmetric_shifts
from benchmarks.validation.motion import View, measure, patch_grid
from marsyard.sim.camera import Cahv
from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import Photometry, Renderer, Scene, Sun, Texture
from marsyard.sim.terrain import Surface, TerrainParameters, synthesise
from marsyard.sim.terrain.rocks import PlacedRock, RockField, RockParameters
from tests.sim.scenes import FORWARD, descent_camera, rocks_near

SUN = Sun(direction(np.radians(110.0), np.radians(40.0)))
#: Limit of the mean error over all patches; the full validation has at least 200 patches.
MAX_MEAN_ERROR_PX = 0.02


def test_known_shift_is_estimated() -> None:
    """The images show Gaussian bumps at exact positions. The second image has another gain and offset."""
    rng = np.random.default_rng(2)
    positions, sizes, heights = rng.uniform(0, 160, (900, 2)), rng.uniform(2.0, 5.0, 900), rng.uniform(-1, 1, 900)
    v, u = np.mgrid[:160, :160].astype(np.float64)

    def render_bumps(shift: np.ndarray) -> np.ndarray:
        image = np.zeros((160, 160))
        for (x, y), size, height in zip(positions + shift, sizes, heights, strict=True):
            image += height * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * size**2))
        return image

    shift = np.array([0.37, -0.22])
    first, second = SmoothImage(render_bumps(np.zeros(2))), SmoothImage(0.8 * render_bumps(shift) + 0.1)
    shifts = symmetric_shifts(first, second, patch_grid((160, 160)))
    assert_allclose(shifts.motion_px, np.broadcast_to(shift, shifts.motion_px.shape), atol=2e-3)
    # If all pixels of a patch have the same motion, the expected shift is that motion.
    uniform_motion = np.broadcast_to(shift, (len(shifts.motion_px), PATCH, PATCH, 2))
    assert_allclose(shifts.expected(uniform_motion), np.broadcast_to(shift, shifts.motion_px.shape), atol=1e-9)


def test_descent_image_motion_matches_the_camera(renderer: Renderer, terrain: Surface) -> None:
    texture = Texture(3.0, (0.03,) * 6)
    scene = Scene(terrain, (380.0, 200.0), SUN, Photometry(), ground_texture=texture)
    camera = descent_camera().crop(256, 256, (512, 512))
    pose = rigid(Rotation.from_euler("zyx", [20.0, 5.0, -4.0], degrees=True), np.array([380.0, 200.0, 2000.0]))
    for motion in measure(renderer, View(scene, camera, pose), np.array([0.3, 0.75])):
        assert len(motion.error) >= 200
        # Without rocks the image has no edges, so the limit is ten times stricter.
        assert np.abs(motion.error.mean(axis=0)).max() < 0.1 * MAX_MEAN_ERROR_PX


def test_rock_image_motion_matches_the_mast_camera(renderer: Renderer) -> None:
    distance_m = 2.0
    parameters = TerrainParameters(
        samples=512, spacing_m=0.05, rms_slope_deg=3.0, slope_baseline_m=1.0, outer_scale_m=10.0, craters_per_km2=0.0
    )
    surface = synthesise(parameters, np.random.default_rng(5))
    target = PlacedRock(name="target", east_m=10.0, north_m=10.0, diameter_m=2.0, shape=3, yaw_deg=20.0)
    field = RockField.draw(surface, RockParameters(abundance=0.05, placed=(target,)), np.random.default_rng(1))
    eye = np.array([9.2 - distance_m, 10.0, float(surface.height(10.0, 10.0)) + 1.4])
    rocks = rocks_near(field, eye[0], eye[1], distance_m + 3.0, 1.4, albedo=0.15)
    textures = {"ground_texture": Texture(0.2, (0.05,) * 6), "object_texture": Texture(0.2, (0.06,) * 8)}
    values: dict[str, Any] = {"mesh_finest_m": 0.04, "mesh_half_width_m": 200.0, "among_objects": True, **textures}
    scene = Scene(surface, (eye[0], eye[1]), SUN, Photometry(), rocks, **values)
    camera = Cahv.from_focal_length(16e-3, 4.65e-6, (512, 384), **FORWARD)
    depression_rad = np.arctan2(0.9, distance_m)
    view = View(scene, camera, rigid(Rotation.from_euler("y", depression_rad), eye))
    for motion in measure(renderer, view, np.array([0.3, 0.75])):
        rock_errors = motion.error[motion.body >= 0]
        assert len(rock_errors) > 60
        assert np.abs(rock_errors.mean(axis=0)).max() < MAX_MEAN_ERROR_PX
