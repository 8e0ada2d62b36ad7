"""Camera calibrations of other programs: OpenCV, ROS, Kalibr, EuRoC, COLMAP and Ames Stereo Pipeline.

Files of OpenCV, ROS (`camera_info`), Kalibr (camera chains) and EuRoC (sensors) are YAML; the others are converted to
the same values (`marsyard.sim.camera.calibration_formats`): a camera matrix and
OpenCV's distortion in OpenCV's axes, z forward, x right, y down; the centre of the upper left pixel is (0, 0), as in
Marsyard. Each is converted to the nearest camera of the CAHV family (`from_opencv`, `from_opencv_fisheye`). The
conversion is exact if only k1 and k2 are not zero. A residual above `MAX_RMS_PX` (RMS over the frame) or `MAX_PX` (at
any pixel) is an error (docs/adr/0020). All cameras of a chain are in the axes of its first camera. The matrix of ROS
describes the whole detector: its images are cropped to `roi`, then each block of `binning_x` x `binning_y` pixels
becomes one pixel.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform

from marsyard.sim.camera.base import CameraModel
from marsyard.sim.camera.calibration_formats import (
    COLMAP,
    OPENCV_ROOT,
    STEREO_PIPELINE,
    read_colmap,
    read_opencv_xml,
    read_stereo_pipeline,
)
from marsyard.sim.camera.file_reading import CALIBRATION_FILES, Source, is_xml, refuse_foreign, xml_root
from marsyard.sim.camera.opencv_models import Residual, from_opencv, from_opencv_fisheye

#: Maximum residual of the fitted camera: RMS over the frame, similar to the residual of a calibration (0.1 to 0.5 px);
#: and at any pixel (the maximum is in a corner).
MAX_RMS_PX, MAX_PX = 0.3, 3.0
#: Tolerance on the elements of R R^T - I for a chain's rotation matrix R.
_ORTHONORMAL_TOLERANCE = 1e-4

#: Number of leading bytes that identify a format.
HEAD_BYTES = 4096
#: First bytes of a YAML or JSON file.
_START = re.compile(rb"\A(\xef\xbb\xbf)?\s*(#[^\n]*\n\s*)*(%YAML|---|\{|[A-Za-z_]\w*\s*:)")
#: Line with the YAML version, and names of the cameras in a Kalibr chain.
_DIRECTIVE = re.compile(r"^%YAML[^\n]*$", re.MULTILINE)
_CHAIN = re.compile(r"cam\d+$")
#: Names of the two lens models in the formats.
_PINHOLE = frozenset({"plumb_bob", "rational_polynomial", "radtan", "radial-tangential", "none", "pinhole"})
_FISHEYE = frozenset({"equidistant", "fisheye"})
#: Names of the image's width and height: OpenCV, its older programs, messages of ROS.
_SIZES = (("image_width", "image_height"), ("image_Width", "image_Height"), ("width", "height"))


@dataclass(frozen=True)
class Calibration:
    """A camera read from a calibration file.

    - name: the camera's name in the file; empty if the file has none
    - camera: the nearest camera of the CAHV family, in OpenCV's axes; in a chain, in the axes of the first camera
    - residual: difference between this camera and the calibration in the file
    """

    name: str
    camera: CameraModel
    residual: Residual


class _Loader(yaml.SafeLoader):  # type: ignore[misc]  # yaml has no types
    """YAML loader for plain data and OpenCV's matrices; aliases are errors: nested aliases can fill the memory."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose a node of the document. Raises yaml.YAMLError at an alias."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError(
                f"line {self.peek_event().start_mark.line + 1} has an alias (*), which is not supported"
            )
        return super().compose_node(parent, index)


def _construct_matrix(loader: _Loader, node: Any) -> Any:
    """Construct OpenCV's matrix: a table with its elements in `data`; None for another node with this tag."""
    return loader.construct_mapping(node, deep=True) if isinstance(node, yaml.MappingNode) else None


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _construct_matrix)
# one-dimensional matrices in OpenCV 5
_Loader.add_constructor("tag:yaml.org,2002:opencv-nd-matrix", _construct_matrix)


def is_calibration(head: bytes) -> bool:
    """Return whether a file with these first bytes can be a calibration."""
    if is_xml(head):
        return xml_root(head) == OPENCV_ROOT
    return any(start.match(head) for start in (COLMAP, STEREO_PIPELINE, _START))


