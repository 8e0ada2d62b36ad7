"""Tests of the map-relative estimator and of the baselines on images of a small synthetic map."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from marsyard.algorithms.localisation.baselines import FeatureEstimator, InertialEstimator
from marsyard.algorithms.localisation.details import LocalisationDetails
from marsyard.algorithms.localisation.estimator import MapRelativeEstimator
from marsyard.algorithms.localisation.interface import PositionOutcome
from marsyard.algorithms.localisation.options import LvsOptions
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
