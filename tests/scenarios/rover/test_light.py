"""Tests of the illumination of a rover run: sun, exposure with a bright sky, and the rover's shadow on templates."""

from typing import Any

import numpy as np
import pytest

from marsyard.algorithms.interface import PixelBox
from marsyard.scenarios.rover.closed_loop import prepare_run, run_case
from marsyard.scenarios.rover.designation import is_lit
from marsyard.scenarios.rover.figures import run_timeline
from marsyard.scenarios.rover.parameters import MastCameraParameters, MovingSunParameters, RoverScenarioParameters
from marsyard.scenarios.rover.points import rover_shades_patch, sample_template
from marsyard.scenarios.rover.run_state import RoverRun
from marsyard.scenarios.rover.stereo_camera import StereoCamera, StereoImages
from marsyard.scenarios.views import mast_pose
from marsyard.sim.dynamics.rover import ROCKY_8, settle
from marsyard.sim.frames import direction
from marsyard.sim.sensor.mast import RESEARCH_MAST
from marsyard.sim.streams import Streams
from tests.scenarios.rover.short_run import SHORT_RUN
from tests.sim.dynamics.grounds import Plane


def make_run(**changes: Any) -> RoverRun:
    return run_case(RoverScenarioParameters.model_validate({**SHORT_RUN, **changes}), Streams(1, "rover tests", 0))


def test_sun_moves_westwards_with_its_hour_angle() -> None:
    # At the equator a sun in the zenith moves west by its hour angle: 16 deg in 66 minutes (Table IV of the tracking
    # paper).
    sun = MovingSunParameters(azimuth_deg=0.0, elevation_deg=90.0, latitude_deg=0.0)
    for minutes in (0.0, 66.0, 132.0):
        angle = np.radians(16.0 * minutes / 66.0)
        np.testing.assert_allclose(sun.direction(60.0 * minutes), [-np.sin(angle), 0.0, np.cos(angle)], atol=1e-12)


def test_images_use_the_sun_direction_of_their_time() -> None:
    # One hour passes between two images. The sun direction changes in it, except with an hour angle rate of 0.
    slow_tracking = {"timing": {"track_s": 3600.0}, "camera": {"detector_noise": False}}
    fixed_sun = {"sun": {**SHORT_RUN["sun"], "hour_angle_deg_min": 0.0}, "rover_shadow": False}
    moving_sun = {"sun": {**SHORT_RUN["sun"], "update_interval_s": 1.0}, "rover_shadow": False}
    fixed_sun_run, moving_sun_run = make_run(**slow_tracking, **fixed_sun), make_run(**slow_tracking, **moving_sun)
    assert fixed_sun_run.stops[1].time_s - fixed_sun_run.stops[0].time_s >= 3600.0
    moving_directions = [
        moving_sun_run.setup.world.scene(stop.time_s).sun.direction for stop in moving_sun_run.stops[:2]
    ]
    sun_rotation_deg = np.degrees(np.arccos(moving_directions[0] @ moving_directions[1]))
    minutes = (moving_sun_run.stops[1].time_s - moving_sun_run.stops[0].time_s) / 60.0
    # The rotation is less than the hour angle, because the sun is not on the celestial equator.
    assert 10.0 < sun_rotation_deg < 16.0 / 66.0 * minutes + 0.01
    fixed_directions = [fixed_sun_run.setup.world.scene(stop.time_s).sun.direction for stop in fixed_sun_run.stops[:2]]
    np.testing.assert_allclose(fixed_directions[0], fixed_directions[1], atol=1e-12)


def test_camera_replaces_the_optics_of_its_detector_only_if_given() -> None:
    optics = {"defocus_px": 1.0, "stray_light": 0.1, "dust_discs": 5, "dust_depth": 0.2}
    own = {"detector": {"preset": "mer-navcam", "optics": optics}}
    for changes in ({}, dict.fromkeys(optics, 0), {"stray_light": 0.3}):
        parameters = MastCameraParameters.model_validate({**own, **changes}).detector_parameters()
        assert {name: getattr(parameters.optics, name) for name in optics} == {**optics, **changes}


def test_images_without_noise_have_the_bits_of_their_timeline() -> None:
    """A 10-bit camera without detector noise has counts of 12 bits, and its timeline states 12."""
    camera = {"preset": "research-navcam", "detector_noise": False}
    run = make_run(camera=camera, legs=[{"motion": "stay", "steps": 1}])
    images = run_timeline(run.setup.camera.parameters, run).images
    assert images
    for image in images:
        assert 2 ** (image.bits - 1) <= image.counts.max() < 2**image.bits


def test_bright_sky_underexposes_full_frames() -> None:
    """With an exposure for the subframe, the sky does not reduce the contrast at the target (tracking paper, 4.5)."""
    drive_east = {"start": {"distance_m": 9.0}, "legs": [{"motion": "approach", "goal_m": 8.5, "step_fraction": 0.1}]}
    sun_ahead = {"sun": {"azimuth_deg": 90.0, "elevation_deg": 30.0}}
    first_images = {
        region: make_run(**drive_east, **sun_ahead, exposure={"metering": region}).stops[0].images
        for region in ("subframe", "full-frame")
    }
    exposure_ratio = first_images["full-frame"].exposure_s / first_images["subframe"].exposure_s
    assert exposure_ratio < 0.3
    contrast = {region: float(np.std(pair.left.counts.astype(float))) for region, pair in first_images.items()}
    assert contrast["full-frame"] == pytest.approx(contrast["subframe"] * exposure_ratio, rel=0.1)


