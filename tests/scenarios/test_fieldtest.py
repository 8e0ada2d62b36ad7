"""The field test's flight processing and triples; one case is rendered."""

from __future__ import annotations

import re
import tomllib
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marsyard import scenarios
from marsyard.algorithms.interface import VelocityOutcome
from marsyard.scenarios.exposure import camera_optics
from marsyard.scenarios.fieldtest.parameters import ElevationParameters, FieldTestParameters
from marsyard.scenarios.fieldtest.run import (
    Category,
    Run,
    RunKey,
    field_camera,
    simulate_run,
    sun_direction,
    survey_ground,
)
from marsyard.scenarios.fieldtest.scenario import (
    FieldTestScenario,
    build_start_scene,
    case_order,
    run_ground,
    scene_at,
    sun_at,
)
from marsyard.scenarios.parts import ScoredFlight
from marsyard.scenarios.views import Eye, site_scene
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import Surface

CATALOGUE = Path(scenarios.__file__).parent / "catalogue" / "dimes-fieldtest.toml"
IMU = {"rate_hz": 25.0, "gyro_bias_deg_h_k": 0.0}
#: Fig. 11 of the paper: sum of its column TOTAL.
TRIPLES = 1913


def stated(**changes: Any) -> FieldTestParameters:
    """The campaign's parameters over a small terrain, with gyros read less often: their increments are exact."""
    parameters = tomllib.loads(CATALOGUE.read_text(encoding="utf-8"))["parameters"]
    return FieldTestParameters.model_validate({**parameters, "samples": 512, "imu": IMU, **changes})


def ivanpah(**changes: Any) -> Run:
    return simulate_run(RunKey(stated(**changes), 4, 5, "test"))


def attitude_errors_deg(run: Run) -> np.ndarray:
    errors: np.ndarray = np.degrees((run.attitudes * run.truth.attitudes.inv()).as_rotvec())
    return errors


def test_sun_is_where_the_almanac_has_it() -> None:
    """Reda & Andreas (2004), their example: zenith 50.11162 deg, of which refraction takes 0.0165 deg."""
    time = datetime(2003, 10, 17, 12, 30, 30, tzinfo=timezone(timedelta(hours=-7)))
    sun = sun_direction(time, 39.742476, -105.1786)
    assert np.degrees(np.arccos(sun[2])) == pytest.approx(50.1281, abs=0.01)
    assert np.degrees(np.arctan2(sun[0], sun[1])) % 360.0 == pytest.approx(194.34024, abs=0.01)


def test_sun_at_the_equinox_stands_over_the_equator() -> None:
    """Equinox of 23 September 2002, 04:55 UT (United States Naval Observatory)."""
    sun = sun_direction(datetime(2002, 9, 23, 4, 55, tzinfo=UTC), 90.0, 0.0)
    assert np.degrees(np.arcsin(sun[2])) == pytest.approx(0.0, abs=0.01)
    with pytest.raises(ValueError, match="time zone"):
        sun_direction(datetime(2002, 9, 23), 0.0, 0.0)


def test_attitude_is_good_to_hundredths_of_a_degree_without_drift() -> None:
    """Random walk of 0.07 deg/sqrt(h) over 40 min held at both ends: 0.03 deg in the middle, a fifth of 0.15 deg."""
    run = ivanpah(drift={"change_k": 0.0})
    assert np.abs(attitude_errors_deg(run)).max() < 0.15


def test_fit_takes_a_constant_bias_off() -> None:
    run = ivanpah(drift={"change_k": 0.0}, imu={**IMU, "gyro_bias_deg_h": 5.0})
    assert np.abs(attitude_errors_deg(run)).max() < 0.15


def test_drift_tilts_across_the_line_and_the_fit_does_not_see_it() -> None:
    """The bias is about the line's direction; the tilt about it changes by tenths of a degree over the run."""
    run = ivanpah()
    azimuth = run.flight.azimuth_rad
    along = np.array([np.sin(azimuth), np.cos(azimuth), 0.0])
    tilt = attitude_errors_deg(run) @ along
    assert np.ptp(tilt) > 0.6
    assert np.ptp(attitude_errors_deg(run) @ np.array([-along[1], along[0], 0.0])) < 0.2


def test_turning_about_with_the_flight_cancels_the_drift() -> None:
    """A platform that follows the flight turns the gyros about at each pass: the drift takes off what it had added."""
    held, turned = ivanpah(), ivanpah(helicopter={"turns_with_flight": True})
    assert (
        np.ptp(attitude_errors_deg(turned)[:, :2], axis=0).max()
        < 0.6 * np.ptp(attitude_errors_deg(held)[:, :2], axis=0).max()
    )


def test_elevation_model_has_the_error_of_its_class() -> None:
    """Over flat ground the error is that of the posts, smoothed a little by interpolation."""
    flat = Surface.from_samples(np.zeros((64, 64, 2), dtype=np.float32), 500.0)
    places = np.random.default_rng(1).uniform(0.0, 30000.0, (4000, 2))
    posts = survey_ground(ElevationParameters(), flat, places, np.random.default_rng(2))
    assert posts(places).std() == pytest.approx(6.0, rel=0.06)


