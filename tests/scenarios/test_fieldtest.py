"""Tests of the field-test scenario: sun position, attitude errors, elevation model, image triples and one case."""

import re
import tomllib
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.algorithms.interface import VelocityOutcome
from marsyard.scenarios import fieldtest
from marsyard.scenarios.cameras import camera_optics
from marsyard.scenarios.fieldtest import run as run_module
from marsyard.scenarios.fieldtest.attitude import EarthRotation, InertialTrajectory
from marsyard.scenarios.fieldtest.conditions import triple_columns
from marsyard.scenarios.fieldtest.flight import RunKey, field_camera
from marsyard.scenarios.fieldtest.images import build_start_scene, run_ground, scene_at, sun_at, take_image
from marsyard.scenarios.fieldtest.measurements import TripleCase, measure
from marsyard.scenarios.fieldtest.parameters import ElevationParameters, FieldTestParameters, ImageTargetParameters
from marsyard.scenarios.fieldtest.run import FieldRun, simulate_elevation_model, simulate_run
from marsyard.scenarios.fieldtest.scenario import FieldTestScenario
from marsyard.scenarios.fieldtest.sun_position import sun_direction
from marsyard.scenarios.fieldtest.targets import Targets, detect_targets
from marsyard.scenarios.fieldtest.triples import Category, case_order, find_triples
from marsyard.scenarios.parts import ScoredFlight
from marsyard.scenarios.views import Viewpoint, site_scene
from marsyard.sim.dynamics import Resting
from marsyard.sim.dynamics.helicopter import HelicopterParameters, draw_helicopter_flight
from marsyard.sim.render.arrays import to_host
from marsyard.sim.sensor.imu import true_increments
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import Surface

CATALOGUE = Path(fieldtest.__file__).parent / "catalogue" / "dimes-fieldtest.toml"
IMU = {"rate_hz": 25.0, "gyro_bias_deg_h_k": 0.0}
#: Number of image triples in Fig. 11 of the paper: sum of the column TOTAL.
N_PAPER_TRIPLES = 1913


def make_parameters(**changes: Any) -> FieldTestParameters:
    """Return the campaign's parameters with a small terrain, a lower gyro rate and projected targets.

    The lower gyro rate does not change the attitudes, because the angle increments are exact.
    """
    parameters = tomllib.loads(CATALOGUE.read_text(encoding="utf-8"))["parameters"]
    small = {"samples": 512, "imu": IMU, "targets": {"sightings": "oracle-projection"}}
    return FieldTestParameters.model_validate({**parameters, **small, **changes})


def make_ivanpah_run(**changes: Any) -> FieldRun:
    """Simulate run 4 of the campaign, Ivanpah Run 3, with seed 5."""
    return simulate_run(RunKey(make_parameters(**changes), 4, 5, "test"))


def compute_attitude_errors_deg(run: FieldRun) -> np.ndarray:
    """Compute the errors of the fitted attitudes, rotation vectors in world axes, shape (images, 3)."""
    errors: np.ndarray = np.degrees((run.attitudes * run.truth.attitudes.inv()).as_rotvec())
    return errors


def test_sun_position_matches_the_almanac() -> None:
    """Example of Reda & Andreas (2004): zenith 50.11162 deg, including 0.0165 deg of refraction."""
    time = datetime(2003, 10, 17, 12, 30, 30, tzinfo=timezone(timedelta(hours=-7)))
    sun = sun_direction(time, 39.742476, -105.1786)
    assert np.degrees(np.arccos(sun[2])) == pytest.approx(50.1281, abs=0.01)
    assert np.degrees(np.arctan2(sun[0], sun[1])) % 360.0 == pytest.approx(194.34024, abs=0.01)


def test_time_without_a_time_zone_is_rejected() -> None:
    with pytest.raises(ValueError, match="time zone"):
        sun_direction(datetime(2002, 9, 23), 0.0, 0.0)


