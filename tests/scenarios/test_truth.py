"""Tests that no algorithm receives the truth.

Spy algorithms record their inputs. Each input field must differ from the truth in several cases. Not compared: images,
exposure times, the sun direction (known from the ephemeris) and the mast geometry (the errors of angles and cameras
include its errors).
"""

from collections.abc import Iterator
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.scenarios.descent.images import camera_optics
from marsyard.scenarios.descent.parameters import IMU_MARGIN_S, SIMULATED_LEAD_S, DescentScenarioParameters
from marsyard.scenarios.descent.scenario import DescentScenario
from marsyard.scenarios.fieldtest.flight import field_camera
from marsyard.scenarios.fieldtest.scenario import FieldTestScenario
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.scenario import LandingScenario
from marsyard.scenarios.parts.scores import ScoredDescent, ScoredFlight
from marsyard.scenarios.rover.closed_loop import run_case
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DescentMeasurements, LandingMeasurements, MastCalibration, RoverMeasurements
from marsyard.sim.sensor import Detector
from marsyard.sim.sensor.imu import true_increments
from marsyard.sim.streams import Streams
from tests.scenarios import spies

#: The first case runs in the suite, the other ones in `make validate`.
CASES = [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)]
#: The algorithm runs in this process, so that it records its inputs here.
IN_PROCESS: dict[str, Any] = {"executable": {"isolated": False}}
RECORDING_SCORE = {"scores": ["tests.scenarios.spies:record_case"], **IN_PROCESS}

Numbers = Float[np.ndarray, "..."]


@pytest.fixture(autouse=True)
def _clear_spies() -> Iterator[None]:
    yield
    spies.RECORDED_INPUTS.clear()
    spies.RECORDED_CASES.clear()


