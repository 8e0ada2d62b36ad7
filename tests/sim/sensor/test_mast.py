"""Tests of the mast: pointing errors, and range errors caused by errors of the stereo calibration."""

import numpy as np
import pytest

from marsyard.sim.camera import CameraModel
from marsyard.sim.sensor.mast import (
    MASTS,
    MER_MAST,
    Mast,
    MastState,
    PointingParameters,
    StereoCalibrationParameters,
    StereoHead,
    stereo_mast,
)

EXACT_POINTING = PointingParameters(zero_deg=0.0, backlash_deg=0.0, settling_deg=0.0, count_deg=0.0)
EXACT_CALIBRATION = StereoCalibrationParameters(
    disparity_error_px=0.0, epipolar_error_px=0.0, alignment_deg=0.0, roll_deg=0.0, focal_error=0.0
)


def _make_rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def _move_mast(mast: Mast, azimuths_deg: list[float]) -> list[MastState]:
    states, rng = [mast.rest], _make_rng()
    for azimuth in azimuths_deg:
        states.append(mast.point(states[-1], float(np.radians(azimuth)), 0.0, rng))
    return states[1:]


def test_error_free_mast_points_as_commanded() -> None:
    mast = Mast.draw(EXACT_POINTING, MER_MAST, _make_rng())
    state = mast.point(mast.rest, 0.4, -0.3, _make_rng())
    assert state.true_rad == state.readings_rad == (0.4, -0.3)
    expected = MER_MAST.rover_from_head(0.4, -0.3)
    assert mast.rover_from_head(state).as_matrix() == pytest.approx(expected.as_matrix())


def test_backlash_lags_by_half_and_absorbs_short_reversals() -> None:
    mast = Mast.draw(EXACT_POINTING.model_copy(update={"backlash_deg": 0.2}), MER_MAST, _make_rng())
    forward, same_command, short_reverse, reverse, long_reverse = (
        np.degrees(state.true_rad[0]) for state in _move_mast(mast, [10.0, 10.0, 9.9, 9.5, -20.0])
    )
    # From below the axis stops 0.1 deg below the command, from above 0.1 deg above it. A reversal by 0.1 deg is within
    # the backlash of 0.2 deg.
    assert [forward, same_command, short_reverse, reverse, long_reverse] == pytest.approx([9.9, 9.9, 9.9, 9.6, -19.9])
    # The encoder is on the motor side of the gears and does not measure the backlash.
    assert np.degrees([state.readings_rad[0] for state in _move_mast(mast, [10.0, 9.9])]) == pytest.approx([10.0, 9.9])


def test_zero_error_is_constant_in_a_run() -> None:
    parameters = EXACT_POINTING.model_copy(update={"zero_deg": 0.3})
    zeros_deg = np.degrees([Mast.draw(parameters, MER_MAST, _make_rng(n)).zeros_rad for n in range(400)])
    # The tolerance is four standard errors of 800 draws.
    assert np.std(zeros_deg) == pytest.approx(0.3, abs=4.0 * 0.3 / np.sqrt(1600.0))
    mast = Mast.draw(parameters, MER_MAST, _make_rng())
    for state in _move_mast(mast, [10.0, -40.0, 5.0]):
        assert np.subtract(state.readings_rad, state.true_rad) == pytest.approx(mast.zeros_rad)


def test_encoder_rounding_and_settling_error_have_the_specified_size() -> None:
    mast = Mast.draw(EXACT_POINTING.model_copy(update={"count_deg": 0.05, "settling_deg": 0.2}), MER_MAST, _make_rng())
    states = _move_mast(mast, list(np.linspace(-30.0, 30.0, 400)))
    counts = np.degrees([state.readings_rad[0] for state in states]) / 0.05
    assert counts == pytest.approx(np.rint(counts), abs=1e-9)
    rounding_deg = np.degrees([state.readings_rad[0] - state.true_rad[0] for state in states])
    assert np.abs(rounding_deg).max() <= 0.025 + 1e-9
    assert np.std(rounding_deg) == pytest.approx(0.05 / np.sqrt(12.0), rel=0.15)
    settling_error_deg = np.degrees([state.true_rad[0] for state in states]) - np.linspace(-30.0, 30.0, 400)
    assert np.std(settling_error_deg) == pytest.approx(0.2, rel=0.15)


def test_mast_stops_at_its_elevation_limit() -> None:
    mast = Mast.draw(EXACT_POINTING, MER_MAST, _make_rng())
    state = mast.point(mast.rest, 0.0, -2.0, _make_rng())
    assert np.degrees(state.readings_rad[1]) == pytest.approx(-87.0)


def test_mer_navcam_position_matches_opportunity_labels() -> None:
    # Measured angles (rad) and camera position C of 1N491020376 and 1N491020519. In the label frame y is right and z is
    # down. Its origin is 0.29 m higher.
    mast = stereo_mast("mer-navcam")
    for azimuth, elevation, centre in (
        (-0.340449, -0.10962, (0.442604, -0.0611635, -1.25106)),
        (0.254358, -0.20924, (0.508813, -0.0504884, -1.24881)),
    ):
        left = mast.left.transform(mast.geometry.rover_from_head(azimuth, elevation))
        expected = np.array([centre[0], -centre[1], -centre[2] + 0.29])
        assert left.c == pytest.approx(expected, abs=0.003)


