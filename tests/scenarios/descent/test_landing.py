"""Tests of the horizontal touchdown velocity: the thrusters reduce it by the estimated velocity, up to a limit."""

import numpy as np
import pytest

from marsyard.scenarios.descent.parameters import LandingParameters
from marsyard.scenarios.descent.score import compute_touchdown

#: Time from the last image to the firing, s; enough for the computation.
AVAILABLE_S = 17.0
IDEAL = LandingParameters(steering_error=0.0, burn_error_m_s=0.0)
#: True horizontal velocity before the firing, m/s, with a magnitude of 15.
TRUE_VELOCITY = np.array([12.0, -9.0])


def make_rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_correct_answer_cancels_the_velocity() -> None:
    result = compute_touchdown(IDEAL, TRUE_VELOCITY, TRUE_VELOCITY.copy(), AVAILABLE_S, make_rng())
    np.testing.assert_allclose(result.with_answer, 0.0, atol=1e-12)
    np.testing.assert_allclose(result.without_answer, TRUE_VELOCITY)


def test_steering_is_limited_by_its_capability() -> None:
    fast_velocity = 2.0 * TRUE_VELOCITY
    result = compute_touchdown(IDEAL, fast_velocity, fast_velocity.copy(), AVAILABLE_S, make_rng())
    # the true speed is 30 m/s
    np.testing.assert_allclose(np.hypot(*result.with_answer), 30.0 - IDEAL.max_steering_m_s)


def test_wrong_answer_increases_the_velocity() -> None:
    """Steering with the negated velocity doubles the velocity."""
    result = compute_touchdown(IDEAL, TRUE_VELOCITY, -TRUE_VELOCITY, AVAILABLE_S, make_rng())
    np.testing.assert_allclose(result.with_answer, 2.0 * TRUE_VELOCITY)


@pytest.mark.parametrize(
    ("estimate", "available_s"),
    [
        (None, AVAILABLE_S),
        (TRUE_VELOCITY, IDEAL.computation_s - 0.1),
        # 5 m/s: the deadband, up to which the burn is not steered
        (np.array([3.0, -4.0]), AVAILABLE_S),
    ],
)
def test_burn_is_not_steered_without_a_timely_estimate_above_the_deadband(
    estimate: np.ndarray | None, available_s: float
) -> None:
    result = compute_touchdown(IDEAL, TRUE_VELOCITY, estimate, available_s, make_rng())
    np.testing.assert_array_equal(result.with_answer, result.without_answer)
    assert result.is_in_time == (available_s >= IDEAL.computation_s)


def test_burn_and_steering_errors_have_the_specified_standard_deviation() -> None:
    parameters = LandingParameters(steering_error=0.1, burn_error_m_s=1.0)
    touchdowns = [
        compute_touchdown(parameters, TRUE_VELOCITY, TRUE_VELOCITY.copy(), AVAILABLE_S, np.random.default_rng(seed))
        for seed in range(2000)
    ]
    without_answer = np.stack([touchdown.without_answer for touchdown in touchdowns]) - TRUE_VELOCITY
    steering = np.stack([touchdown.with_answer - touchdown.without_answer for touchdown in touchdowns]) + TRUE_VELOCITY
    # Relative standard error of a standard deviation from 4000 values: 1 / sqrt(8000) = 1.1 %.
    # The steering error is 10 % of 15 m/s.
    assert without_answer.std() == pytest.approx(1.0, rel=0.05)
    assert steering.std() == pytest.approx(1.5, rel=0.05)
