"""Tests of the field test's flight processing and image triples; one case is rendered."""

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


def make_parameters(**changes: Any) -> FieldTestParameters:
    """Parameters of the campaign over a small terrain with a lower gyro rate: the increments are exact."""
    parameters = tomllib.loads(CATALOGUE.read_text(encoding="utf-8"))["parameters"]
    return FieldTestParameters.model_validate({**parameters, "samples": 512, "imu": IMU, **changes})


def make_ivanpah_run(**changes: Any) -> Run:
    return simulate_run(RunKey(make_parameters(**changes), 4, 5, "test"))


def attitude_errors_deg(run: Run) -> np.ndarray:
    errors: np.ndarray = np.degrees((run.attitudes * run.truth.attitudes.inv()).as_rotvec())
    return errors


def test_sun_position_matches_the_almanac() -> None:
    """Example of Reda & Andreas (2004): zenith 50.11162 deg, including 0.0165 deg of refraction."""
    time = datetime(2003, 10, 17, 12, 30, 30, tzinfo=timezone(timedelta(hours=-7)))
    sun = sun_direction(time, 39.742476, -105.1786)
    assert np.degrees(np.arccos(sun[2])) == pytest.approx(50.1281, abs=0.01)
    assert np.degrees(np.arctan2(sun[0], sun[1])) % 360.0 == pytest.approx(194.34024, abs=0.01)


def test_equinox_sun_is_over_the_equator() -> None:
    """Equinox of 23 September 2002, 04:55 UT (United States Naval Observatory)."""
    sun = sun_direction(datetime(2002, 9, 23, 4, 55, tzinfo=UTC), 90.0, 0.0)
    assert np.degrees(np.arcsin(sun[2])) == pytest.approx(0.0, abs=0.01)
    with pytest.raises(ValueError, match="time zone"):
        sun_direction(datetime(2002, 9, 23), 0.0, 0.0)


def test_drift_free_attitude_error_is_hundredths_of_a_degree() -> None:
    """Random walk of 0.07 deg/sqrt(h) over 40 min, fixed at both ends: 0.03 deg at the middle, a fifth of 0.15 deg."""
    run = make_ivanpah_run(drift={"change_k": 0.0})
    assert np.abs(attitude_errors_deg(run)).max() < 0.15


def test_fit_removes_a_constant_bias() -> None:
    run = make_ivanpah_run(drift={"change_k": 0.0}, imu={**IMU, "gyro_bias_deg_h": 5.0})
    assert np.abs(attitude_errors_deg(run)).max() < 0.15


def test_fit_cannot_remove_drift_across_the_line() -> None:
    """The bias is about the flight line; the tilt about it changes by tenths of a degree during the run."""
    run = make_ivanpah_run()
    azimuth = run.flight.azimuth_rad
    along = np.array([np.sin(azimuth), np.cos(azimuth), 0.0])
    tilt = attitude_errors_deg(run) @ along
    assert np.ptp(tilt) > 0.6
    assert np.ptp(attitude_errors_deg(run) @ np.array([-along[1], along[0], 0.0])) < 0.2


def test_alternating_headings_cancel_the_drift() -> None:
    """A platform that follows the heading reverses the gyros at each pass: the drift changes sign."""
    held, rotated = make_ivanpah_run(), make_ivanpah_run(helicopter={"turns_with_flight": True})
    assert (
        np.ptp(attitude_errors_deg(rotated)[:, :2], axis=0).max()
        < 0.6 * np.ptp(attitude_errors_deg(held)[:, :2], axis=0).max()
    )


def test_elevation_model_has_the_error_of_its_class() -> None:
    """Over flat ground the error is that of the posts, slightly smoothed by interpolation."""
    flat = Surface.from_samples(np.zeros((64, 64, 2), dtype=np.float32), 500.0)
    positions = np.random.default_rng(1).uniform(0.0, 30000.0, (4000, 2))
    posts = survey_ground(ElevationParameters(), flat, positions, np.random.default_rng(2))
    assert posts(positions).std() == pytest.approx(6.0, rel=0.06)


def test_triples_match_their_category() -> None:
    run = make_ivanpah_run()
    counts = dict.fromkeys(Category, 0)
    for triple in run.triples:
        counts[triple.category] += 1
        numbers = list(triple.pictures)
        heights = run.pictures.position_m[numbers, 2]
        moved = np.linalg.norm(np.diff(run.pictures.position_m[numbers, :2], axis=0), axis=1)
        assert np.all(moved <= 30.0 * 3.75)
        rotated = len(set(run.pictures.direction[numbers].tolist())) > 1
        if triple.category is Category.SHORT_TIME:
            assert np.array_equal(np.diff(numbers), [1, 1])
            assert len(set(run.pictures.pass_number[numbers].tolist())) == 1
        else:
            assert np.all((-np.diff(heights) >= 150.0) & (-np.diff(heights) <= 390.0))
            assert rotated is (triple.category is Category.OPPOSITE_DIRECTION)
    assert counts == {Category.SHORT_TIME: 139, Category.SAME_DIRECTION: 66, Category.OPPOSITE_DIRECTION: 24}


