"""No algorithm is given the truth: each field that it gets differs from what is true in every one of several cases.

The algorithms here keep what they are given (`spies`), so that a scenario that hands over anything else than what it
measured is seen too. Not compared are pictures and their exposure times, the direction of the sun (from the ephemeris,
known far better than any camera resolves), and the geometry of a mast (its errors are those of its angles and cameras).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.scenarios.descent.exposure import camera_optics
from marsyard.scenarios.descent.parameters import DescentScenarioParameters
from marsyard.scenarios.descent.scenario import DescentScenario
from marsyard.scenarios.fieldtest.run import field_camera
from marsyard.scenarios.fieldtest.scenario import FieldTestScenario
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.scenario import LandingScenario
from marsyard.scenarios.parts.scores import ScoredDescent, ScoredFlight
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.run import run_case
from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DescentMeasurements, LandingMeasurements, MastCalibration, RoverMeasurements
from marsyard.sim.sensor import Detector
from marsyard.sim.streams import Streams
from tests.scenarios import spies

SPIES = {"scores": ["tests.scenarios.spies:keep"]}

Numbers = Float[np.ndarray, "..."]


@pytest.fixture(autouse=True)
def _empty() -> Iterator[None]:
    yield
    spies.GIVEN.clear()
    spies.TRUE.clear()


def assert_apart(name: str, given: Any, true: Any) -> None:
    """Every case's field differs from its truth by more than rounding."""
    given, true = np.asarray(given, dtype=np.float64), np.asarray(true, dtype=np.float64)
    assert np.abs(given - true).max() > 1e-9 * max(np.abs(true).max(), 1.0), f"{name} is the truth: {given}"


def assert_cameras_apart(name: str, given: CameraModel, true: CameraModel) -> None:
    """Cameras project the same points to other pixels."""
    assert given.size == true.size
    columns, rows = given.size
    corners = np.array([[0.1 * columns, 0.1 * rows], [0.5 * columns, 0.5 * rows], [0.9 * columns, 0.8 * rows]])
    assert_apart(name, given.rays(corners)[1], true.rays(corners)[1])


def assert_poses_apart(name: str, given: RigidTransform, true: RigidTransform) -> None:
    """Poses differ in place and attitude."""
    assert_apart(f"{name}: place", given.translation, true.translation)
    assert_rotations_apart(name, given.rotation, true.rotation)


def assert_rotations_apart(name: str, given: Rotation, true: Rotation) -> None:
    """Rotations differ by more than rounding, which is 1e-8 rad of an angle."""
    assert (given * true.inv()).magnitude() > 1e-7, f"{name} is the true attitude"


def assert_flat_field_apart(given: Numbers, detector: Detector) -> None:
    """The calibrated response of pixels is not a multiple of the true one."""
    rows, columns = given.shape
    true = detector.response.reshape(rows, -1, columns).mean(axis=1)
    assert float(np.std(given / true)) > 1e-6


def assert_all_are_looked_at(kind: type[Any], names: set[str]) -> None:
    """A new field of measurements must be compared here, or exempted with a reason."""
    assert {one.name for one in fields(kind)} == names


@pytest.mark.parametrize("case", range(3))
def test_descents_are_measured(case: int) -> None:
    from tests.scenarios.descent.settings import DESCENT, WORLD

    p = DescentScenarioParameters.model_validate(
        {**WORLD, "descent": DESCENT, "algorithm": "tests.scenarios.spies:VelocitySpy", **SPIES}
    )
    streams = Streams(1, "truth", case)
    row = DescentScenario().run(p, streams).row
    (given,), (true,) = spies.GIVEN, spies.TRUE
    assert isinstance(true, ScoredDescent)
    camera = camera_optics(p.camera).camera.binned(columns=1, rows=p.detector.rows_summed)
    response = Detector.drawn(camera_optics(p.camera).fall_off, p.detector, streams.generator("detector response"))
    assert_flight_is_measured(given, true, camera, [float(row[f"altitude_{k}_m"]) for k in (1, 2, 3)])
    assert_flat_field_apart(given.images[0].calibration.flat_field, response)
    times = np.array(p.picture_times_s)
    for image, attitude, time_s in zip(given.images, given.attitudes, times, strict=True):
        assert_apart("time tag", image.time_s, time_s)
        assert_apart("attitude's time tag", attitude.time_s, time_s)
    moved = np.diff([state.position_m for state in true.states], axis=0)
    assert_apart("interval velocities", given.interval_velocities_m_s, moved / np.diff(times)[:, None])
    for inertial, state in zip(given.inertial_velocities_m_s, true.states, strict=True):
        assert_apart("inertial velocity", inertial, state.velocity_m_s)


