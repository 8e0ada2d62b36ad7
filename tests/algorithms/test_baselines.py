"""Tests of the baseline velocity estimators on rendered descents, with valid and invalid inputs."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from marsyard.algorithms.dimes import DimesEstimator, DimesOptions
from marsyard.algorithms.dimes.baselines import (
    DEFAULT_COMMON_OPTIONS,
    HomographyEstimator,
    PhaseCorrelationEstimator,
    max_length_change,
    rectify_pair,
)
from marsyard.algorithms.dimes.views import build_views
from marsyard.algorithms.interface import VelocityEstimator, VelocityOutcome
from marsyard.sim.measurements import DescentMeasurements
from tests.algorithms.synthetic_descent import (
    draw_flight,
    draw_stripes,
    draw_terrain,
    make_waves,
    render,
    steady_flight,
    tilt_body,
)

ESTIMATORS: dict[str, VelocityEstimator] = {"phase": PhaseCorrelationEstimator(), "homography": HomographyEstimator()}
ALL_ESTIMATORS = (*ESTIMATORS.values(), DimesEstimator())
with_baselines = pytest.mark.parametrize("name", ESTIMATORS)
#: Attitudes at the three images: slightly tilted, with different rolls.
ATTITUDES = (tilt_body(3.0, 0.0, 0.0), tilt_body(5.0, 90.0, 120.0), tilt_body(4.0, 200.0, 250.0))


@pytest.fixture(scope="module")
def measurements() -> DescentMeasurements:
    return render(steady_flight((10.0, 5.0), ATTITUDES), noise=np.random.default_rng(1))


def test_velocity_of_exact_measurements_is_accurate() -> None:
    rng = np.random.default_rng(5)
    flights = [draw_flight(rng, max_tilt_deg=10.0, max_wind=15.0) for _ in range(5)]
    inputs = [render(flight, noise=rng) for flight in flights]
    for estimator in ESTIMATORS.values():
        estimates = [estimator.estimate(item) for item in inputs]
        errors = [
            np.hypot(*(estimate.velocity_m_s - flight.velocities[1, :2]))
            for estimate, flight in zip(estimates, flights, strict=True)
            if estimate.velocity_m_s is not None
        ]
        # an estimator may refuse one of the five descents
        assert len(errors) >= 4
        assert max(errors) < 0.5


def test_images_of_different_ground_have_no_velocity() -> None:
    rng = np.random.default_rng(10)
    for _ in range(3):
        flight = draw_flight(rng, max_tilt_deg=10.0)
        first, second = (render(flight, draw_terrain(1), rng), render(flight, draw_terrain(2), rng))
        inputs = replace(first, images=(first.images[0], second.images[1], first.images[2]))
        for estimator in ALL_ESTIMATORS:
            answer = estimator.estimate(inputs)
            assert answer.outcome in (VelocityOutcome.NO_VALID_TRACK, VelocityOutcome.IMU_MISMATCH)


@with_baselines
def test_disagreement_with_imu_rejects_the_velocity(name: str, measurements: DescentMeasurements) -> None:
    velocities = measurements.interval_velocities_m_s + np.array([[0.0, 0.0, 0.0], [0.0, 10.0, 0.0]])
    answer = ESTIMATORS[name].estimate(replace(measurements, interval_velocities_m_s=velocities))
    assert answer.outcome is VelocityOutcome.IMU_MISMATCH
    assert answer.velocity_m_s is None


def test_motion_above_max_speed_is_not_reported() -> None:
    inputs = render(steady_flight((45.0, 0.0), ATTITUDES))
    assert VelocityOutcome.VALID not in [estimator.estimate(inputs).outcome for estimator in ALL_ESTIMATORS]


@with_baselines
@pytest.mark.parametrize(
    "change_counts",
    [
        np.zeros_like,
        lambda counts: np.full_like(counts, 4095),
        lambda counts: np.random.default_rng(int(counts[0, 0])).integers(0, 4096, counts.shape, dtype=np.uint16),
        draw_stripes,
    ],
)
def test_uniform_noise_and_striped_images_have_no_velocity(
    name: str, change_counts: Callable[[np.ndarray], np.ndarray], measurements: DescentMeasurements
) -> None:
    images = tuple(replace(image, counts=change_counts(image.counts)) for image in measurements.images)
    answer = ESTIMATORS[name].estimate(replace(measurements, images=images))
    # Identical images with texture at the pixel scale can match; the velocity is then rejected.
    assert answer.outcome in (VelocityOutcome.NO_VALID_TRACK, VelocityOutcome.IMU_MISMATCH)


@with_baselines
@pytest.mark.parametrize("altitude_m", [-10.0, 3.0, 2e4, np.nan])
def test_invalid_altitudes_have_no_velocity(name: str, altitude_m: float, measurements: DescentMeasurements) -> None:
    altitudes = tuple(replace(altitude, altitude_m=altitude_m) for altitude in measurements.altitudes)
    assert ESTIMATORS[name].estimate(replace(measurements, altitudes=altitudes)).outcome is not VelocityOutcome.VALID


def test_distortion_is_the_largest_relative_length_change() -> None:
    # Finite differences give the length changes near (100, 50) in all directions.
    homography = np.array([[1.02, 0.01, 3.0], [-0.02, 0.97, 5.0], [1e-4, -2e-4, 1.0]])

    def apply_homography(point: np.ndarray) -> np.ndarray:
        x, y, w = homography @ np.array([*point, 1.0])
        return np.array([x / w, y / w])

    middle, step = np.array([100.0, 50.0]), 1e-4
    angles = np.linspace(0.0, np.pi, 2001)
    changes = [
        np.hypot(*(apply_homography(middle + step * unit_vector) - apply_homography(middle))) / step - 1.0
        for unit_vector in np.column_stack([np.cos(angles), np.sin(angles)])
    ]
    result = max_length_change(homography, float((homography @ np.array([*middle, 1.0]))[2]), apply_homography(middle))
    assert result == pytest.approx(np.abs(changes).max(), abs=1e-4)


@with_baselines
def test_featureless_and_sky_images_are_rejected(name: str, measurements: DescentMeasurements) -> None:
    flat = render(steady_flight((10.0, 0.0), ATTITUDES), draw_terrain(3, 0.0), np.random.default_rng(4))
    assert ESTIMATORS[name].estimate(flat).outcome is not VelocityOutcome.VALID
    up = tuple(replace(attitude, world_from_body=tilt_body(180.0, 0.0, 0.0)) for attitude in measurements.attitudes)
    assert ESTIMATORS[name].estimate(replace(measurements, attitudes=up)).outcome is VelocityOutcome.NO_TEMPLATE_AREA


def test_common_square_is_the_largest_visible_in_both_images() -> None:
    views = build_views(render(steady_flight((0.0, 0.0), ATTITUDES)), DimesOptions().binned_size)
    assert views is not None
    patches = rectify_pair(views[0], views[1], replace(DEFAULT_COMMON_OPTIONS, max_side_px=1000))
    side = len(patches.first)
    # The second image has 256 pixels per side, rotated by 120 deg and tilted: a north-up square in it is smaller.
    assert 140 <= side <= 230
    # Without motion both patches show the same ground, which lies in both images.
    assert np.corrcoef(patches.first.ravel(), patches.second.ravel())[0, 1] > 0.9
    assert rectify_pair(views[0], views[1], replace(DEFAULT_COMMON_OPTIONS, min_side_px=side + 16)) is None


def test_repetitive_terrain_is_rejected() -> None:
    """Waves of 80 m repeat within the search range: a shift by one wavelength looks the same as no shift."""
    measurements = render(steady_flight((10.0, 5.0), ATTITUDES), make_waves(80.0), np.random.default_rng(4))
    for estimator in ESTIMATORS.values():
        assert estimator.estimate(measurements).outcome is VelocityOutcome.NO_VALID_TRACK
