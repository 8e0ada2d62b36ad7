"""The small helicopter's flight: consistent in itself, and as the landing paper describes it (section V)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from marsyard.sim.dynamics import Trajectory
from marsyard.sim.dynamics.rotorcraft import (
    TAIL_S,
    Air,
    AirParameters,
    GroundPatch,
    LandingGuidance,
    LandingLaser,
    Phase,
    RotorcraftFlight,
    RotorcraftParameters,
    TransitParameters,
    VibrationParameters,
    landing_flight,
    transit_flight,
)

GRAVITY, COURSE, HEADING = 9.8, 0.3, 1.0
OVER, SITE = np.array([100.0, 50.0, 12.0]), np.array([103.0, 52.0])
CRAFT, TRANSIT, GUIDANCE = RotorcraftParameters(), TransitParameters(), LandingGuidance()
CALM: dict[str, Any] = {"east_m_s": 0.0, "north_m_s": 0.0, "gust_m_s": 0.0, "vertical_gust_m_s": 0.0}
SMOOTH = RotorcraftParameters(vibration=VibrationParameters(acceleration_m_s2=0.0, angle_deg=0.0))


def _air(seed: int, **changes: float) -> Air:
    span = TRANSIT.lead_s + TRANSIT.pictures_s + TAIL_S + GUIDANCE.wait_s + GUIDANCE.max_duration_s
    return Air.draw(AirParameters.model_validate(changes), CRAFT.step_s, span, np.random.default_rng(seed))


def _transit(air: Air, craft: RotorcraftParameters = CRAFT) -> RotorcraftFlight:
    return transit_flight(craft, TRANSIT, OVER, COURSE, HEADING, GRAVITY, air, np.random.default_rng(5))


def _landing(
    seed: int = 0,
    east_error_m: float = 0.0,
    slope: float = 0.0,
    stuck_m: float | None = None,
    craft: RotorcraftParameters = CRAFT,
    **wind: float,
) -> RotorcraftFlight:
    air = _air(seed, **wind)
    flown = _transit(air, craft)
    errors = np.zeros((len(flown.path.rows), 9))
    errors[:, 0] = east_error_m
    heights = 2.0 + slope * np.tile(0.5 * np.arange(101.0) - 25.0, (101, 1))
    ground = GroundPatch(SITE - 25.0, 0.5, heights)
    laser = LandingLaser(1.0, np.zeros(len(air.gusts_m_s)), stuck_m)
    return landing_flight(flown, GUIDANCE, SITE, errors, air, ground, laser)


def test_an_air_that_ends_too_soon_is_refused() -> None:
    """The kernels would read past its end."""
    air = Air.draw(AirParameters(), CRAFT.step_s, TRANSIT.lead_s + TRANSIT.pictures_s, np.random.default_rng(0))
    with pytest.raises(ValueError, match="the flight may take"):
        _transit(air)


def _touchdown(flight: RotorcraftFlight) -> np.ndarray:
    time = flight.first(Phase.ON_GROUND)
    assert time is not None
    return flight.path.state(time).position_m


def test_velocity_rate_and_force_are_derivatives() -> None:
    """Central differences over 1e-4 s: truncation at the vibration's 22 Hz is (2 pi f h)^2 / 6 = 3e-5 of each."""
    flown, step = _landing(3).path, 1e-4
    assert isinstance(flown, Trajectory)
    first, last = flown.span_s
    times = np.random.default_rng(0).uniform(first + step, last - step, 2000)
    before, now, after = (flown.motion(times + shift) for shift in (-step, 0.0, step))
    velocity = (after.positions_m - before.positions_m) / (2.0 * step)
    np.testing.assert_allclose(now.velocities_m_s, velocity, atol=1e-6)
    acceleration = (after.velocities_m_s - before.velocities_m_s) / (2.0 * step)
    felt = now.attitudes.inv().apply(acceleration + np.array([0.0, 0.0, GRAVITY]))
    # third derivatives jump at the knots, by up to 100 m/s3 at the touchdown
    np.testing.assert_allclose(now.specific_forces_m_s2, felt, atol=5e-3)
    rate = (before.attitudes.inv() * after.attitudes).as_rotvec() / (2.0 * step)
    np.testing.assert_allclose(now.body_rates_rad_s, rate, atol=1e-5)


def test_specific_force_is_thrust_along_the_rotor_and_drag() -> None:
    """In calm air: across the rotor's axis there is nothing but drag."""
    flown = _transit(_air(0, **CALM), SMOOTH).path
    motion = flown.motion(flown.knots_s[1:])
    drag = motion.attitudes.inv().apply(-motion.velocities_m_s / SMOOTH.drag_s)
    # thrust is turned by angles predicted a step ahead: a command that jumps by 1 m/s2 changes them in that step by
    # omega^2 / g h^2 / 6 = 2e-4 rad
    np.testing.assert_allclose(motion.specific_forces_m_s2[:, :2], drag[:, :2], atol=3e-3)


def test_it_pitches_forward_to_fly_and_against_the_wind() -> None:
    """Steady flight: tan(tilt) = drag over weight, of 1 m/s less the wind along the course."""
    for wind in (0.0, -3.0):
        blowing = CALM | {"east_m_s": wind * np.cos(COURSE), "north_m_s": wind * np.sin(COURSE)}
        flown = transit_flight(
            SMOOTH, TRANSIT, OVER, COURSE, COURSE, GRAVITY, _air(0, **blowing), np.random.default_rng(0)
        ).path
        attitude = flown.state(TRANSIT.pictures_s).attitude.as_euler("ZYX")
        speed = float(flown.state(TRANSIT.pictures_s).velocity_m_s[:2] @ [np.cos(COURSE), np.sin(COURSE)])
        assert speed == pytest.approx(1.0, abs=0.05)
        assert np.tan(attitude[1]) == pytest.approx((speed - wind) / 5.0 / GRAVITY, abs=2e-3)
        assert attitude[2] == pytest.approx(0.0, abs=1e-6)


