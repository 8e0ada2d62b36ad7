"""Tests of the helicopter: true flight, instruments, navigation filter and landing with estimated state."""

from functools import cache

import numpy as np
import pytest

from marsyard.scenarios.landing.helicopter import LandingHelicopterParameters, Transit
from marsyard.scenarios.landing.touchdown import Touchdown, horizontal_distance_m, land
from marsyard.sim.dynamics.rotorcraft import GroundPatch, Phase
from marsyard.sim.sensor import LaserParameters
from marsyard.sim.sensor.altimeters import RangingUnit
from marsyard.sim.streams import Streams

GRAVITY_M_S2, HEIGHT_M = 9.8, 10.0
#: Course and heading of the transit, counterclockwise from east.
COURSE_RAD = HEADING_RAD = 0.5
#: Landing site, and level ground of 30 m x 30 m around it with a spacing of 0.5 m.
SITE = np.array([4.0, 3.0, 0.0])
GROUND = GroundPatch(float(SITE[0]) - 15.0, float(SITE[1]) - 15.0, 0.5, np.zeros((61, 61)))
#: RTK receiver with floating solutions: errors of half a metre that change slowly.
FLOATING_RTK: dict[str, object] = {"rtk": {"float_fraction": 1.0}, "transit": {"hover_s": 8.0}}


def _fly_transit(case: int, **changes: object) -> tuple[Transit, Streams]:
    streams = Streams(7, "helicopter", case)
    parameters = LandingHelicopterParameters.model_validate({"transit": {"hover_s": 8.0}} | changes)
    start_m = np.array([0.0, 0.0, HEIGHT_M])
    return Transit.fly(parameters, start_m, COURSE_RAD, HEADING_RAD, GRAVITY_M_S2, streams), streams


@cache
def _fly_landing(case: int) -> tuple[Transit, Touchdown]:
    transit, streams = _fly_transit(case, **FLOATING_RTK)
    return transit, _land(transit, streams)


def _land(transit: Transit, streams: Streams, stuck_m: float | None = None, **laser: float) -> Touchdown:
    """Land at `SITE` with a laser altimeter with the parameters `laser`; a stuck one always reads `stuck_m`."""
    unit = RangingUnit.draw(LaserParameters.model_validate(laser), streams.generator("laser"))
    touchdown = land(transit, SITE, GROUND, unit, streams, stuck_m)
    assert touchdown is not None
    return touchdown


def test_transit_has_forty_images_at_constant_height() -> None:
    transit, _ = _fly_transit(0)
    assert transit.times_s.size == 40
    assert transit.times_s[0] == 0.0
    assert transit.times_s[-1] == 5.0
    heights = [transit.state(number).position_m[2] for number in range(40)]
    np.testing.assert_allclose(heights, HEIGHT_M, atol=0.4)
    # The clock has an offset of 1 ms, and each time tag an error of 0.5 ms.
    assert 0.0 < np.abs(transit.tags_s - transit.times_s).max() < 6e-3


def test_pose_errors_have_the_receiver_variance_and_change_slowly() -> None:
    """Floating solutions have errors of half a metre that change by centimetres within a second."""
    errors, changes = [], []
    for case in range(25):
        transit, _ = _fly_transit(case, **FLOATING_RTK)
        first_error, later_error = (
            np.array(transit.pose(number).world_from_body.translation) - transit.state(number).position_m
            for number in (0, 8)
        )
        errors.append(first_error[:2])
        changes.append((later_error - first_error)[:2])
    # Standard deviations of the receiver: 0.42 m and 0.55 m. The rms of 50 values has a standard error of 10 %.
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.sqrt((0.42**2 + 0.55**2) / 2.0), rel=0.3)
    # The receiver error (0.49 m rms, correlation time 120 s) changes by 0.49 sqrt(2 / 120) = 0.063 m in one second. The
    # filter smooths the change with velocities accurate to 1 cm/s.
    assert 0.01 < np.sqrt(np.mean(np.square(changes))) < 0.063


def test_acceleration_causes_inclinometer_errors() -> None:
    """Gusts accelerate by some tenths of m/s^2: errors of one or two degrees, more than the sensor's 0.25 deg."""
    errors = []
    for case in range(10):
        transit, _ = _fly_transit(case)
        for number in (0, 20, 39):
            measured_up = transit.state(number).attitude.apply(transit.up_body(number).copy())
            errors.append(np.degrees(np.arccos(np.clip(measured_up[2], -1.0, 1.0))))
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) < 4.0


def test_landing_iteration_converges_to_a_consistent_flight() -> None:
    """The last iteration changes the path by less than 1 mm.

    True position plus filter error at touchdown is the reported estimate.
    """
    for case in range(3):
        transit, touchdown = _fly_landing(case)
        assert touchdown.iterations < 8
        assert touchdown.path_change_m < 1e-3
        path, after = touchdown.flight.path, touchdown.navigation_leg
        errors = np.zeros((len(path.rows), 9))
        before = transit.navigation_leg
        for column in range(9):
            times = np.concatenate([before.boundaries_s, after.boundaries_s[1:]])
            values = np.concatenate([before.errors(transit.flight.path), after.errors(path)[1:]])
            errors[:, column] = np.interp(path.knots_s, times, values[:, column])
        assert np.all(np.abs(errors[-1, :2]) < 3.0)
        step = round((touchdown.time_s - path.start_s) / path.step_s)
        estimate = path.state(touchdown.time_s).position_m + errors[step, :3]
        # The last sample boundary is at most 10 ms before the touchdown: 5 mm at the touchdown speed.
        np.testing.assert_allclose(estimate, touchdown.estimated_m, atol=0.01)


