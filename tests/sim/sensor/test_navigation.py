"""Tests of the navigation filter: errors consistent with its covariance, and robust to instrument faults."""

from __future__ import annotations

from dataclasses import dataclass, replace
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
from marsyard.sim.measurements import ImuIncrements
from marsyard.sim.sensor.helicopter_navigation import (
    FilterParameters,
    FilterState,
    NavigationFilter,
    NavigationSolution,
)
from marsyard.sim.sensor.imu import SMALL_UNIT, Imu, ImuParameters
from marsyard.sim.sensor.instrument import ClockParameters
from marsyard.sim.sensor.rtk import Outage, RtkParameters, RtkReceiver, RtkSolutions
from marsyard.sim.sensor.tilt_compass import TiltCompass, TiltCompassParameters, TiltCompassReadings

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


@dataclass(frozen=True)
class Flight:
    """A flight with its inertial unit, a filter, its initial state, and the readings of all instruments."""

    path: SimulatedPath
    imu: Imu
    navigation: NavigationFilter
    start: FilterState
    increments: ImuIncrements
    solutions: RtkSolutions
    readings: TiltCompassReadings

    @classmethod
    def simulate(
        cls,
        seed: int,
        imu_parameters: ImuParameters = SMALL_UNIT,
        rtk: RtkParameters = RTK,
        compass_parameters: TiltCompassParameters = COMPASS,
    ) -> Flight:
        path, rng = _make_path(seed), np.random.default_rng([seed, 1])
        span = path.span_s
        imu = Imu.draw(imu_parameters, span, rng)
        receiver, compass = RtkReceiver.draw(rtk, span, rng), TiltCompass.draw(compass_parameters, rng)
        increments = imu.increments(path, *span, rng)
        solutions = receiver.measure(path, receiver.sampling.within(*span), rng)
        readings = compass.measure(path, compass.sampling.within(*span), rng)
        navigation = NavigationFilter(FilterParameters(), SMALL_UNIT, rtk, compass_parameters, GRAVITY)
        start = navigation.initialize(solutions, readings)
        return cls(path, imu, navigation, start, increments, solutions, readings)

    def estimate(self, end_s: float = np.inf) -> NavigationSolution:
        """Run the filter to a time tag."""
        i = self.increments
        count = int(np.searchsorted(i.times_s, end_s, side="right"))
        part = ImuIncrements(
            i.times_s[:count], i.period_s, i.delta_angles_rad[: count - 1], i.delta_velocities_m_s[: count - 1]
        )
        return self.navigation.run(self.start, part, self.solutions, self.readings)


def _compute_errors(flight: Flight, solution: NavigationSolution, indices: np.ndarray) -> np.ndarray:
    """Compute the true minus the estimated state: position, velocity, attitude, biases of gyro and accelerometer.

    The result has fifteen columns. `indices` select the samples of the inertial unit. Scale and misalignment errors of
    the accelerometer count as a bias: their product with gravity.
    """
    imu, times = flight.imu, flight.imu.boundaries(*flight.path.span_s)[indices]
    truth = flight.path.motion(times)
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


def _compute_end_error(flight: Flight, end_s: float, size: int) -> tuple[np.ndarray, float]:
    """Run to a time; return the errors there, and the normalised squared error of the first `size` of them."""
    solution = flight.estimate(end_s)
    error = _compute_errors(flight, solution, np.array([len(solution.positions_m) - 1]))[0]
    return error, float(error[:size] @ np.linalg.solve(solution.end.covariance[:size, :size], error[:size]))


def _assert_chi_square(mean: float, degrees: int) -> None:
    """Assert that a mean over `N_FLIGHTS` squared errors is within the 99.8 % band of chi-square."""
    low, high = (float(chi2.ppf(probability, degrees * N_FLIGHTS)) / N_FLIGHTS for probability in (0.001, 0.999))
    assert low < mean < high


def test_errors_are_consistent_with_the_covariance() -> None:
    """The state of each flight has fifteen degrees of freedom."""
    with_float_solutions = RtkParameters(float_fraction=0.3, float_s=10.0)
    flights = [Flight.simulate(seed, rtk=with_float_solutions) for seed in range(N_FLIGHTS)]
    for end_s in (-3.0, 0.0, 2.5, 5.0):
        _assert_chi_square(float(np.mean([_compute_end_error(flight, end_s, 15)[1] for flight in flights])), 15)


def test_readings_without_faults_pass_the_gate() -> None:
    for seed in range(10):
        flight = Flight.simulate(seed)
        open_gate = replace(flight.navigation, parameters=FilterParameters(gate=1e9))
        without_gate = replace(flight, navigation=open_gate).estimate()
        np.testing.assert_array_equal(flight.estimate().positions_m, without_gate.positions_m)