def read_calibrations(path: str | Path, *, size: tuple[int, int] | None = None) -> tuple[Calibration, ...]:
    """Read every camera of a calibration file, in order.

    `size` is (columns, rows) of the image, required for a pinhole model of Ames Stereo Pipeline.

    Raises CameraFileError if the file cannot be read or is not a calibration, or if it contains an impossible camera or
    a lens that the CAHV family cannot represent. The message contains file, field and allowed values.
    """
    source = Source(str(path))
    head = source.read_head(HEAD_BYTES)
    refuse_foreign(source, head)
    if is_xml(head):
        return (_Reader(source, read_opencv_xml(source), "").read_calibration("", None),)
    if COLMAP.match(head):
        return tuple(
            _Reader(source, values, f"camera {name}: ").read_calibration(name, None)
            for name, values in read_colmap(source)
        )
    if STEREO_PIPELINE.match(head):
        return (_Reader(source, read_stereo_pipeline(source, size), "").read_calibration("", None),)
    text = source.read_text().encode("latin-1").decode("utf-8-sig", errors="replace")
    try:
        data = yaml.load(_DIRECTIVE.sub("", text), Loader=_Loader)  # noqa: S506  (a SafeLoader)
    except (yaml.YAMLError, ValueError, RecursionError, TypeError) as fault:
        message = " ".join(str(fault).split())
        raise source.error("file", f"is not valid YAML ({message[:200]})", CALIBRATION_FILES) from fault
    if not isinstance(data, Mapping):
        raise source.error("file", "contains no named values", CALIBRATION_FILES)
    names = [name for name in data if isinstance(name, str) and _CHAIN.match(name) and isinstance(data[name], Mapping)]
    if not names:
        return (_Reader(source, data, "").read_calibration(str(data.get("camera_name", "")), None),)
    pose: RigidTransform | None = None
    calibrations = []
    for number, name in enumerate(names):
        reader = _Reader(source, data[name], f"{name}.")
        if number:
            step = reader.read_transform("T_cn_cnm1")
            pose = step if pose is None else step * pose
        calibrations.append(reader.read_calibration(name, pose))
    return tuple(calibrations)


