"""Tests of light during a run: the sun moves, and a bright sky affects the exposure of full frames."""

from typing import Any

import numpy as np
import pytest

from marsyard.scenarios.rover.parameters import RoverScenarioParameters, SunParameters
from marsyard.scenarios.rover.run import Run, run_case
from marsyard.sim.streams import Streams
from tests.scenarios.rover.short_run import SHORT


def make_run(**changes: Any) -> Run:
    return run_case(RoverScenarioParameters.model_validate({**SHORT, **changes}), Streams(1, "rover tests", 0))


def test_the_sun_rotates_westwards_about_the_pole() -> None:
    # At the equator the zenith sun moves west by its hour angle: 16 deg in the 66 minutes of Table IV.
    sun = SunParameters(azimuth_deg=0.0, elevation_deg=90.0, latitude_deg=0.0)
    for minutes in (0.0, 66.0, 132.0):
        angle = np.radians(16.0 * minutes / 66.0)
        np.testing.assert_allclose(sun.direction(60.0 * minutes), [-np.sin(angle), 0.0, np.cos(angle)], atol=1e-12)


def test_images_use_the_sun_at_their_time() -> None:
    # One hour passes between the images: only the second differs from a run with a fixed sun.
    slow = {"timing": {"track_s": 3600.0}, "camera": {"detector_noise": False}}
    static = {"sun": {**SHORT["sun"], "hour_angle_deg_min": 0.0}, "rover_shadow": False}
    moving = {"sun": {**SHORT["sun"], "held_s": 1.0}, "rover_shadow": False}
    under_one, under_moving = make_run(**slow, **static), make_run(**slow, **moving)
    assert under_one.stops[1].time_s - under_one.stops[0].time_s >= 3600.0
    suns = [under_moving.world.scene(stop.time_s).sun.direction for stop in under_moving.stops[:2]]
    rotated = np.degrees(np.arccos(suns[0] @ suns[1]))
    assert 10.0 < rotated < 16.0 / 66.0 * (under_moving.stops[1].time_s - under_moving.stops[0].time_s) / 60.0 + 0.01
    fixed = [under_one.world.scene(stop.time_s).sun.direction for stop in under_one.stops[:2]]
    np.testing.assert_allclose(fixed[0], fixed[1], atol=1e-12)


def test_bright_sky_underexposes_full_frames() -> None:
    """Section 4.5: subframe exposure keeps the contrast at the target for any sky in the frame."""
    eastwards = {"start": {"distance_m": 9.0}, "legs": [{"motion": "approach", "goal_m": 8.5, "step_fraction": 0.1}]}
    sun_ahead = {"sun": {"azimuth_deg": 90.0, "elevation_deg": 30.0}}
    first = {
        of: make_run(**eastwards, **sun_ahead, exposure={"of": of}).stops[0].pictures
        for of in ("subframe", "full-frame")
    }
    shorter = first["full-frame"].exposure_s / first["subframe"].exposure_s
    assert shorter < 0.3
    contrast = {of: float(np.std(pair.left.counts.astype(float))) for of, pair in first.items()}
    assert contrast["full-frame"] == pytest.approx(contrast["subframe"] * shorter, rel=0.1)
