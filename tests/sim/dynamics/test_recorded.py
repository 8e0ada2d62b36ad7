"""Tests of recorded motions: pose files of TUM, EuRoC and pandas are read, and splines match closed-form motions."""

from decimal import Decimal
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from marsyard.sim.dynamics import Trajectory
from marsyard.sim.dynamics.pose_files import COLUMNS, TrajectoryFileError, read_poses
from marsyard.sim.dynamics.recorded import RecordedMotion
from tests.sim.sensor.motions import GRAVITY, Swaying, assert_derivatives

#: The first two poses of freiburg1_xyz of the TUM RGB-D benchmark (Sturm et al. 2012), repeated after one second.
TUM = """# ground truth trajectory
# file: 'rgbd_dataset_freiburg1_xyz.bag'
# timestamp tx ty tz qx qy qz qw
1305031098.6659 1.3563 0.6305 1.6380 0.6132 0.5962 -0.3311 -0.3986
1305031098.6758 1.3543 0.6306 1.6360 0.6129 0.5966 -0.3316 -0.3980
1305031099.6659 1.3563 0.6305 1.6380 0.6132 0.5962 -0.3311 -0.3986
1305031099.6758 1.3543 0.6306 1.6360 0.6129 0.5966 -0.3316 -0.3980
"""

#: The start of the ground truth of MH_01_easy of the EuRoC data sets (Burri et al. 2016) with velocities.
EUROC = """#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], \
v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1]
1403636580838555648,4.688319,-1.786938,0.783338,0.534108,-0.153029,-0.827383,-0.082152,-0.027876,0.033207,0.800006
1403636580843555328,4.688177,-1.786770,0.787350,0.534640,-0.152990,-0.826976,-0.082863,-0.029272,0.033992,0.804771
1403636580848555520,4.688028,-1.786598,0.791382,0.535178,-0.152945,-0.826562,-0.083605,-0.030043,0.034999,0.808240
1403636580853555456,4.687878,-1.786421,0.795429,0.535715,-0.152884,-0.826146,-0.084391,-0.030230,0.035853,0.810462
"""


def make_table(times: np.ndarray, positions: np.ndarray, attitudes: Rotation) -> pd.DataFrame:
    return pd.DataFrame(np.column_stack([times, positions, attitudes.as_quat()]), columns=list(COLUMNS))


def write_poses(folder: Path, text: str, name: str = "poses.txt") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_tum_file_is_read(tmp_path: Path) -> None:
    poses = read_poses(write_poses(tmp_path, TUM))
    assert poses.start_s == Decimal("1305031098.6659")
    assert poses.times_s.tolist() == [0.0, 0.0099, 1.0, 1.0099]
    assert np.allclose(poses.positions_m[1], [1.3543, 0.6306, 1.6360])
    # The file has four digits; the reader normalises the quaternions.
    assert np.allclose(poses.quaternions[0], [0.6132, 0.5962, -0.3311, -0.3986], atol=1e-4)
    assert np.allclose(np.linalg.norm(poses.quaternions, axis=1), 1.0)


def test_euroc_ground_truth_is_read(tmp_path: Path) -> None:
    poses = read_poses(write_poses(tmp_path, EUROC, "data.csv"))
    # The scalar is first in the file and last in Marsyard. Nanoseconds are subtracted as integers.
    assert poses.times_s.tolist() == [0.0, 0.004999680, 0.009999872, 0.014999808]
    assert np.allclose(poses.quaternions[0], [-0.153029, -0.827383, -0.082152, 0.534108], atol=1e-5)
    assert np.allclose(np.diff(poses.times_s), 0.005, atol=1e-6)
    motion = RecordedMotion(
        poses.times_s - poses.times_s[0], poses.positions_m, Rotation.from_quat(poses.quaternions), 9.81
    )
    middle = motion.motion(motion.times_s[1:3])
    # The tolerance is wide, because the file contains estimated velocities, not derivatives of its positions.
    assert np.allclose(middle.velocities_m_s, [[-0.0293, 0.0340, 0.8048], [-0.0300, 0.0350, 0.8082]], atol=2e-3)


