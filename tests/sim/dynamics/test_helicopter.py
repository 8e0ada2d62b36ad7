"""Tests of the field test helicopter: kinematic consistency and the flight described in the paper (III.C)."""

from __future__ import annotations

import numpy as np
import pytest

from marsyard.sim.dynamics.helicopter import HelicopterFlight, HelicopterParameters, draw_helicopter_flight

#: Ground point under the middle of the flight line, world axes, m.
ORIGIN = np.array([100.0, -200.0, 35.0])


def make_flight(**changes: object) -> HelicopterFlight:
    """Draw a flight with an azimuth of 70 deg and gravity of 9.8 m/s2."""
    parameters = HelicopterParameters.model_validate(changes)
    return draw_helicopter_flight(parameters, ORIGIN, np.radians(70.0), 9.8, np.random.default_rng(7))


@pytest.mark.parametrize("turns_with_flight", [False, True])
def test_velocity_rate_and_force_are_derivatives(turns_with_flight: bool) -> None:
    """The truncation error of central differences over 0.4 ms is below 1e-6 m/s for the vibration of 13 Hz."""
    flight, step = make_flight(turns_with_flight=turns_with_flight), 2e-4
    times = np.linspace(-40.0, 2440.0, 400)
    before, motion, after = (flight.motion(times + shift) for shift in (-step, 0.0, step))
    velocity = (after.positions_m - before.positions_m) / (2.0 * step)
    np.testing.assert_allclose(motion.velocities_m_s, velocity, atol=1e-5)
    acceleration = (after.velocities_m_s - before.velocities_m_s) / (2.0 * step)
    specific_force = motion.attitudes.inv().apply(acceleration + np.array([0.0, 0.0, 9.8]))
    np.testing.assert_allclose(motion.specific_forces_m_s2, specific_force, atol=1e-4)
    rate = (before.attitudes.inv() * after.attitudes).as_rotvec() / (2.0 * step)
    # The body axes rotate by up to half a step during the central difference.
    np.testing.assert_allclose(motion.body_rates_rad_s, rate, atol=2e-5)


def test_heights_speed_and_tilt_match_the_paper() -> None:
    flight = make_flight()
    times = np.concatenate([np.arange(leg.start_s, leg.end_s, 0.1) for leg in flight.passes])
    motion = flight.motion(times)
    heights = motion.positions_m[:, 2] - ORIGIN[2]
    assert abs(heights.min() - 1000.0) < 1.0
    assert abs(heights.max() - 2000.0) < 1.0
    assert np.all(np.abs(motion.velocities_m_s[:, 2] - 1.0) < 0.03)  # climb rate (paper: "1 to 2 m/s") plus vibration
    speed = np.hypot(*motion.velocities_m_s[:, :2].T)
    assert abs(speed.mean() - 30.0) < 0.5
    tilt = np.degrees(np.arccos(motion.attitudes.as_matrix()[:, 2, 2]))
    assert 20.0 < tilt.max() < 45.0
    assert 25.0 < np.degrees(np.linalg.norm(motion.body_rates_rad_s, axis=1)).max() < 61.0


def test_passes_alternate_along_one_line() -> None:
    flight = make_flight()
    course_axis = np.array([np.sin(np.radians(70.0)), np.cos(np.radians(70.0))])
    for flight_pass in flight.passes:
        middle = flight.state(0.5 * (flight_pass.start_s + flight_pass.end_s))
        assert np.sign(middle.velocity_m_s[:2] @ course_axis) == flight_pass.direction == (-1) ** flight_pass.number
        cross_track_m = (middle.position_m - ORIGIN)[:2] @ np.array([-course_axis[1], course_axis[0]])
        assert abs(cross_track_m) < 40.0  # 5 times the RMS of the wander


def test_targets_are_overflown_40_minutes_apart() -> None:
    flight = make_flight()
    first, second = ((start + end) / 2.0 for start, end in flight.fly_overs_s)
    assert second - first == pytest.approx(2400.0)
    for time_s in (first, second):
        assert np.hypot(*(flight.state(time_s).position_m - ORIGIN)[:2]) < 40.0


def test_inconsistent_parameters_are_rejected() -> None:
    with pytest.raises(ValueError, match="do not fit into"):
        HelicopterParameters(passes=20)
    with pytest.raises(ValueError, match="outside of the motion"):
        make_flight().state(3000.0)
