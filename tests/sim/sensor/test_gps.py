"""Tests of GPS and RTK receivers: errors, types of solution and outages."""

import numpy as np
import pytest

from marsyard.sim.sensor.gps import Gps, GpsParameters
from marsyard.sim.sensor.instrument import ClockParameters
from marsyard.sim.sensor.rtk import Outage, RtkParameters, RtkReceiver, RtkSolutions
from tests.sim.sensor.motions import Swaying

MOTION = Swaying(position_m=(10.0, 20.0, 30.0), velocity_m_s=(1.0, -0.5, 0.2), sway_m=1.0)
SPAN = (0.0, 400.0)


def _simulate(seed: int, times: np.ndarray, **changes: object) -> tuple[RtkReceiver, RtkSolutions]:
    rng = np.random.default_rng(seed)
    receiver = RtkReceiver.draw(RtkParameters.model_validate(changes), SPAN, rng)
    return receiver, receiver.measure(MOTION, times, rng)


@pytest.mark.parametrize("kind", ["fixed", "floating"])
def test_errors_match_specified_and_reported_deviation(kind: str) -> None:
    fraction = 1.0 if kind == "floating" else 0.0
    times = np.array([5.0])
    truth = MOTION.motion(times)
    samples = [_simulate(seed, times, float_fraction=fraction) for seed in range(400)]
    position_errors = np.array([(solutions.positions_m - truth.positions_m)[0] for _, solutions in samples])
    # The standard error of a deviation from 400 values is 3.5 %; the tolerance is three times that.
    np.testing.assert_allclose(position_errors.std(axis=0), getattr(RtkParameters(), kind).total_m, rtol=0.11)
    reported_m = np.array([solutions.reported_m[0] for _, solutions in samples])
    # The logarithm of reported to true deviation has a standard deviation of 0.1.
    factors = np.log(reported_m / getattr(RtkParameters(), kind).total_m)
    assert np.std(factors[:, 0]) == pytest.approx(0.1, rel=0.11)
    velocity_errors = np.array([(solutions.velocities_m_s - truth.velocities_m_s)[0] for _, solutions in samples])
    # Default noise and wander of the velocity.
    np.testing.assert_allclose(velocity_errors.std(axis=0), np.hypot([0.03, 0.03, 0.05], [0.01, 0.01, 0.02]), rtol=0.11)
    assert all(solutions.fixed[0] == (kind == "fixed") for _, solutions in samples)


def test_slow_error_has_the_specified_correlation_time() -> None:
    """A Gauss-Markov error has a correlation of exp(-1) after one correlation time, 120 s."""
    times = np.array([0.0, 1.0, 120.0])
    errors = np.array(
        [
            (_simulate(seed, times, float_fraction=1.0)[1].positions_m - MOTION.motion(times).positions_m)[:, :2] / 0.5
            for seed in range(400)
        ]
    )
    correlation = np.corrcoef(np.moveaxis(errors, 1, 0).reshape(3, -1))
    assert correlation[0, 1] == pytest.approx(np.exp(-1.0 / 120.0), abs=0.01)
    # The tolerance is three standard errors (1 - r^2) / sqrt(800) of a correlation from 800 values.
    assert correlation[0, 2] == pytest.approx(np.exp(-1.0), abs=0.09)


def test_solution_types_have_specified_fraction_and_duration() -> None:
    times = np.arange(0.0, 400.0, 0.5)
    is_floating = np.array(
        [_simulate(seed, times, float_fraction=0.25, float_s=10.0)[0].is_floating(times) for seed in range(200)]
    )
    # Each of the 200 flights has about 10 cycles of fixed and floating solutions, 40 s each.
    assert is_floating.mean() == pytest.approx(0.25, abs=0.02)
    np.testing.assert_allclose(is_floating[:, [0, -1]].mean(axis=0), 0.25, atol=0.1)
    start_rate_per_s = np.count_nonzero(is_floating[:, 1:] & ~is_floating[:, :-1]) / (200 * 400.0)
    assert start_rate_per_s == pytest.approx(1.0 / 40.0, rel=0.1)


def test_outage_has_no_solutions() -> None:
    times = np.arange(0.0, 10.0, 0.1)
    _, solutions = _simulate(0, times, outages=(Outage(start_s=3.0, duration_s=2.0),))
    is_missing = np.isnan(solutions.positions_m).all(axis=1)
    np.testing.assert_array_equal(is_missing, (times >= 3.0) & (times < 5.0))
    assert np.isfinite(solutions.velocities_m_s[~is_missing]).all()


def test_too_short_fixed_solutions_are_rejected() -> None:
    with pytest.raises(ValueError, match="float_fraction"):
        RtkParameters(float_fraction=0.999, float_s=1.0)


#: A carrier-phase receiver with a nearby base station, resolved integer ambiguities and errors of 2 cm.
RECEIVER = GpsParameters(
    horizontal_noise_m=0.01, vertical_noise_m=0.015, horizontal_wander_m=0.01, vertical_wander_m=0.02, correlation_s=120
)


def test_receiver_errors_have_the_specified_deviations() -> None:
    errors, time = [], np.array([2.0])
    descent = Swaying(position_m=(2500.0, 2500.0, 2000.0), velocity_m_s=(10.0, 0.0, -75.0))
    true_position = descent.motion(time).positions_m[0]
    for seed in range(200):
        rng = np.random.default_rng(seed)
        gps = Gps.draw(RECEIVER, (0.0, 10.0), rng)
        errors.append(gps.measure(descent, time, rng)[0] - true_position)
    # The standard errors from 400 and 200 values are 3.5 % and 5 %; the tolerance is three times that.
    assert np.std(np.array(errors)[:, :2]) == pytest.approx(np.hypot(0.01, 0.01), rel=0.11)
    assert np.std(np.array(errors)[:, 2]) == pytest.approx(np.hypot(0.015, 0.02), rel=0.15)


def test_clock_error_displaces_positions_along_the_motion() -> None:
    """A clock that is 1 s fast gives an event the tag of a position 1 s earlier: 10 m to the west, 75 m higher."""
    descent = Swaying(position_m=(2500.0, 2500.0, 2000.0), velocity_m_s=(10.0, 0.0, -75.0))
    positions = []
    for offset_s in (0.0, 1.0):
        parameters = RECEIVER.model_copy(update={"clock": ClockParameters(offset_s=offset_s)})
        rng = np.random.default_rng(0)
        gps = Gps.draw(parameters, (0.0, 10.0), rng)
        positions.append(gps.measure(descent, np.array([2.0]), rng)[0])
    # The time-correlated error of 1 and 2 cm changes by a few millimetres in 1 s.
    np.testing.assert_allclose(positions[1] - positions[0], [-10.0, 0.0, 75.0], atol=0.02)