def test_triples_are_what_their_category_says() -> None:
    run = ivanpah()
    counts = dict.fromkeys(Category, 0)
    for triple in run.triples:
        counts[triple.category] += 1
        numbers = list(triple.pictures)
        heights = run.pictures.position_m[numbers, 2]
        moved = np.linalg.norm(np.diff(run.pictures.position_m[numbers, :2], axis=0), axis=1)
        assert np.all(moved <= 30.0 * 3.75)
        turned = len(set(run.pictures.direction[numbers].tolist())) > 1
        if triple.category is Category.SHORT_TIME:
            assert np.array_equal(np.diff(numbers), [1, 1])
            assert len(set(run.pictures.flown[numbers].tolist())) == 1
        else:
            assert np.all((-np.diff(heights) >= 150.0) & (-np.diff(heights) <= 390.0))
            assert turned is (triple.category is Category.OPPOSITE_DIRECTION)
    assert counts == {Category.SHORT_TIME: 139, Category.SAME_DIRECTION: 66, Category.OPPOSITE_DIRECTION: 24}


def test_cases_are_the_papers_triples_spread_evenly() -> None:
    parameters = stated()
    order = case_order(parameters)
    assert len(order) == len(set(order)) == TRIPLES
    largest = parameters.runs[3].triples / TRIPLES
    assert sum(number == 3 for number, _ in order[:200]) / 200 == pytest.approx(largest, abs=0.03)


def test_a_run_is_worked_out_the_same_again() -> None:
    key = RunKey(stated(), 4, 5, "test")
    kept, again = simulate_run(key), simulate_run(key)
    assert again is not kept
    assert np.array_equal(again.attitudes.as_quat(), kept.attitudes.as_quat())
    assert again.triples == kept.triples


def test_the_sun_moves_over_rocks_that_stay() -> None:
    """Lava's rocks take core-seconds to build: a run builds them once, whatever its pictures' times."""
    key = RunKey(stated(), 0, 5, "test")
    run, time_s = simulate_run(key), 1800.0
    ground = run_ground(key)
    first = build_start_scene(run, ground)
    early, late = (scene_at(run, first, ground, time) for time in (0.0, time_s))
    assert len(early.objects) > 0
    assert late.objects is early.objects
    east, north, _ = run.flight.origin_m.tolist()
    pixel_rad = camera_optics(field_camera()).rays.pixel_rad
    eye = Eye(east, north, key.field_test.helicopter.lowest_m, pixel_rad)
    alone = site_scene(ground, eye, sun_at(run, time_s))
    assert np.array_equal(late.sun.direction, alone.sun.direction)
    assert late.photometry == alone.photometry
    assert np.array_equal(late.objects.triangles, alone.objects.triangles)
    assert late.extent_m == alone.extent_m


def test_too_many_triples_are_refused() -> None:
    runs = [run.model_dump() for run in stated().runs[4:]]
    with pytest.raises(ValueError, match="5000 triples 'short time' are asked for"):
        simulate_run(RunKey(stated(runs=[{**runs[0], "short_time": 5000}]), 0, 5, "test"))


def handed(case: ScoredFlight) -> dict[str, float]:
    """A user's own score: what it is handed must agree with the row."""
    assert case.answer.velocity_m_s is not None
    assert case.true_velocity_m_s is not None
    error = case.answer.velocity_m_s - case.true_velocity_m_s
    moved = case.motion.state(case.states[2].time_s).position_m - case.states[2].position_m
    return {"error_m_s": float(np.hypot(*error)), "off_m": float(np.abs(moved).max())}


def test_case_is_answered_and_repeats() -> None:
    """A short-time triple over the lake bed: attitude and altitude errors leave under 2 m/s."""
    parameters = stated(runs=[stated().runs[4].model_dump() | {"same_direction": 0, "opposite_direction": 0}])
    several = parameters.model_copy(update={"compared": ("phase-correlation",), "scores": (f"{__name__}:handed",)})
    found = FieldTestScenario().run(several, Streams(5, "test", 0))
    assert found.row["algorithm"] == "dimes"
    assert found.row["phase_correlation.outcome"] in VelocityOutcome.__members__
    assert found.row["run"] == "Ivanpah Run 3"
    assert found.row["category"] == "short time"
    assert found.answered
    assert float(found.row["velocity_error_m_s"]) < 2.0
    for label in ("", "phase_correlation."):
        assert found.row[f"{label}handed_error_m_s"] == found.row[f"{label}velocity_error_m_s"]
    assert found.row["handed_off_m"] == 0.0
    again = FieldTestScenario().run(parameters, Streams(5, "test", 0))
    same = {name: value for name, value in found.row.items() if not re.search(r"time|\.|handed", name)}
    assert same.items() <= again.row.items()
    with pytest.raises(ValueError, match="allowed: 0 to 138"):
        FieldTestScenario().run(parameters, Streams(5, "test", 139))


def test_shadows_of_clouds_move_steadily_from_picture_to_picture() -> None:
    """A sun that is held for a while and then jumps would take the shadows of high clouds with it, past the wind."""
    key = RunKey(stated(), 3, 5, "test")
    run = simulate_run(key)
    assert run.clouds is not None
    ground = np.array([[[0.0, 0.0, 0.0]]])
    places = []
    for time_s in np.arange(1000.0, 1120.0, 3.0).tolist():
        sun = sun_at(run, time_s)
        _, height, east, north, _ = run.clouds.coefficients(sun, time_s)
        up = (height - ground[0, 0, 2]) / sun.direction[2]
        # where in the layer the ground's point sees the sun
        places.append([up * sun.direction[0] - east, up * sun.direction[1] - north])
    moved = np.linalg.norm(np.diff(places, axis=0), axis=1) / 3.0
    clouds = key.field_test.runs[3].clouds
    assert clouds is not None
    wind = np.hypot(clouds.wind_east_m_s, clouds.wind_north_m_s)
    assert np.ptp(moved) < 0.01
    assert abs(moved.mean() - wind) < 0.5
