"""Tests of calibrations that are not YAML, against OpenCV's projection, and of files in formats that are not read."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from marsyard.sim.camera import CameraFileError, read_calibrations, read_camera, read_cameras
from tests.sim.camera.labels import compute_max_opencv_distance_px

SIZE = (640, 480)
MATRIX = np.array([[500.0, 0.0, 321.25], [0.0, 505.0, 238.5], [0.0, 0.0, 1.0]])
#: k1 and k2, which CAHVOR represents exactly.
RADIAL = [-0.21, 0.04, 0.0, 0.0]


def assert_projects_as_opencv(path: Path, distortion: list[float], size: tuple[int, int] | None = None) -> None:
    (camera,) = read_cameras(path, size=size)
    assert camera.size == SIZE
    assert compute_max_opencv_distance_px(camera, MATRIX, distortion) < 1e-6


NAMES = ("camera_matrix", "distortion_coefficients", "image_width", "image_height")


@pytest.mark.parametrize(
    ("suffix", "names"),
    [
        *((suffix, NAMES) for suffix in ("yml", "json", "xml")),
        ("xml", ("Camera_Matrix", "Distortion_Coefficients", "image_Width", "image_Height")),
    ],
)
def test_files_of_current_and_older_opencv_are_read(tmp_path: Path, suffix: str, names: tuple[str, ...]) -> None:
    """The file is written by OpenCV; its older programs write other names."""
    path, (matrix, distortion, width, height) = tmp_path / f"camera.{suffix}", names
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Mon 29 Nov 2021")
    storage.write(width, SIZE[0])
    storage.write(height, SIZE[1])
    storage.write(matrix, MATRIX)
    storage.write(distortion, np.array([[*RADIAL, 0.0]]))
    storage.release()
    assert_projects_as_opencv(path, RADIAL)
    assert read_calibrations(path)[0].residual.max_px < 1e-6
    path.write_text(path.read_text().replace(matrix, "other"))
    with pytest.raises(CameraFileError, match=rf"camera.{suffix}: camera_matrix: missing; allowed: a matrix"):
        read_camera(path)
    path = tmp_path / "entities.xml"
    path.write_text('<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "c">]><opencv_storage></opencv_storage>')
    with pytest.raises(CameraFileError, match="declares entities"):
        read_camera(path)


@pytest.mark.parametrize(
    ("line", "distortion"),
    [
        ("1 OPENCV 640 480 500 505 321.75 239 -0.21 0.04 0 0", RADIAL),
        ("1 PINHOLE 640 480 500 505 321.75 239", [0.0] * 4),
        ("1 FULL_OPENCV 640 480 500 505 321.75 239 -0.21 0.04 0 0 0 0 0 0", RADIAL),
    ],
)
def test_colmap_cameras_are_read(tmp_path: Path, line: str, distortion: list[float]) -> None:
    """COLMAP's pixels are counted from the corner of the image: its principal point is 0.5 larger."""
    path = tmp_path / "cameras.txt"
    path.write_text(f"# Camera list with one line of data per camera:\n# Number of cameras: 1\n{line}\n")
    assert_projects_as_opencv(path, distortion)


def test_colmap_models_with_one_focal_length_and_fisheyes_are_read(tmp_path: Path) -> None:
    path = tmp_path / "cameras.txt"
    path.write_text("1 SIMPLE_RADIAL 640 480 500 320 240 -0.1\n7 RADIAL_FISHEYE 640 480 300 320 240 0.01 0.002\n")
    first, second = read_calibrations(path)
    assert (first.name, second.name) == ("1", "7")
    assert first.camera.focal_lengths == pytest.approx((500.0, 500.0))
    assert first.camera.image_centre == pytest.approx((319.5, 239.5))
    matrix = np.array([[300.0, 0.0, 319.5], [0.0, 300.0, 239.5], [0.0, 0.0, 1.0]])
    assert compute_max_opencv_distance_px(second.camera, matrix, [0.01, 0.002, 0.0, 0.0], fisheye=True) < 1e-6


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ("1 FOV 640 480 500 505 320 240 0.9", "line 1: the camera model is 'FOV'; allowed: SIMPLE_PINHOLE, PINHOLE"),
        ("1 PINHOLE 640 480 500 505 320", "line 1: has 7 words; allowed: identifier, model, width, height, fx"),
        ("1 PINHOLE 640 480 500 505 320 x", "line 1: could not convert string to float: 'x'"),
    ],
)
def test_faulty_colmap_cameras_are_rejected(tmp_path: Path, line: str, fault: str) -> None:
    path = tmp_path / "cameras.txt"
    path.write_text(line + "\n")
    with pytest.raises(CameraFileError, match=fault):
        read_cameras(path)


