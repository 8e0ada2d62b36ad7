"""Tests of the inertial measurement unit: random walk, bias, scale, rounding and temperature."""

import numpy as np
import pytest
from jaxtyping import Float64

from marsyard.sim.sensor import ClockParameters, Imu, ImuParameters, WarmUp
from marsyard.sim.sensor.imu import DEG_H, DEG_SQRT_H, STANDARD_GRAVITY_M_S2
from tests.sim.sensor.motions import GRAVITY, Swaying

#: Parameters of an error-free unit; tests add single errors.
NO_ERRORS = {name: 0.0 for name in ImuParameters.model_fields if name.startswith(("gyro_", "accelerometer_"))} | {
    "gyro_wander_s": 100.0,
    "accelerometer_wander_s": 60.0,
    "angular_random_walk_deg_sqrt_h": 0.0,
    "velocity_random_walk_ug_sqrt_hz": 0.0,
    "clock": ClockParameters(),
}
AT_REST = Swaying()


def make_parameters(**errors: object) -> ImuParameters:
    """Return the parameters of a unit with only the given errors."""
    return ImuParameters.model_validate(NO_ERRORS | errors)


def _compute_allan_deviation(rates: Float64[np.ndarray, "n channels"], samples: int) -> float:
    """Compute the Allan deviation of all channels for averages over `samples` samples (IEEE Std 952, annex C)."""
    count = len(rates) // samples
    means = rates[: count * samples].reshape(count, samples, -1).mean(axis=1)
    return float(np.sqrt(0.5 * np.mean(np.diff(means, axis=0) ** 2)))


def test_allan_deviation_shows_random_walk_and_bias_instability() -> None:
    """The Allan deviation over the averaging time tau matches the formula for white noise plus a Markov bias."""
    # Angular random walk, deg/sqrt(h); bias wander, deg/h; its correlation time, s; sample rate, Hz.
    walk, wander, correlation_s, rate = 0.07, 1.0, 100.0, 4.0
    parameters = make_parameters(
        rate_hz=rate, angular_random_walk_deg_sqrt_h=walk, gyro_wander_deg_h=wander, gyro_wander_s=correlation_s
    )
    rng = np.random.default_rng(0)
    duration_s = 12.0 * 3600.0
    imu = Imu.draw(parameters, (0.0, duration_s), rng)
    rates = imu.increments(AT_REST, 0.0, duration_s, rng).delta_angles_rad * rate

    def compute_expected_deviation(tau: float) -> float:
        x = tau / correlation_s
        # White noise N^2 / tau and an exponentially correlated bias with the correlation time T and the standard
        # deviation sd (IEEE Std 952, eq. C.14, with q T = 2 sd^2).
        markov = (wander * DEG_H) ** 2 / x**2 * (2.0 * x - 3.0 + 4.0 * np.exp(-x) - np.exp(-2.0 * x))
        return float(np.sqrt((walk * DEG_SQRT_H) ** 2 / tau + markov))

    # At 5 s the random walk dominates (slope -1/2). At 190 s the bias instability has its maximum. The relative
    # standard errors are sqrt(tau / (3 x 43200)): 0.6 % and 3.8 %. Tolerances are three times that, plus 1 % for
    # interpolation of the bias.
    assert compute_expected_deviation(5.0) == pytest.approx(walk * DEG_SQRT_H / np.sqrt(5.0), rel=0.01)
    for tau, tolerance in ((5.0, 0.03), (190.0, 0.12)):
        expected = compute_expected_deviation(tau)
        assert _compute_allan_deviation(rates, int(tau * rate)) == pytest.approx(expected, rel=tolerance)
    assert compute_expected_deviation(190.0) > 0.618 * wander * DEG_H


def test_static_ideal_unit_measures_gravity() -> None:
    imu = Imu.draw(make_parameters(), (0.0, 1.0), np.random.default_rng(0))
    increments = imu.increments(AT_REST, 0.0, 1.0, np.random.default_rng(1))
    assert increments.times_s.size == 401
    np.testing.assert_array_equal(increments.delta_angles_rad, 0.0)
    np.testing.assert_allclose(increments.delta_velocities_m_s, [[0.0, 0.0, GRAVITY / 400.0]] * 400, atol=1e-15)


