"""From the answer to the ground."""

import numpy as np
import pytest

from marsyard.scenarios.descent.parameters import LandingParameters
from marsyard.scenarios.descent.score import touchdown

EXACT = LandingParameters(steering_error=0.0, burn_error_m_s=0.0)
DRIFT = np.array([12.0, -9.0])


def _rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_a_right_answer_takes_the_velocity_out() -> None:
    landed = touchdown(EXACT, DRIFT, DRIFT.copy(), 17.0, _rng())
    np.testing.assert_allclose(landed.with_answer, 0.0, atol=1e-12)
    np.testing.assert_allclose(landed.without_answer, DRIFT)


def test_steering_takes_out_no_more_than_it_can() -> None:
    fast = 2.0 * DRIFT
    landed = touchdown(EXACT, fast, fast.copy(), 17.0, _rng())
    np.testing.assert_allclose(np.hypot(*landed.with_answer), 30.0 - EXACT.max_steered_m_s)


def test_a_wrong_answer_does_harm() -> None:
    """Steered by the opposite of its velocity the lander goes twice as fast."""
    landed = touchdown(EXACT, DRIFT, -DRIFT, 17.0, _rng())
    np.testing.assert_allclose(landed.with_answer, 2.0 * DRIFT)


@pytest.mark.parametrize(
    ("believed", "available_s"), [(None, 17.0), (DRIFT, EXACT.computation_s - 0.1), (np.array([3.0, -4.0]), 17.0)]
)
def test_without_an_answer_in_time_nothing_is_steered(believed: np.ndarray | None, available_s: float) -> None:
    landed = touchdown(EXACT, DRIFT, believed, available_s, _rng())
    np.testing.assert_array_equal(landed.with_answer, landed.without_answer)
    assert landed.punctual == (available_s >= EXACT.computation_s)


def test_errors_of_burn_and_steering_have_their_size() -> None:
    p = LandingParameters(steering_error=0.1, burn_error_m_s=1.0)
    landed = [touchdown(p, DRIFT, DRIFT.copy(), 17.0, np.random.default_rng(seed)) for seed in range(2000)]
    without = np.stack([one.without_answer for one in landed]) - DRIFT
    steered = np.stack([one.with_answer - one.without_answer for one in landed]) + DRIFT
    # 4000 draws tell a standard deviation to 1.1 %
    assert without.std() == pytest.approx(1.0, rel=0.05)
    assert steered.std() == pytest.approx(1.5, rel=0.05)
