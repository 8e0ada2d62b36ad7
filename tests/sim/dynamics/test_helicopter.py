"""Tests of the field test helicopter: kinematic consistency and the flight described in the paper (III.C)."""

from itertools import pairwise

import numpy as np
import pytest

from marsyard.sim.dynamics.helicopter import HelicopterFlight, HelicopterParameters, draw_helicopter_flight
from tests.sim.sensor.motions import assert_derivatives

#: Ground point under the middle of the flight line, world axes, m.
ORIGIN = np.array([100.0, -200.0, 35.0])


def make_flight(**changes: object) -> HelicopterFlight:
    """Draw a flight with an azimuth of 70 deg and gravity of 9.8 m/s2."""
    parameters = HelicopterParameters.model_validate(changes)
    return draw_helicopter_flight(parameters, ORIGIN, np.radians(70.0), 9.8, np.random.default_rng(7))


def draw_default_flight(seed: int) -> HelicopterFlight:
    return draw_helicopter_flight(HelicopterParameters(), ORIGIN, 0.3, 9.8, np.random.default_rng(seed))


@pytest.mark.parametrize("turns_with_flight", [False, True])
def test_velocity_rate_and_force_are_derivatives(turns_with_flight: bool) -> None:
    """The truncation error of central differences over 0.4 ms is below 1e-6 m/s for the vibration of 13 Hz."""
    flight = make_flight(turns_with_flight=turns_with_flight)
    assert_derivatives(flight.motion, np.linspace(-40.0, 2540.0, 400), 2e-4, 9.8, velocity=1e-5, force=1e-4, rate=2e-5)


def test_heights_speed_and_tilt_match_the_paper() -> None:
    flight = make_flight()
    times = np.concatenate([np.arange(leg.start_s, leg.end_s, 0.1) for leg in flight.passes])
    motion = flight.motion(times)
    heights = motion.positions_m[:, 2] - ORIGIN[2]
    assert abs(heights.min() - 1000.0) < 1.0
    assert abs(heights.max() - 2000.0) < 1.0
    climbs = np.array([leg.climb_m_s for leg in flight.passes])
    assert np.all((climbs >= 1.0) & (climbs <= 2.0))  # "1 to 2 m/s vertical"
    pass_numbers = np.concatenate([np.full(np.arange(p.start_s, p.end_s, 0.1).size, p.number) for p in flight.passes])
    # vibration: 1 m/s2 RMS of three axes at 13 Hz, 0.012 m/s
    assert np.all(np.abs(motion.velocities_m_s[:, 2] - climbs[pass_numbers]) < 0.03)
    speed = np.hypot(*motion.velocities_m_s[:, :2].T)
    assert abs(speed.mean() - 30.0) < 0.5
    tilt = np.degrees(np.arccos(motion.attitudes.as_matrix()[:, 2, 2]))
    assert 20.0 < tilt.max() < 45.0
    assert 25.0 < np.degrees(np.linalg.norm(motion.body_rates_rad_s, axis=1)).max() < 61.0


def test_run_ends_at_the_maximum_height() -> None:
    """Paper, III.C and III.D.4: from 1000 m to 2000 m, images for about 30 min, about 40 min between the targets."""
    for seed in range(6):
        passes = draw_default_flight(seed).passes
        assert passes[0].start_m == 1000.0
        for before, after in pairwise(passes):
            assert before.end_s - before.start_s == pytest.approx(70.0)
            # turns at constant height
            assert after.start_m == pytest.approx(before.end_m)
            assert after.start_s - before.end_s == pytest.approx(passes[1].start_s - passes[0].end_s)
        assert passes[-1].start_m < 2000.0
        assert passes[-1].end_m == pytest.approx(2000.0)
        assert passes[-1].end_s - passes[0].start_s == pytest.approx(1800.0)


