"""Tests of injected faults of the descent: each fault has the specified effect and size."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from pydantic.fields import FieldInfo
from scipy.spatial.transform import Rotation

from marsyard.scenarios.case_faults import add_detector_faults, corrupt_images
from marsyard.scenarios.descent.faults import AttitudeTilts, DescentFaults, add_altitude_faults
from marsyard.scenarios.descent.flight import create_flight, states_at_images
from marsyard.scenarios.descent.images import calibrated_camera, camera_optics, take_exposures
from marsyard.scenarios.descent.parameters import DescentCameraParameters
from marsyard.scenarios.descent.world import DescentWorld
from marsyard.scenarios.heat_shield import SHIELD_BODY, SHIELD_DIAMETER_M, HeatShield
from marsyard.scenarios.radiance import add_haze
from marsyard.sim.dynamics import State
from marsyard.sim.frames import direction, rigid
from marsyard.sim.measurements import AltitudeMeasurement, AttitudeMeasurement
from marsyard.sim.render import Frame, PixelRays, Sun
from marsyard.sim.sensor import CustomCamera, Detector
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import Environment
from tests.scenarios.descent.descents import NOISELESS_DETECTOR, make_parameters, run_descent

SMALL_CAMERA = DescentCameraParameters(columns=256, rows=256, pixel_pitch_um=48.0)
#: Sun at an azimuth of 4 rad and an elevation of 0.7 rad.
SUN = Sun(direction(4.0, 0.7))


def _render_level_ground(height_m: float, radiance: np.ndarray) -> Frame:
    """Return the frame of level ground for a small camera that looks straight down."""
    rays = PixelRays.from_camera(camera_optics(SMALL_CAMERA).camera)
    downward_component = -rays.directions[:, 2].astype(np.float64)
    return Frame(
        radiance=radiance.astype(np.float32),
        range_m=(height_m / downward_component).reshape(256, 256),
        body=np.full((256, 256), -1, dtype=np.int32),
        normal=np.tile(np.array([0.0, 0.0, 1.0], dtype=np.float32), (256, 256, 1)),
        world_from_body=rigid(Rotation.identity(), np.array([0.0, 0.0, height_m])),
        rays=rays,
    )


def _make_state(height_m: float) -> State:
    zero = np.zeros(3)
    return State(0.0, np.array([0.0, 0.0, height_m]), zero, Rotation.identity(), zero, zero)


@pytest.mark.parametrize(("name", "field"), DescentFaults.model_fields.items())
def test_fault_name_and_size_are_reported(name: str, field: FieldInfo) -> None:
    size = 2 if field.annotation is int else 0.25
    assert DescentFaults.model_validate({name: size}).columns == {
        "fault": name,
        "fault_size": size,
        "fault_free": False,
    }


def test_multiple_faults_have_no_size() -> None:
    name, size, is_free = DescentFaults(haze=1.0, dust_discs=3).columns.values()
    assert (name, is_free) == ("several", False)
    assert np.isnan(size)


def test_haze_reduces_contrast_but_not_brightness() -> None:
    """Haze of optical depth 1 reduces the contrast at nadir to exp(-1); the mean changes by less than a factor of 2."""
    pattern = np.where(np.indices((256, 256)).sum(axis=0) % 2, 0.12, 0.10)
    frame = _render_level_ground(2000.0, pattern)
    clear_image, hazy_image = (add_haze(frame, Environment(), SUN, depth / 2000.0) for depth in (0.0, 1.0))
    np.testing.assert_allclose(clear_image, pattern, rtol=1e-6)
    centre_pixels = np.s_[126:130, 126:130]
    assert np.ptp(hazy_image[centre_pixels]) == pytest.approx(np.exp(-1.0) * 0.02, rel=0.03)
    assert 0.5 < hazy_image.mean() / pattern.mean() < 2.0


@pytest.mark.parametrize("angle_deg", [1.0, 4.0])
def test_heat_shield_has_the_specified_size(angle_deg: float) -> None:
    """A disc with angular diameter a, perpendicular to the line of sight, covers the solid angle pi / 4 a^2."""
    frame = _render_level_ground(2000.0, np.full((256, 256), 0.5))
    first_state = _make_state(2000.0)
    heat_shield = HeatShield.draw(first_state, np.radians(angle_deg), np.random.default_rng(3))
    shield_direction = heat_shield.centre_m - first_state.position_m
    face_on = replace(heat_shield, normal=shield_direction / np.linalg.norm(shield_direction), spin_rad_s=np.zeros(3))
    image = face_on.paint_over(frame, SUN, 0.0)
    solid_angles_sr = frame.rays.pixel_angles.astype(np.float64) ** 2
    covered = image.radiance != frame.radiance
    covered_sr = solid_angles_sr[covered.reshape(-1)].sum()
    assert covered_sr == pytest.approx(np.pi / 4.0 * np.radians(angle_deg) ** 2, rel=0.1)
    # The shield moves away at 20 m/s: 75 m in 3.75 s. Its solid angle decreases with the square of the distance.
    later_radiance = face_on.paint_over(frame, SUN, 3.75).radiance
    distance_m = SHIELD_DIAMETER_M / np.radians(angle_deg)
    area_ratio = solid_angles_sr[(later_radiance != frame.radiance).reshape(-1)].sum() / covered_sr
    assert area_ratio == pytest.approx((distance_m / (distance_m + 75.0)) ** 2, abs=0.05)
    # the ground truth contains the shield, in front of the ground only
    np.testing.assert_allclose(image.range_m[covered], distance_m, rtol=0.01)
    np.testing.assert_array_equal(image.body == SHIELD_BODY, covered)
    below_ground = replace(face_on, centre_m=face_on.centre_m - np.array([0.0, 0.0, 2000.0]))
    np.testing.assert_array_equal(below_ground.paint_over(frame, SUN, 0.0).radiance, frame.radiance)


def test_images_can_be_repeated_or_black() -> None:
    """`corrupt_images` repeats the image before image 3, or sets image 1 to 0; its inputs do not change."""
    images = [np.full((4, 4), value, dtype=np.uint16) for value in (1, 2, 3)]
    assert [int(entry[0, 0]) for entry in corrupt_images(images, repeated=3, black=0)] == [1, 2, 2]
    assert [int(entry[0, 0]) for entry in corrupt_images(images, repeated=0, black=1)] == [0, 2, 3]
    assert [int(entry[0, 0]) for entry in images] == [1, 2, 3]


@pytest.mark.parametrize("lost_rows", [0.0, 0.25, 1.0])
def test_incomplete_image_loses_its_lowest_rows(lost_rows: float) -> None:
    images = [np.full((4, 4), value, dtype=np.uint16) for value in (1, 2, 3)]
    corrupted = corrupt_images(images, repeated=0, black=0, incomplete=3, lost_rows=lost_rows)
    received = 4 - int(4 * lost_rows)
    assert [entry[:, 0].tolist() for entry in corrupted] == [[1] * 4, [2] * 4, [3] * received + [0] * (4 - received)]


@pytest.mark.parametrize("numbers", [{"repeated": 1}, {"repeated": 4}, {"black": 4}, {"incomplete": -1}])
def test_faults_of_missing_images_are_rejected(numbers: dict[str, int]) -> None:
    images = [np.zeros((4, 4), dtype=np.uint16)] * 3
    with pytest.raises(ValueError, match=f"{next(iter(numbers))} is image .*; allowed: . to 3, or 0 for none"):
        corrupt_images(images, **{"repeated": 0, "black": 0, **numbers})


def test_first_image_cannot_be_a_repeated_one() -> None:
    with pytest.raises(ValidationError, match="repeated_image is 1, which no image precedes"):
        DescentFaults(repeated_image=1)


def test_altitude_and_attitude_faults_have_the_specified_size() -> None:
    faults = DescentFaults(
        altitude_error=0.1, altitude_error_once=0.2, attitude_error_deg=3.0, attitude_error_once_deg=5.0
    )
    altitudes = add_altitude_faults(faults, [AltitudeMeasurement(100.0, time_s) for time_s in (0.0, 1.0, 2.0)])
    # 10 % in all readings, and another 20 % in the second
    assert [entry.altitude_m for entry in altitudes] == pytest.approx([110.0, 130.0, 110.0])
    # the heat shield moves away at 20 m/s
    readings = [AltitudeMeasurement(2000.0, time_s) for time_s in (0.0, 1.0, 2.0)]
    shield_ranges = add_altitude_faults(DescentFaults(shield_range_m=60.0), readings)
    assert [entry.altitude_m for entry in shield_ranges] == [60.0, 80.0, 100.0]
    attitudes = [AttitudeMeasurement(Rotation.identity(), time_s) for time_s in (0.0, 1.0, 2.0)]
    tilts = AttitudeTilts.draw(faults, np.random.default_rng(0))
    assert np.degrees(tilts.common.magnitude()) == pytest.approx(3.0)
    assert tilts.common.as_rotvec()[2] == tilts.single.as_rotvec()[2] == 0.0
    tilted = [np.degrees(entry.world_from_body.magnitude()) for entry in tilts.tilt_faulty_image(attitudes)]
    assert tilted == pytest.approx([0.0, 5.0, 0.0])


def _render_descent(faults: Mapping[str, Any], **tables: Any) -> list[np.ndarray]:
    """Return the three images of a descent, in counts."""
    parameters = make_parameters(faults=faults, detector=NOISELESS_DETECTOR, **tables)
    world, streams = DescentWorld.from_parameters(parameters), Streams(1, "faults", 0)
    states = states_at_images(parameters, create_flight(parameters, world.surface, streams))
    optics = camera_optics(parameters.camera)
    detector = Detector.draw(
        optics.fall_off, add_detector_faults(parameters.faults, parameters.detector), streams.generator("detector")
    )
    return [counts for counts, _ in take_exposures(parameters, world, states, optics, detector, streams)]


@pytest.mark.slow
def test_image_faults_change_the_expected_pixels() -> None:
    """Each fault changes a fraction of the pixels in all images, or all pixels in one image."""
    clear_images = _render_descent({})

    def compute_changed_fractions(faults: Mapping[str, Any]) -> list[float]:
        pairs = zip(_render_descent(faults), clear_images, strict=True)
        return [float(np.mean(np.abs(faulty / clear - 1.0) > 0.02)) for faulty, clear in pairs]

    dust_fractions = compute_changed_fractions({"dust_discs": 10})
    assert all(0.002 < fraction < 0.3 for fraction in dust_fractions)
    assert np.ptp(dust_fractions) < 0.02
    # A binned pixel sums four rows: one defective pixel among them changes its value.
    assert compute_changed_fractions({"bad_pixels": 0.01})[0] > 0.02
    late_fractions = compute_changed_fractions({"exposure_delay_s": 0.5})
    assert late_fractions[0] == late_fractions[2] == 0.0 < late_fractions[1]
    shield_fractions = compute_changed_fractions({"heat_shield_deg": 5.0})
    # Shadows of clouds darken pixels; scattered light brightens others.
    assert min(compute_changed_fractions({"cloud_cover": 0.4})) > 0.2
    # The shield tumbles: it may be invisible in one image if its edge points to the camera.
    assert max(shield_fractions) > 0.001


@pytest.mark.parametrize("is_custom", [False, True])
def test_calibration_errors_have_the_specified_standard_deviation(is_custom: bool) -> None:
    """Compare standard deviations of image centre and corner position over 300 draws of the calibration."""
    parameters = DescentCameraParameters()
    if is_custom:
        custom_camera = CustomCamera.from_camera(camera_optics(parameters).camera)
        parameters = parameters.model_copy(update={"model": custom_camera})
    true_camera = camera_optics(parameters).camera
    cameras = [calibrated_camera(parameters, np.random.default_rng(seed)) for seed in range(300)]
    nadir = np.array([[0.0, 0.0, -1.0]])
    centre_shifts = np.stack([camera.project(nadir)[0][0] for camera in cameras]) - true_camera.project(nadir)[0][0]
    # Relative standard error of a standard deviation from 300 draws: 1 / sqrt(600) = 4 %.
    assert centre_shifts.std(axis=0) == pytest.approx([parameters.centre_error_px] * 2, rel=0.15)
    _, corner = true_camera.rays(np.array([[0.0, 0.0]]))
    corners = np.stack([camera.project(corner)[0][0] for camera in cameras])
    corner_shifts = corners - centre_shifts - true_camera.project(corner)[0][0]
    radial_shifts = corner_shifts @ np.array([-1.0, -1.0]) / np.sqrt(2.0)
    # the corner is 511.5 px from the centre along each axis
    expected = np.hypot(parameters.distortion_error_px, parameters.focal_error * np.hypot(511.5, 511.5))
    assert radial_shifts.std() == pytest.approx(expected, rel=0.15)
    assert np.abs(corner_shifts @ np.array([1.0, -1.0])).max() < 0.02


def test_regular_dunes_trigger_the_second_peak_check() -> None:
    """The paper's ratio of the second to the first correlation peak detects repetitive terrain."""
    result = run_descent(
        faults={"dunes_m": 4.0}, descent={"cone_angle_deg": 0.0, "nod_rate_deg_s": 0.0, "wind_east_m_s": 10.0}
    )
    columns = list(result.products["tracks_columns"])
    ratios = result.products["tracks"][:, columns.index("second_peak_ratio")]
    assert ratios.max() > 0.6
    assert result.outcome != "VALID" or float(result.row["velocity_error_m_s"]) < 5.0