def test_scale_and_misalignment_apply_to_true_increments() -> None:
    parameters = make_parameters(
        gyro_scale_ppm=1000.0, gyro_misalignment_mrad=5.0, accelerometer_scale_ppm=2000.0, accelerometer_bias_mg=1.0
    )
    imu = Imu.draw(parameters, (0.0, 1.0), np.random.default_rng(3))
    increments = imu.increments(Swaying(spin_rad_s=1.0), 0.0, 1.0, np.random.default_rng(1))
    rotation_vector = np.array([imu.gyro.misalignment[0, 2], imu.gyro.misalignment[1, 2], 1.0 + imu.gyro.scale[2]])
    np.testing.assert_allclose(increments.delta_angles_rad.sum(axis=0), rotation_vector, atol=1e-12)
    specific_force = imu.accelerometer.bias + np.array([0.0, 0.0, GRAVITY * (1.0 + imu.accelerometer.scale[2])])
    np.testing.assert_allclose(increments.delta_velocities_m_s.sum(axis=0), specific_force, atol=1e-12)
    assert 0.0 < np.abs(imu.gyro.misalignment).max() < 0.02
    assert np.all(np.diag(imu.gyro.misalignment) == 0.0)


def test_rounding_errors_do_not_accumulate() -> None:
    parameters = make_parameters(gyro_count_rad=1e-3, gyro_bias_deg_h=1.0 / DEG_H)
    imu = Imu.draw(parameters, (0.0, 10.0), np.random.default_rng(0))
    delta_angles = imu.increments(AT_REST, 0.0, 10.0, np.random.default_rng(0)).delta_angles_rad
    np.testing.assert_allclose(delta_angles / 1e-3, np.rint(delta_angles / 1e-3), atol=1e-9)
    true_angles = imu.gyro.bias * (np.arange(1, 4001)[:, None] / 400.0)
    assert np.abs(np.cumsum(delta_angles, axis=0) - true_angles).max() <= 0.5e-3 + 1e-12


def test_bias_follows_temperature() -> None:
    """The temperature changes from the start of the use, as of a flight that is navigated for 1200 s before time 0."""
    warm_up = WarmUp(start_s=10.0, change_k=20.0, time_constant_s=100.0)
    imu = Imu.draw(make_parameters(gyro_bias_deg_h_k=0.5, warm_up=warm_up), (-1200.0, 800.0), np.random.default_rng(0))
    bias = imu.gyro.bias_at(np.array([0.0, 10.0, 110.0, 2000.0]) - 1200.0)
    np.testing.assert_array_equal(bias[:2], 0.0)
    np.testing.assert_allclose(bias[2], imu.gyro.bias_per_k * 20.0 * (1.0 - np.exp(-1.0)), rtol=1e-12)
    np.testing.assert_allclose(bias[3], imu.gyro.bias_per_k * 20.0, rtol=1e-8)


def test_random_errors_have_the_specified_deviations() -> None:
    parameters = ImuParameters()
    units = [Imu.draw(parameters, (0.0, 10.0), np.random.default_rng(seed)) for seed in range(400)]
    milli_g = 1e-3 * STANDARD_GRAVITY_M_S2
    # The standard error of a deviation from 1,200 values is 2 %; the tolerance is more than four times that.
    for samples, sd in (
        ([unit.gyro.bias for unit in units], 1.0 * DEG_H),
        ([unit.gyro.scale for unit in units], 100e-6),
        ([unit.gyro.wander.values[0] for unit in units], 0.35 * DEG_H),
        ([unit.gyro.misalignment[0, 1:] for unit in units], 0.1e-3),
        ([unit.accelerometer.bias for unit in units], 0.3 * milli_g),
        ([unit.accelerometer.scale for unit in units], 300e-6),
        ([unit.accelerometer.bias_per_k for unit in units], 0.02 * milli_g),
    ):
        assert np.std(samples) == pytest.approx(sd, rel=0.1)


def test_span_without_samples_is_rejected() -> None:
    imu = Imu.draw(make_parameters(), (0.0, 1.0), np.random.default_rng(0))
    with pytest.raises(ValueError, match="no sample"):
        imu.boundaries(0.0, 0.001)