def test_number_of_passes_follows_from_the_climb() -> None:
    """1000 m at 1.5 m/s: nine passes of 105 m in 70 s, and one of 55 m in 36.7 s."""
    passes = make_flight(min_climb_m_s=1.5, max_climb_m_s=1.5).passes
    assert [leg.start_m for leg in passes] == pytest.approx([1000.0 + 105.0 * number for number in range(10)])
    assert passes[-1].end_s - passes[-1].start_s == pytest.approx(55.0 / 1.5)
    # a multiple of the climb of a pass: the last pass is complete
    passes = make_flight(min_climb_m_s=2.0, max_climb_m_s=2.0, highest_m=1700.0).passes
    assert [leg.end_s - leg.start_s for leg in passes] == pytest.approx([70.0] * 5)
    assert len(make_flight(highest_m=1050.0).passes) == 1


def test_helicopter_completes_the_line_after_the_last_image() -> None:
    flight = make_flight(min_climb_m_s=1.5, max_climb_m_s=1.5)
    start_s = flight.passes[-1].start_s
    along = (flight.state(start_s + 70.0).position_m - ORIGIN) @ [np.sin(np.radians(70.0)), np.cos(np.radians(70.0)), 0]
    # half the line of 70 s at 30 m/s; the distance from the line has no component along it
    assert along == pytest.approx(flight.passes[-1].direction * 1050.0, abs=1.0)


def test_passes_alternate_along_one_line() -> None:
    flight = make_flight()
    course_axis = np.array([np.sin(np.radians(70.0)), np.cos(np.radians(70.0))])
    for flight_pass in flight.passes:
        middle = flight.state(0.5 * (flight_pass.start_s + flight_pass.end_s))
        assert np.sign(middle.velocity_m_s[:2] @ course_axis) == flight_pass.direction == (-1) ** flight_pass.number
        cross_track_m = (middle.position_m - ORIGIN)[:2] @ np.array([-course_axis[1], course_axis[0]])
        assert abs(cross_track_m) < 40.0  # 5 times the RMS of the wander


def test_targets_are_overflown_about_40_minutes_apart() -> None:
    """Paper, III.D.2: "~40 minutes"; 2500 s are 42 min, for 30 min of images, the approach and the return."""
    flight = make_flight()
    first, second = ((start + end) / 2.0 for start, end in flight.fly_overs_s)
    assert second - first == pytest.approx(2500.0)
    for time_s in (first, second):
        assert np.hypot(*(flight.state(time_s).position_m - ORIGIN)[:2]) < 40.0


def test_inconsistent_parameters_are_rejected() -> None:
    for change, message in (
        ({"max_climb_m_s": 0.5}, r"max_climb_m_s is 0\.5; allowed: at least min_climb_m_s, 1\.0"),
        ({"highest_m": 900.0}, r"highest_m is 900\.0; allowed: more than lowest_m, 1000\.0"),
        # 1000 s of passes at 1 m/s, and 14 turns of 20 s between 15 passes of at most 70 s
        ({"collection_s": 1279.0}, r"collection_s is 1279\.0; allowed: at least 1280,"),
        # 90 + 300 + 2040 + 70 = 2500 s
        ({"collection_s": 2040.0}, r"2500\.0 s, do not fit into the 2500\.0 s between"),
    ):
        with pytest.raises(ValueError, match=message):
            make_flight(**change)
    assert len(make_flight(collection_s=1280.0, min_climb_m_s=1.0, max_climb_m_s=1.0).passes) == 15
    with pytest.raises(ValueError, match="outside of the motion"):
        make_flight().state(3000.0)


@pytest.mark.slow
def test_rates_of_climb_are_uniform() -> None:
    """Between 1 and 2 m/s: mean 1.5, standard deviation 1 / sqrt(12). Tolerances: four standard errors of 400 passes.

    The maximum height does not select the rates of the first five passes: they climb by at most 5 x 70 s x 2 m/s, or
    700 m.
    """
    rates = np.array([leg.climb_m_s for seed in range(80) for leg in draw_default_flight(seed).passes[:5]])
    assert rates.min() >= 1.0
    assert rates.max() <= 2.0
    assert rates.mean() == pytest.approx(1.5, abs=4.0 * np.sqrt(1.0 / 12.0 / 400))
    # the variance of the variance of a uniform distribution of width 1 is 1/180 for each sample
    assert rates.var() == pytest.approx(1.0 / 12.0, abs=4.0 * np.sqrt(1.0 / 180.0 / 400))