def test_better_instruments_reduce_the_errors() -> None:
    """The inertial unit is ideal. The receiver has white noise of 2 mm and 5 mm/s, which the filter averages."""
    no_errors = {name: 0.0 for name, value in SMALL_UNIT.model_dump().items() if isinstance(value, float)}
    times = {"rate_hz": 100.0, "gyro_wander_s": 100.0, "accelerometer_wander_s": 60.0}
    ideal = ImuParameters.model_validate(no_errors | times | {"clock": ClockParameters()})
    static = {"wander_m": (0.0,) * 3, "noise_m": (2e-3,) * 3, "correlation_s": 1.0}
    white = {"velocity_noise_m_s": (5e-3,) * 3, "velocity_wander_m_s": (0.0,) * 3, "clock": ClockParameters()}
    accurate_receiver = RtkParameters.model_validate({"fixed": static, "floating": static} | white)
    flight = Flight.simulate(0, ideal, accurate_receiver)
    # Ten seconds after the start; the unit has 100 samples per second.
    errors = _compute_errors(flight, flight.estimate(), np.arange(1000, 1550))
    assert np.abs(errors[:, :3]).max() < 6e-3
    assert np.abs(errors[:, 3:6]).max() < 0.015


def test_outage_errors_are_consistent_with_the_covariance() -> None:
    """Without fixes for eight seconds the position drifts by decimetres, as for a tilt error of 0.2 deg.

    The normalised squared error of position, velocity and attitude has nine degrees of freedom.
    """
    with_outage = RtkParameters(outages=(Outage(start_s=-3.0, duration_s=8.1),), float_fraction=0.0)
    ends = [_compute_end_error(Flight.simulate(seed, rtk=with_outage), 5.0, 9) for seed in range(N_FLIGHTS)]
    assert 0.2 < np.sqrt(np.mean([error[0] ** 2 + error[1] ** 2 for error, _ in ends])) < 3.0
    # The errors agree with the covariance during the outage.
    _assert_chi_square(float(np.mean([squared for _, squared in ends])), 9)


def test_stuck_instruments_are_ignored() -> None:
    """The ninth of equal readings and all later ones have no effect: by default at most eight are used."""
    flight = Flight.simulate(0, compass_parameters=TiltCompassParameters(heading_stuck_s=-8.0, tilt_stuck_s=-8.0))
    solution = flight.estimate()
    up, headings = flight.readings.up_body.copy(), flight.readings.headings_rad.copy()
    for values in (up, headings[:, None]):
        last_change = int(np.flatnonzero(np.any(values[1:] != values[:-1], axis=1))[-1])
        values[last_change + 1 + 8 :] = np.nan
    without_readings = replace(flight, readings=replace(flight.readings, up_body=up, headings_rad=headings)).estimate()
    np.testing.assert_array_equal(solution.attitudes.as_quat(), without_readings.attitudes.as_quat())
    # The receiver's velocities determine the tilt also without inclinometers.
    error_deg = np.degrees(_compute_errors(flight, solution, np.array([1500]))[0, 6:9])
    assert np.abs(error_deg[:2]).max() < 1.0
    assert abs(error_deg[2]) < 8.0


def test_filter_resets_after_persistent_rejection() -> None:
    """A filter with an initial error of 20 m rejects all fixes and resets after one second."""
    flight = Flight.simulate(3, rtk=RtkParameters(float_fraction=0.0))
    start = flight.start
    wrong_start = replace(start, state=start.state + np.eye(16)[0] * 20.0, covariance=0.01 * start.covariance)
    solution = replace(flight, start=wrong_start).estimate()
    errors_m = np.abs(_compute_errors(flight, solution, np.arange(len(solution.positions_m)))[:, :3])
    # Errors after 0.8 s, and from 2 s on.
    assert errors_m[80, 0] > 15.0
    assert errors_m[200:].max() < 0.1


def test_pose_is_defined_only_within_the_flight() -> None:
    flight = Flight.simulate(0)
    solution = flight.estimate()
    with pytest.raises(ValueError, match="outside the solution times"):
        solution.pose(flight.path.span_s[1] + 1.0)
    # 5 ms after a boundary the position has moved by 5 ms of its velocity.
    tags = solution.increments.times_s
    displacement_m = solution.pose(tags[700] + 0.005).translation - solution.positions_m[700]
    np.testing.assert_allclose(displacement_m, 0.005 * solution.velocities_m_s[700], atol=1e-9)
