"""Tests of the consistency check of coarse matching: patch offsets against the covariance of the state.

The cases are offsets with the stated errors, a wrong attitude, outliers, and images of the same ground.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from marsyard.algorithms.localisation.consistency import (
    OffsetErrors,
    OffsetTest,
    PatchGeometry,
    check_offsets,
    estimate_position_error,
    offset_covariance,
)

HEIGHT_M, SIDE_M = 3000.0, 1000.0
#: Standard deviations of position (m), velocity (m/s) and attitude (rad), per axis.
STATE_SD = np.repeat([800.0, 1.0, 2e-3], 3)
#: Time from each of the three images to the last one, s.
AGES_S = np.array([6.6, 3.3, 0.0])
FALSE_REFUSAL = 1e-4  #: Probability that correct patches are refused.
TEST = OffsetTest(outlier_probability=1e-3, false_refusal=FALSE_REFUSAL, chance_agreement=0.126)
#: Ground points relative to the nadir: up to 35 deg off nadir; the areas do not overlap.
POINTS_M = np.array([[0.0, 0.0], [1500.0, 200.0], [-1300.0, 700.0], [200.0, -1600.0], [-300.0, 1700.0]])


def make_patches() -> PatchGeometry:
    """Five patches on level ground in each of three images."""
    images = np.repeat(np.arange(3), 5)
    # the ground moves below the lander: each image shows other ground
    centres = np.tile(POINTS_M, (3, 1)) + 10_000.0 * images[:, np.newaxis]
    lines = np.column_stack([np.tile(POINTS_M, (3, 1)), np.full(15, -HEIGHT_M)])
    return PatchGeometry(images, centres, np.full(15, SIDE_M), lines, AGES_S[images])


ERRORS = OffsetErrors(np.full(15, 60.0), distortion_m=6.0, elevation_m=5.0, matching_m=3.5)
COVARIANCE = offset_covariance(make_patches(), np.diag(STATE_SD**2), ERRORS)


def find_offsets(state_errors: np.ndarray, height_errors_m: np.ndarray) -> np.ndarray:
    """Compute the exact offsets of the patches for errors of the state (true minus estimated) and of the heights.

    The true ray through the patch's pixel is intersected with the ground; no linearisation.
    """
    patches = make_patches()
    turned = Rotation.from_rotvec(state_errors[6:]).apply(patches.lines_m)
    heights = HEIGHT_M + height_errors_m[patches.images]
    hits = turned[:, :2] / -turned[:, 2:] * heights[:, np.newaxis]
    position = state_errors[:2] - patches.ages_s[:, np.newaxis] * state_errors[3:5]
    return np.asarray(position + hits - patches.lines_m[:, :2])


def draw(
    rng: np.random.Generator, attitude_rad: np.ndarray | None = None, state: np.ndarray | None = None
) -> np.ndarray:
    """Draw errors with the stated standard deviations, with other errors of attitude or state if they are given."""
    state = STATE_SD * rng.standard_normal(9) if state is None else state.copy()
    if attitude_rad is not None:
        state[6:] = attitude_rad
    offsets = find_offsets(state, 60.0 * (rng.standard_normal() + rng.standard_normal(3)))
    tangents = make_patches().lines_m[:, :2] / HEIGHT_M
    offsets += ERRORS.elevation_m * tangents * rng.standard_normal((15, 1))
    return np.asarray(offsets + np.hypot(ERRORS.distortion_m, ERRORS.matching_m) * rng.standard_normal((15, 2)))


def test_offsets_with_the_stated_errors_are_chi_square() -> None:
    """The ray geometry is exact in the drawn offsets: the linear model has the right signs and derivatives."""
    rng = np.random.default_rng(1)
    weights = np.linalg.inv(COVARIANCE)
    squares = np.array([o @ weights @ o for o in (draw(rng).ravel() for _ in range(400))])
    # 15 patches x 2 axes: the mean is 30, with a standard deviation of sqrt(60 / 400) for 400 draws; the tolerance is
    # 4 sigma plus 1 % for the effect of linearisation
    assert squares.mean() == pytest.approx(30.0, abs=4.0 * np.sqrt(60.0 / 400.0) + 0.3)
    # 5 % above the 95 % quantile: 4 standard deviations of a binomial number
    assert np.mean(squares > chi2.ppf(0.95, 30)) == pytest.approx(0.05, abs=4.0 * np.sqrt(0.05 * 0.95 / 400.0))


def test_position_error_is_estimated_with_its_covariance() -> None:
    """The normalised square of the estimate's error has the mean 2; its variance is below that of the mean offset."""
    rng, patches, state_covariance = np.random.default_rng(6), make_patches(), np.diag(STATE_SD**2)
    squares, errors, mean_errors = [], [], []
    for _ in range(400):
        state = STATE_SD * rng.standard_normal(9)
        offsets = draw(rng, state=state)
        estimate, covariance = estimate_position_error(offsets, patches, state_covariance, ERRORS)
        errors.append(estimate - state[:2])
        mean_errors.append(offsets.mean(axis=0) - state[:2])
        squares.append(errors[-1] @ np.linalg.solve(covariance, errors[-1]))
    # standard deviation of the mean of 400 draws: sqrt(4 / 400); 1 % for the effect of linearisation
    assert np.mean(squares) == pytest.approx(2.0, abs=4.0 * np.sqrt(4.0 / 400.0) + 0.02)
    assert np.var(errors) < 0.75 * np.var(mean_errors)


