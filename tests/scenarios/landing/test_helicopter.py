"""The helicopter of a case: truth, what its instruments and filter make of it, and a landing on what is believed."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from marsyard.scenarios.landing.helicopter import HelicopterParameters, Touchdown, Transit, horizontal_distance_m, land
from marsyard.sim.dynamics.rotorcraft import GroundPatch
from marsyard.sim.sensor import LaserParameters
from marsyard.sim.sensor.ranging import RangingUnit
from marsyard.sim.streams import Streams

GRAVITY, HEIGHT = 9.8, 10.0
SITE = np.array([4.0, 3.0, 0.0])
GROUND = GroundPatch(SITE[:2] - 15.0, 0.5, np.zeros((61, 61)))
FLOATING: dict[str, object] = {"rtk": {"float_fraction": 1.0}, "transit": {"hover_s": 8.0}}


def _flown(case: int, **changes: object) -> tuple[Transit, Streams]:
    streams = Streams(7, "helicopter", case)
    parameters = HelicopterParameters.model_validate({"transit": {"hover_s": 8.0}} | changes)
    return Transit.flown(parameters, np.array([0.0, 0.0, HEIGHT]), 0.5, 0.5, GRAVITY, streams), streams


@cache
def _landed(case: int) -> tuple[Transit, Touchdown]:
    transit, streams = _flown(case, **FLOATING)
    return transit, _down(transit, streams)


def _down(transit: Transit, streams: Streams, stuck_m: float | None = None) -> Touchdown:
    unit = RangingUnit.drawn(LaserParameters(), streams.generator("laser"))
    touchdown = land(transit, SITE, GROUND, unit, streams, stuck_m)
    assert touchdown is not None
    return touchdown


def test_a_transit_has_forty_pictures_over_several_seconds_at_one_height() -> None:
    transit, _ = _flown(0)
    assert transit.times_s.size == 40
    assert transit.times_s[0] == 0.0
    assert transit.times_s[-1] == 5.0
    heights = [transit.state(number).position_m[2] for number in range(40)]
    np.testing.assert_allclose(heights, HEIGHT, atol=0.4)
    # the clock is off by 1 ms, and 0.5 ms in each tag
    assert 0.0 < np.abs(transit.tags_s - transit.times_s).max() < 6e-3


def test_poses_are_off_by_what_the_filter_says_and_keep_that_between_pictures() -> None:
    """Floating solutions: half a metre off, and nearly the same half a metre a second later."""
    off, change = [], []
    for case in range(25):
        transit, _ = _flown(case, **FLOATING)
        first, later = (
            np.array(transit.pose(number).world_from_body.translation) - transit.state(number).position_m
            for number in (0, 8)
        )
        off.append(first[:2])
        change.append((later - first)[:2])
    # 0.42 m and 0.55 m: 50 values are known to 10 %
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(np.sqrt((0.42**2 + 0.55**2) / 2.0), rel=0.3)
    # the receiver's changes by 0.49 sqrt(2 / 120) = 0.063 m in a second; the filter smooths that by velocities that it
    # knows to 1 cm/s
    assert 0.01 < np.sqrt(np.mean(np.square(change))) < 0.063


def test_inclinometers_are_wrong_by_acceleration() -> None:
    """More than their own 0.25 deg: gusts push at some tenths of m/s2, a degree or two."""
    off = []
    for case in range(10):
        transit, _ = _flown(case)
        for number in (0, 20, 39):
            up = transit.state(number).attitude.apply(transit.up_body(number).copy())
            off.append(np.degrees(np.arccos(np.clip(up[2], -1.0, 1.0))))
    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 4.0


def test_the_same_streams_give_the_same_flight() -> None:
    one, other = (_flown(3)[0] for _ in range(2))
    np.testing.assert_array_equal(one.flight.path.rows, other.flight.path.rows)
    np.testing.assert_array_equal(one.navigated.solution.positions_m, other.navigated.solution.positions_m)


def test_a_landing_agrees_with_its_own_filter() -> None:
    """Flown anew on the errors that the filter made over the flight it gave, it comes down at the same place."""
    for case in range(3):
        transit, down = _landed(case)
        assert down.iterations < 8
        assert down.change_m < 1e-3
        path, navigated = down.flight.path, down.navigated
        errors = np.zeros((len(path.rows), 9))
        before = transit.navigated
        for column in range(9):
            times = np.concatenate([before.boundaries_s, navigated.boundaries_s[1:]])
            values = np.concatenate([before.errors(transit.flight.path), navigated.errors(path)[1:]])
            errors[:, column] = np.interp(path.knots_s, times, values[:, column])
        assert np.all(np.abs(errors[-1, :2]) < 3.0)
        believed = path.state(down.time_s).position_m + errors[round((down.time_s - path.start_s) / path.step_s), :3]
        # the boundary is at most 10 ms before the touchdown, 5 mm at its speed
        np.testing.assert_allclose(believed, down.believed_m, atol=0.01)


def test_navigations_error_becomes_the_touchdowns() -> None:
    """What the true touchdown is off the site beyond what the filter saw is the receiver's wander."""
    for case in range(5):
        transit, down = _landed(case)
        unseen = (down.state.position_m - down.believed_m)[:2]
        wander = transit.instruments.receiver.floating_wander.at(np.array([down.time_s]))[0, :2]
        # the filter follows the receiver within some centimetres
        np.testing.assert_allclose(unseen, -wander, atol=0.12)
        assert horizontal_distance_m(down.believed_m, SITE) < 1.2
        assert horizontal_distance_m(down.gps_m, SITE) < 1.2


