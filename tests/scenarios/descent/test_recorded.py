"""Tests of recorded flights: a simulated flight that is saved and read back gives the same case."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from marsyard.scenarios.descent.flight import create_flight
from marsyard.scenarios.descent.parameters import DescentScenarioParameters
from marsyard.scenarios.descent.recorded import FlightFile
from marsyard.scenarios.descent.world import DescentWorld
from marsyard.scenarios.recorded_axes import RecordedAxes
from marsyard.sim.dynamics.pose_files import COLUMNS
from marsyard.sim.streams import Streams
from tests.scenarios.descent.descents import make_parameters, run_descent

#: OpenCV's camera axes in the axes of a body whose camera looks along -z; equal to its inverse.
CAMERA_IN_BODY = Rotation.from_matrix([[1, 0, 0], [0, -1, 0], [0, 0, -1]])
NED_FROM_ENU = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])


def _write_poses(folder: Path, times: np.ndarray, positions: np.ndarray, attitudes: Rotation) -> str:
    path = folder / "flight.parquet"
    values = np.column_stack([times, positions, attitudes.as_quat()])
    pd.DataFrame(values, columns=list(COLUMNS)).to_parquet(path)
    return str(path)


def _write_vertical_fall(folder: Path, *, height_m: float = 2200.0, tilt_deg: float = 0.0) -> str:
    """Write 25 s of descent at 70 m/s, 10 m/s east; attitudes of a camera that looks down, tilted about x."""
    times = np.arange(0.0, 25.0, 0.1)
    positions = np.column_stack([10.0 * times, 0.0 * times, height_m - 70.0 * times])
    down = Rotation.from_matrix([[1, 0, 0], [0, -1, 0], [0, 0, -1]])
    tilt = Rotation.from_euler("x", tilt_deg, degrees=True)
    return _write_poses(folder, times, positions, Rotation.concatenate([tilt * down] * times.size))


def test_recorded_flight_equals_the_simulated_case(tmp_path: Path) -> None:
    """The file has 50 Hz, north-east-down axes, attitudes of the camera and another time origin."""
    simulated_case, parameters = run_descent(), make_parameters()
    world = DescentWorld.from_parameters(parameters)
    flight = create_flight(parameters, world.surface, Streams(1, "test", 0))
    times = np.arange(-5.0, flight.firing_s + 1.0, 0.02)
    truth = flight.motion.motion(times)
    origin = np.array(
        [
            parameters.location.east_m,
            parameters.location.north_m,
            world.surface.height(parameters.location.east_m, parameters.location.north_m),
        ]
    )
    file = _write_poses(
        tmp_path,
        times + 1234.0,
        NED_FROM_ENU.apply(truth.positions_m - origin),
        NED_FROM_ENU * truth.attitudes * CAMERA_IN_BODY.inv(),
    )
    recorded_case = run_descent(flight={"file": file, "axes": "ned", "first_image_s": 1234.0})
    assert recorded_case.outcome == simulated_case.outcome == "VALID"
    for name in ("velocity_true_x_m_s", "velocity_true_y_m_s", "altitude_1_m", "off_nadir_3_deg", "firing_after_s"):
        assert recorded_case.row[name] == pytest.approx(simulated_case.row[name], abs=1e-2), name
    # Interpolation moves the camera by up to 0.1 mm: images and estimate change slightly.
    for axis in "xy":
        name = f"velocity_estimated_{axis}_m_s"
        assert recorded_case.row[name] == pytest.approx(simulated_case.row[name], abs=0.05)
    # The instruments have the same errors.
    for name in ("attitude_error_common_deg", "altitude_error_2_m", "tag_error_1_s"):
        assert recorded_case.row[name] == pytest.approx(simulated_case.row[name], rel=0.02, abs=1e-4), name


@pytest.mark.parametrize("unit_s", [1e-3, 1e-9])
def test_flights_with_large_gaps_are_rejected(tmp_path: Path, unit_s: float) -> None:
    """With times in milliseconds or nanoseconds instead of seconds, the lander would hover during the images."""
    times = np.arange(0.0, 25.0, 0.1)
    positions = np.column_stack([10.0 * times, 0.0 * times, 2200.0 - 70.0 * times])
    down = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
    file = _write_poses(tmp_path, times / unit_s, positions, Rotation.concatenate([down] * times.size))
    with pytest.raises(ValidationError, match=r"pose 2 is .* s after the pose before it; allowed .*up to 2 s"):
        DescentScenarioParameters.model_validate({"flight": {"file": file, "axes": "enu"}})


def test_flight_with_a_gap_after_the_images_is_accepted(tmp_path: Path) -> None:
    times = np.append(np.arange(0.0, 25.0, 0.1), 60.0)
    positions = np.column_stack([10.0 * times, 0.0 * times, 5000.0 - 70.0 * times])
    down = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
    file = _write_poses(tmp_path, times, positions, Rotation.concatenate([down] * times.size))
    DescentScenarioParameters.model_validate({"flight": {"file": file, "axes": "enu"}})


def test_flight_is_rotated_and_moved_to_its_start(tmp_path: Path) -> None:
    file = _write_vertical_fall(tmp_path)
    parameters = DescentScenarioParameters.model_validate(
        {"flight": {"file": file, "axes": "enu", "heading_offset_deg": 90.0}}
    )
    assert isinstance(parameters.flight, FlightFile)
    # origin of the file in the world, and gravity (m/s^2)
    motion = parameters.flight.create_trajectory(np.array([100.0, 200.0, 30.0]), 3.7)
    # The rotation by 90 deg turns east into south. The first image is 5 s after the start: 50 m south, 350 m lower.
    assert np.allclose(motion.state(0.0).position_m, [100.0, 200.0 - 50.0, 30.0 + 2200.0 - 350.0])
    assert np.allclose(motion.state(0.0).velocity_m_s, [0.0, -10.0, -70.0])
    assert np.allclose(motion.state(0.0).specific_force_m_s2, [0.0, 0.0, 3.7], atol=1e-9)
    # The body's -z axis points down; its x axis, east in the file, points south.
    assert np.allclose(motion.state(0.0).attitude.apply([0.0, 0.0, -1.0]), [0.0, 0.0, -1.0])
    assert np.allclose(motion.state(0.0).attitude.apply([1.0, 0.0, 0.0]), [0.0, -1.0, 0.0])


def test_lever_arm_and_mounting_are_applied(tmp_path: Path) -> None:
    """The vehicle's axes are the world axes; the camera is 2 m below and looks along the vehicle's -z axis."""
    times = np.arange(0.0, 20.0, 0.1)
    positions = np.column_stack([0.0 * times, 0.0 * times, 2000.0 - 50.0 * times])
    file = _write_poses(tmp_path, times, positions, Rotation.identity(times.size))
    quaternion = tuple(Rotation.from_matrix(np.diag([1.0, -1.0, -1.0])).as_quat().tolist())
    values = {"file": file, "axes": "enu", "mounting": quaternion, "lever_m": (0.0, 0.0, -2.0)}
    parameters = DescentScenarioParameters.model_validate({"flight": values})
    assert isinstance(parameters.flight, FlightFile)
    state = parameters.flight.create_trajectory(np.zeros(3), 3.7).state(0.0)
    assert np.allclose(state.attitude.as_matrix(), np.eye(3))
    assert state.position_m[2] == pytest.approx(2000.0 - 250.0 - 2.0)


@pytest.mark.parametrize(
    ("attitude_of", "axes_in_vehicle"),
    [
        # x, y, z of the body (the camera looks along -z, columns along x) and of OpenCV's camera (right, down, forward)
        ("body", ([0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0])),
        ("camera", ([0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0])),
    ],
)
def test_mounting_is_that_of_the_body_or_of_the_camera(
    attitude_of: str, axes_in_vehicle: tuple[list[float], ...]
) -> None:
    """The vehicle's axes are forward, left, up; its camera looks forward."""
    mounting = tuple(Rotation.from_matrix(np.transpose(axes_in_vehicle)).as_quat().tolist())
    axes = RecordedAxes.model_validate({"axes": "enu", "attitude_of": attitude_of, "mounting": mounting})
    world_from_vehicle = Rotation.from_euler("zyx", [30.0, 20.0, 10.0], degrees=True)
    attitude = axes.body_attitudes(world_from_vehicle)
    forward, right = [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]
    assert np.allclose(attitude.apply([0.0, 0.0, -1.0]), world_from_vehicle.apply(forward))
    assert np.allclose(attitude.apply([1.0, 0.0, 0.0]), world_from_vehicle.apply(right))