def assert_flight_is_measured(
    given: DescentMeasurements, true: ScoredFlight, camera: CameraModel, altitudes_m: list[float]
) -> None:
    """Cameras, attitudes and altitudes."""
    names = {"images", "attitudes", "altitudes", "interval_velocities_m_s", "sun_direction", "inertial_velocities_m_s"}
    assert_all_are_looked_at(DescentMeasurements, names)
    for image, attitude, altitude, state, altitude_m in zip(
        given.images, given.attitudes, given.altitudes, true.states, altitudes_m, strict=True
    ):
        assert_cameras_apart("camera", image.camera, camera)
        assert_rotations_apart("attitude", attitude.world_from_body, state.attitude)
        assert_apart("altitude", altitude.altitude_m, altitude_m)


@pytest.mark.parametrize("case", range(3))
def test_triples_of_the_field_test_are_measured(case: int) -> None:
    """Their time tags are a virtual interval apart by the paper's method (III.D), whenever they were taken."""
    from tests.scenarios.test_fieldtest import stated

    runs = [stated().runs[4].model_dump() | {"same_direction": 0, "opposite_direction": 0}]
    p = stated(runs=runs, algorithm="tests.scenarios.spies:VelocitySpy", **SPIES)
    row = FieldTestScenario().run(p, Streams(5, "test", case)).row
    (given,), (true,) = spies.GIVEN, spies.TRUE
    camera = field_camera().binned(columns=1, rows=p.detector.rows_summed)
    assert_flight_is_measured(given, true, camera, [float(row[f"altitude_{k}_m"]) for k in (1, 2, 3)])
    moved = np.diff([state.position_m for state in true.states], axis=0)
    assert_apart("interval velocities", given.interval_velocities_m_s, moved / p.triples.virtual_interval_s)


@pytest.mark.parametrize("helicopter", [None, {}])
@pytest.mark.parametrize("case", range(3))
def test_landings_are_measured(case: int, helicopter: dict[str, Any] | None) -> None:
    """Time tags are exact by assumption: what a clock's error does is in the errors of the poses."""
    p = LandingScenarioParameters.model_validate(
        {
            "site": "heli-benign",
            "terrain": {"samples": 256},
            "helicopter": helicopter,
            "algorithm": "tests.scenarios.spies:SiteSpy",
            **SPIES,
        }
    )
    row: dict[str, Scalar] = dict(LandingScenario().run(p, Streams(1, "truth", case)).row)
    (given,), (true,) = spies.GIVEN, spies.TRUE
    assert_all_are_looked_at(LandingMeasurements, {"images", "poses", "slant_range_m", "up_body", "apriori_site_world"})
    for image, pose, state in zip(given.images, given.poses, true.states, strict=True):
        assert_cameras_apart("camera", image.camera, p.optics.binned(columns=1, rows=p.detector.rows_summed))
        assert_poses_apart("pose", pose.world_from_body, rigid(state.attitude, state.position_m))
    first, range_m = true.states[0], float(row["range_m"])
    assert_apart("slant range", given.slant_range_m, range_m)
    assert_apart("vertical", given.up_body, first.attitude.inv().apply([0.0, 0.0, 1.0]))
    site = given.apriori_site_world
    assert_apart("a-priori site", site, first.world_from_body.apply(range_m * np.array(p.optics.a)))
    for pose in (given.poses[0].world_from_body, first.world_from_body):
        assert_apart("distance of the a-priori site", np.linalg.norm(site - pose.translation), range_m)


@pytest.mark.parametrize("case", range(2))
def test_stops_of_a_rover_are_measured(case: int) -> None:
    """The estimated pose is right at the start by definition, and from then on never again."""
    from tests.scenarios.rover.short_run import SHORT

    p = RoverScenarioParameters.model_validate({**SHORT, "algorithm": "tests.scenarios.spies:TrackerSpy"})
    run = run_case(p, Streams(1, "truth", case))
    aims = [one for one in spies.GIVEN if isinstance(one, tuple)]
    updates = [one for one in spies.GIVEN if isinstance(one, RoverMeasurements)]
    assert len(aims) == len(updates) == len(run.stops) >= 3
    assert_all_are_looked_at(
        RoverMeasurements, {"left", "right", "mast", "azimuth_rad", "elevation_rad", "world_from_rover"}
    )
    assert_all_are_looked_at(MastCalibration, {"geometry", "left", "right"})
    for stop, (aim_pose, aim_mast), given in zip(run.stops, aims, updates, strict=True):
        for mast in (aim_mast, given.mast):
            assert_cameras_apart("left camera", mast.left, run.rig.left)
            assert_cameras_apart("right camera", mast.right, run.rig.right)
        true = stop.stance.world_from_rover
        head = mast.geometry.rover_from_head(given.azimuth_rad, given.elevation_rad)
        assert_rotations_apart("mast's angles", head.rotation, (true.inv() * stop.world_from_head).rotation)
        if stop is not run.stops[0]:
            assert_poses_apart("pose", given.world_from_rover, true)
            assert_poses_apart("pose of an aim", aim_pose, true)