def test_the_touchdown_is_measured_as_the_paper_did() -> None:
    """The mean of dozens of solutions: where it stands, and the receiver's error then."""
    transit, down = _landed(1)
    assert down.gps_solutions == 50
    receiver = transit.instruments.receiver
    times = np.linspace(down.time_s + 2.0, down.time_s + 7.0, 200)
    wander = receiver.floating_wander.at(times).mean(axis=0)
    # noise of 3 cm (5 cm upwards) averaged over 50 solutions; the skids slide by a tenth of a second's way
    np.testing.assert_allclose(down.gps_m[:2], (down.state.position_m + wander)[:2], atol=0.05)
    np.testing.assert_allclose(
        down.gps_deviation_m, receiver.reported_factor * np.hypot([0.42, 0.55, 0.8], [0.03, 0.03, 0.05])
    )


def test_long_after_the_landing_the_receivers_error_is_another_one() -> None:
    """Errors a fraction of their correlation time apart are nearly equal; ten times apart they are independent.

    Then the mean solution is off the site by the receiver's error at the landing and by another of its size: over both
    axes 2 (0.42^2 + 0.55^2) = 0.98 m^2, and what the autopilot leaves.
    """
    off: dict[float, list[float]] = {2.0: [], 300.0: []}
    for later, errors in off.items():
        for case in range(40):
            wandering = {"wander_m": [0.42, 0.55, 0.8], "noise_m": [0.03, 0.03, 0.05], "correlation_s": 30.0}
            transit, streams = _flown(
                case,
                rtk={"float_fraction": 1.0, "floating": wandering},
                air={"gust_m_s": 0.0, "vertical_gust_m_s": 0.0},
                transit={"hover_s": 8.0},
                averaging_after_s=later,
            )
            errors.append(horizontal_distance_m(_down(transit, streams).gps_m, SITE))
    soon, late = (float(np.sqrt(np.mean(np.square(errors)))) for errors in off.values())
    assert soon < 0.6 * late
    # 80 values are known to 8 %; the filter's smoothing takes a little of the first
    assert late == pytest.approx(np.sqrt(0.98), rel=0.25)


def test_without_solutions_there_is_no_measured_touchdown() -> None:
    transit, streams = _flown(0, rtk={"float_fraction": 0.0, "outages": [{"start_s": 6.0, "duration_s": 200.0}]})
    down = _down(transit, streams)
    assert down.gps_solutions == 0
    assert np.isnan(horizontal_distance_m(down.gps_m, SITE))
    assert np.isfinite(horizontal_distance_m(down.believed_m, SITE))


def test_a_stuck_altimeter_makes_a_hard_landing() -> None:
    transit, streams = _flown(0)
    assert -_down(transit, streams).state.velocity_m_s[2] == pytest.approx(0.3, abs=0.15)
    assert -_down(transit, streams, stuck_m=8.0).state.velocity_m_s[2] == pytest.approx(0.7, abs=0.15)


def test_a_landing_that_takes_too_long_is_none() -> None:
    transit, streams = _flown(0, guidance={"max_duration_s": 3.0})
    unit = RangingUnit.drawn(LaserParameters(), streams.generator("laser"))
    assert land(transit, SITE, GROUND, unit, streams) is None