def assert_differs(name: str, inputs: Any, truth: Any) -> None:
    """Assert that an input differs from its true value by more than rounding."""
    inputs, truth = np.asarray(inputs, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    assert np.abs(inputs - truth).max() > 1e-9 * max(np.abs(truth).max(), 1.0), f"{name} is the truth: {inputs}"


def assert_cameras_differ(name: str, inputs: CameraModel, truth: CameraModel) -> None:
    """Assert that the cameras project the same points to other pixels."""
    assert inputs.size == truth.size
    columns, rows = inputs.size
    corners = np.array([[0.1 * columns, 0.1 * rows], [0.5 * columns, 0.5 * rows], [0.9 * columns, 0.8 * rows]])
    assert_differs(name, inputs.rays(corners)[1], truth.rays(corners)[1])


def assert_poses_differ(name: str, inputs: RigidTransform, truth: RigidTransform) -> None:
    """Assert that the poses differ in position and attitude."""
    assert_differs(f"{name}: position", inputs.translation, truth.translation)
    assert_rotations_differ(name, inputs.rotation, truth.rotation)


def assert_rotations_differ(name: str, inputs: Rotation, truth: Rotation) -> None:
    """Assert that the rotations differ by more than 1e-7 rad; rounding causes 1e-8 rad."""
    assert (inputs * truth.inv()).magnitude() > 1e-7, f"{name} is the true attitude"


def assert_flat_field_differs(inputs: Numbers, detector: Detector) -> None:
    """Assert that the calibrated pixel response, shape (rows, columns), is not a multiple of the true response."""
    rows, columns = inputs.shape
    truth = detector.response.reshape(rows, -1, columns).mean(axis=1)
    assert float(np.std(inputs / truth)) > 1e-6


def assert_all_fields_are_compared(measurement_class: type[Any], names: set[str]) -> None:
    """Assert that the measurements have exactly the named fields, which this module compares or exempts."""
    assert {entry.name for entry in fields(measurement_class)} == names


@pytest.mark.parametrize("case", CASES)
def test_descent_inputs_differ_from_truth(case: int) -> None:
    from tests.scenarios.descent.descents import DESCENT, SMALL_WORLD

    parameters = DescentScenarioParameters.model_validate(
        {
            **SMALL_WORLD,
            "descent": DESCENT,
            "inertial": {"rate_hz": 100.0},
            "algorithm": "tests.scenarios.spies:VelocitySpy",
            **RECORDING_SCORE,
        }
    )
    streams = Streams(1, "truth", case)
    row = DescentScenario().run(parameters, streams).row
    (inputs,), (truth,) = spies.RECORDED_INPUTS, spies.RECORDED_CASES
    assert isinstance(truth, ScoredDescent)
    camera = parameters.detector.delivered_camera(camera_optics(parameters.camera).camera)
    response = Detector.draw(
        camera_optics(parameters.camera).fall_off, parameters.detector, streams.generator("detector response")
    )
    assert_flight_inputs_differ(inputs, truth, camera, [float(row[f"altitude_{k}_m"]) for k in (1, 2, 3)])
    assert_flat_field_differs(inputs.images[0].calibration.flat_field, response)
    times = np.array(parameters.image_times_s)
    for image, attitude, time_s in zip(inputs.images, inputs.attitudes, times, strict=True):
        assert_differs("time tag", image.time_s, time_s)
        assert_differs("attitude's time tag", attitude.time_s, time_s)
    true_displacements = np.diff([state.position_m for state in truth.states], axis=0)
    assert_differs("interval velocities", inputs.interval_velocities_m_s, true_displacements / np.diff(times)[:, None])
    for inertial, state in zip(inputs.inertial_velocities_m_s, truth.states, strict=True):
        assert_differs("inertial velocity", inertial, state.velocity_m_s)
    boundaries = -SIMULATED_LEAD_S + IMU_MARGIN_S + np.arange(inputs.increments.times_s.size) / 100.0
    angles, velocities = true_increments(truth.motion, boundaries)
    assert_differs("time tags of the increments", inputs.increments.times_s, boundaries)
    # errors of single increments are much smaller than the increments
    assert np.abs(inputs.increments.delta_angles_rad - angles).max() > 1e-6
    assert np.abs(inputs.increments.delta_velocities_m_s - velocities).max() > 1e-5


def assert_flight_inputs_differ(
    inputs: DescentMeasurements, truth: ScoredFlight, camera: CameraModel, altitudes_m: list[float]
) -> None:
    """Assert that cameras, attitudes and altitudes differ from the truth."""
    # the increments are compared separately; the gravity of the site is known
    names = {"images", "attitudes", "altitudes", "interval_velocities_m_s", "sun_direction", "inertial_velocities_m_s"}
    names |= {"increments", "gravity_m_s2", "sun_directions"}
    assert_all_fields_are_compared(DescentMeasurements, names)
    for image, attitude, altitude, state, altitude_m in zip(
        inputs.images, inputs.attitudes, inputs.altitudes, truth.states, altitudes_m, strict=True
    ):
        assert_cameras_differ("camera", image.camera, camera)
        assert_rotations_differ("attitude", attitude.world_from_body, state.attitude)
        assert_differs("altitude", altitude.altitude_m, altitude_m)


@pytest.mark.slow
@pytest.mark.parametrize("case", range(3))
def test_field_test_inputs_differ_from_truth(case: int) -> None:
    """Time tags are not compared: as in the paper (III.D), their intervals equal the virtual interval."""
    from tests.scenarios.test_fieldtest import make_parameters

    # one run, only image triples of the category "short time"
    runs = [make_parameters().runs[4].model_dump() | {"same_direction": 0, "opposite_direction": 0}]
    parameters = make_parameters(runs=runs, algorithm="tests.scenarios.spies:VelocitySpy", **RECORDING_SCORE)
    row = FieldTestScenario().run(parameters, Streams(5, "test", case)).row
    (inputs,), (truth,) = spies.RECORDED_INPUTS, spies.RECORDED_CASES
    camera = parameters.detector.delivered_camera(field_camera())
    assert_flight_inputs_differ(inputs, truth, camera, [float(row[f"altitude_{k}_m"]) for k in (1, 2, 3)])
    true_displacements = np.diff([state.position_m for state in truth.states], axis=0)
    true_velocities = true_displacements / parameters.triples.virtual_interval_s
    assert_differs("interval velocities", inputs.interval_velocities_m_s, true_velocities)


@pytest.mark.parametrize("helicopter", [None, {}])
@pytest.mark.parametrize("case", CASES)
def test_landing_inputs_differ_from_truth(case: int, helicopter: dict[str, Any] | None) -> None:
    """Poses that the parameters define have exact time tags; those of a helicopter have the tags of its clock."""
    parameters = LandingScenarioParameters.model_validate(
        {
            "site": "heli-benign",
            "terrain": {"samples": 256},
            "helicopter": helicopter,
            "algorithm": "tests.scenarios.spies:SiteSpy",
            **RECORDING_SCORE,
        }
    )
    row: dict[str, Scalar] = dict(LandingScenario().run(parameters, Streams(1, "truth", case)).row)
    (inputs,), (truth,) = spies.RECORDED_INPUTS, spies.RECORDED_CASES
    assert_all_fields_are_compared(
        LandingMeasurements, {"images", "poses", "slant_range_m", "up_body", "apriori_site_world"}
    )
    for image, pose, state in zip(inputs.images, inputs.poses, truth.states, strict=True):
        assert_cameras_differ("camera", image.camera, parameters.detector.delivered_camera(parameters.optics))
        assert_poses_differ("pose", pose.world_from_body, rigid(state.attitude, state.position_m))
        assert image.time_s == pose.time_s
        if helicopter is not None:
            assert_differs("time tag", image.time_s, state.time_s)
    first_state, range_m = truth.states[0], float(row["range_m"])
    assert_differs("slant range", inputs.slant_range_m, range_m)
    assert_differs("vertical", inputs.up_body, first_state.attitude.inv().apply([0.0, 0.0, 1.0]))
    site = inputs.apriori_site_world
    assert_differs("a-priori site", site, first_state.world_from_body.apply(range_m * np.array(parameters.optics.a)))
    for pose in (inputs.poses[0].world_from_body, first_state.world_from_body):
        assert_differs("distance of the a-priori site", np.linalg.norm(site - pose.translation), range_m)


@pytest.mark.parametrize("case", CASES)
def test_rover_inputs_differ_from_truth(case: int) -> None:
    """The first stop is not compared: the estimated pose is defined as exact at the start."""
    from tests.scenarios.rover.short_run import SHORT_RUN

    parameters = RoverScenarioParameters.model_validate(
        {**SHORT_RUN, **IN_PROCESS, "algorithm": "tests.scenarios.spies:TrackerSpy"}
    )
    run = run_case(parameters, Streams(1, "truth", case))
    aim_calls = [entry for entry in spies.RECORDED_INPUTS if isinstance(entry, tuple)]
    updates = [entry for entry in spies.RECORDED_INPUTS if isinstance(entry, RoverMeasurements)]
    assert len(aim_calls) == len(updates) == len(run.stops) >= 3
    assert_all_fields_are_compared(
        RoverMeasurements, {"left", "right", "mast", "azimuth_rad", "elevation_rad", "world_from_rover"}
    )
    assert_all_fields_are_compared(MastCalibration, {"geometry", "left", "right"})
    for stop, (aim_pose, aim_mast), inputs in zip(run.stops, aim_calls, updates, strict=True):
        for mast in (aim_mast, inputs.mast):
            assert_cameras_differ("left camera", mast.left, run.setup.rig.left)
            assert_cameras_differ("right camera", mast.right, run.setup.rig.right)
        truth = stop.stance.world_from_rover
        head = mast.geometry.rover_from_head(inputs.azimuth_rad, inputs.elevation_rad)
        assert_rotations_differ("mast's angles", head.rotation, (truth.inv() * stop.world_from_head).rotation)
        if stop is not run.stops[0]:
            assert_poses_differ("pose", inputs.world_from_rover, truth)
            assert_poses_differ("pose of an aim", aim_pose, truth)
