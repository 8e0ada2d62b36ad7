"""Tests of the map-relative estimator and of the baselines on images of a small synthetic map."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
import scipy.ndimage
from scipy.spatial import cKDTree

from marsyard.algorithms.localisation.baselines import FeatureEstimator, InertialEstimator
from marsyard.algorithms.localisation.details import LocalisationDetails
from marsyard.algorithms.localisation.estimator import MapRelativeEstimator
from marsyard.algorithms.localisation.interface import PositionOutcome
from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.algorithms.localisation.sift_pose import MAX_DISTANCE_RATIO, extract_map_features, match_descriptors
from marsyard.sim.measurements import DetectorImage
from tests.algorithms.localisation.synthetic_flight import (
    ATTITUDE,
    ERROR_M,
    FLAT_MAP,
    VELOCITY_M_S,
    descend,
    list_outcomes,
    make_image,
    make_images,
    position_error_m,
    true_position,
)
from tests.algorithms.localisation.synthetic_map import Scene, make_camera, make_scene, trace_image

NO_COARSE_FIX, VALID = PositionOutcome.NO_COARSE_FIX, PositionOutcome.VALID


@cache
def _scene(seed: int) -> Scene:
    """Terrain of 4.6 km: at 1700 m the camera sees 3.6 km."""
    return make_scene(seed=seed, size=768, relief_m=40.0)


@cache
def _traced_images() -> tuple[DetectorImage, ...]:
    """Images of the first terrain from the true positions."""
    camera = make_camera(256)
    return tuple(
        make_image(time_s, trace_image(_scene(1), camera, true_position(time_s), ATTITUDE), camera)
        for time_s in (1.0, 2.0, 3.0, 4.0)
    )


def test_inertial_baseline_propagates_the_initial_state() -> None:
    estimates = list(descend(InertialEstimator(), FLAT_MAP, make_images(6)))
    assert set(list_outcomes(estimates)) == {VALID}
    deviations = []
    for estimate in estimates:
        assert estimate.position_m is not None
        assert estimate.velocity_m_s is not None
        assert estimate.covariance is not None
        # tolerance: rounding of the sums of 600 increments
        np.testing.assert_allclose(estimate.position_m, true_position(estimate.time_s) - ERROR_M, atol=1e-6)
        np.testing.assert_allclose(estimate.velocity_m_s, VELOCITY_M_S, atol=1e-9)
        assert (estimate.world_from_body.inv() * ATTITUDE).magnitude() < 1e-9
        # sd of 0.1 m/s for up to 6 s; the attitude's 1 mrad adds 0.5 g t^2 1e-3 = 0.07 m
        expected = np.hypot(100.0, 0.1 * estimate.time_s)
        assert np.sqrt(estimate.covariance[0, 0]) == pytest.approx(expected, abs=1e-3)
        deviations.append(estimate.covariance[0, 0])
    assert np.all(np.diff(deviations[:-1]) > 0.0)


def test_stages_find_the_position_on_a_synthetic_map() -> None:
    estimates = list(descend(MapRelativeEstimator(), _scene(1).map_product, _traced_images()))
    assert list_outcomes(estimates) == [NO_COARSE_FIX, NO_COARSE_FIX, VALID, VALID, VALID]
    # images without noise and exact attitude: below a map pixel of 6 m
    assert max(position_error_m(estimate) for estimate in estimates[2:]) < 3.0


def test_stages_find_no_position_on_an_unrelated_map() -> None:
    estimates = list(descend(MapRelativeEstimator(), _scene(2).map_product, _traced_images()))
    assert set(list_outcomes(estimates)) == {NO_COARSE_FIX}


def test_features_find_the_position_on_a_synthetic_map() -> None:
    estimates = list(descend(FeatureEstimator(), _scene(1).map_product, _traced_images()[:2]))
    assert list_outcomes(estimates) == [VALID] * 3
    for estimate in estimates:
        assert estimate.position_m is not None
        error = estimate.position_m[:2] - true_position(estimate.time_s)[:2]
        # features at the working scale of about 13 m a pixel, and no use of the attitude
        assert np.hypot(*error) < 40.0
    details = estimates[0].details
    assert isinstance(details, LocalisationDetails)
    assert details.inliers is not None
    assert details.inliers >= LvsOptions().min_matches


@pytest.mark.slow
def test_features_find_no_position_on_an_unrelated_map() -> None:
    estimates = list(descend(FeatureEstimator(), _scene(2).map_product, _traced_images()[:2]))
    assert list_outcomes(estimates) == [NO_COARSE_FIX] * 3


def test_features_need_contrast_and_an_altitude() -> None:
    """A uniform map and a uniform image have no features; without an altitude the scale is not known."""
    complete = _scene(1).map_product
    product = replace(
        complete, appearance=complete.appearance[:200, :200], elevation_m=complete.elevation_m[:200, :200]
    )
    assert set(list_outcomes(list(descend(FeatureEstimator(), FLAT_MAP, _traced_images()[:1])))) == {NO_COARSE_FIX}
    assert set(list_outcomes(list(descend(FeatureEstimator(), product, make_images(1))))) == {NO_COARSE_FIX}
    without = descend(FeatureEstimator(), product, _traced_images()[:1], with_altitudes=False)
    assert set(list_outcomes(list(without))) == {NO_COARSE_FIX}


def test_features_of_strips_are_those_of_the_whole_map() -> None:
    noise = np.random.default_rng(5).standard_normal((900, 400))
    appearance = 2.0 * scipy.ndimage.gaussian_filter(noise, 2.0) + 5.0 * scipy.ndimage.gaussian_filter(noise, 5.0)
    low, high = np.quantile(appearance, (0.01, 0.99))
    image = np.clip(255.0 * (appearance - low) / (high - low), 0.0, 255.0).astype(np.uint8)
    keypoints, descriptors = cv2.SIFT.create(nfeatures=0).detectAndCompute(image, None)
    # more features than the map has
    pixels, strip_descriptors = extract_map_features(appearance, 100_000)
    assert len(pixels) == len(strip_descriptors)
    # larger features reach beyond the margin; a position can have several descriptors, with different orientations
    small = np.array([keypoint.size < 20.0 for keypoint in keypoints])
    positions = np.array([keypoint.pt for keypoint in keypoints])[small]
    tree = cKDTree(np.hstack([pixels, strip_descriptors]))
    distances = np.asarray(tree.query(np.hstack([positions, descriptors[small]]))[0])
    assert len(positions) > 1000
    # the descriptors have a length of 512; with this seed and another one, at most 0.2 % of all features and 1.4 % of
    # those next to the edges of the strips differ by more than 1
    assert np.mean(distances < 1.0) > 0.995
    at_edges = np.min(np.abs(positions[:, 1:] - np.array([225.0, 450.0, 675.0])), axis=1) < 10.0
    assert np.mean(distances[at_edges] < 1.0) > 0.97


def test_matches_equal_those_of_the_brute_force_matcher() -> None:
    rng = np.random.default_rng(7)
    map_descriptors = rng.integers(0, 256, (900, 128)).astype(np.float32)
    noisy = map_descriptors[rng.choice(900, 600, replace=False)] + rng.normal(0.0, 30.0, (600, 128))
    descriptors = np.clip(np.rint(noisy), 0, 255).astype(np.float32)
    descriptors[::3] = rng.integers(0, 256, (200, 128))
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(descriptors, map_descriptors, k=2)
    expected = [
        (first.queryIdx, first.trainIdx)
        for first, second in pairs
        if first.distance < MAX_DISTANCE_RATIO * second.distance
    ]
    indices, map_indices = match_descriptors(descriptors, map_descriptors)
    assert list(zip(indices.tolist(), map_indices.tolist(), strict=True)) == expected
    assert len(expected) > 300
    assert match_descriptors(descriptors, map_descriptors[:1])[0].size == 0
