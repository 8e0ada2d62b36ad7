"""Tests of the navigation filter: errors consistent with its covariance, and robust to instrument faults."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from marsyard.sim.dynamics.rotorcraft import (
    TAIL_S,
    Air,
    AirParameters,
    RotorcraftParameters,
    SimulatedPath,
    TransitParameters,
    simulate_transit,
)
from marsyard.sim.sensor.helicopter_navigation import FilterParameters, NavigationFilter, NavigationSolution
from marsyard.sim.sensor.imu import SMALL_UNIT, Imu, ImuParameters
from marsyard.sim.sensor.instrument import ClockParameters
from marsyard.sim.sensor.kernels.navigation import POSITION_FIX, VELOCITY_FIX
from marsyard.sim.sensor.rtk import Outage, RtkParameters, RtkReceiver
from marsyard.sim.sensor.tilt_compass import TiltCompass, TiltCompassParameters

#: Gravity, m/s2; number of simulated flights.
GRAVITY, N_FLIGHTS = 9.8, 50
CRAFT, TRANSIT = RotorcraftParameters(), TransitParameters(hover_s=8.0)
RTK, COMPASS = RtkParameters(), TiltCompassParameters()


@cache
def _make_path(seed: int) -> SimulatedPath:
    rng = np.random.default_rng(seed)
    air = Air.draw(AirParameters(), CRAFT.step_s, TRANSIT.lead_s + TRANSIT.imaging_duration_s + TAIL_S, rng)
    waypoint_m, heading_rad = np.array([100.0, 50.0, 10.0]), rng.uniform(0.0, 2.0 * np.pi)
    return simulate_transit(CRAFT, TRANSIT, waypoint_m, 0.3, heading_rad, GRAVITY, air, rng).path


def _run_filter(
    seed: int,
    imu_parameters: ImuParameters = SMALL_UNIT,
    rtk_parameters: RtkParameters = RTK,
    compass_parameters: TiltCompassParameters = COMPASS,
    covariance_times_s: tuple[float, ...] = (),
    parameters: FilterParameters = FilterParameters(),  # noqa: B008 - frozen
) -> tuple[SimulatedPath, Imu, NavigationSolution]:
    path, rng = _make_path(seed), np.random.default_rng([seed, 1])
    span = path.span_s
    imu = Imu.draw(imu_parameters, span, rng)
    receiver, compass = RtkReceiver.draw(rtk_parameters, span, rng), TiltCompass.draw(compass_parameters, rng)
    increments = imu.increments(path, *span, rng)
    solutions = receiver.measure(path, receiver.sampling.within(*span), rng)
    readings = compass.measure(path, compass.sampling.within(*span), rng)
    navigation = NavigationFilter(parameters, SMALL_UNIT, rtk_parameters, compass_parameters, GRAVITY)
    start = navigation.initialize(solutions, readings)
    return path, imu, navigation.run(start, increments, solutions, readings, np.array(covariance_times_s))


def _compute_errors(path: SimulatedPath, imu: Imu, solution: NavigationSolution, indices: np.ndarray) -> np.ndarray:
    """Compute the true minus the estimated state: position, velocity, attitude, biases of gyro and accelerometer.

    The result has fifteen columns. `indices` select the samples of the inertial unit.

    Scale and misalignment errors of the accelerometer count as a bias: their product with gravity.
    """
    times = imu.boundaries(*path.span_s)[indices]
    truth = path.motion(times)
    gravity_scale_error = imu.accelerometer.sensitivity_error[:, 2] * GRAVITY
    return np.concatenate(
        [
            truth.positions_m - solution.positions_m[indices],
            truth.velocities_m_s - solution.velocities_m_s[indices],
            (truth.attitudes * solution.attitudes[indices].inv()).as_rotvec(),
            imu.gyro.bias_at(times) - solution.gyro_biases_rad_s[indices],
            imu.accelerometer.bias_at(times) + gravity_scale_error - solution.accelerometer_biases_m_s2[indices],
        ],
        axis=1,
    )


def test_errors_are_consistent_with_the_covariance() -> None:
    """The mean normalised squared error over independent flights is within the 99.8 % band of chi-square.

    The state of each flight has fifteen degrees of freedom.
    """
    with_float_solutions = RtkParameters(float_fraction=0.3, float_s=10.0)
    squared_errors = []
    for seed in range(N_FLIGHTS):
        times_s = (-3.0, 0.0, 2.5, 5.0)
        path, imu, solution = _run_filter(seed, rtk_parameters=with_float_solutions, covariance_times_s=times_s)
        errors = _compute_errors(path, imu, solution, solution.covariance_indices)
        pairs = zip(errors, solution.covariances, strict=True)
        squared_errors.append([float(error @ np.linalg.solve(covariance, error)) for error, covariance in pairs])
    low, high = (float(chi2.ppf(probability, 15 * N_FLIGHTS)) / N_FLIGHTS for probability in (0.001, 0.999))
    means = np.mean(squared_errors, axis=0)
    assert np.all((means > low) & (means < high)), means


def test_innovations_are_white() -> None:
    normalised_innovations: dict[int, list[float]] = {POSITION_FIX: [], VELOCITY_FIX: []}
    products: dict[int, list[float]] = {POSITION_FIX: [], VELOCITY_FIX: []}
    for seed in range(20):
        innovations = _run_filter(seed)[2].innovations
        assert np.mean(innovations.used) > 0.99
        for kind in normalised_innovations:
            for axis in range(3):
                is_selected = (innovations.kinds == kind) & (innovations.axes == axis) & (innovations.times_s > -8.0)
                values = innovations.normalised[is_selected]
                normalised_innovations[kind].extend(values)
                products[kind].extend(values[1:] * values[:-1])
    for kind in normalised_innovations:
        # The standard errors from 7,600 values are 1.6 % of the variance and 0.011 of the correlation. A bias that the
        # filter does not model increases both.
        assert np.var(normalised_innovations[kind]) == pytest.approx(1.0, abs=0.1)
        assert abs(np.mean(products[kind])) < 0.12


def test_better_instruments_reduce_the_errors() -> None:
    """The inertial unit is ideal. The receiver has white noise of 2 mm and 5 mm/s, which the filter averages."""
    no_errors = {name: 0.0 for name, value in SMALL_UNIT.model_dump().items() if isinstance(value, float)}
    times = {"rate_hz": 100.0, "gyro_wander_s": 100.0, "accelerometer_wander_s": 60.0}
    ideal = ImuParameters.model_validate(no_errors | times | {"clock": ClockParameters()})
    static = {"wander_m": (0.0,) * 3, "noise_m": (2e-3,) * 3, "correlation_s": 1.0}
    white = {"velocity_noise_m_s": (5e-3,) * 3, "velocity_wander_m_s": (0.0,) * 3, "clock": ClockParameters()}
    accurate_receiver = RtkParameters.model_validate({"fixed": static, "floating": static} | white)
    path, imu, solution = _run_filter(0, ideal, accurate_receiver)
    # Ten seconds after the start; the unit has 100 samples per second.
    errors = _compute_errors(path, imu, solution, np.arange(1000, 1550))
    assert np.abs(errors[:, :3]).max() < 6e-3
    assert np.abs(errors[:, 3:6]).max() < 0.015


def test_outage_errors_are_consistent_with_the_covariance() -> None:
    """Without fixes for eight seconds the position drifts by decimetres, as for a tilt error of 0.2 deg.

    The normalised squared error of position, velocity and attitude has nine degrees of freedom.
    """
    with_outage = RtkParameters(outages=(Outage(start_s=-3.0, duration_s=8.1),), float_fraction=0.0)
    squared_errors, horizontal_errors_m = [], []
    for seed in range(N_FLIGHTS):
        path, imu, solution = _run_filter(seed, rtk_parameters=with_outage, covariance_times_s=(5.0,))
        error = _compute_errors(path, imu, solution, solution.covariance_indices)[0]
        squared_errors.append(error[:9] @ np.linalg.solve(solution.covariances[0][:9, :9], error[:9]))
        horizontal_errors_m.append(np.hypot(*error[:2]))
    assert 0.2 < np.sqrt(np.mean(np.square(horizontal_errors_m))) < 3.0
    # The errors agree with the covariance during the outage.
    low, high = (float(chi2.ppf(probability, 9 * N_FLIGHTS)) / N_FLIGHTS for probability in (0.001, 0.999))
    assert low < np.mean(squared_errors) < high


def test_stuck_instruments_are_ignored() -> None:
    stuck_parameters = TiltCompassParameters(heading_stuck_s=-8.0, tilt_stuck_s=-8.0)
    attitude_errors_deg: dict[str, list[np.ndarray]] = {name: [] for name in ("free", "stuck")}
    for seed in range(20):
        for name, compass_parameters in (("free", COMPASS), ("stuck", stuck_parameters)):
            path, imu, solution = _run_filter(seed, compass_parameters=compass_parameters)
            error = _compute_errors(path, imu, solution, np.array([1500]))[0]
            attitude_errors_deg[name].append(np.degrees(error[6:9]))
            if name == "stuck":
                late_kinds = solution.innovations.kinds[solution.innovations.times_s > -7.0]
                assert set(late_kinds) == {POSITION_FIX, VELOCITY_FIX}
    rms_free, rms_stuck = (np.sqrt(np.mean(np.square(attitude_errors_deg[name]), axis=0)) for name in ("free", "stuck"))
    # The receiver's velocities determine the tilt with or without inclinometers.
    assert np.all(rms_stuck[:2] < 1.5 * rms_free[:2] + 0.05)
    assert rms_stuck[2] < 4.0


def test_filter_resets_after_persistent_rejection() -> None:
    """A filter with an initial error of 20 m rejects all fixes and resets after one second."""
    path, rng = _make_path(3), np.random.default_rng(4)
    span = path.span_s
    imu, receiver = Imu.draw(SMALL_UNIT, span, rng), RtkReceiver.draw(RtkParameters(float_fraction=0.0), span, rng)
    compass = TiltCompass.draw(COMPASS, rng)
    solutions = receiver.measure(path, receiver.sampling.within(*span), rng)
    readings = compass.measure(path, compass.sampling.within(*span), rng)
    navigation = NavigationFilter(FilterParameters(), SMALL_UNIT, receiver.parameters, COMPASS, GRAVITY)
    start = navigation.initialize(solutions, readings)
    wrong_start = replace(start, state=start.state + np.eye(16)[0] * 20.0, covariance=0.01 * start.covariance)
    solution = navigation.run(wrong_start, imu.increments(path, *span, rng), solutions, readings)
    innovations = solution.innovations
    assert not innovations.used[(innovations.kinds == POSITION_FIX) & (innovations.axes == 0)][0]
    position_errors_m = np.abs(solution.positions_m - path.motion(imu.boundaries(*span)).positions_m)
    # Errors after 0.8 s, and from 2 s on.
    assert position_errors_m[80, 0] > 15.0
    assert position_errors_m[200:].max() < 0.1


def test_pose_is_defined_only_within_the_flight() -> None:
    path, _, solution = _run_filter(0)
    with pytest.raises(ValueError, match="outside the solution times"):
        solution.pose(path.span_s[1] + 1.0)
    # 5 ms after a boundary the position has moved by 5 ms of its velocity.
    tags = solution.increments.times_s
    displacement_m = solution.pose(tags[700] + 0.005).translation - solution.positions_m[700]
    np.testing.assert_allclose(displacement_m, 0.005 * solution.velocities_m_s[700], atol=1e-9)