def test_touchdown_error_equals_the_receiver_error() -> None:
    """True minus estimated position at touchdown is the negative of the receiver's slowly varying error."""
    for case in range(5):
        transit, touchdown = _fly_landing(case)
        navigation_error = (touchdown.state.position_m - touchdown.estimated_m)[:2]
        receiver_error = transit.instruments.receiver.floating_wander.at(np.array([touchdown.time_s]))[0, :2]
        # The filter follows the receiver within some centimetres.
        np.testing.assert_allclose(navigation_error, -receiver_error, atol=0.12)
        assert horizontal_distance_m(touchdown.estimated_m, SITE) < 1.2
        assert horizontal_distance_m(touchdown.gps_m, SITE) < 1.2


def test_touchdown_position_is_a_mean_of_rtk_solutions() -> None:
    """As in the paper, the position is the mean of 50 solutions: true position plus receiver error at that time."""
    transit, touchdown = _fly_landing(1)
    assert touchdown.gps_solutions == 50
    receiver = transit.instruments.receiver
    times = np.linspace(touchdown.time_s + 2.0, touchdown.time_s + 7.0, 200)
    receiver_error = receiver.floating_wander.at(times).mean(axis=0)
    # The noise of 3 cm (5 cm vertical) is averaged over 50 solutions. After the touchdown the helicopter slides by its
    # velocity times the time constant of the ground contact, 0.1 s.
    np.testing.assert_allclose(touchdown.gps_m[:2], (touchdown.state.position_m + receiver_error)[:2], atol=0.05)
    np.testing.assert_allclose(
        touchdown.gps_deviation_m, receiver.reported_factor * np.hypot([0.42, 0.55, 0.8], [0.03, 0.03, 0.05])
    )


@pytest.mark.slow
def test_receiver_error_decorrelates_after_landing() -> None:
    """Receiver errors with a correlation time of 30 s are almost equal after 2 s and independent after 300 s.

    After 300 s the error of the mean solution is the difference of two independent receiver errors, with the variance
    2 (0.42^2 + 0.55^2) = 0.98 m^2 over both axes, plus the autopilot error.
    """
    errors_by_delay: dict[float, list[float]] = {2.0: [], 300.0: []}
    for delay_s, errors in errors_by_delay.items():
        for case in range(40):
            receiver_errors = {"wander_m": [0.42, 0.55, 0.8], "noise_m": [0.03, 0.03, 0.05], "correlation_s": 30.0}
            transit, streams = _fly_transit(
                case,
                rtk={"float_fraction": 1.0, "floating": receiver_errors},
                air={"gust_m_s": 0.0, "vertical_gust_m_s": 0.0},
                transit={"hover_s": 8.0},
                averaging_after_s=delay_s,
            )
            errors.append(horizontal_distance_m(_land(transit, streams).gps_m, SITE))
    early_rms, late_rms = (float(np.sqrt(np.mean(np.square(errors)))) for errors in errors_by_delay.values())
    assert early_rms < 0.6 * late_rms
    # The rms of 80 values (two axes of 40 flights) has a standard error of 1 / sqrt(160) = 8 %.
    assert late_rms == pytest.approx(np.sqrt(0.98), rel=0.25)


def test_missing_solutions_give_no_measured_touchdown() -> None:
    transit, streams = _fly_transit(0, rtk={"float_fraction": 0.0, "outages": [{"start_s": 6.0, "duration_s": 200.0}]})
    touchdown = _land(transit, streams)
    assert touchdown.gps_solutions == 0
    assert np.isnan(horizontal_distance_m(touchdown.gps_m, SITE))
    assert np.isfinite(horizontal_distance_m(touchdown.estimated_m, SITE))


def test_stuck_altimeter_causes_a_hard_landing() -> None:
    """Sink rates at touchdown: 0.3 m/s after the flare; 0.7 m/s, that of the descent, if the range stays at 8 m."""
    transit, streams = _fly_transit(0)
    assert -_land(transit, streams).state.velocity_m_s[2] == pytest.approx(0.3, abs=0.15)
    assert -_land(transit, streams, stuck_m=8.0).state.velocity_m_s[2] == pytest.approx(0.7, abs=0.15)


@pytest.mark.parametrize("changes", [{"min_range_m": 3.0}, {"max_range_m": 0.3}])
def test_altimeter_without_readings_below_the_flare_range_causes_a_hard_landing(changes: dict[str, float]) -> None:
    """The flare begins at 1.5 m above the ground; the camera touches down at 0.4 m."""
    transit, streams = _fly_transit(0)
    sink_m_s = -_land(transit, streams, **changes).state.velocity_m_s[2]
    assert sink_m_s == pytest.approx(0.7, abs=0.15)


def test_rounded_readings_start_the_flare() -> None:
    """With a resolution of 4 m, ranges below 2 m are rounded to zero, which is below 1.5 m."""
    transit, streams = _fly_transit(0)
    flight = _land(transit, streams, count_m=4.0, noise_m=0.0).flight
    start_s = flight.phase_start_s(Phase.FLARE)
    assert start_s is not None
    # the command is delayed by 0.1 s: 0.07 m at the speed of the descent
    assert flight.path.state(start_s).position_m[2] == pytest.approx(2.0 - 0.07, abs=0.03)


def test_time_tags_after_the_end_of_the_filter_are_rejected() -> None:
    with pytest.raises(ValueError, match=r"image_clock: .* is 3 s; allowed: at most 0.1 s"):
        LandingHelicopterParameters.model_validate({"image_clock": {"offset_sd_s": 0.5, "jitter_sd_s": 0.0}})


def test_overlong_landing_has_no_touchdown() -> None:
    transit, streams = _fly_transit(0, guidance={"max_duration_s": 3.0})
    unit = RangingUnit.draw(LaserParameters(), streams.generator("laser"))
    assert land(transit, SITE, GROUND, unit, streams) is None
