"""Tests of injected faults of a landing: receiver outages, altimeter faults, lost images and defective pixels."""

import numpy as np
import pytest
from pydantic import ValidationError

from marsyard.scenarios.case_faults import add_detector_faults
from marsyard.scenarios.landing.faults import (
    LandingFaults,
    add_range_faults,
    add_receiver_outage,
    draw_received_images,
    stuck_range_m,
)
from marsyard.scenarios.landing.helicopter import LandingHelicopterParameters, Transit
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.sim.sensor import preset
from marsyard.sim.streams import Streams

HELICOPTER = LandingHelicopterParameters.model_validate({"transit": {"hover_s": 8.0}})


@pytest.mark.slow
def test_receiver_outage_covers_images_and_landing() -> None:
    """During an outage of 40 s the filter propagates without position updates, so its position errors increase."""
    position_errors_m: dict[float, list[float]] = {0.0: [], 40.0: []}
    for outage_s, errors in position_errors_m.items():
        flight = add_receiver_outage(LandingFaults(gps_outage_s=outage_s), HELICOPTER)
        for case in range(6):
            # start (m), course and heading (rad), gravity (m/s^2)
            transit = Transit.fly(flight, np.array([0.0, 0.0, 10.0]), 0.5, 0.5, 9.8, Streams(7, "outage", case))
            estimate = np.array(transit.pose(0).world_from_body.translation)
            errors.append(float(np.hypot(*(estimate - transit.state(0).position_m)[:2])))
            has_solution = np.isfinite(transit.navigation_leg.solutions.positions_m[:, 0])
            fix_times_s = transit.navigation_leg.fix_times_s
            is_outage = (fix_times_s >= -outage_s) & (outage_s > 0.0)
            np.testing.assert_array_equal(has_solution, ~is_outage)
    assert np.median(position_errors_m[40.0]) > 10.0 * np.median(position_errors_m[0.0])


def test_altimeter_faults_replace_all_ranges() -> None:
    ranges = np.array([9.0, 10.0, 11.0])
    np.testing.assert_array_equal(add_range_faults(LandingFaults(), ranges, 10.0), ranges)
    # stuck at 20 % above the height of 10 m
    np.testing.assert_allclose(add_range_faults(LandingFaults(laser_stuck=0.2), ranges, 10.0), 12.0)
    assert np.isnan(add_range_faults(LandingFaults(laser_silent=1), ranges, 10.0)).all()
    # The landing treats a silent altimeter as an infinite range, above the height at which it slows down.
    assert stuck_range_m(LandingFaults(laser_silent=1), 10.0) == np.inf
    assert stuck_range_m(LandingFaults(), 10.0) is None


def test_two_or_more_images_are_received_for_any_loss_rate() -> None:
    rng = np.random.default_rng(0)
    assert len(draw_received_images(LandingFaults(), 40, rng)) == 40
    image_numbers = draw_received_images(LandingFaults(lost_images=0.75), 40, rng)
    assert len(np.unique(image_numbers)) == 10
    assert np.all(np.diff(image_numbers) > 0)
    assert len(draw_received_images(LandingFaults(lost_images=1.0), 40, rng)) == 2


@pytest.mark.parametrize("fault", [{"lost_images": 0.5}, {"gps_outage_s": 5.0}])
def test_flight_faults_require_a_flight(fault: dict[str, float]) -> None:
    LandingScenarioParameters.model_validate({"faults": fault, "helicopter": {}})
    with pytest.raises(ValidationError, match="helicopter"):
        LandingScenarioParameters.model_validate({"faults": fault})


def test_bad_pixel_faults_set_the_fraction_and_the_list() -> None:
    detector = preset("xc-55").detector
    unlisted, listed = (
        add_detector_faults(LandingFaults.model_validate({name: 0.01}), detector).defects
        for name in ("bad_pixels", "listed_bad_pixels")
    )
    assert (unlisted.dead_fraction, unlisted.hot_fraction, unlisted.listed) == (0.01, 0.01, False)
    assert (listed.dead_fraction, listed.hot_fraction, listed.listed) == (0.01, 0.01, True)