def _make_swaying_motion() -> Swaying:
    return Swaying(
        spin_rad_s=0.3,
        nod_rad=0.2,
        nod_rad_s=2.0,
        velocity_m_s=(10.0, -3.0, -60.0),
        acceleration_m_s2=(0.0, 0.0, 1.0),
        sway_m=5.0,
        sway_rad_s=1.5,
        tilt=Rotation.from_rotvec([0.2, 0.1, 0.0]),
    )


def _record_motion(spacing_s: float) -> RecordedMotion:
    times = np.arange(0.0, 10.0 + 0.5 * spacing_s, spacing_s)
    truth = _make_swaying_motion().motion(times)
    return RecordedMotion(times, truth.positions_m, truth.attitudes, GRAVITY)


def _compute_max_spline_errors(spacing_s: float) -> dict[str, float]:
    motion, times_s = _record_motion(spacing_s), np.linspace(1.0, 9.0, 501)
    actual, expected = motion.motion(times_s), _make_swaying_motion().motion(times_s)
    return {
        "position": float(np.abs(actual.positions_m - expected.positions_m).max()),
        "velocity": float(np.abs(actual.velocities_m_s - expected.velocities_m_s).max()),
        "attitude": float((actual.attitudes.inv() * expected.attitudes).magnitude().max()),
        "rate": float(np.abs(actual.body_rates_rad_s - expected.body_rates_rad_s).max()),
        "force": float(np.abs(actual.specific_forces_m_s2 - expected.specific_forces_m_s2).max()),
    }


def test_splines_converge_to_closed_form_motion() -> None:
    """Errors of cubic splines with the step h are of order h^4 in value, h^3 in slope and h^2 in curvature.

    Half the step reduces them by factors of 16, 8 and 4.
    """
    assert isinstance(_record_motion(0.1), Trajectory)
    coarse, fine = _compute_max_spline_errors(0.1), _compute_max_spline_errors(0.05)
    for name, order in (("position", 4), ("velocity", 3), ("attitude", 4), ("rate", 3), ("force", 2)):
        assert fine[name] < coarse[name] / 2 ** (order - 0.5), name
    assert fine["position"] < 1e-5
    assert fine["rate"] < 1e-4
    # The error of the curvature is the fourth derivative of the sway, 5 m x 1.5^4 rad^4/s^4, times h^2 / 12.
    assert fine["force"] < 2.0 * 5.0 * 1.5**4 * 0.05**2 / 12.0 + 1e-3


def test_rates_and_forces_are_spline_derivatives() -> None:
    """Rates and forces are consistent with the poses, also if the poses are noisy."""
    rng = np.random.default_rng(3)
    knots_s = np.arange(0.0, 3.0, 0.1)
    noisy_attitudes = (
        Rotation.from_rotvec(0.02 * rng.standard_normal((knots_s.size, 3)))
        * _make_swaying_motion().motion(knots_s).attitudes
    )
    positions = _make_swaying_motion().motion(knots_s).positions_m + 0.1 * rng.standard_normal((knots_s.size, 3))
    motion = RecordedMotion(knots_s, positions, noisy_attitudes, GRAVITY)
    tolerances = {"velocity": 1e-4, "force": 1e-2, "rate": 1e-4, "force_rtol": 1e-4}
    assert_derivatives(motion.motion, np.linspace(0.5, 2.5, 57), 1e-5, GRAVITY, **tolerances)


