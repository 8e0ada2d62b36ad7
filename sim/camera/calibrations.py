"""Calibrations of other programs: OpenCV's YAML or JSON, ROS' `camera_info`, Kalibr's camera chain, EuRoC's sensor.

All are YAML with a camera matrix and OpenCV's distortion in OpenCV's axes (z forward, x right, y down, pixels counted
from the centre of the upper left one). They are converted to the nearest camera of the CAHV family (`from_opencv`,
`from_opencv_fisheye`), which is exact for lenses of k1 and k2 alone. A residual above `MAX_RMS_PX` over the frame or
`MAX_PX` anywhere in it is an error (docs/adr/0020). Cameras of a chain are given in the axes of its first.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from marsyard.sim.camera.assembly import Source
from marsyard.sim.camera.base import CameraModel
from marsyard.sim.camera.opencv import Residual, from_opencv, from_opencv_fisheye

#: Maximum residual of the fitted camera: RMS over the frame, less than a calibration's own residual (0.1 to 0.5 px);
#: and anywhere in the frame, which is in a corner.
MAX_RMS_PX, MAX_PX = 0.3, 3.0
#: Tolerance on the orthonormality of a chain's rotation.
_ORTHONORMAL = 1e-4

_START = re.compile(rb"\A(\xef\xbb\xbf)?\s*(#[^\n]*\n\s*)*(%YAML|---|\{|[A-Za-z_]\w*\s*:)")
_DIRECTIVE = re.compile(r"^%YAML[^\n]*$", re.MULTILINE)
_CHAIN = re.compile(r"cam\d+$")
#: Names of the two lens models in the formats.
_PINHOLE = frozenset({"plumb_bob", "rational_polynomial", "radtan", "radial-tangential", "none", "pinhole"})
_FISHEYE = frozenset({"equidistant", "fisheye"})
_ALLOWED = (
    "a calibration of OpenCV (camera_matrix, distortion_coefficients, image_width, image_height), ROS (the same and "
    "distortion_model), Kalibr (cam0: ...) or EuRoC (intrinsics, resolution, ...)"
)


@dataclass(frozen=True)
class Calibration:
    """A camera read from a calibration file.

    - name: the camera's name in the file; empty if it has none
    - camera: in OpenCV's axes, those of the first camera of a chain
    - residual: distance between the camera's pixels and the calibration's, over the frame
    """

    name: str
    camera: CameraModel
    residual: Residual


class _Loader(yaml.SafeLoader):  # type: ignore[misc]  # yaml has no types
    """Loader of plain data and OpenCV's matrices; aliases are errors, because nested ones can fill the memory."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose a node of the document. Raises yaml.YAMLError at an alias."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError(f"line {self.peek_event().start_mark.line + 1} has an alias (*), which is not read")
        return super().compose_node(parent, index)


def _matrix(loader: yaml.SafeLoader, node: yaml.Node) -> Any:
    return loader.construct_mapping(node, deep=True) if isinstance(node, yaml.MappingNode) else None


# the second is OpenCV 5's tag of one-dimensional matrices
for _kind in ("opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_kind}", _matrix)


def is_calibration(head: bytes) -> bool:
    """Whether the first bytes of a file may be those of a calibration in YAML or JSON."""
    return _START.match(head) is not None


def read_calibrations(path: str | Path) -> tuple[Calibration, ...]:
    """Read every camera of a calibration file, in order.

    Raises CameraFileError if the file cannot be read, is no such calibration, has an impossible camera or a lens that
    the CAHV family cannot represent; it names file, field and allowed values.
    """
    source = Source(str(path))
    data = _parse(source)
    names = [name for name in data if isinstance(name, str) and _CHAIN.match(name) and isinstance(data[name], Mapping)]
    if names:
        return _chain([(name, data[name]) for name in names], source)
    reader = _Reader(source, data, "")
    name = str(data.get("camera_name", ""))
    intrinsics = reader.kalibr() if "intrinsics" in data else reader.opencv()
    return (_calibration(name, intrinsics, None, reader),)


class _Intrinsics(NamedTuple):
    """Camera matrix, distortion coefficients, (columns, rows) and whether the lens is a fisheye."""

    matrix: NDArray[np.float64]
    distortion: NDArray[np.float64]
    size: tuple[int, int]
    fisheye: bool


def _parse(source: Source) -> Mapping[str, Any]:
    text = source.text().encode("latin-1").decode("utf-8-sig", errors="replace")
    try:
        data = yaml.load(_DIRECTIVE.sub("", text), Loader=_Loader)  # noqa: S506  (a SafeLoader)
    except (yaml.YAMLError, ValueError, RecursionError, TypeError) as fault:
        message = " ".join(str(fault).split())
        raise source.error("file", f"is not valid YAML ({message[:200]})", _ALLOWED) from fault
    if not isinstance(data, Mapping):
        raise source.error("file", "holds no named values", _ALLOWED)
    return data


def _chain(parts: Sequence[tuple[str, Mapping[str, Any]]], source: Source) -> tuple[Calibration, ...]:
    pose: RigidTransform | None = None
    read = []
    for number, (name, data) in enumerate(parts):
        reader = _Reader(source, data, f"{name}.")
        if number:
            step = reader.transform("T_cn_cnm1")
            pose = step if pose is None else step * pose
        read.append(_calibration(name, reader.kalibr(), pose, reader))
    return tuple(read)