def test_stated_errors_are_accepted() -> None:
    rng = np.random.default_rng(2)
    results = [check_offsets(draw(rng), COVARIANCE, 0, TEST) for _ in range(200)]
    assert all(result.is_consistent for result in results)
    # 200 x 15 patches, of which 3 are expected to be removed: outlier_probability is 1e-3
    assert sum(np.count_nonzero(~result.members) for result in results) <= 12


def test_a_wrong_attitude_is_inconsistent() -> None:
    """10 deg of tilt: all patches are displaced by about 530 m, those at 35 deg off nadir by up to 230 m more.

    2 deg of heading: 57 m at a distance of 1.6 km, in opposite directions on both sides.
    """
    rng = np.random.default_rng(3)
    azimuths = rng.uniform(-np.pi, np.pi, 5)
    tilts = np.radians(10.0) * np.column_stack([np.cos(azimuths), np.sin(azimuths), np.zeros(5)])
    for error_rad in (*tilts, np.radians([0.0, 0.0, 2.0])):
        assert not check_offsets(draw(rng, error_rad), COVARIANCE, 0, TEST).is_consistent


def test_an_outlier_is_removed() -> None:
    offsets = draw(np.random.default_rng(4))
    offsets[7] += [80.0, -40.0]  # ten standard deviations
    result = check_offsets(offsets, COVARIANCE, 0, TEST)
    assert result.is_consistent
    np.testing.assert_array_equal(np.flatnonzero(~result.members), [7])


def test_more_outliers_than_chance_explains_are_inconsistent() -> None:
    """P(at least k of k wrong patches are near the others) = 0.126^k: above 1e-4 up to k = 4."""
    wrong, azimuths = np.array([0, 3, 6, 9, 12]), 2.0 * np.pi * np.arange(5) / 5.0
    for count, is_consistent in ((4, True), (5, False)):
        offsets = np.zeros((15, 2))
        offsets[wrong[:count]] = 200.0 * np.column_stack([np.cos(azimuths), np.sin(azimuths)])[:count]
        result = check_offsets(offsets, COVARIANCE, 0, TEST)
        np.testing.assert_array_equal(np.flatnonzero(~result.members), wrong[:count])
        assert result.outlier_probability == pytest.approx(0.126**count)
        assert result.normalised_square < result.limit
        assert result.is_consistent is is_consistent


def test_images_of_the_same_ground_share_the_map_error() -> None:
    """The error of equal squares is equal; half of it is common if they overlap by half; none without overlap."""
    centres = np.array([[0.0, 0.0], [0.0, 0.0], [0.5 * SIDE_M, 0.0], [0.0, SIDE_M]])
    lines = np.tile([0.0, 0.0, -HEIGHT_M], (4, 1))
    patches = PatchGeometry(np.arange(4), centres, np.full(4, SIDE_M), lines, np.zeros(4))
    errors = OffsetErrors(np.zeros(4), distortion_m=6.0, elevation_m=5.0, matching_m=0.0)
    covariance = offset_covariance(patches, np.zeros((9, 9)), errors).reshape(4, 2, 4, 2)
    np.testing.assert_allclose(covariance[0, 0, :, 0], 36.0 * np.array([1.0, 1.0, 0.5, 0.0]))
    np.testing.assert_array_equal(covariance[:, 0, :, 1], 0.0)


def test_a_single_patch_is_tested() -> None:
    result = check_offsets(np.array([[3.0, 0.0]]), np.eye(2), 0, TEST)
    assert result.normalised_square == pytest.approx(9.0)
    assert result.limit == pytest.approx(chi2.isf(FALSE_REFUSAL, 2))
    assert result.is_consistent