def test_cases_are_evenly_spread_triples_of_the_paper() -> None:
    parameters = make_parameters()
    order = case_order(parameters)
    assert len(order) == len(set(order)) == TRIPLES
    largest = parameters.runs[3].triples / TRIPLES
    assert sum(number == 3 for number, _ in order[:200]) / 200 == pytest.approx(largest, abs=0.03)


def test_run_is_deterministic() -> None:
    key = RunKey(make_parameters(), 4, 5, "test")
    stored, repeated = simulate_run(key), simulate_run(key)
    assert repeated is not stored
    assert np.array_equal(repeated.attitudes.as_quat(), stored.attitudes.as_quat())
    assert repeated.triples == stored.triples


def test_sun_moves_while_rocks_are_fixed() -> None:
    """Lava rocks take long to build: a run builds them once for all image times."""
    key = RunKey(make_parameters(), 0, 5, "test")
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


def test_too_many_triples_are_rejected() -> None:
    runs = [run.model_dump() for run in make_parameters().runs[4:]]
    with pytest.raises(ValueError, match="5000 triples 'short time' are requested"):
        simulate_run(RunKey(make_parameters(runs=[{**runs[0], "short_time": 5000}]), 0, 5, "test"))


def score_checked(case: ScoredFlight) -> dict[str, float]:
    """A custom score: its inputs must agree with the row."""
    assert case.answer.velocity_m_s is not None
    assert case.true_velocity_m_s is not None
    error = case.answer.velocity_m_s - case.true_velocity_m_s
    moved = case.motion.state(case.states[2].time_s).position_m - case.states[2].position_m
    return {"error_m_s": float(np.hypot(*error)), "off_m": float(np.abs(moved).max())}


def test_case_is_answered_and_deterministic() -> None:
    """A short-time triple over the lake bed: attitude and altitude errors cause less than 2 m/s."""
    parameters = make_parameters(
        runs=[make_parameters().runs[4].model_dump() | {"same_direction": 0, "opposite_direction": 0}]
    )
    compared = parameters.model_copy(
        update={"compared": ("phase-correlation",), "scores": (f"{__name__}:score_checked",)}
    )
    result = FieldTestScenario().run(compared, Streams(5, "test", 0))
    assert result.row["algorithm"] == "dimes"
    assert result.row["phase_correlation.outcome"] in VelocityOutcome.__members__
    assert result.row["run"] == "Ivanpah Run 3"
    assert result.row["category"] == "short time"
    assert result.answered
    assert float(result.row["velocity_error_m_s"]) < 2.0
    for label in ("", "phase_correlation."):
        assert result.row[f"{label}score_checked_error_m_s"] == result.row[f"{label}velocity_error_m_s"]
    assert result.row["score_checked_off_m"] == 0.0
    repeated = FieldTestScenario().run(parameters, Streams(5, "test", 0))
    same = {name: value for name, value in result.row.items() if not re.search(r"time|\.|score_checked", name)}
    assert same.items() <= repeated.row.items()
    with pytest.raises(ValueError, match="allowed: 0 to 138"):
        FieldTestScenario().run(parameters, Streams(5, "test", 139))


def test_cloud_shadows_move_steadily_between_images() -> None:
    """A sun position updated in steps would shift the shadows of high clouds faster than the wind."""
    key = RunKey(make_parameters(), 3, 5, "test")
    run = simulate_run(key)
    assert run.clouds is not None
    ground = np.array([[[0.0, 0.0, 0.0]]])
    positions = []
    for time_s in np.arange(1000.0, 1120.0, 3.0).tolist():
        sun = sun_at(run, time_s)
        _, height, east, north, _ = run.clouds.coefficients(sun, time_s)
        up = (height - ground[0, 0, 2]) / sun.direction[2]
        # Position in the cloud layer between the ground point and the sun.
        positions.append([up * sun.direction[0] - east, up * sun.direction[1] - north])
    moved = np.linalg.norm(np.diff(positions, axis=0), axis=1) / 3.0
    clouds = key.field_test.runs[3].clouds
    assert clouds is not None
    wind = np.hypot(clouds.wind_east_m_s, clouds.wind_north_m_s)
    assert np.ptp(moved) < 0.01
    assert abs(moved.mean() - wind) < 0.5
