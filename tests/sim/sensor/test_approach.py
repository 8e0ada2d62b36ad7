"""Tests of inertial errors from cruise to the start of the descent, against propagation at the unit's full rate."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from jaxtyping import Float64

from marsyard.sim.dynamics import Motion, State
from marsyard.sim.measurements import ImuIncrements
from marsyard.sim.sensor import Approach, ApproachParameters, Imu, ImuParameters, InertialSolution
from marsyard.sim.sensor.imu import true_increments
from tests.sim.sensor.test_imu import make_parameters

#: A profile short enough for a propagation at the full rate, without initial errors.
SHORT = ApproachParameters(
    attitude_sd_deg=0.0, velocity_sd_m_s=0.0, cruise_s=60.0, entry_s=40.0, parachute_s=25.0, upright_s=15.0
)


@dataclass(frozen=True)
class ProfileMotion:
    """Motion with attitude, rate and specific force of the nominal profile; position and velocity are zero."""

    approach: Approach
    span_s: tuple[float, float] = (-np.inf, np.inf)

    def state(self, time_s: float) -> State:
        return self.motion(np.array([time_s])).state(0)

    def motion(self, times_s: Float64[np.ndarray, "n"]) -> Motion:
        zeros = np.zeros((times_s.size, 3))
        approach = self.approach
        attitudes, rates = approach.attitudes(times_s), approach.body_rates(times_s)
        return Motion(times_s, zeros, zeros, attitudes, rates, approach.specific_forces(times_s))


def _propagate_at_full_rate(imu: Imu, approach: Approach, seeds: range) -> list[tuple[np.ndarray, np.ndarray]]:
    """Compute the final errors of attitude (rotation vector, rad) and velocity (m/s); one pair per seed."""
    start = approach.attitudes(np.array([approach.start_s]))[0]
    boundaries = imu.boundaries(approach.start_s, approach.end_s)
    angles, velocities = true_increments(ProfileMotion(approach), boundaries)
    exact_increments = ImuIncrements(boundaries, 1.0 / imu.parameters.rate_hz, angles, velocities)
    exact_solution = InertialSolution.propagate(exact_increments, start, np.zeros(3), 0.0)
    errors = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        increments = replace(
            exact_increments,
            delta_angles_rad=imu.gyro.measure(angles, boundaries, rng),
            delta_velocities_m_s=imu.accelerometer.measure(velocities, boundaries, rng),
        )
        estimate = InertialSolution.propagate(increments, start, np.zeros(3), 0.0)
        attitude = (estimate.attitudes[-1] * exact_solution.attitudes[-1].inv()).as_rotvec()
        errors.append((attitude, estimate.velocities_m_s[-1] - exact_solution.velocities_m_s[-1]))
    return errors


def test_rates_are_the_derivative_of_attitude() -> None:
    # The approach ends at -2 s, the start of the descent.
    approach = Approach(SHORT, -2.0)
    times = np.linspace(approach.start_s + 1.0, approach.end_s - 1.0, 200)
    step_s = 1e-4
    before, after = approach.attitudes(times - step_s), approach.attitudes(times + step_s)
    differences = (before.inv() * after).as_rotvec() / (2.0 * step_s)
    # The rate jumps at the start of entry, at parachute deployment and when the body is upright. These are excluded.
    knots = np.array([-2.0 - 25.0 - 40.0, -2.0 - 25.0, -2.0 - 10.0])
    is_smooth = np.abs(times[:, None] - knots).min(axis=1) > 2.0 * step_s
    np.testing.assert_allclose(approach.body_rates(times)[is_smooth], differences[is_smooth], atol=1e-6)


def test_profile_has_specified_deceleration_and_ends_upright() -> None:
    parameters = ApproachParameters()
    approach = Approach(parameters, 0.0)
    times = np.linspace(approach.start_s, 0.0, 200001)
    forces = approach.specific_forces(times)
    gravity_delta_v = parameters.gravity_m_s2 * parameters.parachute_s
    total_delta_v = parameters.entry_delta_v_m_s + parameters.parachute_delta_v_m_s + gravity_delta_v
    assert np.trapezoid(forces[:, 2], times) == pytest.approx(total_delta_v, rel=1e-3)
    assert approach.attitudes(np.array([0.0]))[0].apply([0.0, 0.0, -1.0])[2] == pytest.approx(-1.0)
    # At the start the body -z axis points to the heading, 12 deg below the horizon.
    start_axis = approach.attitudes(np.array([approach.start_s]))[0].apply([0.0, 0.0, -1.0])
    assert np.degrees(np.arctan2(start_axis[0], start_axis[1])) == pytest.approx(parameters.heading_deg)
    assert np.degrees(np.arccos(-start_axis[2])) == pytest.approx(parameters.entry_off_nadir_deg)
    assert 4.0 < forces[:, 2].max() / 9.81 < 7.0


def test_constant_errors_match_a_full_rate_propagation() -> None:
    unit_parameters = make_parameters(
        gyro_bias_deg_h=30.0,
        gyro_wander_deg_h=10.0,
        gyro_scale_ppm=300.0,
        gyro_misalignment_mrad=0.3,
        accelerometer_bias_mg=1.0,
        accelerometer_wander_mg=0.5,
        accelerometer_scale_ppm=500.0,
        accelerometer_misalignment_mrad=0.3,
    )
    approach = Approach(SHORT, -2.0)
    for seed in range(3):
        imu = Imu.draw(unit_parameters, (approach.start_s, 0.0), np.random.default_rng(seed))
        fast = approach.errors(imu, np.random.default_rng(0))
        [(attitude, velocity)] = _propagate_at_full_rate(imu, approach, range(1))
        # Tolerance: the fast method is first order in errors of up to 10 mrad, with steps of 2.4 deg of spin.
        np.testing.assert_allclose(fast.attitude_rad, attitude, atol=0.01 * float(np.linalg.norm(attitude)))
        np.testing.assert_allclose(fast.velocity_m_s, velocity, atol=0.01 * float(np.linalg.norm(velocity)))


def test_noise_matches_a_full_rate_propagation() -> None:
    unit_parameters = make_parameters(
        rate_hz=20.0, angular_random_walk_deg_sqrt_h=1.0, velocity_random_walk_ug_sqrt_hz=3000.0
    )
    approach = Approach(SHORT, -2.0)
    imu = Imu.draw(unit_parameters, (approach.start_s, 0.0), np.random.default_rng(0))
    fast = [approach.errors(imu, np.random.default_rng(seed)) for seed in range(400)]
    slow = _propagate_at_full_rate(imu, approach, range(120))
    attitude_fast = np.std([errors.attitude_rad for errors in fast], axis=0)
    velocity_fast = np.std([errors.velocity_m_s for errors in fast], axis=0)
    attitude_slow, velocity_slow = (np.std([errors[k] for errors in slow], axis=0) for k in (0, 1))
    # The standard error of the ratio from 400 and 120 values is 7.4 %; the tolerance is three times that.
    np.testing.assert_allclose(attitude_fast / attitude_slow, 1.0, atol=0.22)
    np.testing.assert_allclose(velocity_fast / velocity_slow, 1.0, atol=0.22)
    # A random walk of 1 deg/sqrt(h) for 125 s.
    np.testing.assert_allclose(np.degrees(attitude_fast), np.sqrt(125.0 / 3600.0), rtol=0.12)


def test_scale_error_rotates_attitude_about_spin_axis() -> None:
    parameters = SHORT.model_copy(update={"cruise_s": 900.0, "spin_scale_ppm": 20.0})
    approach = Approach(parameters, 0.0)
    imu = Imu.draw(make_parameters(gyro_scale_ppm=1e4), (approach.start_s, 0.0), np.random.default_rng(0))
    calibrated_imu = approach.calibrate(imu, np.random.default_rng(1))
    level = parameters.model_copy(update={"entry_off_nadir_deg": 0.0, "deploy_off_nadir_deg": 0.0})
    level_approach = Approach(level, 0.0)
    error = level_approach.errors(calibrated_imu, np.random.default_rng(0)).attitude_rad
    # Spin of 2 rpm for 900 s of cruise and 40 s of entry.
    rotation_rad = 2.0 * np.pi / 30.0 * 940.0
    assert abs(calibrated_imu.gyro.scale[2]) < 1e-4
    assert error[2] == pytest.approx(calibrated_imu.gyro.scale[2] * rotation_rad, rel=1e-9)
    np.testing.assert_array_equal(calibrated_imu.gyro.scale[:2], imu.gyro.scale[:2])


def test_spin_scale_error_dominates_the_descent_attitude_error() -> None:
    approach = Approach(ApproachParameters(), -2.0)
    errors = []
    for seed in range(150):
        rng = np.random.default_rng(seed)
        imu = approach.calibrate(Imu.draw(ImuParameters(), (approach.start_s, 0.0), rng), rng)
        errors.append(approach.errors(imu, rng).attitude_rad)
    deviations_deg = np.degrees(np.std(errors, axis=0))
    # Errors about the spin axis (the entry direction): 1 deg/h for 1140 s is 0.32 deg; 100 ppm of 38 turns is 1.37 deg.
    # About the other axes the effect of the bias averages out until the parachute opens.
    assert 1.2 < deviations_deg[0] < 1.6
    assert deviations_deg[1:].max() < 0.45
