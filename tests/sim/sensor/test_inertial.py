"""Tests of inertial navigation with errors of the inertial unit and of time tags."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.sim.measurements import ImuIncrements
from marsyard.sim.sensor import Imu, ImuParameters, InertialSolution, NavigationErrors
from marsyard.sim.sensor.instrument import Clock, ClockParameters
from tests.sim.sensor.motions import GRAVITY, Swaying
from tests.sim.sensor.test_imu import make_parameters

#: A motion like a descent: it nods with 60 deg/s, rotates, sways and falls.
DESCENT = Swaying(
    spin_rad_s=0.3,
    nod_rad=0.2,
    nod_rad_s=5.2,
    velocity_m_s=(12.0, -20.0, -75.0),
    acceleration_m_s2=(0.3, 0.1, 0.2),
    sway_m=20.0,
    sway_rad_s=0.4,
)
SPAN = (-2.0, 18.0)
NO_ERRORS = NavigationErrors(np.zeros(3), np.zeros(3))


def _navigate(
    motion: Swaying, parameters: ImuParameters, errors: NavigationErrors = NO_ERRORS, seed: int = 0
) -> tuple[Imu, InertialSolution]:
    rng = np.random.default_rng(seed)
    imu = Imu.draw(parameters, SPAN, rng)
    start = motion.state(SPAN[0])
    attitude, velocity = errors.apply(start.attitude, start.velocity_m_s)
    increments = imu.increments(motion, *SPAN, rng)
    return imu, InertialSolution.propagate(increments, attitude, velocity, GRAVITY)


def test_error_free_navigation_reproduces_the_motion() -> None:
    _, solution = _navigate(DESCENT, make_parameters())
    # Times between samples are included.
    times = np.linspace(-2.0, 18.0, 137)
    truth = DESCENT.motion(times)
    assert (solution.attitude(times) * truth.attitudes.inv()).magnitude().max() < 1e-5
    np.testing.assert_allclose(solution.velocity(times), truth.velocities_m_s, atol=2e-5)
    sample_times = np.array([0.0, 3.75, 7.5, 18.0])
    truth = DESCENT.motion(sample_times)
    assert (solution.attitude(sample_times) * truth.attitudes.inv()).magnitude().max() < 1e-10
    np.testing.assert_allclose(solution.velocity(sample_times), truth.velocities_m_s, atol=1e-6)
    means = np.diff(truth.positions_m, axis=0) / np.diff(sample_times)[:, None]
    np.testing.assert_allclose(solution.mean_velocities(sample_times), means, atol=1e-5)


def test_only_bias_along_the_spin_axis_accumulates() -> None:
    spin = 2.0 * np.pi / 4.0
    imu, solution = _navigate(Swaying(spin_rad_s=spin), make_parameters(gyro_bias_deg_h=100.0))
    truth = Swaying(spin_rad_s=spin).state(18.0).attitude
    error = (solution.attitude(np.array([18.0]))[0] * truth.inv()).as_rotvec()
    # The body makes five complete turns. Second-order errors are 1e-5 of those of first order.
    assert error[2] == pytest.approx(imu.gyro.bias[2] * 20.0, rel=1e-4)
    assert np.abs(error[:2]).max() < 1e-3 * np.abs(imu.gyro.bias[:2] * 20.0).max()


def test_accelerometer_bias_and_tilt_cause_velocity_errors() -> None:
    imu, solution = _navigate(Swaying(), make_parameters(accelerometer_bias_mg=1.0))
    np.testing.assert_allclose(solution.velocity(np.array([18.0]))[0], imu.accelerometer.bias * 20.0, rtol=1e-9)
    tilt = np.array([1e-3, -2e-3, 5e-3])
    _, solution = _navigate(Swaying(), make_parameters(), NavigationErrors(tilt, np.array([3.0, 0.0, 0.0])))
    expected = np.array([3.0, 0.0, 0.0]) + 20.0 * np.cross(tilt, [0.0, 0.0, GRAVITY])
    np.testing.assert_allclose(solution.velocity(np.array([18.0]))[0], expected, atol=20.0 * GRAVITY * 2e-5)


def test_random_walks_have_the_specified_deviation() -> None:
    attitudes_deg, velocities_m_s = [], []
    for seed in range(150):
        walks = {"angular_random_walk_deg_sqrt_h": 0.07, "velocity_random_walk_ug_sqrt_hz": 50.0}
        parameters = make_parameters(rate_hz=50.0, **walks)
        _, solution = _navigate(Swaying(), parameters, seed=seed)
        attitudes_deg.append(np.degrees(solution.attitude(np.array([18.0]))[0].as_rotvec()))
        velocities_m_s.append(solution.velocity(np.array([18.0]))[0, 2])
    # The standard errors from 450 and 150 values are 3.3 % and 5.8 %; the tolerance is three times that. Tilt does not
    # affect the z velocity.
    assert np.std(attitudes_deg) == pytest.approx(0.07 * np.sqrt(20.0 / 3600.0), rel=0.1)
    assert np.std(velocities_m_s) == pytest.approx(50e-6 * 9.80665 * np.sqrt(20.0), rel=0.18)


def test_tag_error_of_10_ms_shifts_ground_by_21_m() -> None:
    # A rotation of 60 deg/s during 10 ms shifts the line of sight by 21 m on the ground 2000 m below.
    motion = Swaying(spin_rad_s=np.radians(60.0), tilt=Rotation.from_euler("x", 90.0, degrees=True))
    _, solution = _navigate(motion, make_parameters())
    clock = Clock(ClockParameters(), offset_s=0.01)
    tag = clock.tags(np.array([3.75]), np.random.default_rng(0))
    angle_error = (solution.attitude(tag)[0] * motion.state(3.75).attitude.inv()).magnitude()
    assert 2000.0 * np.tan(angle_error) == pytest.approx(20.9, abs=0.1)
    # If the unit has the same clock offset, the error is zero.
    imu = Imu.draw(make_parameters(clock=ClockParameters(offset_s=0.01)), SPAN, np.random.default_rng(0))
    increments = imu.increments(motion, *SPAN, np.random.default_rng(0))
    synchronous_solution = InertialSolution.propagate(increments, motion.state(SPAN[0]).attitude, np.zeros(3), GRAVITY)
    assert (synchronous_solution.attitude(tag)[0] * motion.state(3.75).attitude.inv()).magnitude() < 1e-9


def test_time_tags_increase_despite_large_jitter() -> None:
    imu = Imu.draw(make_parameters(clock=ClockParameters(jitter_sd_s=0.01)), SPAN, np.random.default_rng(0))
    increments = imu.increments(DESCENT, *SPAN, np.random.default_rng(0))
    assert np.all(np.diff(increments.times_s) >= 0.0)
    start = DESCENT.state(SPAN[0])
    solution = InertialSolution.propagate(increments, start.attitude, start.velocity_m_s, GRAVITY)
    times = np.concatenate([increments.times_s[:1], np.linspace(-1.9, 17.9, 1000), increments.times_s[-1:]])
    error = (solution.attitude(times) * DESCENT.motion(times).attitudes.inv()).magnitude()
    # The body rate is at most 1.35 rad/s. A time of 0.05 s is more than four standard deviations of the jitter.
    assert error.max() < 1.35 * 0.05


def test_navigation_is_defined_only_within_its_samples() -> None:
    increments = ImuIncrements(np.array([0.0, 1.0]), 1.0, np.zeros((1, 3)), np.zeros((1, 3)))
    solution = InertialSolution.propagate(increments, Rotation.identity(), np.zeros(3), GRAVITY)
    with pytest.raises(ValueError, match=r"outside the navigation solution, 0\.0000 s to 1\.0000 s"):
        solution.velocity(np.array([1.5]))
