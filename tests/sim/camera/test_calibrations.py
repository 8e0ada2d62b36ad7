"""Tests of OpenCV's camera models, and of calibration files of OpenCV, ROS, Kalibr and EuRoC, against OpenCV."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.camera import (
    Cahvor,
    Cahvore,
    CameraFileError,
    CameraModel,
    from_opencv,
    from_opencv_fisheye,
    read_calibrations,
    read_camera,
    read_cameras,
)
from tests.sim.camera.labels import EUROC, assert_fault, compute_max_opencv_distance_px

#: Written by OpenCV's sample calibration.cpp for a web camera (blog.csdn.net, article of 23 August 2015).
OPENCV = """%YAML:1.0
calibration_time: "08/21/15 16:54:26"
image_width: 640
image_height: 480
board_width: 6
board_height: 9
square_size: 1.
flags: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.3765976500165073e+002, 0., 3.4011155767874686e+002, 0.,
       5.3789341813113867e+002, 2.3694081464807104e+002, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -2.7762353155161251e-001, 5.3976467600878486e-002,
       2.1257384355991209e-003, -3.9487502777272009e-004,
       4.8679847473271927e-002 ]
avg_reprojection_error: 4.4034956116049290e-001
"""

#: A smartphone camera in ROS's format (README of a repository that streams Tango to ROS). Its rational model has no
#: coefficients k4 to k6.
ROS = """image_width: 1920
image_height: 1080
camera_name: camera_color
camera_matrix:
  rows: 3
  cols: 3
  data: [1484.120151053405, 0.0, 982.1869163422028, 0.0, 1483.296808359715, 543.0569322723705, 0.0, 0.0, 1.0]
distortion_model: rational_polynomial
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.09370951394834764, -0.1640721737187069, 0.0, 0.0, 0.1224192868301668]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [1484.120151053405, 0.0, 982.1869163422028, 0.0, 0.0, 1483.296808359715, 543.0569322723705, 0.0,
    0.0, 0.0, 1.0, 0.0]
"""


#: The EuRoC cameras from the MSCKF definition in Kalibr's format, reduced to the fields that the test reads.
KALIBR = """cam0:
  T_cam_imu:
  - [0.014865542981794, 0.999557249008346, -0.025774436697440, 0.065222909535531]
  - [-0.999880929698575, 0.014967213324719, 0.003756188357967, -0.020706385492719]
  - [0.004140296794224, 0.025715529947966, 0.999660727177902, -0.008054602460030]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
  distortion_model: radtan
  intrinsics: [458.654, 457.296, 367.215, 248.375]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [0.999997256477881, 0.002312067192424, 0.000376008102415, -0.110073808127187]
  - [-0.002317135723281, 0.999898048506644, 0.014089835846648, 0.000399121547014]
  - [-0.000343393120525, -0.014090668452714, 0.999900662637729, -0.000853702503357]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [-0.28368365, 0.07451284, -0.00010473, -3.55590700e-05]
  distortion_model: radtan
  intrinsics: [457.587, 456.134, 379.999, 255.238]
  resolution: [752, 480]
  rostopic: /cam1/image_raw
"""

#: The same first camera with Kalibr's equidistant model (README of a visual odometry package).
EQUIDISTANT = """cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.0016509958435871643, 0.02437222940989351, -0.03582816956989852,
    0.019860839087717054]
  distortion_model: equidistant
  intrinsics: [461.487246372674, 460.1113992557959, 356.39105303227853, 231.15719697054647]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
