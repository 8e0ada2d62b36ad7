"""Tests of loss criteria, states and hand-off of tracking, of placement, and of the accuracy formulas (Table I)."""

from itertools import pairwise

import numpy as np
import pytest

from marsyard.algorithms.interface import TargetLoss, TargetUpdate, TrackingState
from marsyard.algorithms.vtt.accuracy import (
    NAVCAM,
    PANCAM,
    StereoDesign,
    accuracy_row,
    drift_error_m,
    round_half_up,
    stereo_range_error_m,
    table_1,
    tracked_approach_error_m,
)
from marsyard.algorithms.vtt.arm import (
    GoalCriterion,
    HandOffOutcome,
    PlacementOutcome,
    hand_off,
    place_instrument,
    tool_overlap_m,
)
from marsyard.algorithms.vtt.losses import Distances, MatchEvidence, Tolerances, find_losses, next_state, tolerances
from marsyard.algorithms.vtt.options import VttOptions
from marsyard.sim.measurements import MastCalibration
from tests.algorithms.vtt.synthetic_drive import navcam, pancam

OPTIONS = VttOptions()
#: Evidence of a correct match.
GOOD = {"match_score": 0.9, "stereo_score": 0.9, "distance_correction_m": 0.0, "position_correction_m": 0.0}
TOLERANCES = Tolerances(distance_m=0.2, position_m=0.4)


@pytest.mark.parametrize(
    ("criterion", "value", "expected"),
    [
        ("match_score", 0.71, None),
        ("match_score", 0.69, TargetLoss.LOW_MATCH_SCORE),
        ("stereo_score", 0.71, None),
        ("stereo_score", 0.69, TargetLoss.LOW_STEREO_SCORE),
        ("distance_correction_m", -0.19, None),
        ("distance_correction_m", -0.21, TargetLoss.DISTANCE_JUMP),
        ("distance_correction_m", 0.21, TargetLoss.DISTANCE_JUMP),
        ("position_correction_m", 0.39, None),
        ("position_correction_m", 0.41, TargetLoss.POSITION_JUMP),
    ],
)
def test_target_is_lost_if_one_criterion_is_exceeded(criterion: str, value: float, expected: TargetLoss | None) -> None:
    result = find_losses(MatchEvidence(**(GOOD | {criterion: value})), TOLERANCES, OPTIONS)
    assert result == (() if expected is None else (expected,))


def test_all_violated_criteria_are_reported() -> None:
    assert find_losses(MatchEvidence(0.1, 0.1, 9.0, 9.0), TOLERANCES, OPTIONS) == (
        TargetLoss.LOW_MATCH_SCORE,
        TargetLoss.LOW_STEREO_SCORE,
        TargetLoss.DISTANCE_JUMP,
        TargetLoss.POSITION_JUMP,
    )


def test_tolerances_match_the_formula() -> None:
    # Range error of the MER navcam for 1 px of disparity: R^2 / (1222.5 px x 0.2 m), which is 0.409 m at 10 m and
    # 0.331 m at 9 m. The step of 1 m adds 20 %, 0.2 m; the direction error is 0.03 rad x 9 m = 0.27 m. The minimum of
    # the tolerance is 0.05 m.
    result = tolerances(Distances(10.0, 10.0, 9.0, 1.0, 1.0), navcam().left, navcam().right, OPTIONS)
    assert result.distance_m == pytest.approx(0.05 + np.sqrt(0.409**2 + 0.3313**2 + 0.2**2), abs=1e-3)
    assert result.position_m == pytest.approx(0.05 + np.sqrt(0.409**2 + 0.3313**2 + 0.2**2 + 0.27**2), abs=1e-3)


NORMAL, LOST, FAILURE = TrackingState.NORMAL, TrackingState.LOST, TrackingState.FAILURE


@pytest.mark.parametrize(
    ("limit", "results", "expected"),
    [
        (2, [True, False, False, True, False], [NORMAL, LOST, LOST, NORMAL, LOST]),
        (2, [False, False, False, True], [LOST, LOST, FAILURE, FAILURE]),
        (2, [False, True, False, False, True], [LOST, NORMAL, LOST, LOST, NORMAL]),
        (1, [False, False, True], [LOST, FAILURE, FAILURE]),
        (0, [True, False, True], [NORMAL, FAILURE, FAILURE]),
    ],
)
def test_state_transitions_match_figure_6(limit: int, results: list[bool], expected: list[TrackingState]) -> None:
    """`results`: whether the tracker located the target in each image."""
    state, lost_count, states = NORMAL, 0, []
    for is_tracked in results:
        state, lost_count = next_state(state, lost_count, is_tracked, limit)
        states.append(state)
    assert states == expected
    assert next_state(TrackingState.NO_TARGET, 0, True, limit) == (TrackingState.NO_TARGET, 0)


