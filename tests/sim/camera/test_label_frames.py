"""Tests of the frames of camera models in PDS labels: rover, site, local level and Mars-fixed frames.

The expected cameras are the model of the label in the rover's frame, moved with SciPy's transforms.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.camera import (
    Cahvore,
    CameraFileError,
    CameraModel,
    read_camera,
    read_cameras,
    read_framed_cameras,
    read_pds3_product,
)
from marsyard.sim.frames import MARS_RADII_M, world_from_mars_fixed
from tests.sim.camera.labels import LCAM, SITE_FROM_ROVER, pds3_label, pds4_label

#: Pose of the rover's local level frame in the site frame; and of the rover in the local level frame.
SITE_FROM_LOCAL = RigidTransform.from_translation(SITE_FROM_ROVER.translation)
LOCAL_FROM_ROVER = RigidTransform.from_rotation(SITE_FROM_ROVER.rotation)


def assert_cameras_are_close(camera: CameraModel, expected: CameraModel) -> None:
    for letter in "cahvor":
        assert np.allclose(getattr(camera, letter), getattr(expected, letter), rtol=0.0, atol=1e-6), letter


@pytest.mark.parametrize("write_label", [pds3_label, pds4_label])
@pytest.mark.parametrize(
    ("frame", "frame_from_rover"),
    [
        ("ROVER_FRAME", RigidTransform.identity()),
        ("ROVER_NAV_FRAME", RigidTransform.identity()),
        ("SITE_FRAME", SITE_FROM_ROVER),
        ("LOCAL_LEVEL_FRAME", LOCAL_FROM_ROVER),
    ],
)
def test_models_are_returned_in_the_rover_frame(
    tmp_path: Path, navcam: CameraModel, write_label: Callable[..., Path], frame: str, frame_from_rover: RigidTransform
) -> None:
    path = write_label(tmp_path, navcam.transform(frame_from_rover), frame)
    assert_cameras_are_close(read_camera(path), navcam)
    assert read_framed_cameras(path)[0].frame.name == "ROVER"


def test_definition_of_the_local_level_frame_has_priority(tmp_path: Path, navcam: CameraModel) -> None:
    """The origin of this local level frame is 3 m north of the rover."""
    local_from_site = RigidTransform.from_translation(-np.array(SITE_FROM_ROVER.translation) - [3.0, 0.0, 0.0])
    group = """GROUP = LOCAL_LEVEL_COORDINATE_SYSTEM
  ORIGIN_OFFSET_VECTOR = (-81.1293, -26.1436, 3.59172)
  ORIGIN_ROTATION_QUATERNION = (1.0, 0.0, 0.0, 0.0)
  REFERENCE_COORD_SYSTEM_NAME = SITE_FRAME
END_GROUP = LOCAL_LEVEL_COORDINATE_SYSTEM
"""
    model = navcam.transform(local_from_site * SITE_FROM_ROVER)
    path = pds3_label(tmp_path, model, "LOCAL_LEVEL_FRAME", groups=group)
    assert_cameras_are_close(read_camera(path), navcam)


@pytest.mark.parametrize("write_label", [pds3_label, pds4_label])
def test_rover_pose_on_mars_is_used(tmp_path: Path, navcam: CameraModel, write_label: Callable[..., Path]) -> None:
    """The model and the rover's pose are both in the Mars-fixed frame, whose vectors have a resolution of 1e-3 m."""
    mars_from_rover = RigidTransform.from_components(
        np.array([701403.2, 3145680.62, 1075894.36]), SITE_FROM_ROVER.rotation
    )
    path = write_label(tmp_path, navcam.transform(mars_from_rover), "MCMF_FRAME", "MCMF_FRAME", mars_from_rover)
    assert_cameras_are_close(read_camera(path), navcam)
    assert read_framed_cameras(path)[0].frame.name == "ROVER"


def test_site_model_without_rover_pose_stays_in_the_site_frame(tmp_path: Path, navcam: CameraModel) -> None:
    model = navcam.transform(SITE_FROM_ROVER)
    path = pds3_label(tmp_path, model, "SITE_FRAME", rover_reference=None)
    assert read_framed_cameras(path)[0].frame.name == "SITE"
    assert_cameras_are_close(read_camera(path), model)


def test_pose_in_another_site_is_not_used(tmp_path: Path, navcam: CameraModel) -> None:
    """The rover's pose is in site 194, the model in site 193, and the label does not connect the sites."""
    path = pds3_label(tmp_path, navcam.transform(SITE_FROM_ROVER), "SITE_FRAME")
    text = path.read_text()
    assert text.count("REFERENCE_COORD_SYSTEM_INDEX = 194") == 2
    path.write_text(text.replace("REFERENCE_COORD_SYSTEM_INDEX = 194", "REFERENCE_COORD_SYSTEM_INDEX = 193", 1))
    framed = read_framed_cameras(path)[0]
    assert (framed.frame.name, framed.frame.indices) == ("SITE", (193,))


