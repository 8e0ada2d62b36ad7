"""Tests of the correction of a common tilt by the inclination of the ground: exact tracks, then images with truth."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.algorithms.dimes import DimesDetails, DimesEstimator, DimesOptions
from marsyard.algorithms.dimes.tilt import GroundTracks, expected_attitude_error, fit_ground, levelled_velocity
from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome
from marsyard.sim.measurements import DescentMeasurements
from tests.algorithms.synthetic_descent import (
    INTERVAL_S,
    Flight,
    draw_flight,
    render,
    steady_flight,
    tilt_body,
    valid_velocity,
)

PUBLISHED = DimesEstimator()
CORRECTED = DimesEstimator(DimesOptions(correct_tilt=True))
#: Priors without slope: the whole inclination is a tilt of the attitudes.
LEVEL = DimesOptions(correct_tilt=True, slope_sd_rad=1e-6)
#: Fraction of an inclination that the default priors assign to the attitudes: 0.9^2 / (0.9^2 + 0.59^2).
TILT_FRACTION = 0.699


def project_plane(rng: np.random.Generator, tilt: Rotation) -> tuple[list[GroundTracks], np.ndarray]:
    """Project points of level ground into three cameras; return tracks in a tilted frame, and the true velocities.

    Heights are distances from the plane, which is what a radar altimeter measures from a tilted frame.
    """
    velocities = np.array([[14.0, -9.0, -75.0], [12.0, -6.0, -72.0]])
    displacements = np.vstack([np.zeros(3), np.cumsum(INTERVAL_S * velocities, axis=0)])
    positions = np.array([0.0, 0.0, 2000.0]) + displacements
    pairs = []
    for first, second in ((0, 1), (1, 2)):
        ground = np.column_stack([rng.uniform(-700.0, 700.0, (80, 2)), np.zeros(80)])
        points = []
        for position in positions[[first, second]]:
            rays = tilt.apply(ground - position)
            points.append(-position[2] * rays[:, :2] / rays[:, 2:])
        pairs.append(GroundTracks(points[0], points[1], (positions[first, 2], positions[second, 2]), 5.6, INTERVAL_S))
    return pairs, velocities


@pytest.mark.parametrize("tilt_deg", [(0.0, 0.0), (1.4, 0.0), (-0.7, 2.0)])
def test_exact_tracks_give_the_exact_tilt_and_velocity(tilt_deg: tuple[float, float]) -> None:
    tilt = Rotation.from_rotvec(np.deg2rad([*tilt_deg, 0.0]))
    pairs, velocities = project_plane(np.random.default_rng(1), tilt)
    fit = fit_ground(pairs, [np.zeros(2)] * 2, replace(LEVEL, track_sd_px=1e-5))
    normal = tilt.apply([0.0, 0.0, 1.0])
    # the priors of the instruments allow deviations in proportion to the tilt, by about 2e-4 of it
    np.testing.assert_allclose(fit.inclination, normal[:2] / normal[2], atol=1e-5)
    np.testing.assert_allclose(fit.displacements_m / INTERVAL_S, tilt.apply(velocities), atol=1e-3)
    np.testing.assert_allclose(fit.corrections, 0.0, atol=0.02)
    assert fit.tracks == (80, 80)
    # a tilt of 2 deg is corrected to first order: 75 m/s times 0.035^2 / 2, and 14 m/s times 0.035^2
    error = expected_attitude_error(fit.inclination, LEVEL)
    np.testing.assert_allclose(error, np.deg2rad([*tilt_deg, 0.0]), atol=1e-4)
    np.testing.assert_allclose(levelled_velocity(fit, INTERVAL_S, error), velocities[1, :2], atol=0.07)


def test_outliers_do_not_change_the_fit() -> None:
    rng = np.random.default_rng(2)
    pairs, velocities = project_plane(rng, Rotation.from_rotvec(np.deg2rad([1.0, -1.0, 0.0])))
    wrong = [replace(pair, second=pair.second + 5.6 * 5.0 * (np.arange(80) < 8)[:, np.newaxis]) for pair in pairs]
    clean_fit, fit = (fit_ground(tracks, list(velocities[:, :2]), LEVEL) for tracks in (pairs, wrong))
    assert fit.tracks == (72, 72)
    # a tenth of the tracks is missing: the inclination, with a standard deviation of 0.2 deg, changes by less
    np.testing.assert_allclose(fit.inclination, clean_fit.inclination, atol=np.deg2rad(0.05))


def rotate_attitudes(inputs: DescentMeasurements, rotation: Rotation) -> DescentMeasurements:
    """Add an attitude error to all images."""
    attitudes = tuple(replace(a, world_from_body=rotation * a.world_from_body) for a in inputs.attitudes)
    return replace(inputs, attitudes=attitudes)


def get_details(answer: VelocityEstimate) -> DimesDetails:
    assert isinstance(answer.details, DimesDetails)
    return answer.details


@pytest.fixture(scope="module")
def flights() -> list[tuple[Flight, DescentMeasurements]]:
    rng = np.random.default_rng(31)
    drawn = [draw_flight(rng, max_tilt_deg=15.0, max_wind=20.0) for _ in range(2)]
    return [(flight, render(flight, noise=rng)) for flight in drawn]


def test_common_tilt_is_corrected(flights: list[tuple[Flight, DescentMeasurements]]) -> None:
    """A tilt of 1.5 deg causes an error of 75 m/s times 0.026 = 1.96 m/s; the priors leave 30 % of it."""
    level = DimesEstimator(LEVEL)
    for number, (flight, inputs) in enumerate(flights):
        truth = flight.velocities[1, :2]
        tilt = Rotation.from_euler("z", 90.0 * number, degrees=True).apply([np.deg2rad(1.5), 0.0, 0.0])
        tilted = rotate_attitudes(inputs, Rotation.from_rotvec(tilt))
        error = valid_velocity(PUBLISHED.estimate(tilted)) - truth
        assert np.hypot(*error) == pytest.approx(1.96, abs=0.4)
        assert np.hypot(*(valid_velocity(level.estimate(tilted)) - truth)) < 0.35
        answer = CORRECTED.estimate(tilted)
        assert np.hypot(*(valid_velocity(answer) - truth)) == pytest.approx((1.0 - TILT_FRACTION) * 1.96, abs=0.35)
        fit = get_details(answer).ground
        assert fit.agrees_with_instruments
        # the normal of level ground in a frame that is rotated by the tilt; 0.2 deg is about one standard deviation
        np.testing.assert_allclose(fit.inclination, [tilt[1], -tilt[0]], atol=np.deg2rad(0.4))


def incline_world(
    flight: Flight, inputs: DescentMeasurements, slope: Rotation
) -> tuple[np.ndarray, DescentMeasurements]:
    """Rotate ground, lander and sun together; return the true horizontal velocity, and measurements without errors."""
    rotated = rotate_attitudes(inputs, slope)
    velocities = slope.apply(inputs.interval_velocities_m_s)
    sun = slope.apply(inputs.sun_direction)
    return slope.apply(flight.velocities)[1, :2], replace(
        rotated, interval_velocities_m_s=velocities, sun_direction=sun
    )


def test_slope_at_the_limit_of_landing_sites_causes_errors_within_the_requirement(
    flights: list[tuple[Flight, DescentMeasurements]],
) -> None:
    """A slope of 2 deg is mistaken for a tilt: 0.7 times 75 m/s times 0.035 = 1.83 m/s; the requirement is 5 m/s."""
    for number, (flight, inputs) in enumerate(flights):
        axis = Rotation.from_euler("z", 90.0 * number, degrees=True).apply([1.0, 0.0, 0.0])
        truth, inclined = incline_world(flight, inputs, Rotation.from_rotvec(np.deg2rad(2.0) * axis))
        assert np.hypot(*(valid_velocity(PUBLISHED.estimate(inclined)) - truth)) < 0.5
        error_m_s = np.hypot(*(valid_velocity(CORRECTED.estimate(inclined)) - truth))
        assert error_m_s == pytest.approx(1.83, abs=0.4)


def test_implausible_inclination_is_refused() -> None:
    flight = steady_flight((8.0, -3.0))
    tilted = rotate_attitudes(render(flight), tilt_body(8.0, 40.0, 0.0))
    # 8 deg times 75 m/s = 10.5 m/s: a wrong answer of the published algorithm
    assert np.hypot(*(valid_velocity(PUBLISHED.estimate(tilted)) - [8.0, -3.0])) > 5.0
    answer = CORRECTED.estimate(tilted)
    assert answer.outcome is VelocityOutcome.INCLINED_GROUND
    assert answer.velocity_m_s is None


def test_inclination_does_not_matter_without_descent_rate() -> None:
    positions = np.array([900.0, 1400.0, 1500.0]) + INTERVAL_S * np.outer(np.arange(3), [20.0, 10.0, -2.0])
    flight = replace(steady_flight((20.0, 10.0)), positions=positions)
    tilted = rotate_attitudes(render(flight), tilt_body(10.0, 40.0, 0.0))
    answer = CORRECTED.estimate(tilted)
    np.testing.assert_allclose(valid_velocity(answer), valid_velocity(PUBLISHED.estimate(tilted)), atol=0.5)
    np.testing.assert_allclose(valid_velocity(answer), [20.0, 10.0], atol=1.5)


def test_published_answer_remains_if_instruments_disagree() -> None:
    inputs = render(steady_flight((8.0, -3.0)))
    # a rotation of a single image about the vertical by 15 standard deviations, which the IMU check accepts
    attitudes = list(inputs.attitudes)
    rotation = Rotation.from_euler("z", 0.3, degrees=True)
    attitudes[1] = replace(attitudes[1], world_from_body=rotation * attitudes[1].world_from_body)
    wrong = replace(inputs, attitudes=tuple(attitudes))
    answer, published = CORRECTED.estimate(wrong), PUBLISHED.estimate(wrong)
    assert answer.outcome is published.outcome is VelocityOutcome.VALID
    np.testing.assert_array_equal(valid_velocity(answer), valid_velocity(published))
    assert get_details(answer).ground is None


def test_published_answer_remains_with_few_tracks() -> None:
    inputs = render(steady_flight((8.0, -3.0)))
    few = DimesEstimator(DimesOptions(correct_tilt=True, grid_template_px=101))
    answer = few.estimate(inputs)
    np.testing.assert_array_equal(valid_velocity(answer), valid_velocity(PUBLISHED.estimate(inputs)))
    assert get_details(answer).ground is None
