"""Tests of the helicopter: true flight, instruments, navigation filter and landing with estimated state."""

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


def _fly_transit(case: int, **changes: object) -> tuple[Transit, Streams]:
    streams = Streams(7, "helicopter", case)
    parameters = HelicopterParameters.model_validate({"transit": {"hover_s": 8.0}} | changes)
    return Transit.fly(parameters, np.array([0.0, 0.0, HEIGHT]), 0.5, 0.5, GRAVITY, streams), streams


@cache
def _fly_landing(case: int) -> tuple[Transit, Touchdown]:
    transit, streams = _fly_transit(case, **FLOATING)
    return transit, _land(transit, streams)


def _land(transit: Transit, streams: Streams, stuck_m: float | None = None) -> Touchdown:
    unit = RangingUnit.draw(LaserParameters(), streams.generator("laser"))
    touchdown = land(transit, SITE, GROUND, unit, streams, stuck_m)
    assert touchdown is not None
    return touchdown


def test_transit_has_forty_images_at_constant_height() -> None:
    transit, _ = _fly_transit(0)
    assert transit.times_s.size == 40
    assert transit.times_s[0] == 0.0
    assert transit.times_s[-1] == 5.0
    heights = [transit.state(number).position_m[2] for number in range(40)]
    np.testing.assert_allclose(heights, HEIGHT, atol=0.4)
    # The clock has an offset of 1 ms, and each time tag an error of 0.5 ms.
    assert 0.0 < np.abs(transit.tags_s - transit.times_s).max() < 6e-3


def test_pose_errors_match_filter_and_persist_between_images() -> None:
    """Floating solutions: errors of half a metre that hardly change within a second."""
    off, change = [], []
    for case in range(25):
        transit, _ = _fly_transit(case, **FLOATING)
        first, later = (
            np.array(transit.pose(number).world_from_body.translation) - transit.state(number).position_m
            for number in (0, 8)
        )
        off.append(first[:2])
        change.append((later - first)[:2])
    # 0.42 m and 0.55 m: 50 values determine a spread to 10 %.
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(np.sqrt((0.42**2 + 0.55**2) / 2.0), rel=0.3)
    # The receiver error changes by 0.49 sqrt(2 / 120) = 0.063 m per second. The filter smooths it with velocities
    # accurate to 1 cm/s.
    assert 0.01 < np.sqrt(np.mean(np.square(change))) < 0.063


def test_acceleration_causes_inclinometer_errors() -> None:
    """More than their own 0.25 deg: gusts accelerate by some tenths of m/s2, one or two degrees."""
    off = []
    for case in range(10):
        transit, _ = _fly_transit(case)
        for number in (0, 20, 39):
            up = transit.state(number).attitude.apply(transit.up_body(number).copy())
            off.append(np.degrees(np.arccos(np.clip(up[2], -1.0, 1.0))))
    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 4.0


def test_equal_streams_give_equal_flights() -> None:
    one, other = (_fly_transit(3)[0] for _ in range(2))
    np.testing.assert_array_equal(one.flight.path.rows, other.flight.path.rows)
    np.testing.assert_array_equal(one.navigated.solution.positions_m, other.navigated.solution.positions_m)


def test_landing_repeats_with_recorded_filter_errors() -> None:
    """A new flight with the recorded filter errors ends at the same position."""
    for case in range(3):
        transit, down = _fly_landing(case)
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
        estimate = path.state(down.time_s).position_m + errors[round((down.time_s - path.start_s) / path.step_s), :3]
        # The boundary is at most 10 ms before the touchdown: 5 mm at its speed.
        np.testing.assert_allclose(estimate, down.estimated_m, atol=0.01)


def test_navigation_error_becomes_touchdown_error() -> None:
    """The true touchdown offset minus the known filter offset is the slowly varying receiver error."""
    for case in range(5):
        transit, down = _fly_landing(case)
        unseen = (down.state.position_m - down.estimated_m)[:2]
        wander = transit.instruments.receiver.floating_wander.at(np.array([down.time_s]))[0, :2]
        # The filter follows the receiver within some centimetres.
        np.testing.assert_allclose(unseen, -wander, atol=0.12)
        assert horizontal_distance_m(down.estimated_m, SITE) < 1.2
        assert horizontal_distance_m(down.gps_m, SITE) < 1.2


def test_touchdown_is_measured_as_in_the_paper() -> None:
    """The mean of dozens of solutions: true position plus receiver error at that time."""
    transit, down = _fly_landing(1)
    assert down.gps_solutions == 50
    receiver = transit.instruments.receiver
    times = np.linspace(down.time_s + 2.0, down.time_s + 7.0, 200)
    wander = receiver.floating_wander.at(times).mean(axis=0)
    # Noise of 3 cm (5 cm vertical) averaged over 50 solutions; the skids slide by the motion of a tenth of a second.
    np.testing.assert_allclose(down.gps_m[:2], (down.state.position_m + wander)[:2], atol=0.05)
    np.testing.assert_allclose(
        down.gps_deviation_m, receiver.reported_factor * np.hypot([0.42, 0.55, 0.8], [0.03, 0.03, 0.05])
    )


def test_receiver_error_decorrelates_after_landing() -> None:
    """Errors a fraction of the correlation time apart are almost equal; ten times apart they are independent. The mean
    solution is then off by two independent receiver errors: 2 (0.42^2 + 0.55^2) = 0.98 m^2 over both axes, plus the
    autopilot error.
    """
    off: dict[float, list[float]] = {2.0: [], 300.0: []}
    for later, errors in off.items():
        for case in range(40):
            wandering = {"wander_m": [0.42, 0.55, 0.8], "noise_m": [0.03, 0.03, 0.05], "correlation_s": 30.0}
            transit, streams = _fly_transit(
                case,
                rtk={"float_fraction": 1.0, "floating": wandering},
                air={"gust_m_s": 0.0, "vertical_gust_m_s": 0.0},
                transit={"hover_s": 8.0},
                averaging_after_s=later,
            )
            errors.append(horizontal_distance_m(_land(transit, streams).gps_m, SITE))
    soon, late = (float(np.sqrt(np.mean(np.square(errors)))) for errors in off.values())
    assert soon < 0.6 * late
    # 80 values determine a spread to 8 %; filter smoothing reduces the first.
    assert late == pytest.approx(np.sqrt(0.98), rel=0.25)


def test_missing_solutions_give_no_measured_touchdown() -> None:
    transit, streams = _fly_transit(0, rtk={"float_fraction": 0.0, "outages": [{"start_s": 6.0, "duration_s": 200.0}]})
    down = _land(transit, streams)
    assert down.gps_solutions == 0
    assert np.isnan(horizontal_distance_m(down.gps_m, SITE))
    assert np.isfinite(horizontal_distance_m(down.estimated_m, SITE))


def test_stuck_altimeter_causes_a_hard_landing() -> None:
    transit, streams = _fly_transit(0)
    assert -_land(transit, streams).state.velocity_m_s[2] == pytest.approx(0.3, abs=0.15)
    assert -_land(transit, streams, stuck_m=8.0).state.velocity_m_s[2] == pytest.approx(0.7, abs=0.15)


def test_overlong_landing_has_no_touchdown() -> None:
    transit, streams = _fly_transit(0, guidance={"max_duration_s": 3.0})
    unit = RangingUnit.draw(LaserParameters(), streams.generator("laser"))
    assert land(transit, SITE, GROUND, unit, streams) is None