@pytest.mark.parametrize("gyro_bias_deg_h", [1.0, 5.0])
def test_attitude_error_without_drift_is_below_0_15_deg(gyro_bias_deg_h: float) -> None:
    """A random walk of 0.07 deg/sqrt(h) over 40 min with known ends has 0.03 deg rms at the middle; bound: 5 sigma."""
    run = make_ivanpah_run(drift={"change_k": 0.0}, imu={**IMU, "gyro_bias_deg_h": gyro_bias_deg_h})
    assert np.abs(compute_attitude_errors_deg(run)).max() < 0.15


def test_gyros_at_rest_measure_the_rotation_of_the_earth() -> None:
    """A sidereal day has 86,164.1 s. At a latitude of 35 deg the horizontal component points north."""
    earth = EarthRotation.at_latitude(35.0)
    resting = InertialTrajectory(Resting(np.zeros(3), Rotation.from_euler("z", 90.0, degrees=True), 9.8), earth)
    angles, _ = true_increments(resting, np.linspace(0.0, 3600.0, 11))
    degrees_per_hour = np.degrees(angles.sum(axis=0))
    assert np.linalg.norm(degrees_per_hour) == pytest.approx(360.0 * 3600.0 / 86164.1, rel=1e-4)
    # The body x axis points north, z points up.
    assert degrees_per_hour == pytest.approx(15.041 * np.array([0.819, 0.0, 0.574]), abs=0.01)


def test_attitude_fit_needs_the_rotation_of_the_earth(monkeypatch: pytest.MonkeyPatch) -> None:
    """The Earth turns by 10 deg between the passes over the targets.

    The fit can represent this rotation by a constant bias, except on a platform that turns with the helicopter.
    """
    rotating_platform = {"turns_with_flight": True}
    run = make_ivanpah_run(drift={"change_k": 0.0}, helicopter=rotating_platform)
    assert np.abs(compute_attitude_errors_deg(run)).max() < 0.15
    # The gyros measure the rotation of the Earth, but the attitude fit ignores it.
    to_inertial = EarthRotation.to_inertial
    monkeypatch.setattr(EarthRotation, "to_inertial", lambda self, times: to_inertial(self, 0.0 * times))
    monkeypatch.setattr(
        InertialTrajectory,
        "motion",
        lambda self, times: replace(
            (motion := self.trajectory.motion(times)), attitudes=to_inertial(self.earth, times) * motion.attitudes
        ),
    )
    run = make_ivanpah_run(drift={"change_k": 0.0}, helicopter=rotating_platform)
    assert np.abs(compute_attitude_errors_deg(run)).max() > 0.3


def test_camera_looks_up_to_45_deg_off_nadir() -> None:
    max_angles_deg = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        flight = draw_helicopter_flight(HelicopterParameters(), np.zeros(3), 0.3, 9.8, rng)
        times = np.concatenate([np.arange(leg.start_s, leg.end_s, 0.5) for leg in flight.passes])
        axes = flight.motion(times).attitudes.apply(np.array([0.0, 0.0, -1.0]))
        max_angles_deg.append(float(np.degrees(np.arccos(-axes[:, 2])).max()))
    # The residual motion of the platform is 0.2 deg.
    assert max(max_angles_deg) == pytest.approx(45.0, abs=1.5)
    assert min(max_angles_deg) > 30.0


def test_noise_campaign_has_bursts_in_each_run() -> None:
    parameters = tomllib.loads(CATALOGUE.with_name("dimes-fieldtest-noise.toml").read_text(encoding="utf-8"))
    noise_parameters = FieldTestParameters.model_validate(parameters["parameters"])
    assert all(noise_parameters.run_detector(number).bursts.bursts == 10.0 for number in range(4))
    # the fifth run has an intact cable
    assert noise_parameters.run_detector(4) == noise_parameters.detector


