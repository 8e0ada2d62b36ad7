"""Tests of motion blur and smear: `moving_exposure` against sums of many sharp images at successive times."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from marsyard.sim.camera import Cahv, Cahvor
from marsyard.sim.frames import rigid
from marsyard.sim.render import Photometry, Scene, Sun, process_renderer
from marsyard.sim.render.backend import default_backend
from marsyard.sim.render.pixel_rays import PixelRays
from marsyard.sim.sensor import ImageMotion, natural_fall_off
from marsyard.sim.sensor.image_motion import moving_exposure
from marsyard.sim.terrain import TerrainParameters, synthesise
from tests.sim.scenes import DOWN, FORWARD, descent_camera
from tests.sim.sensor.motions import uniform_motion

Image = NDArray[np.float64]
EXPOSURE_S = 4e-3


def _sum_sharp_images(
    image_at: Callable[[float], Image], shape: tuple[int, int], transfer_row_s: float, clear_row_s: float, rows: int
) -> Image:
    """Compute the radiance x seconds that the charge of each pixel collects, from 24 images of the exposure.

    `image_at` renders an image at a time, s. Groups of `rows` transfer steps use one image.
    """
    total = sum((image_at(((n + 0.5) / 24 - 0.5) * EXPOSURE_S) for n in range(24)), np.zeros(shape)) * EXPOSURE_S / 24
    for first in range(1, shape[0], rows):
        lags = range(first, min(first + rows, shape[0]))
        middle = float(np.mean(lags)) - 0.5
        readout = image_at(0.5 * EXPOSURE_S + middle * transfer_row_s) * transfer_row_s
        clearing = image_at(-0.5 * EXPOSURE_S - middle * clear_row_s) * clear_row_s
        for lag in lags:
            total[lag:] += readout[:-lag]
            total[:-lag] += clearing[lag:]
    return total


def test_rotating_camera_matches_many_renderings() -> None:
    """The camera rotates by 60 deg/s and moves by 80 m/s over rough ground.

    The camera has 80 x 80 pixels, and the transfer time of the descent camera with 1024 x 1024 pixels.
    """
    size = 80
    transfer_row_s, clear_row_s = 5e-6 * 1024 / size, 1e-6 * 1024 / size
    parameters = TerrainParameters(samples=512, rms_slope_deg=6.0, outer_scale_m=400.0, albedo_contrast=0.2)
    surface = synthesise(parameters, np.random.default_rng(11))
    pinhole = Cahv.from_focal_length(14.67e-3, 12e-6, (size, size), **DOWN)
    camera = Cahvor.from_cahv(pinhole, r=np.array([0.00096, -0.002183, 0.018547]))
    rays = PixelRays.from_camera(camera)
    renderer = process_renderer(default_backend())
    scene = Scene(surface, (0.0, 0.0), Sun(np.array([0.6, 0.3, np.sqrt(0.55)])), Photometry())
    attitude = Rotation.from_euler("xyz", [20.0, -10.0, 30.0], degrees=True)
    velocity, rate = np.array([20.0, -15.0, -75.0]), np.radians([45.0, -40.0, 5.0])
    position = np.array([50.0, 80.0, 1400.0])
    response = natural_fall_off(camera)

    def render_at(time_s: float) -> Image:
        rotation = Rotation.from_rotvec(rate * time_s) * attitude
        return np.asarray(
            renderer.render(scene, rays, rigid(rotation, position + velocity * time_s)).radiance * response
        )

    frame = renderer.render(scene, rays, rigid(attitude, position))
    motion = ImageMotion.from_camera(camera, frame.range_m, frame.world_from_body, velocity, rate)
    assert motion.max_px_s == pytest.approx(np.radians(60.0) * 14.67e-3 / 12e-6, rel=0.1)
    result = moving_exposure(frame.radiance, response, motion, EXPOSURE_S, transfer_row_s, clear_row_s)
    expected = _sum_sharp_images(render_at, (size, size), transfer_row_s, clear_row_s, rows=6)
    # Pixels outside the frame have no radiance, so a border as wide as the image motion is excluded.
    inner = np.s_[13:-13, 13:-13]
    error = (result - expected)[inner] / expected.mean()
    assert np.sqrt((error**2).mean()) < 0.004
    static_image = (frame.radiance * response * EXPOSURE_S)[inner]
    assert np.abs(static_image / static_image.mean() - expected[inner] / expected[inner].mean()).std() > 0.02


@pytest.mark.parametrize("velocity", [(0.0, 1400.0), (1400.0, 0.0), (-1000.0, 800.0), (6.0, -4.0)])
def test_smear_and_blur_of_drifting_image_match_sum_of_sharp_images(velocity: tuple[float, float]) -> None:
    rng = np.random.default_rng(0)
    scene = (1.0 + 0.5 * gaussian_filter(rng.standard_normal((128, 96)), 1.5)).astype(np.float32)
    response = np.linspace(1.0, 0.8, 128)[:, None] * (1.0 + 0.01 * rng.standard_normal((128, 96)))
    response = response.astype(np.float32)
    rows, columns = np.indices(scene.shape).astype(np.float64)

    def render_at(time_s: float) -> Image:
        positions = [rows - velocity[0] * time_s, columns - velocity[1] * time_s]
        return map_coordinates(scene.astype(np.float64), positions, order=3, mode="nearest") * response

    result = moving_exposure(scene, response, uniform_motion(*velocity), EXPOSURE_S, 4e-5, 8e-6)
    expected = _sum_sharp_images(render_at, scene.shape, 4e-5, 8e-6, rows=1)
    assert np.sqrt(((result - expected) ** 2).mean()) < 0.0015 * expected.mean()


def test_image_velocity_matches_finite_differences() -> None:
    camera = descent_camera(512)
    rng = np.random.default_rng(4)
    distance = 1000.0 + 100.0 * rng.random((512, 512))
    pose = rigid(Rotation.from_euler("xyz", [0.2, 0.1, 1.0]), np.array([3.0, 5.0, 900.0]))
    velocity, rate = np.array([10.0, -20.0, -60.0]), np.array([0.3, -0.4, 0.2])
    motion = ImageMotion.from_camera(camera, distance, pose, velocity, rate)
    pixels = 32.0 * np.stack(np.meshgrid(np.arange(16), np.arange(16)), axis=-1).astype(np.float64)
    origins, directions = camera.rays(pixels)
    world = pose.apply((origins + distance[::32, ::32, None] * directions).reshape(-1, 3))
    step = 1e-5
    ends = []
    for time_s in (-step, step):
        later = rigid(Rotation.from_rotvec(rate * time_s) * pose.rotation, pose.translation + velocity * time_s)
        ends.append(camera.project(later.inv().apply(world))[0].reshape(16, 16, 2))
    expected = (ends[1] - ends[0]) / (2 * step)
    np.testing.assert_allclose(motion.velocity_px_s[:16, :16, ::-1], expected, atol=1e-3)


def test_image_at_infinite_range_moves_only_by_rotation() -> None:
    camera = Cahv.from_focal_length(6e-3, 12e-6, (128, 96), **FORWARD)
    pose = rigid(Rotation.identity(), np.zeros(3))
    sky = np.full((96, 128), np.inf)
    assert ImageMotion.from_camera(camera, sky, pose, np.array([50.0, 20.0, 0.0]), np.zeros(3)).max_px_s < 1e-3
    rotation_only = ImageMotion.from_camera(camera, sky, pose, np.zeros(3), np.array([0.0, 0.0, 0.1]))
    # A left turn moves the image to the right by 500 px/rad.
    assert rotation_only.velocity_px_s[1, 2, 1] == pytest.approx(50.0, rel=0.01)


@pytest.mark.parametrize("velocity", [(1222.0, 0.0), (0.0, -1222.0), (864.0, 864.0)])
def test_border_of_moving_image_approximates_wider_image(velocity: tuple[float, float]) -> None:
    """The scene is extrapolated at the border; the reference is a wider image with zero response outside the frame.

    The motion is 60 deg/s of the descent camera (1222 px/s). The ground has 10 % contrast in waves of about 8 pixels.
    """
    margin = 12
    rng = np.random.default_rng(2)
    waves = gaussian_filter(rng.standard_normal((280, 280)), 2.0)
    wide_scene = (1.0 + 0.1 * waves / waves.std()).astype(np.float32)
    inner = np.s_[margin:-margin, margin:-margin]
    frame = np.ascontiguousarray(wide_scene[inner])
    response = np.zeros_like(wide_scene)
    response[inner] = 1.0
    motion = uniform_motion(*velocity)
    from_frame = moving_exposure(frame, np.ones_like(frame), motion, EXPOSURE_S, 5e-6, 1e-6)
    from_wider_image = moving_exposure(wide_scene, response, motion, EXPOSURE_S, 5e-6, 1e-6)[inner]
    error = (from_frame - from_wider_image) / from_wider_image.mean()
    rows, columns = (np.asarray(indices) for indices in np.indices(frame.shape))
    border_distance: np.ndarray = np.minimum.reduce([rows, columns, rows[::-1], columns[:, ::-1]])
    rms = [float(np.sqrt(np.mean(error[border_distance == ring] ** 2))) for ring in range(20)]
    # The noise of an image is 1 %.
    assert 1e-4 < rms[0] < 0.03
    assert max(rms[3:]) < 0.0015


@pytest.mark.parametrize("velocity", [(0.0, 1500.0), (1100.0, -900.0), (37.0, 12.0)])
def test_moving_dot_is_at_its_mid_exposure_position(velocity: tuple[float, float]) -> None:
    rows, columns = np.indices((64, 64))
    dot = np.exp(-0.5 * ((rows - 31.3) ** 2 + (columns - 30.6) ** 2) / 1.5**2).astype(np.float32)
    image = moving_exposure(dot, np.ones_like(dot), uniform_motion(*velocity), EXPOSURE_S, 0.0, 0.0)
    total = image.sum(dtype=np.float64)
    assert total == pytest.approx(dot.sum(dtype=np.float64) * EXPOSURE_S, rel=1e-4)
    assert (image * rows).sum() / total == pytest.approx(31.3, abs=0.005)
    assert (image * columns).sum() / total == pytest.approx(30.6, abs=0.005)
    # Along the motion, the blur over a path of length L adds a variance of L^2 / 12.
    position_along_motion = ((rows - 31.3) * velocity[0] + (columns - 30.6) * velocity[1]) / np.hypot(*velocity)
    path = np.hypot(*velocity) * EXPOSURE_S
    assert (image * position_along_motion**2).sum() / total == pytest.approx(1.5**2 + path**2 / 12.0, rel=0.02)


def test_slow_motion_equals_static_exposure() -> None:
    rng = np.random.default_rng(3)
    scene, response = (1.0 + 0.1 * rng.standard_normal((2, 96, 64))).astype(np.float32)
    result = moving_exposure(scene, response, uniform_motion(1e-6, 1e-6), EXPOSURE_S, 5e-6, 1e-6)
    rate = scene * response
    cumulative_rate = np.cumsum(rate, axis=0)
    static = EXPOSURE_S * rate + 5e-6 * (cumulative_rate - rate) + 1e-6 * (cumulative_rate[-1:] - cumulative_rate)
    # The tolerance covers the smear, which uses responses averaged over 32 rows.
    np.testing.assert_allclose(result, static, rtol=1e-3)


def test_smear_trail_of_a_moving_dot_is_inclined() -> None:
    """The charge d rows below the dot passes it d transfer times after the exposure."""
    rows, columns = np.indices((96, 96))
    dot = np.exp(-0.5 * ((rows - 20.0) ** 2 + (columns - 40.0) ** 2) / 1.5**2).astype(np.float32)
    image = moving_exposure(dot, np.ones_like(dot), uniform_motion(0.0, 1000.0), EXPOSURE_S, 5e-5, 0.0)
    for row in (40, 60, 90):
        centre = (image[row] * columns[row]).sum() / image[row].sum()
        assert centre == pytest.approx(40.0 + 1000.0 * (0.5 * EXPOSURE_S + (row - 20 - 0.5) * 5e-5), abs=0.05)
    # During clearing the charge of higher rows passes the dot before the exposure; the higher the row, the earlier.
    clearing_image = moving_exposure(dot, np.ones_like(dot), uniform_motion(0.0, 1000.0), EXPOSURE_S, 0.0, 5e-5)
    centre = (clearing_image[5] * columns[5]).sum() / clearing_image[5].sum()
    assert centre == pytest.approx(40.0 - 1000.0 * (0.5 * EXPOSURE_S + 14.5 * 5e-5), abs=0.05)
