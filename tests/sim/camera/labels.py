"""Helpers of the tests of camera files: labels with a model in a given frame, faults, comparison with OpenCV."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.camera import CameraFileError, CameraModel, read_cameras

#: Pose of Opportunity in its site frame, from the label of 1F483288473EFFCMUFP1214L0M1.
SITE_FROM_ROVER = RigidTransform.from_components(
    np.array([-84.1293, -26.1436, 3.59172]), Rotation.from_quat([-0.0697583, -0.0424514, 0.249015, 0.965051])
)
_PDS3 = """PDS_VERSION_ID = PDS3
RECORD_BYTES = 4096
^IMAGE = 2
SPACECRAFT_CLOCK_START_COUNT = "{clock}"
OBJECT = IMAGE
  LINES = {rows}
  LINE_SAMPLES = {columns}
  SAMPLE_TYPE = UNSIGNED_INTEGER
  SAMPLE_BITS = 8
END_OBJECT = IMAGE
GROUP = GEOMETRIC_CAMERA_MODEL
  MODEL_TYPE = CAHVOR
  MODEL_COMPONENT_ID = (C,A,H,V,O,R)
{components}
  REFERENCE_COORD_SYSTEM_INDEX = {index}
  REFERENCE_COORD_SYSTEM_NAME = {frame}
END_GROUP = GEOMETRIC_CAMERA_MODEL
{rover}{groups}END
"""
_ROVER = """GROUP = ROVER_COORDINATE_SYSTEM
  COORDINATE_SYSTEM_INDEX = (194,835,1,0,0)
  COORDINATE_SYSTEM_NAME = ROVER_FRAME
  ORIGIN_OFFSET_VECTOR = {offset}
  ORIGIN_ROTATION_QUATERNION = {quaternion}
  REFERENCE_COORD_SYSTEM_INDEX = 194
  REFERENCE_COORD_SYSTEM_NAME = {reference}
END_GROUP = ROVER_COORDINATE_SYSTEM
"""
#: Label of the landing camera of Mars 2020, frame 19; it names no letters for components 8 and 9.
LCAM = """ODL_VERSION_ID = ODL3
^IMAGE = ("LCAM.IMG", 1)
SPACECRAFT_CLOCK_START_COUNT = "0666952855.123"
OBJECT = IMAGE
  LINES = 1024
  LINE_SAMPLES = 1024
  SAMPLE_TYPE = UNSIGNED_INTEGER
  SAMPLE_BITS = 8
END_OBJECT = IMAGE
GROUP = GEOMETRIC_CAMERA_MODEL
  MODEL_TYPE = CAHVORE
  MODEL_COMPONENT_ID = ("C","A","H","V","O","R","E")
  MODEL_COMPONENT_1 = (701403.20,3145680.62,1075894.36)
  MODEL_COMPONENT_2 = (-0.171207,-0.938368,-0.300257)
  MODEL_COMPONENT_3 = (402.013,-460.182,-500.756)
  MODEL_COMPONENT_4 = (241.732,-699.869,298.075)
  MODEL_COMPONENT_5 = (-0.170765,-0.938306,-0.300702)
  MODEL_COMPONENT_6 = (-1.165e-06,0.120304,0.033668)
  MODEL_COMPONENT_7 = (-0.0793475,0.182685,-0.11582)
  MODEL_COMPONENT_8 = 2.0
  MODEL_COMPONENT_9 = 0.0
  REFERENCE_COORD_SYSTEM_NAME = "MCMF_FRAME"
END_GROUP = GEOMETRIC_CAMERA_MODEL
END"""

#: EuRoC's first camera (sensor.yaml), with the fields that are read.
EUROC = """resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375]
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""


def pds3_label(
    folder: Path,
    camera: CameraModel,
    frame: str,
    rover_reference: str | None = "SITE_FRAME",
    rover_pose: RigidTransform = SITE_FROM_ROVER,
    groups: str = "",
    name: str = "product.img",
    clock: float = 100.0,
) -> Path:
    """Write a product with a CAHVOR model, the rover's pose (none without reference) and a black image."""
    vectors = [getattr(camera, letter).tolist() for letter in "cahvor"]
    components = "\n".join(f"  MODEL_COMPONENT_{n} = {_list(vector)}" for n, vector in enumerate(vectors, start=1))
    rover = ""
    if rover_reference is not None:
        quaternion = rover_pose.rotation.as_quat()[[3, 0, 1, 2]].tolist()
        offset = _list(rover_pose.translation.tolist())
        rover = _ROVER.format(offset=offset, quaternion=_list(quaternion), reference=rover_reference)
    index = 194 if frame.startswith("SITE") else "(194,835,1,0,0)"
    columns, rows = camera.size
    text = _PDS3.format(**locals())
    path = folder / name
    path.write_bytes(text.encode().ljust(4096) + bytes(columns * rows))
    return path