def test_attitude_fit_does_not_remove_a_drift_about_the_flight_line() -> None:
    """The gyro bias about the flight line drifts: the tilt about this axis changes by tenths of a degree."""
    run = make_ivanpah_run()
    azimuth = run.flown.flight.azimuth_rad
    flight_direction = np.array([np.sin(azimuth), np.cos(azimuth), 0.0])
    tilt = compute_attitude_errors_deg(run) @ flight_direction
    assert np.ptp(tilt) > 0.6
    assert np.ptp(compute_attitude_errors_deg(run) @ np.array([-flight_direction[1], flight_direction[0], 0.0])) < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("run_index", [0, 2, 4])
def test_targets_are_detected_in_the_images_of_a_pass(run_index: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nearly all targets are detected on lava, dunes and the lake bed.

    A binned pixel covers 0.4 m x 1.6 m on the ground. The RMS bounds are 15 cm (0.37 px) in columns and 40 cm
    (0.25 px) in rows.
    """
    detections = []

    def record_detection(*arguments: Any) -> np.ndarray:
        detections.append(centroids := detect_targets(*arguments))
        return centroids

    states = []

    def record_state(*arguments: Any) -> Any:
        states.append(arguments[3])  # camera state at the exposure
        return take_image(*arguments)

    monkeypatch.setattr(run_module, "detect_targets", record_detection)
    monkeypatch.setattr(run_module, "take_image", record_state)
    parameters = make_parameters(drift={"change_k": 0.0}, targets={"images": 3})
    key = RunKey(parameters, run_index, 6, "test")
    run = simulate_run(key)
    assert np.abs(compute_attitude_errors_deg(run)).max() < 0.15
    camera = field_camera().bin(columns=1, rows=4)
    targets = Targets.draw(
        parameters.targets, run_ground(key).surface, run.flown.flight.origin_m[:2], key.generator("targets")
    )
    true_pixels = [camera.project(state.attitude.inv().apply(targets.true_m - state.position_m))[0] for state in states]
    errors = np.stack(detections) - np.stack(true_pixels)
    is_detected = np.isfinite(errors[..., 0])
    assert is_detected.mean() > 0.9
    assert np.all(np.sqrt(np.mean(errors[is_detected] ** 2, axis=0)) < [0.37, 0.25])


def test_three_targets_are_in_the_centre() -> None:
    """Paper, III.D.2: nine of eleven targets are used, three are in the centre (here on a circle of 10 m radius)."""
    flat_ground = Surface.from_samples(np.zeros((64, 64, 2), dtype=np.float32), 500.0)
    centre = np.array([300.0, -120.0])
    targets = Targets.draw(ImageTargetParameters(survey_m=0.0), flat_ground, centre, np.random.default_rng(3))
    distances = np.hypot(*(targets.surveyed_m[:, :2] - centre).T)
    assert len(distances) == 9
    np.testing.assert_allclose(distances[:3], 10.0, atol=1e-6)
    assert np.all(distances[3:] > 10.0)
    sides = targets.surveyed_m[:3] - np.roll(targets.surveyed_m[:3], 1, axis=0)
    np.testing.assert_allclose(np.linalg.norm(sides, axis=1), 10.0 * np.sqrt(3.0), atol=1e-6)
    with pytest.raises(ValueError, match="10 targets are in the centre, but only 9 are used"):
        ImageTargetParameters(central=10)


def test_targets_are_detected_only_if_the_image_contains_them() -> None:
    """Spots of noise and a bright rock on bare ground do not match the pattern of the targets."""
    rng = np.random.default_rng(3)
    camera = field_camera().bin(columns=1, rows=4)
    image = rng.normal(1000.0, 30.0, (256, 1024)).clip(0.0).astype(np.uint16)
    image[100:103, 500:505] = 3000
    flat_ground = Surface.from_samples(np.zeros((64, 64, 2), dtype=np.float32), 500.0)
    targets = Targets.draw(ImageTargetParameters(), flat_ground, np.zeros(2), rng)
    position = np.array([0.0, 0.0, 500.0])
    centroids = detect_targets(image, targets, camera, position, Rotation.identity(), np.radians(1.0))
    assert np.isnan(centroids).all()
    # Add the targets to the image, seen with an attitude that differs from the prior. Bilinear weights spread each
    # target over four pixels.
    attitude = Rotation.from_rotvec(np.radians([1.0, -1.5, 1.0]))
    pixels = camera.project(attitude.inv().apply(targets.true_m - position))[0]
    corner = np.floor(pixels).astype(int)
    fraction = pixels - corner
    for row, column in np.ndindex(2, 2):
        weights = np.abs(1 - row - fraction[:, 1]) * np.abs(1 - column - fraction[:, 0])
        image[corner[:, 1] + row, corner[:, 0] + column] += (2000.0 * weights).astype(np.uint16)
    centroids = detect_targets(image, targets, camera, position, Rotation.identity(), np.radians(1.0))
    assert np.abs(centroids - pixels).max() < 0.3


def test_run_without_detected_targets_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_module, "detect_targets", lambda *_: np.full((9, 2), np.nan))
    with pytest.raises(ValueError, match="Ivanpah Run 3: 0 sightings of targets in a pass"):
        make_ivanpah_run(targets={"images": 1})


def test_elevation_model_has_the_specified_rms_error() -> None:
    """Over flat ground the heights have the RMS error of the grid points, 6 m. Interpolation reduces it slightly."""
    flat_ground = Surface.from_samples(np.zeros((64, 64, 2), dtype=np.float32), 500.0)
    positions = np.random.default_rng(1).uniform(0.0, 30000.0, (4000, 2))
    elevation_model = simulate_elevation_model(ElevationParameters(), flat_ground, positions, np.random.default_rng(2))
    assert elevation_model(positions).std() == pytest.approx(6.0, rel=0.06)


def test_triples_match_their_category() -> None:
    """Limits of the parameters: 30 m/s over the virtual interval of 3.75 s, height steps of 150 to 390 m.

    The counts are those of Ivanpah Run 3 in the campaign.
    """
    run = make_ivanpah_run()
    counts = dict.fromkeys(Category, 0)
    for triple in run.triples:
        counts[triple.category] += 1
        numbers = list(triple.image_indices)
        heights = run.images.position_m[numbers, 2]
        distances_m = np.linalg.norm(np.diff(run.images.position_m[numbers, :2], axis=0), axis=1)
        assert np.all(distances_m <= 30.0 * 3.75)
        has_two_directions = len(set(run.images.direction[numbers].tolist())) > 1
        if triple.category is Category.SHORT_TIME:
            assert np.array_equal(np.diff(numbers), [1, 1])
            assert len(set(run.images.pass_number[numbers].tolist())) == 1
        else:
            assert np.all((-np.diff(heights) >= 150.0) & (-np.diff(heights) <= 390.0))
            assert has_two_directions is (triple.category is Category.OPPOSITE_DIRECTION)
    assert counts == {Category.SHORT_TIME: 139, Category.SAME_DIRECTION: 66, Category.OPPOSITE_DIRECTION: 24}


def test_first_cases_contain_the_runs_in_proportion_to_their_triples() -> None:
    """Each image triple of the paper is one case."""
    parameters = make_parameters()
    order = case_order(parameters)
    assert len(order) == len(set(order)) == N_PAPER_TRIPLES
    expected_fraction = parameters.runs[3].triples / N_PAPER_TRIPLES
    assert sum(number == 3 for number, _ in order[:200]) / 200 == pytest.approx(expected_fraction, abs=0.03)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_flight_contains_the_number_of_triples_of_the_paper(seed: int) -> None:
    """Run 3 of Kelso has the most triples. An image every 2 s or passes of 100 s leave too few in some flights."""
    parameters = make_parameters()
    run = simulate_run(RunKey(parameters, 3, seed, "test"))
    counts = {category: len(triples) for category, triples in find_triples(run.images, parameters.triples).items()}
    requested = {Category.SHORT_TIME: 251, Category.SAME_DIRECTION: 306, Category.OPPOSITE_DIRECTION: 286}
    assert all(counts[category] > 1.2 * count for category, count in requested.items()), counts


def test_sun_moves_while_rocks_are_fixed() -> None:
    """Rocks are built once per run, because this is slow. The sun direction is computed for each image."""
    key = RunKey(make_parameters(), 0, 5, "test")
    run, time_s = simulate_run(key), 1800.0
    ground = run_ground(key)
    start_scene = build_start_scene(run.flown, ground)
    early_scene, late_scene = (scene_at(run.flown, start_scene, ground, time) for time in (0.0, time_s))
    assert len(early_scene.objects) > 0
    assert late_scene.objects is early_scene.objects
    east, north, _ = run.flown.flight.origin_m.tolist()
    pixel_rad = camera_optics(field_camera()).rays.pixel_rad
    viewpoint = Viewpoint(east, north, key.field_test.helicopter.lowest_m, pixel_rad)
    single_scene = site_scene(ground, viewpoint, sun_at(run.flown, time_s))
    assert np.array_equal(late_scene.sun.direction, single_scene.sun.direction)
    assert late_scene.photometry == single_scene.photometry
    assert np.array_equal(late_scene.objects.triangles, single_scene.objects.triangles)
    extents = [[to_host(value)[0] for value in vars(scene.extent).values()] for scene in (late_scene, single_scene)]
    assert extents[0] == extents[1]


def test_too_many_triples_are_rejected() -> None:
    runs = [run.model_dump() for run in make_parameters().runs[4:]]
    with pytest.raises(ValueError, match="5000 triples 'short time' are requested"):
        simulate_run(RunKey(make_parameters(runs=[{**runs[0], "short_time": 5000}]), 0, 5, "test"))


def score_inputs(case: ScoredFlight) -> dict[str, float]:
    """Custom score that returns errors, which are compared with the columns of the row."""
    assert case.answer.velocity_m_s is not None
    assert case.true_velocity_m_s is not None
    error = case.answer.velocity_m_s - case.true_velocity_m_s
    position_error_m = case.motion.state(case.states[2].time_s).position_m - case.states[2].position_m
    return {"error_m_s": float(np.hypot(*error)), "position_error_m": float(np.abs(position_error_m).max())}


def test_case_is_answered_and_deterministic() -> None:
    """A short-time triple over the flat lake bed: attitude and altitude errors cause less than 2 m/s."""
    parameters = make_parameters(
        runs=[make_parameters().runs[4].model_dump() | {"same_direction": 0, "opposite_direction": 0}]
    )
    compared_parameters = parameters.model_copy(
        update={
            "compared": ("phase-correlation", "marsyard.algorithms.controls:NoImage"),
            "scores": (f"{__name__}:score_inputs",),
        }
    )
    result = FieldTestScenario().run(compared_parameters, Streams(5, "test", 0))
    assert result.row["algorithm"] == "dimes"
    assert result.row["phase_correlation.outcome"] in VelocityOutcome.__members__
    assert result.row["run"] == "Ivanpah Run 3"
    assert result.row["category"] == "short time"
    assert result.answered
    assert float(result.row["velocity_error_m_s"]) < 2.0
    for label in ("", "phase_correlation."):
        assert result.row[f"{label}score_inputs_error_m_s"] == result.row[f"{label}velocity_error_m_s"]
    assert result.row["score_inputs_position_error_m"] == 0.0
    # the inertial velocity has an unknown constant error of 15 m/s rms per axis: it does not contain the truth
    assert 5.0 < float(result.row["NoImage.velocity_error_m_s"]) < 75.0
    repeated_result = FieldTestScenario().run(parameters, Streams(5, "test", 0))
    # Columns of run times, of the compared algorithm and of the score are not compared.
    excluded_columns = re.compile(r"time|\.|score_inputs")
    columns = {name: value for name, value in result.row.items() if not excluded_columns.search(name)}
    assert columns.items() <= repeated_result.row.items()
    with pytest.raises(ValueError, match="allowed: 0 to 138"):
        FieldTestScenario().run(parameters, Streams(5, "test", 139))


def test_measurements_and_columns_are_those_of_each_image() -> None:
    """The paper has a sun vector for each image (III.D); the images of a triple are minutes apart."""
    parameters, run = make_parameters(), make_ivanpah_run()
    key = run.flown.key
    triple = next(item for item in run.triples if item.category is Category.OPPOSITE_DIRECTION)
    states = [run.flown.flight.state(time) for time in run.truth.times_s[list(triple.image_indices)].tolist()]
    case = TripleCase(run, triple, (states[0], states[1], states[2]))
    images = [np.zeros((1, 1), dtype=np.uint16)] * 3
    rng = np.random.default_rng(0)
    measurements = measure(parameters, case, images, key.detector(), key.calibrated_camera(), rng)
    for frame, state in zip(measurements.frames(), states, strict=True):
        np.testing.assert_array_equal(frame.sun_direction, run.flown.sun(state.time_s))
    suns = measurements.suns()
    assert np.degrees(np.arccos(suns[0] @ suns[2])) > 0.5
    row: Any = triple_columns(parameters, case, measurements, run_ground(key).surface)
    assert row["horizontal_speed_m_s"] == np.hypot(*states[2].velocity_m_s[:2])
    # the true nadir in body axes is rotated by the measured attitude, and intersected with level ground
    shifts = []
    for number, (attitude, state) in enumerate(zip(measurements.attitudes, states, strict=True), start=1):
        down = (attitude.world_from_body * state.attitude.inv()).apply([0.0, 0.0, -1.0])
        shifts.append(row[f"altitude_{number}_m"] * down[:2] / -down[2])
    # images 2 and 3 are 3.75 s apart for the estimator; errors of second order in attitude errors of about a degree
    expected_m_s = np.hypot(*(shifts[2] - shifts[1])) / 3.75
    assert row["attitude_velocity_error_m_s"] == pytest.approx(expected_m_s, rel=0.05)
    assert expected_m_s > 0.1


def test_cloud_shadows_move_steadily_between_images() -> None:
    """The sun direction is continuous. Steps of it would move the shadows of high clouds faster than the wind."""
    key = RunKey(make_parameters(), 3, 5, "test")
    run = simulate_run(key)
    ground = np.array([[[0.0, 0.0, 0.0]]])
    positions = []
    for time_s in np.arange(1000.0, 1120.0, 3.0).tolist():
        sun = sun_at(run.flown, time_s)
        clouds = run.flown.clouds.at_time(sun, time_s)
        height, east, north = (to_host(value)[0] for value in (clouds.height, clouds.east, clouds.north))
        slant_factor = (height - ground[0, 0, 2]) / sun.direction[2]
        # Position in the cloud layer between the ground point and the sun.
        positions.append([slant_factor * sun.direction[0] - east, slant_factor * sun.direction[1] - north])
    velocities_m_s = np.linalg.norm(np.diff(positions, axis=0), axis=1) / 3.0
    parameters = key.field_test.runs[3].clouds
    wind = np.hypot(parameters.wind_east_m_s, parameters.wind_north_m_s)
    assert np.ptp(velocities_m_s) < 0.01
    assert abs(velocities_m_s.mean() - wind) < 0.5


def test_alternating_headings_reduce_the_effect_of_drift() -> None:
    """If the platform turns with the heading, the effect of the drift changes its sign at each pass.

    The tilt error then changes less between passes in the same direction. The fitted constant bias leaves a rest.
    """
    changes_deg = []
    for turns_with_flight in (False, True):
        run = make_ivanpah_run(helicopter={"turns_with_flight": turns_with_flight})
        errors, numbers = compute_attitude_errors_deg(run)[:, :2], run.images.pass_number
        means = np.array([errors[numbers == number].mean(axis=0) for number in np.unique(numbers)])
        changes_deg.append(np.linalg.norm(means[2:] - means[:-2], axis=1).max())
    assert changes_deg[0] > 0.4
    assert changes_deg[1] < 0.7 * changes_deg[0]