@pytest.mark.parametrize("first_image_s", [None, 1750000005.0])
def test_times_since_1970_are_subtracted_before_rounding(tmp_path: Path, first_image_s: float | None) -> None:
    """The specific force of a fall without acceleration is that of gravity (3.7 m/s^2), with poses at 400 Hz."""
    times = np.arange(10_000)
    positions = np.column_stack([0.0 * times, 0.0 * times, 2200.0 - 0.0025 * 70.0 * times])
    down = np.tile([1.0, 0.0, 0.0, 0.0], (times.size, 1))
    frame = pd.DataFrame(np.column_stack([times, positions, down]), columns=["time_ns", *COLUMNS[1:]])
    frame["time_ns"] = 1_750_000_000_000_000_000 + 2_500_000 * times
    frame.to_parquet(tmp_path / "flight.parquet")
    flight = FlightFile.model_validate(
        {"file": str(tmp_path / "flight.parquet"), "axes": "enu", "first_image_s": first_image_s}
    )
    assert flight.first_image_time_s == 1750000005.0
    motion = flight.create_trajectory(np.zeros(3), 3.7)
    assert motion.span_s[0] == -5.0
    forces = motion.motion(np.linspace(0.0, 15.0, 999)).specific_forces_m_s2
    # rounding errors of the positions: 2200 m x 2^-53 x 12 / (2.5 ms)^2 = 5e-7 m/s^2
    assert np.abs(forces - [0.0, 0.0, 3.7]).max() < 1e-5