def take_pair(camera: dict[str, Any], box: PixelBox, metering: str = "subframe") -> tuple[StereoImages, int]:
    """Take a pair from a mast that looks down 30 deg; return it with the full scale of its counts."""
    changes = {"exposure": {"metering": metering}, "camera": {"preset": "research-navcam", **camera}}
    parameters, streams = RoverScenarioParameters.model_validate({**SHORT_RUN, **changes}), Streams(1, "tests", 0)
    setup = prepare_run(parameters, streams).setup
    scene, head = setup.world.scene(0.0), setup.rig.head.true
    pose = mast_pose(scene.surface, *scene.centre_m, 1.5, 90.0, -30.0)
    stereo = StereoCamera.draw(parameters, streams)
    pair = stereo.take(scene, None, pose, (head.left, head.right), (box, box), setup.world.brightness(0.0), 0.0)
    return pair, 2**stereo.bits - 1


def test_full_frame_is_metered_with_its_own_fall_off() -> None:
    """The subframe has no effect on the exposure of full-frame metering, nor has a list of bad pixels.

    The controlled percentile of the reduced frame is near its target, 0.75.
    """
    defects = {"detector": {"preset": "research-navcam", "defects": {"hot_fraction": 1e-3, "listed": True}}}
    whole, full_scale = take_pair({}, PixelBox((0, 0), (1024, 768)), "full-frame")
    corner, _ = take_pair(defects, PixelBox((0, 0), (64, 64)), "full-frame")
    assert corner.exposure_s == pytest.approx(whole.exposure_s, rel=0.02)
    reduced = whole.left.counts.reshape(48, 16, 64, 16).mean(axis=(1, 3))
    assert np.percentile(reduced, 98.0) / full_scale == pytest.approx(0.75, abs=0.06)


def test_images_without_detector_noise_have_the_blur_of_the_optics() -> None:
    box = PixelBox((400, 300), (160, 160))
    sharp, blurred = (
        take_pair({"detector_noise": False, "defocus_px": defocus_px}, box)[0].left.counts for defocus_px in (0.0, 5.0)
    )
    assert np.abs(np.diff(blurred.astype(float))).mean() < 0.8 * np.abs(np.diff(sharp.astype(float))).mean()


def test_lit_points_are_not_in_the_shadow_of_a_cloud() -> None:
    clouds = {"cover": 0.5, "size_m": 50.0, "edge_m": 5.0, "optical_depth": 20.0, "wind_east_m_s": 5.0}
    parameters = RoverScenarioParameters.model_validate({**SHORT_RUN, "clouds": clouds})
    run = prepare_run(parameters, Streams(1, "rover tests", 0))
    world, point = run.setup.world, run.target.point_world
    layer, times_s = world.base.clouds, np.arange(0.0, 120.0, 5.0)
    assert layer is not None
    transmitted = [layer.transmittance(point[None], world.scene(time_s).sun, time_s)[0] for time_s in times_s]
    lit = [is_lit(world, point, time_s) for time_s in times_s]
    assert lit == [fraction >= 0.5 for fraction in transmitted]
    assert set(lit) == {True, False}
    # the target is designated in the first images
    assert run.target.lit is is_lit(world, point, parameters.timing.track_s)


EAST = 0.5 * np.pi


@pytest.mark.parametrize("elevation_deg", [25.0, 40.0])
def test_head_shadow_is_at_the_sun_ray_intersection(elevation_deg: float) -> None:
    """The rover faces east and the sun is in the west: the head's shadow is height / tan(elevation) ahead."""
    stance = settle(ROCKY_8, Plane(), 0.0, 0.0, EAST)
    sun = direction(-EAST, float(np.radians(elevation_deg)))
    head = stance.world_from_rover.apply(RESEARCH_MAST.base_m + RESEARCH_MAST.elbow_m + RESEARCH_MAST.head_m)
    shadow = head - head[2] / sun[2] * sun

    def is_shaded(east_m: float, north_m: float) -> bool:
        # The patch has a half angle of 2 mrad, seen from the head. The mast points ahead.
        position = shadow + np.array([east_m, north_m, 0.0])
        patch = sample_template(head, position, 0.002)
        return rover_shades_patch(ROCKY_8, stance, RESEARCH_MAST, (0.0, 0.0), patch, sun)

    # the boxes of both cameras, 0.3 m apart
    assert is_shaded(0.0, -0.15)
    assert is_shaded(0.0, 0.15)
    # The head is at most half a metre wide. The ground 0.6 m ahead or to the side is sunlit.
    assert not is_shaded(0.6, 0.0)
    assert not is_shaded(0.0, 0.6)
    assert not is_shaded(0.0, -0.6)
    # Closer to the rover, the mast shades the ground.
    assert is_shaded(-0.4, 0.0)


def test_template_patch_has_points_at_centre_half_and_full_radius() -> None:
    eye, point = np.array([0.0, 0.0, 1.5]), np.array([2.0, 0.0, 0.2])
    patch = sample_template(eye, point, 0.02)
    ray_vectors = patch - eye
    angles = np.arccos(ray_vectors @ (point - eye) / np.linalg.norm(ray_vectors, axis=1) / np.linalg.norm(point - eye))
    np.testing.assert_allclose(sorted(set(np.round(angles, 4))), [0.0, 0.01, 0.02], atol=2e-4)