def test_the_transit_keeps_its_height_and_its_course() -> None:
    """Forty pictures, five seconds, 1 m/s: 5 m along the course, at constant height but for the gusts."""
    ends, heights, tilts = [], [], []
    for seed in range(20):
        motion = _transit(_air(seed)).path.motion(np.linspace(0.0, TRANSIT.pictures_s, TRANSIT.pictures))
        ends.append(motion.positions_m[-1] - motion.positions_m[0])
        heights.append(np.ptp(motion.positions_m[:, 2]))
        tilts.append(motion.attitudes.as_euler("ZYX", degrees=True).std(axis=0))
    along = np.mean(ends, axis=0)
    assert np.hypot(*along[:2]) == pytest.approx(5.0, abs=0.3)
    assert np.arctan2(along[1], along[0]) == pytest.approx(COURSE, abs=0.1)
    assert max(heights) < 0.3
    # gusts move the attitude within a flight by about a degree; well within the paper's limits of tracking, 10 deg
    assert 0.2 < np.mean(tilts) < 2.0


def test_it_shakes_at_the_stated_rate() -> None:
    shaken, smooth = (_transit(_air(1), craft).path for craft in (CRAFT, SMOOTH))
    times = np.arange(0.0, 5.0, 1e-3)
    moving = [flown.motion(times) for flown in (shaken, smooth)]
    felt = [motion.attitudes.apply(motion.specific_forces_m_s2) for motion in moving]
    spectrum = np.abs(np.fft.rfft(felt[0] - felt[1], axis=0)) * 2.0 / times.size
    assert np.all(np.argmax(spectrum, axis=0) == 110)  # 5 s resolve 0.2 Hz
    np.testing.assert_allclose(spectrum[110], 1.5, rtol=1e-3)
    turned = moving[0].attitudes.as_euler("ZYX", degrees=True) - moving[1].attitudes.as_euler("ZYX", degrees=True)
    np.testing.assert_allclose(turned.std(axis=0), 0.03 / np.sqrt(2.0), rtol=1e-3)


def test_in_calm_air_it_lands_on_the_site_from_where_it_believes_to_be() -> None:
    exact = _touchdown(_landing(**CALM))
    np.testing.assert_allclose(exact[:2], SITE, atol=0.02)
    shifted = _touchdown(_landing(east_error_m=0.7, **CALM))
    np.testing.assert_allclose(shifted[:2], SITE - [0.7, 0.0], atol=0.02)


def test_gusts_spread_touchdowns() -> None:
    def spread(gust_m_s: float) -> float:
        off = [_touchdown(_landing(seed, gust_m_s=gust_m_s))[:2] - SITE for seed in range(25)]
        return float(np.sqrt(np.mean(np.square(off))))

    # nothing saturates, so twice the gusts make about twice the errors; 50 values are known to 10 %
    assert spread(0.8) / spread(0.4) == pytest.approx(2.0, rel=0.2)


def test_phases_begin_where_the_paper_says() -> None:
    flight = _landing(slope=0.1, craft=SMOOTH, **CALM)
    state = {phase: flight.path.state(time) for phase in Phase if (time := flight.first(phase)) is not None}
    assert list(state) == list(Phase)
    assert state[Phase.APPROACH].time_s - TRANSIT.pictures_s == pytest.approx(GUIDANCE.wait_s, abs=0.05)
    # commands act on the state 0.1 s before: 0.2 m at 2 m/s, 0.07 m at the descent's 0.7 m/s
    assert np.hypot(*(state[Phase.DESCENT].position_m[:2] - SITE)) == pytest.approx(2.0, abs=0.25)
    flare = state[Phase.LANDING].position_m
    assert flare[2] - 2.0 - 0.1 * (flare[0] - SITE[0]) == pytest.approx(1.5, abs=0.1)
    down = state[Phase.ON_GROUND]
    assert down.position_m[2] - 2.0 - 0.1 * (down.position_m[0] - SITE[0]) == pytest.approx(CRAFT.gear_m, abs=0.01)
    assert down.velocity_m_s[2] == pytest.approx(-GUIDANCE.flare_m_s, abs=0.05)
    rest = flight.path.state(flight.path.span_s[1])
    np.testing.assert_allclose(rest.velocity_m_s, 0.0, atol=1e-9)
    np.testing.assert_allclose(rest.attitude.as_matrix()[:, 2], [0.0, 0.0, 1.0], atol=1e-9)
    assert rest.time_s - down.time_s == pytest.approx(GUIDANCE.rest_s, abs=0.05)


def test_with_a_stuck_altimeter_it_never_slows_down() -> None:
    flight = _landing(stuck_m=9.0, **CALM)
    assert flight.first(Phase.LANDING) is None
    time = flight.first(Phase.ON_GROUND)
    assert time is not None
    assert flight.path.state(time).velocity_m_s[2] == pytest.approx(-GUIDANCE.descent_m_s, abs=0.05)


def test_a_flight_is_known_within_its_span_only() -> None:
    with pytest.raises(ValueError, match="outside of the motion"):
        _transit(_air(0)).path.state(99.0)