@pytest.mark.parametrize("write_label", [pds3_label, pds4_label])
def test_frames_without_transform_are_refused_by_name(
    tmp_path: Path, navcam: CameraModel, write_label: Callable[..., Path]
) -> None:
    with pytest.raises(CameraFileError, match=r"RSM_HEAD_FRAME.* has no known transform.*allowed: ROVER, SITE"):
        read_cameras(write_label(tmp_path, navcam, "RSM_HEAD_FRAME"))
    with pytest.raises(CameraFileError, match=r"LOCAL_LEVEL_FRAME.* has no known transform"):
        read_cameras(write_label(tmp_path, navcam, "LOCAL_LEVEL_FRAME", None))


def test_reverse_quaternions_of_pds4_are_inverted(tmp_path: Path, navcam: CameraModel) -> None:
    path = pds4_label(tmp_path, navcam.transform(SITE_FROM_ROVER), "SITE_FRAME")
    quaternion = SITE_FROM_ROVER.rotation.as_quat().tolist()
    text = path.read_text()
    for number, value in enumerate(quaternion[:3], start=1):
        text = text.replace(f"<geom:qsin{number}>{value!r}<", f"<geom:qsin{number}>{-value!r}<")
    path.write_text(text.replace(">Forward<", ">Reverse<"))
    assert_cameras_are_close(read_camera(path), navcam)
    path.write_text(text.replace(">Forward<", ">Sideways<"))
    with pytest.raises(CameraFileError, match=r"rotation_direction: 'Sideways'; allowed: Forward or Reverse"):
        read_camera(path)


def test_unknown_poses_are_no_poses(tmp_path: Path, navcam: CameraModel) -> None:
    path = pds3_label(tmp_path, navcam, "ROVER_FRAME")
    text = path.read_text()
    offset = next(line for line in text.splitlines() if "ORIGIN_OFFSET" in line)
    path.write_text(text.replace(offset, '  ORIGIN_OFFSET_VECTOR = ("UNK","UNK","UNK")'.ljust(len(offset))))
    assert read_pds3_product(path).pose is None


def test_landing_camera_is_in_the_mars_fixed_frame(tmp_path: Path) -> None:
    """Frame 19 of Mars 2020's landing camera: under the parachute over Jezero, looking down.

    Jezero's floor is 2.5 km below the areoid and the frame is between 11.2 and 2.1 km above the ground. The areoid is
    within 2 km of the ellipsoid.
    """
    path = tmp_path / "lcam.lbl"
    path.write_text(LCAM)
    (framed,) = read_framed_cameras(path)
    assert framed.frame.name == "MCMF"
    camera = framed.camera
    assert isinstance(camera, Cahvore)
    assert camera.linearity == 0.0
    assert np.array_equal(camera.c, [701403.20, 3145680.62, 1075894.36])
    world_from_mars = world_from_mars_fixed(camera.c)
    # the ellipsoid's point with this normal, from the normal alone
    up = world_from_mars.rotation.inv().apply([0.0, 0.0, 1.0])
    squares = np.array([MARS_RADII_M[0], MARS_RADII_M[0], MARS_RADII_M[1]]) ** 2
    height = float((camera.c - squares * up / np.sqrt(np.sum(squares * up**2))) @ up)
    assert -2500.0 - 2000.0 + 2100.0 < height < -2500.0 + 2000.0 + 11200.0
    # Jezero is at 18.4 deg N, 77.5 deg E; planetographic latitudes are up to 0.34 deg larger
    assert np.degrees(np.arcsin(up[2])) == pytest.approx(18.6, abs=0.4)
    assert np.degrees(np.arctan2(up[1], up[0])) == pytest.approx(77.4, abs=0.3)
    assert (world_from_mars.rotation.as_matrix() @ camera.a)[2] < -0.9


def test_world_axes_of_the_mars_fixed_frame() -> None:
    """On the equator and at the pole the ellipsoid's normal is radial."""
    axes = world_from_mars_fixed(np.array([0.0, MARS_RADII_M[0] + 100.0, 0.0])).rotation
    assert np.allclose(axes.apply([0.0, 1.0, 0.0]), [0.0, 0.0, 1.0])
    assert np.allclose(axes.apply([0.0, 0.0, 1.0]), [0.0, 1.0, 0.0])
    assert np.allclose(axes.apply([-1.0, 0.0, 0.0]), [1.0, 0.0, 0.0])
    pole = world_from_mars_fixed(np.array([0.0, 0.0, -MARS_RADII_M[1]]))
    assert np.allclose(pole.rotation.apply([0.0, 0.0, -1.0]), [0.0, 0.0, 1.0])
    assert np.allclose(pole.translation + pole.rotation.apply([0.0, 0.0, -MARS_RADII_M[1]]), 0.0)
    with pytest.raises(ValueError, match="not near the surface of Mars"):
        world_from_mars_fixed(np.array([701.4, 3145.7, 1075.9]))
    assert isinstance(axes, Rotation)