def test_arm_receives_only_tracked_targets_at_the_goal() -> None:
    target_m, goal = np.array([1.5, 0.0, 0.1]), GoalCriterion(distance_m=1.5, tolerance_m=0.05)
    tracked_target = TargetUpdate(NORMAL, (), target_m)
    at_goal = hand_off(tracked_target, goal, navcam())
    assert at_goal.outcome is HandOffOutcome.HANDED_OFF
    np.testing.assert_array_equal(at_goal.target.position_rover, target_m)
    # Eq. 5 of the tracking paper at 1.735 m from the mast's elevation axis, which is 0.35 m ahead of the rover's origin
    # and 1.4 m above it: 1.23 cm of stereo error, and 0.35 cm for a drift of 2.5 px.
    assert at_goal.target.error_m == pytest.approx(np.hypot(1.735**2 / 244.5, 2.5 * 1.735 / 1222.5), rel=0.01)
    lost_target = hand_off(TargetUpdate(LOST, (TargetLoss.LOW_MATCH_SCORE,), target_m), goal, navcam())
    assert (lost_target.outcome, lost_target.target) == (HandOffOutcome.NOT_TRACKED, None)
    away_from_goal = hand_off(TargetUpdate(NORMAL, (), np.array([1.6, 0.0, 0.1])), goal, navcam())
    assert (away_from_goal.outcome, away_from_goal.target) == (HandOffOutcome.NOT_AT_GOAL, None)


VIEWPOINT = np.array([0.0, 0.0, 1.5])
TARGET = np.array([2.0, 0.1, 0.3])


def make_surface(ridge_m: float = 1.0, ridge_height_m: float = 0.0) -> np.ndarray:
    """Return level ground around the target every 2 mm, higher by `ridge_height_m` beyond `ridge_m` along x."""
    steps = np.arange(-0.15, 0.15, 0.002)
    x, y = (values.ravel() for values in np.meshgrid(steps, steps))
    heights = np.where(x > ridge_m, ridge_height_m, 0.0)
    return np.asarray(TARGET + np.column_stack([x, y, heights]))


def test_instrument_is_placed_on_flat_ground() -> None:
    placement = place_instrument(make_surface(), TARGET, VIEWPOINT)
    assert placement.outcome is PlacementOutcome.PLACED
    assert placement.position_rover == pytest.approx(TARGET, abs=1e-9)
    assert placement.normal_rover == pytest.approx([0.0, 0.0, 1.0], abs=1e-9)


def test_target_next_to_a_step_is_reselected_away_from_it() -> None:
    """The tools reach 5 cm: with a step of 3 cm at 4.5 cm they collide, 6 mm away they do not."""
    surface = make_surface(0.045, 0.03)
    assert tool_overlap_m(surface, TARGET, np.array([0.0, 0.0, 1.0])) == pytest.approx(0.015)
    placement = place_instrument(surface, TARGET, VIEWPOINT)
    assert placement.outcome is PlacementOutcome.RESELECTED
    moved = placement.position_rover - TARGET
    assert 0.004 <= -moved[0] <= 0.008
    # the nearest free position is chosen
    assert np.linalg.norm(moved) == pytest.approx(0.006, abs=0.0021)


def test_no_position_within_8_mm_is_a_collision() -> None:
    # the step is 2.5 cm from the target; the tools would have to move by 2.5 cm
    assert place_instrument(make_surface(0.025, 0.03), TARGET, VIEWPOINT).outcome is PlacementOutcome.COLLISION
    # a step lower than the clearance of 1.5 cm is permitted
    assert place_instrument(make_surface(0.025, 0.01), TARGET, VIEWPOINT).outcome is PlacementOutcome.PLACED


def test_too_few_points_are_no_surface() -> None:
    assert place_instrument(np.empty((0, 3)), TARGET, VIEWPOINT).outcome is PlacementOutcome.NO_SURFACE
    ring = make_surface()
    ring = ring[np.linalg.norm(ring - TARGET, axis=1) > 0.035]
    assert place_instrument(ring, TARGET, VIEWPOINT).outcome is PlacementOutcome.NO_SURFACE
    assert np.isnan(tool_overlap_m(ring, TARGET, np.array([0.0, 0.0, 1.0])))


