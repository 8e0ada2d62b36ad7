import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad_vec
from scipy.spatial.transform import Rotation

from sim.dynamics import DescentParameters, ParachuteDescent

START = np.array([100.0, -50.0, 2100.0])


def _descent(**changes: float) -> ParachuteDescent:
    swinging = {
        "wind_east_m_s": 12.0,
        "wind_north_m_s": -7.0,
        "gust_east_m_s2": 0.3,
        "cone_angle_deg": 25.0,
        "cone_phase_deg": 40.0,
        "nod_rate_deg_s": 60.0,
        "nod_phase_deg": 70.0,
        "heading_deg": 200.0,
        "spin_rate_deg_s": 5.0,
    }
    return ParachuteDescent(DescentParameters(**(swinging | changes)), START)


STILL = {"cone_angle_deg": 0.0, "nod_rate_deg_s": 0.0, "spin_rate_deg_s": 0.0, "gust_east_m_s2": 0.0}


@settings(max_examples=20)
@given(time_s=st.floats(-5.0, 20.0))
def test_velocity_integrates_to_position_and_force_to_velocity(time_s: float) -> None:
    descent = _descent()
    span = 0.7
    before, after = descent.state(time_s), descent.state(time_s + span)
    travelled, _ = quad_vec(lambda t: descent.state(t).velocity_m_s, time_s, time_s + span, epsabs=1e-9)
    np.testing.assert_allclose(after.position_m - before.position_m, travelled, atol=1e-7)

    def acceleration(t: float) -> np.ndarray:
        state = descent.state(t)
        return state.attitude.apply(state.specific_force_m_s2) + np.array([0.0, 0.0, -descent.gravity_m_s2])

    gained, _ = quad_vec(acceleration, time_s, time_s + span, epsabs=1e-8)
    np.testing.assert_allclose(after.velocity_m_s - before.velocity_m_s, gained, atol=1e-5)


def test_body_rate_turns_the_attitude() -> None:
    descent = _descent()
    attitude, step = descent.state(0.0).attitude, 1e-3
    for k in range(1000):
        rate = descent.state((k + 0.5) * step).body_rate_rad_s
        attitude = attitude * Rotation.from_rotvec(rate * step)
    error = (attitude * descent.state(1.0).attitude.inv()).magnitude()
    # the midpoint rule is off by step^2/24 times the second derivative of the rate, about 30 rad/s^3
    assert error < 1e-5


def test_first_picture_is_at_the_start() -> None:
    np.testing.assert_allclose(_descent().state(0.0).position_m, START, atol=1e-12)


def test_without_swing_the_lander_drifts_with_the_wind_and_looks_down() -> None:
    descent = _descent(**STILL)
    state = descent.state(3.0)
    np.testing.assert_allclose(state.velocity_m_s, [12.0, -7.0, -75.0 + 0.2 * 3.0], atol=1e-8)
    np.testing.assert_allclose(state.attitude.apply([0.0, 0.0, -1.0]), [0.0, 0.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(state.body_rate_rad_s, 0.0, atol=1e-10)
    assert np.linalg.norm(state.specific_force_m_s2) == pytest.approx(3.71 + 0.2, abs=1e-3)


def test_heading_turns_clockwise_from_north() -> None:
    forward = _descent(**STILL, heading_deg=90.0).state(0.0).attitude.apply([0.0, 1.0, 0.0])
    np.testing.assert_allclose(forward, [1.0, 0.0, 0.0], atol=1e-12)


def test_greatest_rate_and_angle_are_those_asked_for() -> None:
    times = np.linspace(0.0, 22.0, 2001)
    nodding = _descent(**(STILL | {"nod_rate_deg_s": 60.0}))
    rates = [np.linalg.norm(nodding.state(t).body_rate_rad_s) for t in times[:200]]
    assert np.degrees(max(rates)) == pytest.approx(60.0, rel=1e-3)
    coning = _descent(**(STILL | {"cone_angle_deg": 30.0}))
    axes = coning.attitudes(times).apply([0.0, 0.0, -1.0])
    assert np.degrees(np.arccos(-axes[:, 2])).max() == pytest.approx(30.0, abs=1e-3)


def test_tilts_towards_the_azimuth_asked_for() -> None:
    coning = _descent(
        **(STILL | {"cone_angle_deg": 20.0}), cone_direction_deg=90.0, cone_phase_deg=0.0, heading_deg=0.0
    )
    # the line leans so that the lander swings out to the east and its camera, looking along it, looks east of nadir
    looking = coning.attitudes(np.zeros(1)).apply([0.0, 0.0, -1.0])[0]
    np.testing.assert_allclose(looking, [np.sin(np.radians(20.0)), 0.0, -np.cos(np.radians(20.0))], atol=1e-12)


def test_motion_holds_the_states() -> None:
    descent, times = _descent(), np.array([-2.0, 0.0, 7.5])
    motion = descent.motion(times)
    for k, time in enumerate(times):
        state = descent.state(float(time))
        np.testing.assert_array_equal(motion.positions_m[k], state.position_m)
        np.testing.assert_array_equal(motion.velocities_m_s[k], state.velocity_m_s)
        np.testing.assert_array_equal(motion.attitudes[k].as_quat(), state.attitude.as_quat())
        np.testing.assert_array_equal(motion.body_rates_rad_s[k], state.body_rate_rad_s)
        np.testing.assert_array_equal(motion.specific_forces_m_s2[k], state.specific_force_m_s2)
    assert descent.span_s == (-np.inf, np.inf)