@pytest.mark.parametrize("name", MASTS)
def test_ideal_calibration_equals_the_design(name: str) -> None:
    design = stereo_mast(name)
    head = StereoHead.draw(design, EXACT_CALIBRATION, _make_rng())
    for camera, ideal_camera in ((head.calibrated.left, design.left), (head.calibrated.right, design.right)):
        for vector in ("c", "a", "h", "v"):
            assert getattr(camera, vector) == pytest.approx(getattr(ideal_camera, vector), abs=1e-9)
    assert head.disparity_error_px(5.0) == pytest.approx(0.0, abs=1e-8)


def _triangulate_range_m(left_camera: CameraModel, right_camera: CameraModel, pixels: list[np.ndarray]) -> float:
    """Compute the range (m) along the left line of sight at its closest approach to the right one."""
    lines_of_sight = [camera.rays(pixel) for camera, pixel in zip((left_camera, right_camera), pixels, strict=True)]
    directions = np.stack([lines_of_sight[0][1], -lines_of_sight[1][1]], axis=1)
    distances = np.linalg.lstsq(directions, lines_of_sight[1][0] - lines_of_sight[0][0], rcond=None)[0]
    return float(distances[0])


@pytest.mark.parametrize("name", ["mer-navcam", "research-navcam"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_disparity_error_causes_range_error_of_eq_1(name: str, seed: int) -> None:
    design = stereo_mast(name)
    head = StereoHead.draw(design, EXACT_CALIBRATION.model_copy(update={"disparity_error_px": 0.5}), _make_rng(seed))
    error, range_m = head.disparity_error_px(10.0), 10.0
    assert 0.0 < abs(error) <= 0.5
    assert head.disparity_error_px(2.0) == pytest.approx(error, rel=0.02)
    point = np.array([range_m, 0.0, 0.0])
    pixels = [camera.project(point)[0] for camera in (design.left, design.right)]
    measured_range_m = _triangulate_range_m(head.calibrated.left, head.calibrated.right, pixels)
    baseline = float(np.linalg.norm(design.left.c - design.right.c))
    expected = range_m**2 / (design.left.focal_lengths[0] * baseline) * error
    # Eq. 1 of the tracking paper is of first order in error / disparity. The disparity is 25 px at 10 m for the navcam.
    assert measured_range_m - np.hypot(range_m, 0.5 * baseline) == pytest.approx(expected, rel=0.03)


def test_disparity_errors_are_uniform_within_their_bound() -> None:
    design = stereo_mast("research-navcam")
    parameters = EXACT_CALIBRATION.model_copy(update={"disparity_error_px": 0.5})
    errors = np.array([StereoHead.draw(design, parameters, _make_rng(n)).disparity_error_px(1e4) for n in range(150)])
    assert np.abs(errors).max() <= 0.5 + 1e-6
    assert np.std(errors) == pytest.approx(0.5 / np.sqrt(3.0), rel=0.15)


def test_disparity_offset_is_added_to_the_disparity_error() -> None:
    parameters = EXACT_CALIBRATION.model_copy(update={"disparity_offset_px": -1.2})
    head = StereoHead.draw(stereo_mast("research-navcam"), parameters, _make_rng())
    assert head.disparity_error_px(1e4) == pytest.approx(-1.2, abs=1e-3)


def test_row_errors_and_common_rotations_shift_images() -> None:
    design, point = stereo_mast("research-navcam"), np.array([50.0, 0.0, 0.0])
    misaligned = EXACT_CALIBRATION.model_copy(update={"epipolar_error_px": 1.0})
    misaligned_pair = StereoHead.draw(design, misaligned, _make_rng(5)).calibrated
    rows = [camera.project(point)[0][1] for camera in (misaligned_pair.left, misaligned_pair.right)]
    columns = [camera.project(point)[0][0] for camera in (misaligned_pair.left, misaligned_pair.right)]
    expected = [camera.project(point)[0][0] for camera in (design.left, design.right)]
    assert columns == pytest.approx(expected, abs=1e-3)
    # The second draw of the generator is the epipolar error.
    rng = _make_rng(5)
    rng.uniform()
    assert abs(rows[0] - rows[1]) == pytest.approx(abs(rng.standard_normal()), rel=1e-3)
    head = StereoHead.draw(design, EXACT_CALIBRATION.model_copy(update={"alignment_deg": 1.0}), _make_rng(5))
    shifts = [
        camera.project(point)[0] - ideal_camera.project(point)[0]
        for camera, ideal_camera in ((head.calibrated.left, design.left), (head.calibrated.right, design.right))
    ]
    assert np.linalg.norm(shifts[0]) > 5.0
    assert shifts[0] == pytest.approx(shifts[1], abs=0.5)
    assert head.disparity_error_px(20.0) == pytest.approx(0.0, abs=1e-6)


def test_focal_length_errors_scale_the_image() -> None:
    design = stereo_mast("research-navcam")
    head = StereoHead.draw(design, EXACT_CALIBRATION.model_copy(update={"focal_error": 0.01}), _make_rng(3))
    point = np.array([10.0, 2.0, 1.0])
    for camera, ideal_camera in ((head.calibrated.left, design.left), (head.calibrated.right, design.right)):
        centre = np.array(ideal_camera.image_centre)
        ratio = (camera.project(point)[0] - centre) / (ideal_camera.project(point)[0] - centre)
        scale = camera.focal_lengths[0] / ideal_camera.focal_lengths[0]
        assert ratio == pytest.approx([scale, scale])
        assert scale != pytest.approx(1.0, abs=1e-6)


def test_unknown_mast_is_rejected() -> None:
    with pytest.raises(ValueError, match="xc-55"):
        stereo_mast("xc-55")