def test_pandas_tables_are_read(tmp_path: Path) -> None:
    truth = _make_swaying_motion().motion(np.linspace(0.0, 2.0, 21))
    frame = make_table(truth.times_s, truth.positions_m, truth.attitudes)
    frame.insert(2, "comment", "as flown")
    frame.to_csv(tmp_path / "poses.csv", index=False)
    frame.to_parquet(tmp_path / "poses.parquet")
    for name in ("poses.csv", "poses.parquet"):
        poses = read_poses(tmp_path / name)
        assert np.allclose(poses.positions_m, truth.positions_m, rtol=0, atol=1e-9)
        difference = Rotation.from_quat(poses.quaternions).inv() * truth.attitudes
        assert difference.magnitude().max() < 1e-9
    # A file is read only once. Different files have different hashes.
    assert read_poses(tmp_path / "poses.csv") is read_poses(tmp_path / "poses.csv")
    assert read_poses(tmp_path / "poses.csv").sha256 != read_poses(tmp_path / "poses.parquet").sha256


#: First time of a flight in 2025 (s, ns since 1970), and the time between its poses.
EPOCH_NS, EPOCH_STEP_NS = 1_750_000_000_123_456_789, 2_500_000


def _write_epoch_flight(folder: Path, kind: str) -> Path:
    """Write 2 s of fall at 80 m/s without acceleration at 400 Hz, with times since 1970 in one of the formats."""
    nanoseconds = [EPOCH_NS + number * EPOCH_STEP_NS for number in range(800)]
    seconds = [f"{time // 10**9}.{time % 10**9:09d}" for time in nanoseconds]
    microseconds = [time // 1000 / 1e6 for time in nanoseconds]
    positions = np.zeros((800, 3))
    positions[:, 2] = -80.0 * np.arange(800) * EPOCH_STEP_NS * 1e-9
    frame = make_table(np.zeros(800), positions, Rotation.identity(800))
    path = folder / ("poses.parquet" if kind.startswith("parquet") else "poses.csv")
    match kind.partition(" ")[2]:
        case "s":
            frame["time_s"] = seconds
        case "ns":
            frame = frame.rename(columns={"time_s": "time_ns"}).assign(time_ns=nanoseconds)
        case "decimal":
            frame["time_s"] = pd.Series([Decimal(text) for text in seconds], dtype=object)
        case "timestamp":
            frame["time_s"] = pd.to_datetime(nanoseconds)
        case "us":
            frame["time_s"] = microseconds
        case "us by numpy":
            frame["time_s"] = [f"{time:.18e}" for time in microseconds]
        case "rounded":
            frame["time_s"] = [float(text) for text in seconds]
        case "rounded by numpy":
            frame["time_s"] = [f"{float(text):.18e}" for text in seconds]
    if kind.startswith("parquet"):
        frame.to_parquet(path)
    else:
        is_tum = kind.startswith("tum")
        frame.to_csv(path, index=False, header=not is_tum, sep=" " if is_tum else ",")
    return path


@pytest.mark.parametrize(
    "kind",
    [
        *("csv s", "csv ns", "csv us", "csv us by numpy", "tum s", "tum ns", "tum us", "tum us by numpy"),
        *("parquet ns", "parquet decimal", "parquet timestamp", "parquet us"),
    ],
)
def test_times_since_1970_add_no_acceleration(tmp_path: Path, kind: str) -> None:
    """Times in floating point are rounded to 0.2 us, an error of several m/s^2; the specific force is that of rest."""
    poses = read_poses(_write_epoch_flight(tmp_path, kind))
    resolution_ns = 1000 if kind.split()[1] == "us" else 1
    assert poses.start_s == Decimal(EPOCH_NS // resolution_ns * resolution_ns).scaleb(-9)
    # The tolerance is that of spline derivatives in floating point: 160 m x 2^-53 x 12 / (2.5 ms)^2.
    motion = RecordedMotion(poses.times_s, poses.positions_m, Rotation.from_quat(poses.quaternions), GRAVITY)
    forces = motion.motion(np.linspace(0.1, 1.9, 999)).specific_forces_m_s2
    assert np.abs(forces - [0.0, 0.0, GRAVITY]).max() < 1e-6


@pytest.mark.parametrize("kind", ["parquet rounded", "csv rounded", "tum rounded", "tum rounded by numpy"])
def test_times_rounded_by_the_file_are_refused(tmp_path: Path, kind: str) -> None:
    """The error is 0.5^0.5 x 2.4e-7 s x 80 m/s / (2.5 ms)^2 = 2.2 m/s^2."""
    path = _write_epoch_flight(tmp_path, kind)
    with pytest.raises(TrajectoryFileError, match=r"rounded to 2e-07 s: an acceleration error of 2.2 m/s\^2; allowed:"):
        read_poses(path)


def test_text_that_is_no_time_is_reported(tmp_path: Path) -> None:
    path = _write_epoch_flight(tmp_path, "csv s")
    path.write_text(path.read_text().replace("1750000000.125956789", "noon"))
    with pytest.raises(TrajectoryFileError, match="the time 'noon' is not a number"):
        read_poses(path)


def _write_faulty_poses(tmp_path: Path, **changes: float) -> Path:
    truth = _make_swaying_motion().motion(np.linspace(0.0, 2.0, 21))
    frame = make_table(truth.times_s, truth.positions_m, truth.attitudes)
    for column, value in changes.items():
        frame.loc[7, column] = value
    frame.to_csv(tmp_path / "faulty.csv", index=False)
    return tmp_path / "faulty.csv"


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"x_m": np.nan}, "pose 8: x_m is not finite"),
        ({"time_s": np.inf}, "pose 8: time_s is not finite"),
        ({"time_s": 0.5}, "pose 8: time goes from 0.600000 to 0.500000 s; allowed: times that increase"),
        ({"time_s": 0.6}, "pose 8: time goes from 0.600000 to 0.600000 s"),
        ({"qw": 3.0}, r"pose 8: the quaternion's length is 3.\d+; allowed: 1 within 0.005"),
    ],
)
def test_invalid_poses_are_reported(tmp_path: Path, changes: dict[str, float], fault: str) -> None:
    with pytest.raises(TrajectoryFileError, match=fault) as error_info:
        read_poses(_write_faulty_poses(tmp_path, **changes))
    assert "faulty.csv" in str(error_info.value)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("time_s,x_m\n1,2\n", "has no column y_m, z_m, qx"),
        ("1 2 3\n4 5 6\n", "has 3 numbers in a line"),
        ("", "has 0 poses; allowed: at least 4"),
        (TUM[: TUM.rindex("1305031099.6758")], "has 3 poses"),
        ("hello world\n", "cannot be read as a table"),
        ("a,b\n\x00\x01", "is not a table of poses"),
        ("PAR1 but no more", "cannot be read as a table"),
    ],
)
def test_files_without_poses_are_rejected(tmp_path: Path, text: str, fault: str) -> None:
    with pytest.raises(TrajectoryFileError, match=fault):
        read_poses(write_poses(tmp_path, text, "faulty.dat"))
    with pytest.raises(TrajectoryFileError, match=r"absent\.csv: cannot be read"):
        read_poses(tmp_path / "absent.csv")


def test_oversized_file_is_rejected_without_reading(tmp_path: Path) -> None:
    path = tmp_path / "large.csv"
    with path.open("wb") as file:
        file.truncate(1 << 30)
    with pytest.raises(TrajectoryFileError, match="larger than 512 MiB"):
        read_poses(path)


def test_invalid_motions_are_rejected() -> None:
    times, static = np.arange(4.0), Rotation.identity(4)
    positions = np.zeros((4, 3))
    with pytest.raises(ValueError, match="has 3 poses"):
        RecordedMotion(times[:3], positions[:3], static[:3], 3.7)
    large_turn = Rotation.from_euler("z", np.array([[0.0], [0.0], [120.0], [120.0]]), degrees=True)
    with pytest.raises(ValueError, match=r"rotates by 120 deg after 1.000000 s \(pose 2\)"):
        RecordedMotion(times, positions, large_turn, 3.7)
    with pytest.raises(ValueError, match="time 4 s is outside of the motion; allowed: 0 to 3 s"):
        RecordedMotion(times, positions, static, 3.7).state(4.0)