def _calibration(name: str, lens: _Intrinsics, pose: RigidTransform | None, reader: _Reader) -> Calibration:
    camera: CameraModel
    try:
        fit = from_opencv_fisheye if lens.fisheye else from_opencv
        camera, residual = fit(lens.matrix, lens.distortion, lens.size, pose)
    except ValueError as fault:
        raise reader.error("camera", str(fault), "a camera matrix, and a distortion that is one-to-one") from fault
    if not (residual.rms_px <= MAX_RMS_PX and residual.max_px <= MAX_PX):
        raise reader.error(
            "distortion",
            f"the nearest camera of the CAHV family is {residual.rms_px:.2g} px off over the frame (RMS), "
            f"{residual.max_px:.2g} px at most",
            f"{MAX_RMS_PX:g} and {MAX_PX:g} px; crop the picture, or calibrate with fewer coefficients",
        )
    return Calibration(name, camera, residual)


@dataclass(frozen=True)
class _Reader:
    """The values of one camera, and the prefix of its fields in messages."""

    source: Source
    data: Mapping[str, Any]
    prefix: str

    def error(self, field: str, fault: str, allowed: str) -> ValueError:
        """Create the error for a field."""
        return self.source.error(f"{self.prefix}{field}", fault, allowed)

    def opencv(self) -> _Intrinsics:
        """Read the intrinsics of an OpenCV or ROS file."""
        matrix = self.numbers(("camera_matrix", "cameraMatrix", "K"), "a matrix of 3 x 3 numbers")
        if len(matrix) != 9:
            raise self.error("camera_matrix", f"has {len(matrix)} numbers", "3 x 3")
        names = ("distortion_coefficients", "distCoeffs", "dist_coeffs", "D")
        coefficients = self.numbers(names, "a list of numbers", missing=[])
        flagged = bool(self.data.get("fisheye_model", False))
        return self._intrinsics(np.reshape(matrix, (3, 3)), coefficients, fisheye=flagged)

    def kalibr(self) -> _Intrinsics:
        """Read the intrinsics of a Kalibr or EuRoC file."""
        model = self.data.get("camera_model", "pinhole")
        if model != "pinhole":
            raise self.error("camera_model", f"{model!r}", "pinhole")
        intrinsics = self.numbers(("intrinsics",), "fx, fy, cx, cy")
        if len(intrinsics) != 4:
            raise self.error("intrinsics", f"has {len(intrinsics)} numbers", "fx, fy, cx, cy")
        fx, fy, cx, cy = intrinsics
        coefficients = self.numbers(("distortion_coeffs", "distortion_coefficients"), "a list of numbers", missing=[])
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        return self._intrinsics(matrix, coefficients, fisheye=False)

    def _intrinsics(self, matrix: NDArray[np.float64], coefficients: list[float], *, fisheye: bool) -> _Intrinsics:
        """Combine the values; the lens model is given by its name, in OpenCV files by the number of coefficients."""
        model = self.data.get("distortion_model")
        if model is not None and model not in _PINHOLE | _FISHEYE:
            raise self.error("distortion_model", f"{model!r}", ", ".join(sorted(_PINHOLE | _FISHEYE)))
        fisheye = fisheye or model in _FISHEYE
        while not fisheye and len(coefficients) > 8 and coefficients[-1] == 0.0:
            coefficients = coefficients[:-1]  # thin prism and tilt, unused
        return _Intrinsics(np.asarray(matrix, dtype=np.float64), np.array(coefficients), self.size(), fisheye)

    def size(self) -> tuple[int, int]:
        """(columns, rows)."""
        both = next((self.data[name] for name in ("resolution", "image_size", "imageSize") if name in self.data), None)
        pair = both if both is not None else [self.data.get("image_width"), self.data.get("image_height")]
        if isinstance(pair, Mapping):
            pair = [pair.get("width"), pair.get("height")]
        match pair:
            case [int(columns), int(rows)] if 0 < columns < 1e6 and 0 < rows < 1e6:
                return columns, rows
        raise self.error(
            "image_width, image_height or resolution",
            "missing" if pair in (None, [None, None]) else f"{pair!r}",
            "two positive integers, columns and rows",
        )

    def numbers(self, names: Sequence[str], allowed: str, missing: list[float] | None = None) -> list[float]:
        """Read finite numbers from a list, nested lists or a matrix with `data`."""
        name = next((one for one in names if one in self.data), None)
        if name is None:
            if missing is not None:
                return missing
            raise self.error(names[0], "missing", allowed)
        value = self.data[name]
        items = value.get("data") if isinstance(value, Mapping) else value
        flat = _flat(items) if isinstance(items, list) else None
        if flat is None:
            raise self.error(name, f"{str(value)[:80]!r} is no list of finite numbers", allowed)
        return flat

    def transform(self, name: str) -> RigidTransform:
        """Read a rigid transform, written as a matrix of 4 x 4."""
        flat = self.numbers((name,), "a rigid transform as a matrix of 4 x 4 numbers")
        matrix = np.array(flat)
        if matrix.size == 16:
            matrix = matrix.reshape(4, 4)
            turn = matrix[:3, :3]
            rigid = np.allclose(turn @ turn.T, np.eye(3), rtol=0.0, atol=_ORTHONORMAL) and np.linalg.det(turn) > 0.0
            if rigid and np.allclose(matrix[3], [0.0, 0.0, 0.0, 1.0]):
                return RigidTransform.from_matrix(matrix)
        raise self.error(name, "is not rigid", "a rotation and a translation as a matrix of 4 x 4 numbers")


def _flat(value: Any) -> list[float] | None:
    """Flatten nested lists of finite numbers; None if they contain anything else. YAML 1.1 reads 1e-3 as text."""
    if isinstance(value, list):
        parts = [_flat(one) for one in value]
        return None if None in parts else [number for part in parts for number in part or ()]
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return [number] if math.isfinite(number) else None