def pds4_label(
    folder: Path,
    camera: CameraModel,
    frame: str,
    rover_reference: str | None = "SITE_FRAME",
    rover_pose: RigidTransform = SITE_FROM_ROVER,
) -> Path:
    """Write a label with a CAHVOR model and the rover's pose; the pose's reference is named by an identifier."""
    names = (
        ("Center", "c", ("x_position", "y_position", "z_position")),
        ("Axis", "a", ("x_unit", "y_unit", "z_unit")),
        ("Horizontal", "h", ("x_pixel", "y_pixel", "z_pixel")),
        ("Vertical", "v", ("x_pixel", "y_pixel", "z_pixel")),
        ("Optical", "o", ("x_unit", "y_unit", "z_unit")),
        ("Radial_Terms", "r", ("c0", "c1", "c2")),
    )
    model = ""
    for element, letter, parts in names:
        element = element if element.endswith("Terms") else f"Vector_{element}"
        values = _elements(parts, getattr(camera, letter).tolist())
        model += f"<geom:{element}>{values}</geom:{element}>"
    definition = ""
    if rover_reference is not None:
        offset = _elements(("x_position", "y_position", "z_position"), rover_pose.translation.tolist())
        quaternion = rover_pose.rotation.as_quat()[[3, 0, 1, 2]].tolist()
        definition = f"""<geom:Coordinate_Space_Definition>
      <local_identifier>ROVER_NAV_FRAME_194_835_1_0_0</local_identifier>
      <geom:Coordinate_Space_Present>{_frame_element("ROVER_NAV_FRAME")}</geom:Coordinate_Space_Present>
      <geom:Vector_Origin_Offset>{offset}</geom:Vector_Origin_Offset>
      <geom:Quaternion_Plus_Direction>{_elements(("qcos", "qsin1", "qsin2", "qsin3"), quaternion)}
        <geom:rotation_direction>Forward</geom:rotation_direction></geom:Quaternion_Plus_Direction>
      <geom:Coordinate_Space_Reference><Local_Internal_Reference>
        <local_identifier_reference>{rover_reference}_194</local_identifier_reference>
      </Local_Internal_Reference></geom:Coordinate_Space_Reference>
    </geom:Coordinate_Space_Definition>"""
    columns, rows = camera.size
    path = folder / "label.xml"
    path.write_text(f"""<?xml version="1.0"?><Product_Observational xmlns:geom="http://pds.nasa.gov/pds4/geom/v1">
    <geom:Camera_Model_Parameters><geom:model_type>CAHVOR</geom:model_type><geom:CAHVOR_Model>{model}</geom:CAHVOR_Model>
      <geom:Coordinate_Space_Reference>{_frame_element(frame)}</geom:Coordinate_Space_Reference>
    </geom:Camera_Model_Parameters>{definition}
    <Array_2D_Image>
      <Axis_Array><axis_name>Line</axis_name><elements>{rows}</elements></Axis_Array>
      <Axis_Array><axis_name>Sample</axis_name><elements>{columns}</elements></Axis_Array>
    </Array_2D_Image></Product_Observational>""")
    return path


def _list(values: list[float]) -> str:
    return "(" + ",".join(repr(value) for value in values) + ")"


def _elements(names: tuple[str, ...], values: list[float]) -> str:
    return "".join(f"<geom:{name}>{value!r}</geom:{name}>" for name, value in zip(names, values, strict=True))


def _frame_element(frame: str) -> str:
    numbers = {"SITE_FRAME": [194], "MCMF_FRAME": []}.get(frame, [194, 835, 1])
    index = "".join(
        f"<geom:Coordinate_Space_Index><geom:index_value_number>{number}</geom:index_value_number>"
        "</geom:Coordinate_Space_Index>"
        for number in numbers
    )
    return (
        "<geom:Coordinate_Space_Indexed>"
        f"<geom:coordinate_space_frame_type>{frame}</geom:coordinate_space_frame_type>{index}"
        "</geom:Coordinate_Space_Indexed>"
    )


def assert_fault(
    path: Path, text: str, change: tuple[str, str], fault: str, read: Callable[[Path], object] = read_cameras
) -> None:
    """Assert that a file with a changed text is rejected with a message that names the file and what is allowed."""
    assert change[0] in text
    path.write_bytes(text.replace(*change).encode("latin-1"))
    with pytest.raises(CameraFileError, match=fault) as error_info:
        read(path)
    assert path.name in str(error_info.value)
    assert "allowed" in str(error_info.value)


def compute_max_opencv_distance_px(
    camera: CameraModel,
    matrix: np.ndarray,
    distortion: list[float] | np.ndarray,
    pose: RigidTransform | None = None,
    *,
    fisheye: bool = False,
) -> float:
    """Compute the maximum distance over the frame between the pixels of Marsyard and OpenCV for the same far points."""
    columns, rows = (np.linspace(-0.5, extent - 0.5, 25) for extent in camera.size)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    points = camera.c + 1e5 * camera.rays(pixels)[1]
    pose = RigidTransform.identity() if pose is None else pose
    rotation, translation = pose.rotation.as_rotvec(), np.asarray(pose.translation)
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    expected_px, _ = project(points.reshape(-1, 1, 3), rotation, translation, matrix, np.array(distortion))
    return float(np.max(np.linalg.norm(expected_px.reshape(-1, 2) - pixels, axis=1)))
