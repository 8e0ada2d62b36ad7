"""Tests of the lander's flight: profile, exact derivatives, and limits."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.scenarios.localisation.flight import BELOW_END_M, LEAD_S, LanderFlight, ProfileParameters

GROUND_M = -100.0
GRAVITY_M_S2 = 3.72


def test_flight_follows_the_simulated_parachute_descent(flight: LanderFlight) -> None:
    """The spline equals the solution of the equations of motion until separation."""
    times = np.linspace(-0.99 * LEAD_S, flight.separation_s - 1e-6, 5003)
    spline, parachute = flight.motion(times), flight.parachute.motion(times)
    np.testing.assert_allclose(spline.positions_m, parachute.positions_m, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(spline.velocities_m_s, parachute.velocities_m_s, rtol=0.0, atol=1e-5)
    assert (spline.attitudes.inv() * parachute.attitudes).magnitude().max() < 1e-5
    # the angular acceleration is free at the start of the spline, and steps at separation
    inner = (times > -LEAD_S + 0.1) & (times < flight.separation_s - 0.1)
    np.testing.assert_allclose(spline.body_rates_rad_s[inner], parachute.body_rates_rad_s[inner], rtol=0.0, atol=1e-4)
    np.testing.assert_allclose(
        spline.specific_forces_m_s2[inner], parachute.specific_forces_m_s2[inner], rtol=0.0, atol=1e-3
    )


def test_velocity_rate_and_force_are_derivatives(flight: LanderFlight) -> None:
    """Difference quotients of position, attitude and velocity equal velocity, body rate and specific force."""
    step = 1e-4
    times = np.sort(
        np.concatenate(
            [np.linspace(-1.0, flight.span_s[1] - 1.0, 1999), flight.separation_s + np.linspace(-0.1, 1.5, 101)]
        )
    )
    before, middle, after = (flight.motion(times + offset) for offset in (-step, 0.0, step))
    # second-order differences: acceleration and jerk x step^2 are below 1e-6; rounding of 4 km / step is 1e-8
    velocities = (after.positions_m - before.positions_m) / (2.0 * step)
    np.testing.assert_allclose(velocities, middle.velocities_m_s, rtol=0.0, atol=1e-6)
    rates = (before.attitudes.inv() * after.attitudes).as_rotvec() / (2.0 * step)
    np.testing.assert_allclose(rates, middle.body_rates_rad_s, rtol=0.0, atol=1e-5)
    # the jerk of a cubic spline steps at its knots, by up to 1 m/s^3
    accelerations = (after.velocities_m_s - before.velocities_m_s) / (2.0 * step)
    forces = middle.attitudes.inv().apply(accelerations + np.array([0.0, 0.0, GRAVITY_M_S2]))
    np.testing.assert_allclose(forces, middle.specific_forces_m_s2, rtol=0.0, atol=2e-4)


def test_motion_is_continuous_at_separation(flight: LanderFlight) -> None:
    """Acceleration and body rate change by no more than jerk and angular acceleration x time at separation."""
    first, second = (flight.state(flight.separation_s + offset) for offset in (-1e-4, 1e-4))
    change = second.attitude.apply(second.specific_force_m_s2) - first.attitude.apply(first.specific_force_m_s2)
    assert np.linalg.norm(change) < 0.02
    assert np.linalg.norm(second.body_rate_rad_s - first.body_rate_rad_s) < 1e-3


def test_profile_has_the_altitudes_and_speeds_of_the_parameters(flight: LanderFlight) -> None:
    """Altitudes of start, separation and end; speeds under the parachute and on the thrusters."""
    p = flight.parameters
    start, separation, end = (flight.state(time) for time in (0.0, flight.separation_s, flight.end_s))
    np.testing.assert_allclose(start.position_m, [300.0, -200.0, GROUND_M + 4200.0], rtol=0.0, atol=1e-6)
    assert separation.position_m[2] - GROUND_M == pytest.approx(p.altitude_separation_m, abs=1e-6)
    assert end.position_m[2] - GROUND_M == pytest.approx(p.altitude_end_m, abs=1e-6)
    assert flight.time_of_altitude(500.0) == pytest.approx(flight.end_s, abs=1e-9)
    assert flight.state(flight.span_s[1]).position_m[2] - GROUND_M == pytest.approx(500.0 - BELOW_END_M, abs=1e-3)
    assert -start.velocity_m_s[2] == pytest.approx(90.0, abs=1.5)
    # equilibrium speed in air whose density has grown by exp(2100 / 11200): 82 m/s
    assert -separation.velocity_m_s[2] == pytest.approx(82.0, abs=3.0)
    np.testing.assert_allclose(end.velocity_m_s, [0.0, 0.0, -p.descent_speed_m_s], rtol=0.0, atol=0.3)


def test_powered_descent_keeps_its_limits(flight: LanderFlight) -> None:
    """Accelerations, tilt and body rate are within the limits once the thrusters have replaced the parachute."""
    p = flight.parameters
    motion = flight.motion(np.arange(flight.separation_s + 2.5, flight.end_s, 0.02))
    accelerations = motion.attitudes.apply(motion.specific_forces_m_s2) - np.array([0.0, 0.0, GRAVITY_M_S2])
    assert np.linalg.norm(accelerations[:, :2], axis=1).max() < p.max_horizontal_m_s2
    assert np.abs(accelerations[:, 2]).max() < 1.05 * p.max_vertical_m_s2
    cycle_rate = 2.0 * np.pi * np.sqrt(3.0) * p.limit_cycle_deg / p.limit_cycle_s
    assert np.degrees(np.linalg.norm(motion.body_rates_rad_s, axis=1)).max() < p.max_rate_deg_s + cycle_rate
    tilt_deg = np.degrees(np.arccos(motion.attitudes.as_matrix()[:, 2, 2]))
    assert tilt_deg.max() < 20.0
    # upright with the limit cycle only, once the horizontal velocity is zero
    assert tilt_deg[-50:].max() < np.sqrt(2.0) * p.limit_cycle_deg + 0.05


def test_errors_name_the_allowed_values(flight: LanderFlight) -> None:
    """Invalid altitudes are reported."""
    with pytest.raises(ValueError, match="allowed: decreasing"):
        ProfileParameters(altitude_separation_m=5000.0)
    with pytest.raises(ValueError, match="is not passed; allowed"):
        flight.time_of_altitude(100.0)
    with pytest.raises(ValueError, match="allowed: above the separation"):
        LanderFlight.simulate(
            flight.parameters, np.zeros(3), np.random.default_rng(0), ground_height_m=0.0, gravity_m_s2=GRAVITY_M_S2
        )


def test_guidance_does_not_change_the_heading(flight: LanderFlight) -> None:
    """The heading at the end is the heading at separation; heading: rotation about the vertical without the tilt."""
    headings = []
    for time in (flight.separation_s, flight.end_s):
        attitude = flight.state(time).attitude
        up = attitude.apply([0.0, 0.0, 1.0])
        tilt = Rotation.from_quat(np.append(np.cross([0.0, 0.0, 1.0], up), 1.0 + up[2]))
        headings.append((tilt.inv() * attitude).as_rotvec()[2])
    assert headings[1] == pytest.approx(headings[0], abs=np.radians(0.35))