def test_table_1_matches_printed_digits() -> None:
    pancam, navcam = table_1()
    assert (pancam.designation_cm, pancam.untracked_cm) == (9.7, 18.7)
    assert (navcam.designation_cm, navcam.untracked_cm) == (38.8, 42.0)
    assert pancam.tracked_formula == "sqrt(0.4^2 + (0.06 N)^2)"
    assert navcam.tracked_formula == "sqrt(1.6^2 + (0.16 N)^2)"
    # "Even with an extreme 10-pixel drift, ... 0.7 cm for pancam and 2.3 cm with navcam."
    assert [round_half_up(row.tracked_cm(10.0), 1) for row in (pancam, navcam)] == [0.7, 2.3]


def test_errors_scale_with_range_and_focal_length() -> None:
    assert stereo_range_error_m(6.0, 1000.0, 0.2) == pytest.approx(9.0 * stereo_range_error_m(2.0, 1000.0, 0.2))
    # range^2 x disparity error / (focal length x baseline): 4 m2 x 0.5 px / (1000 px x 0.2 m)
    assert stereo_range_error_m(2.0, 1000.0, 0.2, 0.5) == pytest.approx(0.01)
    # A pixel at 2 m: 0.58 mm and 1.55 mm.
    assert drift_error_m(2.0, PANCAM.focal_px, 1.0) == pytest.approx(0.58e-3, abs=5e-6)
    assert tracked_approach_error_m(0.03, 0.04) == pytest.approx(0.05)


@pytest.mark.parametrize(
    ("value", "digits", "expected"),
    [(38.75, 1, 38.8), (38.749999999999993, 1, 38.8), (1.55, 1, 1.6), (0.155, 2, 0.16), (-0.25, 1, -0.3)],
)
def test_half_digits_are_rounded_away_from_zero(value: float, digits: int, expected: float) -> None:
    assert round_half_up(value, digits) == expected


def test_state_without_target_is_unchanged() -> None:
    assert next_state(TrackingState.NO_TARGET, 0, True, 2) == (TrackingState.NO_TARGET, 0)


@pytest.mark.parametrize("mast", [navcam(), pancam()])
def test_stereo_noise_rarely_loses_a_target(mast: MastCalibration) -> None:
    # 1 px (3 sigma) in two disparities and 20 % (3 sigma) of a 1 m step. Less than 0.3 % exceed the root sum square
    # before the constant term of the tolerance is added.
    rng = np.random.default_rng(1)
    # range = focal length x baseline / disparity
    range_disparity = mast.left.focal_lengths[0] * np.linalg.norm(mast.left.c - mast.right.c)
    old, new = (range_disparity / (range_disparity / r + rng.normal(0.0, 1.0 / 3.0, 100_000)) for r in (10.0, 9.0))
    correction = new - (old - 1.0 + rng.normal(0.0, 0.2 / 3.0, 100_000))
    tolerance = tolerances(Distances(10.0, 10.0, 9.0, 1.0, 1.0), mast.left, mast.right, OPTIONS)
    assert np.mean(np.abs(correction) > tolerance.distance_m) < 0.003
    assert np.quantile(np.abs(correction), 0.99) > tolerance.distance_m * 0.45  # the tolerance is not much too large


def test_table_1_requires_the_specified_pixel_pitch() -> None:
    # The text of the paper derives a pitch of 4.69 um from the sensor size (4.8 mm / 1024); with this pitch the errors
    # would be 9.8 and 39.1 cm.
    designs = [
        StereoDesign(design.name, design.focal_length_m, 4.8e-3 / 1024, design.baseline_m)
        for design in (PANCAM, NAVCAM)
    ]
    assert [accuracy_row(design).designation_cm for design in designs] == [9.8, 39.1]


def test_ten_pixel_drift_matches_the_paper() -> None:
    # "Even with an extreme 10-pixel drift, ... 0.7 cm for pancam and 2.3 cm with navcam."
    pancam, navcam = table_1()
    assert round_half_up(pancam.tracked_cm(10.0), 1) == 0.7
    assert round_half_up(navcam.tracked_cm(10.0), 1) == 2.3


def test_tolerances_decrease_with_target_distance() -> None:
    distances = [10.0 * 0.9**i for i in range(16)]
    step_tolerances = [
        tolerances(Distances(10.0, old, new, old - new, 10.0 - new), navcam().left, navcam().right, OPTIONS)
        for old, new in pairwise(distances)
    ]
    assert np.all(np.diff([step.distance_m for step in step_tolerances]) < 0.0)
    assert step_tolerances[-1].distance_m < 0.11
    # The initial designation uncertainty and the rover drift remain: the tolerance is never below either of them.
    # 0.409 m is the range error of the designation at 10 m.
    assert min(step.position_m for step in step_tolerances) > 0.409