"""


def write_file(folder: Path, text: str, name: str = "calibration.yaml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def make_camera_matrix(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def test_opencv_file_projects_like_opencv(tmp_path: Path) -> None:
    path = write_file(tmp_path, OPENCV)
    (calibration,) = read_calibrations(path)
    assert isinstance(calibration.camera, Cahvor)
    assert calibration.camera.size == (640, 480)
    # OpenCV reads its own file.
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    matrix = storage.getNode("camera_matrix").mat()
    distortion = storage.getNode("distortion_coefficients").mat().ravel()
    distance_px = compute_max_opencv_distance_px(calibration.camera, matrix, distortion)
    # The reported residual is computed at samples. The margin covers the pixels between them.
    assert distance_px < 1.1 * calibration.residual.max_px
    # The residual is less than the reprojection error of the calibration, 0.44 px.
    assert 0.0 < calibration.residual.rms_px < 0.2
    assert read_camera(path) == calibration.camera


def test_ros_camera_info_is_read(tmp_path: Path) -> None:
    (calibration,) = read_calibrations(write_file(tmp_path, ROS))
    assert calibration.name == "camera_color"
    data = yaml.safe_load(ROS)
    matrix = np.reshape(data["camera_matrix"]["data"], (3, 3))
    distance_px = compute_max_opencv_distance_px(calibration.camera, matrix, data["distortion_coefficients"]["data"])
    assert distance_px < 1.1 * calibration.residual.max_px
    assert calibration.residual.rms_px < 0.2


def _project_with_readout(camera: CameraModel, column: int, row: int, binning: tuple[int, int]) -> np.ndarray:
    """Return pixels of the cropped and binned image for a grid of pixels of the whole detector.

    The centre of the block of pixels 0 to b - 1 is the pixel (b - 1) / 2, which becomes pixel 0.
    """
    pixels = np.stack(np.meshgrid([200.0, 700.0, 1200.0], [100.0, 500.0, 900.0]), axis=-1).reshape(-1, 2)
    directions = camera.rays(pixels)[1]
    factor = np.array(binning)
    return np.concatenate([directions, (pixels - [column, row] - (factor - 1) / 2) / factor], axis=1)


#: Offset, binning and size of the whole image.
WHOLE = ((0, 0), (1, 1), (1920, 1080))


@pytest.mark.parametrize("separator", ["image_", ""])
@pytest.mark.parametrize(
    ("readout", "offset", "binning", "size"),
    [
        ("binning_x: 2\nbinning_y: 4\n", (0, 0), (2, 4), (960, 270)),
        ("binning_x: 0\nbinning_y: 0\nroi: {x_offset: 0, y_offset: 0, height: 0, width: 0}\n", *WHOLE),
        ("roi: {x_offset: 100, y_offset: 60, height: 600, width: 801}\n", (100, 60), (1, 1), (801, 600)),
        (
            "binning_x: 2\nbinning_y: 2\nroi: {x_offset: 100, y_offset: 60, height: 601, width: 801, do_rectify: 0}\n",
            (100, 60),
            (2, 2),
            (400, 300),
        ),
        ("roi: {x_offset: 20, y_offset: 80}\n", (20, 80), (1, 1), (1900, 1000)),
    ],
)
def test_ros_binning_and_region_are_applied(
    tmp_path: Path,
    separator: str,
    readout: str,
    offset: tuple[int, int],
    binning: tuple[int, int],
    size: tuple[int, int],
) -> None:
    text = ROS.replace("image_width", f"{separator}width").replace("image_height", f"{separator}height")
    (whole,) = read_calibrations(write_file(tmp_path, ROS))
    (calibration,) = read_calibrations(write_file(tmp_path, text + readout))
    assert calibration.camera.size == size
    samples = _project_with_readout(whole.camera, *offset, binning)
    pixels, _ = calibration.camera.project(calibration.camera.c + samples[:, :3])
    assert np.allclose(pixels, samples[:, 3:], rtol=0.0, atol=1e-9)
    assert calibration.residual.max_px == pytest.approx(whole.residual.max_px / min(binning))


@pytest.mark.parametrize(
    ("readout", "fault"),
    [
        ("roi: {x_offset: 1200, width: 800, height: 600}", r"roi: 800 x 600 pixels at \(1200, 0\); allowed: a region"),
        ("roi: {width: 800, height: 0}", "roi: 800 x 0 pixels"),
        ("roi: {x_offset: -1, width: 8, height: 8}", "roi.x_offset: -1; allowed: an integer of 0 or more"),
        ("roi: {width: 8.5, height: 8}", "roi.width: 8.5"),
        ("roi: all", "roi: 'all'; allowed: x_offset"),
        ("binning_x: 1.5", "binning_x: 1.5; allowed: an integer"),
        ("binning_y: -2", "binning_y: -2"),
        ("binning_x: 3000", "binning_x, binning_y: 3000, 1; allowed: at most 1920, 1080"),
    ],
)
def test_impossible_readouts_are_rejected(tmp_path: Path, readout: str, fault: str) -> None:
    with pytest.raises(CameraFileError, match=fault):
        read_calibrations(write_file(tmp_path, ROS + readout + "\n"))


def test_ros_rational_lens_is_fitted(tmp_path: Path) -> None:
    """The eight coefficients of an Azure Kinect colour camera, scaled to the field of view of the smartphone."""
    coefficients = [0.52, -2.6, 4e-4, -2e-4, 1.5, 0.40, -2.4, 1.45]
    text = ROS.replace("[0.09370951394834764, -0.1640721737187069, 0.0, 0.0, 0.1224192868301668]", str(coefficients))
    (calibration,) = read_calibrations(write_file(tmp_path, text.replace("cols: 5", "cols: 8")))
    matrix = np.reshape(yaml.safe_load(ROS)["camera_matrix"]["data"], (3, 3))
    assert compute_max_opencv_distance_px(calibration.camera, matrix, coefficients) < 1.1 * calibration.residual.max_px


def test_kalibr_camera_chain_is_read(tmp_path: Path) -> None:
    left, right = read_calibrations(write_file(tmp_path, KALIBR))
    data = yaml.safe_load(KALIBR)
    pose = RigidTransform.from_matrix(np.array(data["cam1"]["T_cn_cnm1"]))
    coefficients = [[-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05], data["cam1"]["distortion_coeffs"]]
    assert (left.name, right.name) == ("cam0", "cam1")
    matrices = [make_camera_matrix(*data[name]["intrinsics"]) for name in ("cam0", "cam1")]
    assert compute_max_opencv_distance_px(left.camera, matrices[0], coefficients[0]) < 0.5
    assert compute_max_opencv_distance_px(right.camera, matrices[1], coefficients[1], pose) < 0.5
    # EuRoC's stereo baseline is 11 cm; the second camera is right of the first.
    assert np.linalg.norm(right.camera.c - left.camera.c) == pytest.approx(0.11, abs=0.001)
    assert right.camera.c[0] > 0.1
    with pytest.raises(CameraFileError, match="2 of them"):
        read_camera(tmp_path / "calibration.yaml")
    assert len(read_cameras(tmp_path / "calibration.yaml")) == 2


def test_euroc_sensor_file_equals_kalibr_camera(tmp_path: Path) -> None:
    (euroc,) = read_calibrations(write_file(tmp_path, EUROC, "sensor.yaml"))
    assert euroc.camera == read_calibrations(write_file(tmp_path, KALIBR))[0].camera


@pytest.mark.slow
def test_equidistant_lens_projects_like_opencv_fisheye(tmp_path: Path) -> None:
    (calibration,) = read_calibrations(write_file(tmp_path, EQUIDISTANT))
    assert isinstance(calibration.camera, Cahvore)
    assert calibration.residual.max_px < 0.5
    data = yaml.safe_load(EQUIDISTANT)["cam0"]
    matrix = make_camera_matrix(*data["intrinsics"])
    distance_px = compute_max_opencv_distance_px(calibration.camera, matrix, data["distortion_coeffs"], fisheye=True)
    assert distance_px < 1.1 * calibration.residual.max_px


def test_fisheye_with_up_to_two_coefficients_is_exact_beyond_90_degrees() -> None:
    """Without coefficients the model of Kannala and Brandt is theta = r / f."""
    matrix, size = make_camera_matrix(300.0, 300.0, 499.5, 499.5), (1000, 1000)
    camera, residual = from_opencv_fisheye(matrix, np.zeros(4), size)
    assert residual.max_px < 1e-9
    corner = camera.rays(np.array([-0.5, -0.5]))[1]
    assert np.degrees(np.arccos(corner[2])) == pytest.approx(np.degrees(500.0 * np.sqrt(2.0) / 300.0))
    camera, residual = from_opencv_fisheye(matrix, np.array([0.01, -0.002, 0.0, 0.0]), size)
    assert residual.max_px < 1e-9


def test_fisheye_pose_is_applied() -> None:
    pose = RigidTransform.from_components([0.1, -0.2, 0.3], Rotation.from_rotvec([0.2, -0.1, 0.4]))
    matrix, size = make_camera_matrix(300.0, 310.0, 320.0, 240.0), (640, 480)
    coefficients = [0.01, -0.002, 0.0, 0.0]
    camera, _ = from_opencv_fisheye(matrix, np.array(coefficients), size, pose)
    assert compute_max_opencv_distance_px(camera, matrix, coefficients, pose, fisheye=True) < 1e-6


#: File, text that is replaced, its replacement, and the expected message.
FAULTS = [
    (OPENCV, "image_width: 640\n", "", "image_width, image_height or resolution.*allowed: two positive integers"),
    (OPENCV, "image_width: 640", "image_width: -640", "allowed: two positive integers"),
    (OPENCV, "5.3765976500165073e+002", ".nan", "camera_matrix: .* not a list of finite numbers"),
    (OPENCV, "5.3765976500165073e+002, 0.,", "5.3765976500165073e+002,", "camera_matrix: has 8 numbers"),
    (OPENCV, "camera_matrix: !!", "matrix: !!", "camera_matrix: missing"),
    (OPENCV, "5.3765976500165073e+002", "-537.6", "fx and fy positive"),
    (OPENCV, "4.8679847473271927e-002 ]", "", "is not valid YAML"),
    (ROS, "rational_polynomial", "thin_prism", "distortion_model: 'thin_prism'; allowed: equidistant"),
    (ROS, "0.1224192868301668]", "0.1, 0.2]", "distortion must be none"),
    (OPENCV, "-2.7762353155161251e-001", "-1.8", "folds over within the frame"),
    (KALIBR, "camera_model: pinhole", "camera_model: omni", "cam0.camera_model: 'omni'; allowed: pinhole"),
    (KALIBR, "  - [0.999997256477881, ", "  - [0.799997256477881, ", "cam1.T_cn_cnm1: is not rigid"),
    (KALIBR, "  T_cn_cnm1:", "  T_other:", "cam1.T_cn_cnm1: missing"),
    (KALIBR, "[458.654, 457.296, 367.215, 248.375]", "[458.654, 457.296]", "cam0.intrinsics: has 2 numbers"),
    (KALIBR, "resolution: [752, 480]", "resolution: [752]", "resolution: .*752"),
]


@pytest.mark.parametrize(("text", "old", "new", "fault"), FAULTS, ids=[f"{old!r} {new!r}" for _, old, new, _ in FAULTS])
def test_errors_name_field_and_allowed_values(tmp_path: Path, text: str, old: str, new: str, fault: str) -> None:
    assert_fault(tmp_path / "faulty.yaml", text, (old, new), fault)


def test_lens_not_representable_by_cahvor_is_rejected(tmp_path: Path) -> None:
    """No lens axis O represents a tangential distortion of several percent: the residual is several pixels."""
    text = OPENCV.replace("2.1257384355991209e-003", "0.05").replace("-3.9487502777272009e-004", "-0.04")
    with pytest.raises(CameraFileError, match=r"distortion: the nearest camera .* px at most; allowed: 0.3 and 3 px"):
        read_calibrations(write_file(tmp_path, text))


def test_large_files_are_rejected_without_reading(tmp_path: Path) -> None:
    path = tmp_path / "large.yaml"
    with path.open("wb") as file:
        file.write(b"image_width: 640\n")
        file.truncate(1 << 30)
    with pytest.raises(CameraFileError, match="larger than 8 MiB"):
        read_cameras(path)


OPENCV_MATRIX = np.array([[900.0, 0.0, 630.0], [0.0, 905.0, 350.0], [0.0, 0.0, 1.0]])
OPENCV_POSE = RigidTransform.from_components([0.5, -1.0, 2.0], Rotation.from_rotvec([0.4, -0.2, 1.0]))


@pytest.mark.parametrize("distortion", [[], [-0.2, 0.05, 0, 0], [0.1, -0.02, 0, 0, 0]])
def test_radial_distortion_from_opencv_is_exact(distortion: list[float]) -> None:
    coefficients = np.array(distortion, dtype=float)
    camera, residual = from_opencv(OPENCV_MATRIX, coefficients, (1280, 720), OPENCV_POSE)
    assert residual.max_px < 1e-9
    assert compute_max_opencv_distance_px(camera, OPENCV_MATRIX, coefficients, OPENCV_POSE) < 1e-7


def test_skew_of_the_matrix_is_preserved() -> None:
    skewed = OPENCV_MATRIX + np.array([[0, 2.0, 0], [0, 0, 0], [0, 0, 0]])
    camera, _ = from_opencv(skewed, np.zeros(0), (1280, 720))
    point = np.array([0.2, -0.1, 1.0])
    assert np.allclose(camera.project(point)[0], (skewed @ point)[:2], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("matrix", "distortion", "fault"),
    [
        (OPENCV_MATRIX, np.zeros(12), "distortion must be none"),
        (OPENCV_MATRIX, np.array([np.nan, 0, 0, 0]), "finite"),
        (-OPENCV_MATRIX, np.zeros(5), "matrix must be"),
        (OPENCV_MATRIX + np.eye(3), np.zeros(5), "matrix must be"),
        (OPENCV_MATRIX, np.array([-2.0, 0.0, 0.0, 0.0]), "folds over"),
    ],
)
def test_invalid_opencv_cameras_are_rejected(matrix: np.ndarray, distortion: np.ndarray, fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        from_opencv(matrix, distortion, (1280, 720))