#: A pinhole model with millimetres: focal lengths and principal point divided by the pitch are those of `MATRIX`.
TSAI = """VERSION_4
PINHOLE
fu = 5
fv = 5.05
cu = 3.2125
cv = 2.385
u_direction = 1  0  0
v_direction = 0  1  0
w_direction = 0  0  1
C = 701403.2 3145680.62 1075894.36
R = 1 0 0 0 1 0 0 0 1
pitch = 0.01
TSAI
k1 = -0.21
k2 = 0.04
p1 = 0
p2 = 0
k3 = 0
"""


def test_pinhole_models_of_ames_stereo_pipeline_are_read(tmp_path: Path) -> None:
    path = tmp_path / "camera.tsai"
    path.write_text(TSAI)
    assert_projects_as_opencv(path, RADIAL, SIZE)
    path.write_text(TSAI.partition("TSAI")[0] + "NULL\n")
    assert_projects_as_opencv(path, [0.0] * 4, SIZE)
    # an empty line between the version and the model, and no line with the lens
    path.write_text(TSAI.partition("TSAI")[0].replace("PINHOLE", "\nPINHOLE"))
    assert_projects_as_opencv(path, [0.0] * 4, SIZE)
    with pytest.raises(CameraFileError, match=r"camera.tsai: size: missing: .*allowed: size = \[columns, rows\]"):
        read_camera(path)


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ("TSAI", "BrownConrady", "lens model: 'BrownConrady'; allowed: NULL or TSAI"),
        ("v_direction = 0  1  0", "v_direction = 0  -1  0", "v_direction: '0  -1  0'; allowed: 0 1 0"),
        ("fu = 5", "", "fu: 'missing'; allowed: a number"),
        ("pitch = 0.01", "pitch = 0", "pitch: 0; allowed: the size of a pixel, above 0"),
        ("k1 = -0.21", "k1 = x", "k1: could not convert string to float"),
    ],
)
def test_faulty_pinhole_models_are_rejected(tmp_path: Path, old: str, new: str, fault: str) -> None:
    path = tmp_path / "camera.tsai"
    path.write_text(TSAI.replace(old, new))
    with pytest.raises(CameraFileError, match=fault):
        read_cameras(path, size=SIZE)


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        ('<?xml version="1.0"?>\n<document version="1.2.0"><chunk/></document>', "is a Metashape project"),
        ("<calibration><projection>frame</projection></calibration>", "is a Metashape calibration"),
        ("<?xml version='1.0'?><!-- <a> --><kml:kml/>", "is XML with the root element 'kml'"),
        ('{"isis_camera_version": 2, "image_lines": 1024}', "is a CSM ISD"),
        ("LBLSIZE=4096            FORMAT='BYTE'  TYPE='IMAGE'", "is a VICAR file without a PDS label"),
        ("VERSION 1\nsensor frame\n", "is in an unknown format"),
        ("\x01\x00\x00\x00\x00", "is binary and no PDS3 product"),
    ],
)
def test_other_formats_are_refused_by_name(tmp_path: Path, content: str, fault: str) -> None:
    path = tmp_path / "camera.file"
    path.write_text(content)
    with pytest.raises(CameraFileError, match=f"camera.file: file: {fault}.*allowed: a PDS3 or PDS4 label, a JPL text"):
        read_cameras(path)
