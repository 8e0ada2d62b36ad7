"""Tests of the scores of position estimates: columns and stored products, for a straight flight over a shifted map."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.algorithms.localisation.details import LocalisationDetails
from marsyard.algorithms.localisation.interface import InitialState, MapProduct, PositionEstimate, PositionOutcome
from marsyard.campaigns.store.products import pack_products
from marsyard.scenarios.localisation.figures import case_products
from marsyard.scenarios.localisation.map_truth import MapTruth, SmoothField
from marsyard.scenarios.localisation.score import REQUIRED_M, EstimateErrors, answer_row, compute_errors
from marsyard.scenarios.streamed import StreamAnswers
from marsyard.sim.dynamics import State

#: Shift of the map relative to the world, east and north, m.
SHIFT_M = np.array([30.0, -40.0])
#: Position at time 0 (m) and constant velocity (m/s) of the flight, world axes.
START_M, VELOCITY_M_S = np.array([100.0, 200.0, 4000.0]), np.array([10.0, 5.0, -90.0])
ATTITUDE = Rotation.from_rotvec([0.0, 0.02, 0.5])
#: Covariance of the errors of position (m), velocity (m/s) and attitude (rad).
COVARIANCE = np.diag([4.0, 9.0, 25.0, 1.0, 1.0, 1.0, 1e-4, 1e-4, 1e-4])
#: Time tags of the inertial unit minus true times, s.
IMU_OFFSET_S = 0.5
#: True times of the images and of the final estimate, s.
IMAGE_TIMES_S = (2.0, 6.0, 9.9, 14.0)
END_S = 15.0


class _StraightFlight:
    """A flight with constant velocity and attitude."""

    span_s = (-2.0, 20.0)

    def state(self, time_s: float) -> State:
        """Return the true state."""
        zero = np.zeros(3)
        return State(time_s, START_M + VELOCITY_M_S * time_s, VELOCITY_M_S.copy(), ATTITUDE, zero, zero)


def _make_map_truth(shift_m: np.ndarray = SHIFT_M, distortion_x_m: float = 0.0) -> MapTruth:
    none, east = (SmoothField(np.full((8, 8), value), np.array([-4e3, -4e3]), 1e3) for value in (0.0, distortion_x_m))
    return MapTruth(shift_m, east, none, none, 1.0)


def _make_images(tags_s: Sequence[float]) -> tuple[Any, ...]:
    """Return images with these time tags; the counts of each are its number, from 1."""
    return tuple(
        SimpleNamespace(counts=np.full((4, 4), number, dtype=np.uint16), time_s=tag_s)
        for number, tag_s in enumerate(tags_s, start=1)
    )


def _make_descent(**changes: Any) -> Any:
    """Return the parts of a `LocalisedDescent` that the score of answers uses."""
    rows = np.arange(40.0, dtype=np.float32).reshape(5, 8)
    product = MapProduct(rows, np.zeros_like(rows), np.array([-10.0, 20.0]), 6.0, 1.0, 1.0, 1.0)
    initial = InitialState(0.0, START_M, VELOCITY_M_S, ATTITUDE, np.eye(9), 3.7)
    flight = _StraightFlight()
    return SimpleNamespace(
        **{
            "flight": flight,
            "states": tuple(flight.state(time_s) for time_s in IMAGE_TIMES_S),
            "map_truth": _make_map_truth(),
            "images": _make_images(IMAGE_TIMES_S),
            "imu_offset_s": IMU_OFFSET_S,
            "measurements": SimpleNamespace(initial=initial, map_product=product),
            **changes,
        }
    )


def _estimate(
    time_s: float, error_m: Sequence[float], covariance: np.ndarray = COVARIANCE, details: object = None
) -> PositionEstimate:
    """Return a valid estimate with this error relative to the map; its time tag is on the inertial unit's clock.

    The velocity error is 0.5 m/s, the attitude error 0.2 deg.
    """
    position = START_M + VELOCITY_M_S * time_s + np.append(SHIFT_M, 0.0) + np.asarray(error_m)
    velocity = VELOCITY_M_S + np.array([0.3, 0.0, -0.4])
    attitude = Rotation.from_rotvec([np.radians(0.2), 0.0, 0.0]) * ATTITUDE
    return PositionEstimate(
        PositionOutcome.VALID, time_s + IMU_OFFSET_S, position, velocity, attitude, covariance, details
    )


def _refusal(time_s: float, outcome: PositionOutcome = PositionOutcome.NO_COARSE_FIX) -> PositionEstimate:
    return PositionEstimate(outcome, time_s + IMU_OFFSET_S, details=LocalisationDetails("coarse"))


def _answers(*estimates: PositionEstimate) -> StreamAnswers[PositionEstimate]:
    """Return the answers to images and the final one; the second image takes 0.7 s, the others 0.1 s."""
    image_s = tuple(0.7 if number == 1 else 0.1 for number in range(len(estimates) - 1))
    return StreamAnswers(estimates[:-1], estimates[-1], image_s)


def _row(*estimates: PositionEstimate, **changes: Any) -> dict[str, Any]:
    return dict(answer_row(_make_descent(**changes), _answers(*estimates)))


def test_errors_are_relative_to_map_and_world() -> None:
    """The map is shifted by (30, -40) m: the reference on the map is the true position plus the shift."""
    estimate = _estimate(6.0, [3.0, -4.0, 5.0])
    errors = EstimateErrors.from_estimate(estimate, _StraightFlight().state(6.0), _make_map_truth())
    # rounding of coordinates of kilometres
    np.testing.assert_allclose(errors.position_m, [3.0, -4.0, 5.0], atol=1e-9)
    np.testing.assert_allclose(errors.world_m, [33.0, -44.0], atol=1e-9)
    assert errors.horizontal_m == pytest.approx(5.0)
    assert errors.velocity_m_s == pytest.approx(0.5)
    assert errors.attitude_deg == pytest.approx(0.2)
    np.testing.assert_allclose(errors.sd_m, [2.0, 3.0, 5.0])
    assert errors.time_s == 6.0 + IMU_OFFSET_S


def test_reference_position_includes_the_map_distortion() -> None:
    estimate = _estimate(6.0, [3.0, 0.0, 0.0])
    errors = EstimateErrors.from_estimate(estimate, _StraightFlight().state(6.0), _make_map_truth(SHIFT_M, 7.0))
    np.testing.assert_allclose(errors.position_m, [-4.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(errors.world_m, [33.0, -40.0], atol=1e-9)


def test_nees_uses_the_full_horizontal_covariance() -> None:
    covariance = COVARIANCE.copy()
    covariance[:2, :2] = [[4.0, 3.0], [3.0, 9.0]]
    errors = EstimateErrors.from_estimate(
        _estimate(6.0, [2.0, 3.0, 50.0], covariance), _StraightFlight().state(6.0), _make_map_truth()
    )
    # the inverse of [[4, 3], [3, 9]] is [[9, -3], [-3, 4]] / 27: (36 - 36 + 36) / 27
    assert errors.nees == pytest.approx(36.0 / 27.0)


def test_refusal_has_no_errors() -> None:
    with pytest.raises(ValueError, match="the estimate is UNCERTAIN; allowed: VALID"):
        EstimateErrors.from_estimate(
            _refusal(1.0, PositionOutcome.UNCERTAIN), _StraightFlight().state(1.0), _make_map_truth()
        )
    errors = compute_errors(_make_descent(), _answers(_refusal(2.0), _estimate(6.0, [1.0, 0.0, 0.0])))
    assert errors[0] is None
    assert errors[1] is not None


def test_truth_is_at_the_time_of_the_tag_without_the_clock_offset() -> None:
    (error,) = compute_errors(_make_descent(), _answers(_estimate(6.0, [0.0, 0.0, 0.0])))
    np.testing.assert_allclose(error.position_m, 0.0, atol=1e-9)
    (wrong,) = compute_errors(_make_descent(imu_offset_s=0.0), _answers(_estimate(6.0, [0.0, 0.0, 0.0])))
    # half a second at 10, 5 and -90 m/s
    np.testing.assert_allclose(wrong.position_m, -0.5 * VELOCITY_M_S, atol=1e-9)


def test_row_of_a_located_descent() -> None:
    details = [LocalisationDetails("fine", inliers=count) for count in (40, 90, 60)]
    coarse_m = _estimate(6.0, [30.0, -40.0, 0.0]).position_m
    assert coarse_m is not None
    details[0] = replace(details[0], coarse_position_m=coarse_m[:2])
    row = _row(
        _refusal(2.0),
        _estimate(6.0, [6.0, 8.0, 0.0], details=details[0]),
        _estimate(9.4, [0.0, 3.0, 0.0], details=details[1]),
        _estimate(14.0, [0.0, 20.0, 0.0], details=details[2]),
        _estimate(END_S, [3.0, 4.0, -2.0]),
    )
    assert row["coarse_error_m"] == pytest.approx(50.0)
    assert row["fix_after_s"] == 6.5
    assert row["fixed_in_time"] is True
    assert row["position_error_at_10_s_m"] == pytest.approx(3.0)
    assert row["position_error_m"] == pytest.approx(5.0)
    assert row["position_error_max_m"] == pytest.approx(20.0)
    assert [row[f"position_error_{axis}_m"] for axis in ("east", "north", "up")] == pytest.approx([3.0, 4.0, -2.0])
    assert [row[f"position_sd_{axis}_m"] for axis in ("east", "north", "up")] == pytest.approx([2.0, 3.0, 5.0])
    assert row["position_error_world_m"] == pytest.approx(np.hypot(33.0, -36.0))
    assert row["position_nees"] == pytest.approx(9.0 / 4.0 + 16.0 / 9.0)
    assert (row["velocity_error_m_s"], row["attitude_error_deg"]) == (pytest.approx(0.5), pytest.approx(0.2))
    assert (row["valid_images"], row["false_fix"]) == (3, False)
    assert (row["inliers_median"], row["inliers_min"]) == (60.0, 40.0)
    assert (row["image_time_max_s"], row["image_time_median_s"]) == (0.7, 0.1)


@pytest.mark.parametrize(("error_m", "is_false"), [(REQUIRED_M - 0.01, False), (REQUIRED_M + 0.01, True)])
def test_false_fix_is_an_error_above_40_m_of_any_estimate(error_m: float, is_false: bool) -> None:
    exact, wrong = _estimate(9.0, [0.0, 0.0, 0.0]), _estimate(6.0, [0.6 * error_m, -0.8 * error_m, 0.0])
    assert _row(wrong, exact, exact)["false_fix"] is is_false
    assert _row(exact, exact, wrong)["false_fix"] is is_false
    # also if the estimator withdraws the position later
    assert _row(wrong, _refusal(9.0, PositionOutcome.INCONSISTENT), _refusal(END_S))["false_fix"] is is_false
    # a height error does not make a fix false
    assert _row(exact, _estimate(9.0, [0.0, 0.0, 500.0]))["false_fix"] is False


def test_first_position_after_10_s_is_late() -> None:
    """The limit of 10 s applies to time tags: the third image, 9.9 s after the start, has the tag 10.4 s."""
    row = _row(_refusal(2.0), _refusal(6.0), _estimate(9.9, [1.0, 0.0, 0.0]), _estimate(END_S, [2.0, 0.0, 0.0]))
    assert row["fixed_in_time"] is False
    assert np.isnan(row["position_error_at_10_s_m"])
    assert row["fix_after_s"] == pytest.approx(10.4)
    assert row["position_error_m"] == pytest.approx(2.0)
    in_time = _row(_estimate(10.0 - IMU_OFFSET_S, [1.0, 0.0, 0.0]), _refusal(END_S))
    assert in_time["fixed_in_time"] is True
    assert in_time["position_error_at_10_s_m"] == pytest.approx(1.0)


def test_position_that_is_withdrawn_before_10_s_is_not_available() -> None:
    withdrawn = _row(_estimate(2.0, [1.0, 0.0, 0.0]), _refusal(6.0), _estimate(14.0, [2.0, 0.0, 0.0]))
    assert (withdrawn["fixed_in_time"], withdrawn["position_reported"]) == (False, True)
    assert np.isnan(withdrawn["position_error_at_10_s_m"])
    assert withdrawn["fix_after_s"] == pytest.approx(2.5)
    restored = _row(_estimate(2.0, [1.0, 0.0, 0.0]), _refusal(6.0), _estimate(9.4, [2.0, 0.0, 0.0]), _refusal(END_S))
    assert restored["fixed_in_time"] is True
    assert restored["position_error_at_10_s_m"] == pytest.approx(2.0)


def test_row_of_refusals_has_nan_errors() -> None:
    row = _row(_refusal(2.0), _refusal(6.0), _refusal(END_S))
    assert (row["fixed_in_time"], row["false_fix"], row["valid_images"]) == (False, False, 0)
    numbers = {name for name, value in row.items() if isinstance(value, float) and np.isnan(value)}
    assert numbers == {
        "coarse_error_m",
        "fix_after_s",
        *(f"position_error_{name}_m" for name in ("at_10_s", "max", "east", "north", "up", "world")),
        "position_error_m",
        *(f"position_sd_{name}_m" for name in ("east", "north", "up")),
        "velocity_error_m_s",
        "attitude_error_deg",
        "position_nees",
        "inliers_median",
        "inliers_min",
    }


def test_rows_have_equal_columns() -> None:
    valid, refused, empty = _row(_estimate(6.0, [0.0] * 3)), _row(_refusal(6.0)), _row(_refusal(END_S))
    assert valid.keys() == refused.keys() == empty.keys()


def test_products_of_valid_and_refused_estimates() -> None:
    pixels, flags = np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([True, False])
    details = LocalisationDetails("fine", None, 1, pixels, 0.1 * pixels, flags)
    answers = _answers(
        _refusal(2.0), _estimate(6.0, [3.0, 4.0, 5.0], details=details), _estimate(END_S, [1.0, 2.0, 3.0])
    )
    stored = case_products(_make_descent(images=_make_images(IMAGE_TIMES_S[:2])), answers)
    assert stored["outcomes"] == ["NO_COARSE_FIX", "VALID", "VALID"]
    assert np.isnan(stored["track"][0]).all()
    np.testing.assert_allclose(stored["track"][1], [6.5, 3.0, 4.0, 5.0, 2.0, 3.0, 5.0], atol=1e-9)
    np.testing.assert_array_equal(stored["inliers"], [np.nan, 1.0, np.nan])
    expected = np.array([START_M[:2] + VELOCITY_M_S[:2] * time_s + SHIFT_M for time_s in IMAGE_TIMES_S])
    np.testing.assert_allclose(stored["true_xy_m"], expected)
    np.testing.assert_allclose(stored["estimated_xy_m"][1] - expected[1], [3.0, 4.0], atol=1e-9)
    assert np.isnan(stored["estimated_xy_m"][0]).all()
    # outer borders of 8 columns and 5 rows of pixels of 6 m
    np.testing.assert_allclose(stored["map_extent_m"], [-13.0, 35.0, 17.0, 47.0])
    assert stored["map"].dtype == np.uint8
    np.testing.assert_array_equal(stored["landmarks_px"], pixels)
    np.testing.assert_array_equal(stored["landmarks_used"], flags)
    assert (stored["image_1"][0, 0], stored["image_2"][0, 0]) == (1, 2)
    assert pack_products(stored).size > 0


def test_landmarks_are_those_of_the_last_image_if_its_tag_is_earlier() -> None:
    """The clock's errors exchange the tags of the last two images: the second estimate answers the last image."""
    flags = np.ones(1, dtype=bool)
    estimates = [
        _estimate(
            time_s,
            [0.0, 0.0, 0.0],
            details=LocalisationDetails("fine", measured_px=np.full((1, 2), time_s), residuals_px=None, used=flags),
        )
        for time_s in (2.0, 6.0, 9.9)
    ]
    images = _make_images((2.0, 9.9, 6.0))
    stored = case_products(_make_descent(images=images), _answers(*estimates, _refusal(END_S)))
    assert stored["image_2"][0, 0] == 3
    np.testing.assert_array_equal(stored["landmarks_px"], [[6.0, 6.0]])


def test_products_without_images() -> None:
    stored = case_products(_make_descent(images=()), _answers(_refusal(END_S)))
    assert stored["track"].shape == (1, 7)
    assert "image_1" not in stored
    assert "landmarks_px" not in stored
    assert pack_products(stored).size > 0