def test_invalid_flights_are_rejected_on_load(tmp_path: Path) -> None:
    def expect_error(match: str, file: str, **values: Any) -> None:
        with pytest.raises(ValidationError, match=match):
            DescentScenarioParameters.model_validate({"flight": {"file": file, "axes": "enu"} | values})

    expect_error("at image 1 the camera looks up, 60.0 deg above", _write_vertical_fall(tmp_path, tilt_deg=150.0))
    expect_error("at image 1 the camera looks up", _write_vertical_fall(tmp_path), attitude_of="body")
    expect_error(r"at image 3 the camera is 5.0 m below the ground", _write_vertical_fall(tmp_path, height_m=870.0))
    expect_error(r"covers 0.000 to 24.900 s; images from 23.000 to", _write_vertical_fall(tmp_path), first_image_s=23.0)
    expect_error("flight.axes|axes", _write_vertical_fall(tmp_path), axes="xyz")
    expect_error("not a quaternion of length 1", _write_vertical_fall(tmp_path), mounting=(0.0, 0.0, 0.0, 2.0))
    expect_error("absent.csv: cannot be read", "absent.csv")


def test_changed_flight_file_is_rejected(tmp_path: Path) -> None:
    file = _write_vertical_fall(tmp_path)
    parameters = DescentScenarioParameters.model_validate({"flight": {"file": file, "axes": "enu"}})
    stored_parameters = parameters.model_dump(mode="json", round_trip=True)
    assert DescentScenarioParameters.model_validate(stored_parameters) == parameters
    _write_vertical_fall(tmp_path, height_m=2300.0)
    with pytest.raises(ValidationError, match=r"file has changed since the campaign was created"):
        DescentScenarioParameters.model_validate(stored_parameters)