@dataclass(frozen=True)
class _Reader:
    """Reader of one camera: the values in the file, and the prefix of their names in error messages."""

    source: Source
    data: Mapping[str, Any]
    prefix: str

    def error(self, field: str, fault: str, allowed: str) -> ValueError:
        """Create the error for a field."""
        return self.source.error(f"{self.prefix}{field}", fault, allowed)

    def read_calibration(self, name: str, pose: RigidTransform | None) -> Calibration:
        """Read the camera; its lens model follows from the model's name and, in OpenCV's files, the coefficients."""
        is_fisheye = False
        if "intrinsics" in self.data or _CHAIN.match(self.prefix.removesuffix(".")):  # EuRoC, Kalibr
            matrix = self.read_intrinsics()
            names: tuple[str, ...] = ("distortion_coeffs", "distortion_coefficients")
        else:
            matrix = self.read_matrix()
            names = ("distortion_coefficients", "distCoeffs", "Distortion_Coefficients", "dist_coeffs", "D", "d")
            is_fisheye = bool(self.data.get("fisheye_model", False))
        coefficients = self.read_numbers(names, "a list of numbers", default=[])
        lens = self.data.get("distortion_model")
        if lens is not None and lens not in _PINHOLE | _FISHEYE:
            raise self.error("distortion_model", f"{lens!r}", ", ".join(sorted(_PINHOLE | _FISHEYE)))
        is_fisheye = is_fisheye or lens in _FISHEYE
        while not is_fisheye and len(coefficients) > 8 and coefficients[-1] == 0.0:
            coefficients = coefficients[:-1]  # coefficients of thin prism and tilt that are zero
        size = self.read_size()
        try:
            camera: CameraModel
            fit = from_opencv_fisheye if is_fisheye else from_opencv
            camera, residual = fit(matrix, np.array(coefficients), size, pose)
        except ValueError as fault:
            raise self.error("camera", str(fault), "a camera matrix, and a distortion that is one-to-one") from fault
        if not (residual.rms_px <= MAX_RMS_PX and residual.max_px <= MAX_PX):
            raise self.error(
                "distortion",
                f"the nearest camera of the CAHV family differs by {residual.rms_px:.2g} px over the frame (RMS), "
                f"{residual.max_px:.2g} px at most",
                f"{MAX_RMS_PX:g} and {MAX_PX:g} px; crop the image, or calibrate with fewer coefficients",
            )
        if self.prefix:
            return Calibration(name, camera, residual)
        camera, binning = self.apply_readout(camera)
        return Calibration(name, camera, Residual(residual.rms_px / binning, residual.max_px / binning))

    def read_intrinsics(self) -> Float[np.ndarray, "3 3"]:
        """Read the camera matrix from the numbers fx, fy, cx, cy of EuRoC and Kalibr, pixels."""
        model = self.data.get("camera_model", "pinhole")
        if model != "pinhole":
            raise self.error("camera_model", f"{model!r}", "pinhole")
        intrinsics = self.read_numbers(("intrinsics",), "fx, fy, cx, cy")
        if len(intrinsics) != 4:
            raise self.error("intrinsics", f"has {len(intrinsics)} numbers", "fx, fy, cx, cy")
        fx, fy, cx, cy = intrinsics
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def read_matrix(self) -> Float[np.ndarray, "3 3"]:
        """Read the camera matrix of OpenCV and ROS, pixels."""
        flat = self.read_numbers(
            ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "k"), "a matrix of 3 x 3 numbers"
        )
        if len(flat) != 9:
            raise self.error("camera_matrix", f"has {len(flat)} numbers", "3 x 3")
        return np.array(flat, dtype=np.float64).reshape(3, 3)

    def apply_readout(self, camera: CameraModel) -> tuple[CameraModel, int]:
        """Crop and bin the camera as `roi`, `binning_x` and `binning_y` of ROS say; return also the smaller binning.

        Offsets and sizes of the region are in pixels of the whole detector. A region of size 0 is the whole detector, a
        binning of 0 is none; pixels that do not fill a block are not delivered.
        """
        region = self.data.get("roi") or {}
        if not isinstance(region, Mapping):
            raise self.error("roi", f"{region!r}", "x_offset, y_offset, width and height")
        column, row, width, height = (
            self.read_count(region, name, "roi.") for name in ("x_offset", "y_offset", "width", "height")
        )
        if width == height == 0:
            width, height = camera.size[0] - column, camera.size[1] - row
        if min(width, height) < 1 or column + width > camera.size[0] or row + height > camera.size[1]:
            raise self.error(
                "roi",
                f"{width} x {height} pixels at ({column}, {row})",
                f"a region within image_width x image_height, {camera.size[0]} x {camera.size[1]} (without binning)",
            )
        columns, rows = (max(self.read_count(self.data, name), 1) for name in ("binning_x", "binning_y"))
        if columns > width or rows > height:
            raise self.error(
                "binning_x, binning_y", f"{columns}, {rows}", f"at most {width}, {height}, the image's size"
            )
        cropped = camera.crop(column, row, (width // columns * columns, height // rows * rows))
        return cropped.bin(columns, rows), min(columns, rows)

    def read_count(self, values: Mapping[Any, Any], name: str, prefix: str = "") -> int:
        """Read an integer of 0 or more; 0 if it is missing."""
        value = values.get(name, 0)
        if not isinstance(value, int) or isinstance(value, bool) or value < 0:
            raise self.error(f"{prefix}{name}", f"{value!r}", "an integer of 0 or more")
        return value

    def read_size(self) -> tuple[int, int]:
        """Read (columns, rows)."""
        missing = (None, [None, None])
        pairs: list[Any] = [self.data.get(name) for name in ("resolution", "image_size", "imageSize")]
        pairs += [[self.data.get(width), self.data.get(height)] for width, height in _SIZES]
        pair = next((pair for pair in pairs if pair not in missing), None)
        if isinstance(pair, Mapping):
            pair = [pair.get("width"), pair.get("height")]
        match pair:
            case [int(columns), int(rows)] if 0 < columns < 1e6 and 0 < rows < 1e6:
                return columns, rows
        raise self.error(
            "image_width, image_height or resolution",
            "missing" if pair in missing else f"{pair!r}",
            "two positive integers, columns and rows",
        )

    def read_numbers(self, names: Sequence[str], allowed: str, default: list[float] | None = None) -> list[float]:
        """Read the finite numbers of the first of `names` in the file: a list, nested lists or a matrix with `data`."""
        name = next((name for name in names if name in self.data), None)
        if name is None and default is not None:
            return default
        if name is None:
            raise self.error(names[0], "missing", allowed)
        value = self.data[name]
        items = value.get("data") if isinstance(value, Mapping) else value
        flat = _flatten_numbers(items) if isinstance(items, list) else None
        if flat is None:
            raise self.error(name, f"{str(value)[:80]!r} is not a list of finite numbers", allowed)
        return flat

    def read_transform(self, name: str) -> RigidTransform:
        """Read a rigid transform, stored as a 4 x 4 matrix."""
        matrix = np.array(self.read_numbers((name,), "a rigid transform as a matrix of 4 x 4 numbers"))
        if matrix.size == 16:
            matrix = matrix.reshape(4, 4)
            rotation = matrix[:3, :3]
            is_orthonormal = np.allclose(rotation @ rotation.T, np.eye(3), rtol=0.0, atol=_ORTHONORMAL_TOLERANCE)
            if is_orthonormal and np.linalg.det(rotation) > 0.0 and np.allclose(matrix[3], [0.0, 0.0, 0.0, 1.0]):
                return RigidTransform.from_matrix(matrix)
        raise self.error(name, "is not rigid", "a rotation and a translation as a matrix of 4 x 4 numbers")


def _flatten_numbers(value: Any) -> list[float] | None:
    """Flatten nested lists of finite numbers; None if they contain anything else. YAML 1.1 parses 1e-3 as text."""
    if isinstance(value, list):
        parts = [_flatten_numbers(item) for item in value]
        return None if None in parts else [number for part in parts for number in part or ()]
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return [number] if math.isfinite(number) else None
