"""Tests of the IMU consistency check of DIMES over combinations of tracks, and of the validity checks of tracks."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.algorithms.dimes.estimator import combine_pairs, propagate_velocity
from marsyard.algorithms.dimes.options import DimesOptions
from marsyard.algorithms.dimes.products import DimesTrack, PairDetails
from marsyard.algorithms.dimes.validity import (
    TrackMetrics,
    ValidityCheck,
    failed_checks,
    rank_combinations,
    track_metrics,
)
from marsyard.algorithms.dimes.views import BinnedView, build_view
from marsyard.algorithms.image.peaks import Peak
from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome
from marsyard.sim.measurements import DetectorImage
from tests.algorithms.synthetic_descent import CAMERA, ROWS_SUMMED, make_calibration, valid_velocity

THRESHOLD = DimesOptions().imu_threshold_m_s
#: Metrics of a track that passes all validity checks.
METRICS = TrackMetrics(contrast=0.02, peak=0.9, peak_width_px=4.0, second_peak_ratio=0.3, on_border=False)


def make_track(pair: int, index: int, velocity: np.ndarray, failures: tuple[ValidityCheck, ...] = ()) -> DimesTrack:
    """Create a track of which only number of pair and template, velocity and failed checks are used."""
    blank = np.zeros((3, 3))
    return DimesTrack(
        pair, index, *(np.zeros(2),) * 3, blank, blank, np.ones(2), blank, METRICS, failures, np.asarray(velocity)
    )


@cache
def make_nadir_view() -> BinnedView:
    """Create a black view from 2 km."""
    image = DetectorImage(np.zeros((256, 1024), dtype=np.uint16), 0.0, CAMERA.bin(1, ROWS_SUMMED), make_calibration())
    return build_view(image, Rotation.identity(), 2000.0, np.array([0.0, 0.0, 1.0]), (256, 256))


def make_pair(*tracks: DimesTrack) -> PairDetails:
    """Create the details of a pair with these tracks; the images are not used."""
    nadir = make_nadir_view()
    return PairDetails(np.zeros((0, 2)), np.zeros((2, 2)), 5.0, tracks, (nadir, nadir))


def combine_tracks(first: list[np.ndarray], second: list[np.ndarray], velocities: np.ndarray) -> VelocityEstimate:
    """Combine valid tracks with these velocities in the first and the second pair, for these IMU velocities."""
    pairs = [
        make_pair(*(make_track(pair, index, velocity) for index, velocity in enumerate(velocities)))
        for pair, velocities in enumerate((first, second))
    ]
    return combine_pairs((pairs[0], pairs[1]), velocities, THRESHOLD)


def test_combinations_are_sorted_by_consistency() -> None:
    velocities = np.array([[40.0, 0.0, -75.0], [41.0, 2.0, -75.0]])
    first = [(0, np.array([5.0, 5.0])), (1, np.array([9.0, 5.0]))]
    result = rank_combinations(first, [(1, np.array([6.0, 7.0]))], velocities)
    assert [(combination.first, combination.second) for combination in result] == [(0, 1), (1, 1)]
    assert [combination.discrepancy_m_s for combination in result] == pytest.approx([0.0, 4.0])


def test_best_combination_reports_second_pair_velocity() -> None:
    velocities = np.array([[40.0, 0.0, -75.0], [41.0, 2.0, -70.0]])
    answer = combine_tracks(
        [np.array([5.0, 5.0]), np.array([30.0, 5.0])], [np.array([6.5, 7.0]), np.array([6.1, 7.0])], velocities
    )
    assert answer.outcome is VelocityOutcome.VALID
    np.testing.assert_allclose(valid_velocity(answer), [6.1, 7.0])


def test_each_pair_needs_one_track() -> None:
    velocities = np.zeros((2, 3))
    tracks = [np.array([5.0, 5.0])]
    assert combine_tracks(tracks, tracks, velocities).outcome is VelocityOutcome.VALID
    assert combine_tracks(tracks, [], velocities).outcome is VelocityOutcome.NO_TEMPLATE_AREA
    assert combine_tracks(tracks, [np.array([15.0, 5.0])], velocities).outcome is VelocityOutcome.IMU_MISMATCH


def test_discrepancy_at_the_threshold_is_a_mismatch() -> None:
    velocities = np.zeros((2, 3))
    zero_velocity, threshold_velocity = [np.zeros(2)], [np.array([THRESHOLD, 0.0])]
    assert combine_tracks(zero_velocity, threshold_velocity, velocities).outcome is VelocityOutcome.IMU_MISMATCH
    assert combine_tracks(zero_velocity, [0.999 * threshold_velocity[0]], velocities).outcome is VelocityOutcome.VALID


@pytest.mark.parametrize("wrong_pair", [0, 1])
def test_invalid_tracks_are_ignored(wrong_pair: int) -> None:
    # In one pair the only valid track is wrong. In the other pair the wrong track is invalid.
    correct, wrong, failures = np.array([5.0, 5.0]), np.array([25.0, 5.0]), (ValidityCheck.PEAK_HEIGHT,)
    pairs = [
        make_pair(make_track(pair, 0, wrong, failures), make_track(pair, 1, wrong if pair == wrong_pair else correct))
        for pair in range(2)
    ]
    answer = combine_pairs((pairs[0], pairs[1]), np.zeros((2, 3)), THRESHOLD)
    assert answer.outcome is VelocityOutcome.IMU_MISMATCH
    invalid = make_pair(make_track(0, 0, correct, (ValidityCheck.CONTRAST,)))
    answer = combine_pairs((invalid, pairs[1]), np.zeros((2, 3)), THRESHOLD)
    assert answer.outcome is VelocityOutcome.NO_VALID_TRACK


def test_propagation_removes_the_inertial_bias() -> None:
    bias = np.array([6.0, -3.0])
    at_pair, at_firing = np.array([10.0, 2.0]), np.array([14.0, -1.0])
    np.testing.assert_allclose(propagate_velocity(at_pair, at_pair + bias, at_firing + bias), at_firing)


@pytest.mark.parametrize(
    ("change", "check"),
    [
        ({"contrast": 0.001}, ValidityCheck.CONTRAST),
        ({"peak": 0.2}, ValidityCheck.PEAK_HEIGHT),
        ({"peak_width_px": 40.0}, ValidityCheck.PEAK_WIDTH),
        ({"second_peak_ratio": 0.95}, ValidityCheck.SECOND_PEAK),
        ({"on_border": True}, ValidityCheck.SEARCH_BORDER),
        ({"contrast": float("nan")}, ValidityCheck.CONTRAST),
    ],
)
def test_each_metric_beyond_its_limit_fails_its_check(change: dict[str, Any], check: ValidityCheck) -> None:
    assert failed_checks(METRICS, DimesOptions()) == ()
    assert failed_checks(replace(METRICS, **change), DimesOptions()) == (check,)


def test_track_at_each_limit_is_valid() -> None:
    options = DimesOptions()
    limits = (options.min_contrast, options.min_peak, options.max_peak_width_px, options.max_second_peak_ratio)
    assert failed_checks(TrackMetrics(*limits, on_border=False), options) == ()


@pytest.mark.parametrize(
    "invalid",
    [{"template_px": 30}, {"template_px": 3}, {"search_margin_px": 0}, {"grid_step_px": 0}, {"max_off_nadir_rad": 2.0}],
)
def test_invalid_options_are_reported(invalid: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(invalid))):
        DimesOptions(**invalid)


def test_surface_without_positive_peak_fails_the_second_peak_check() -> None:
    metrics = track_metrics(0.02, np.zeros((9, 9)), Peak(4, 4, 0.0, on_border=False), DimesOptions())
    assert metrics.second_peak_ratio == 1.0
    assert ValidityCheck.SECOND_PEAK in failed_checks(metrics, DimesOptions())


def draw_track_errors(rng: np.random.Generator, cases: int) -> np.ndarray:
    """Draw velocity errors of four tracks per case from error formulas, m/s, shape (cases, pair, template, 2).

    The tracks of an image have common errors of altitude, 1 % (3 sigma), and attitude, 0.03 deg (0.5 ms at 60 deg/s).
    The match error is 0.1 m/s per track. Features are within 39 deg of the nadir, at 0.8 altitudes. A feature at
    distance r from the nadir of a camera at height H, with relative altitude error e and tilt error (a, b), is
    displaced by at most e r + H (1 + r^2 / H^2) (a, b).
    """
    heights = np.array([2000.0, 1719.0, 1438.0])
    scale = rng.normal(0.0, 0.01 / 3.0, (cases, 3))
    tilt = rng.normal(0.0, np.radians(0.03), (cases, 3, 2))
    errors = np.empty((cases, 2, 2, 2))
    for pair in range(2):
        radius = 0.8 * heights[pair + 1] * np.sqrt(rng.uniform(0.0, 1.0, (cases, 2, 1)))
        angle = rng.uniform(0.0, 2.0 * np.pi, (cases, 2, 1))
        position = radius * np.concatenate([np.cos(angle), np.sin(angle)], axis=2)
        displacements = []
        for k in (pair, pair + 1):
            stretch = heights[k] * (1.0 + (radius / heights[k]) ** 2)
            displacements.append(scale[:, k, None, None] * position + stretch * tilt[:, k, None, :])
        errors[:, pair] = (displacements[0] - displacements[1]) / 3.75 + rng.normal(0.0, 0.1, (cases, 2, 2))
    return errors


@pytest.mark.slow
@pytest.mark.parametrize("tracks_per_pair", [1, 2])
@pytest.mark.parametrize("wrong_by", [10.0, 20.0, 55.0])
def test_one_wrong_track_rarely_causes_a_wrong_velocity(tracks_per_pair: int, wrong_by: float) -> None:
    # With one of four tracks wrong by at least 10 m/s, 99.5 % of cases report a correct velocity or none.
    rng = np.random.default_rng(12)
    cases = 1000
    errors = draw_track_errors(rng, cases)[:, :, :tracks_per_pair]
    acceptable_count = 0
    for case in range(cases):
        angle = rng.uniform(0.0, 2.0 * np.pi)
        tracks = errors[case].copy()
        tracks[rng.integers(2), rng.integers(tracks_per_pair)] += wrong_by * np.array([np.cos(angle), np.sin(angle)])
        truth, change = rng.uniform(-20.0, 20.0, 2), rng.normal(0.0, 1.0, 2)
        # both IMU velocities have an error of (7, -4) m/s
        inertial = np.zeros((2, 3))
        inertial[:, :2] = truth + np.array([[7.0, -4.0]]) + np.array([[0.0, 0.0], change])
        answer = combine_tracks(list(truth + tracks[0]), list(truth + change + tracks[1]), inertial)
        error = 0.0 if answer.velocity_m_s is None else np.hypot(*(answer.velocity_m_s - truth - change))
        acceptable_count += bool(error <= 5.0)
    assert acceptable_count >= 0.995 * cases
