"""Calibrations by other programs: OpenCV's YAML or JSON, ROS' `camera_info`, Kalibr's camera chain, EuRoC's sensor.

All are YAML, and all state a camera matrix and OpenCV's distortion in OpenCV's axes (z forward, x right, y down, pixels
counted from the centre of the upper left one). They are read as the nearest camera of the CAHV family (`from_opencv`,
`from_opencv_fisheye`), which is exact for lenses of k1 and k2 alone, and refused where that is off by more than
`MOST_RMS_PX` over the frame or `MOST_PX` anywhere in it (docs/adr/0020). Cameras of a chain are given in the axes of
its first.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from marsyard.sim.camera.assembly import Source
from marsyard.sim.camera.base import CameraModel
from marsyard.sim.camera.opencv import Residual, from_opencv, from_opencv_fisheye

#: Farthest that a fitted camera may be from the calibrated one: RMS over the frame, pixels, less than calibrations
#: themselves leave of their points (0.1 to 0.5 px); and anywhere, which is in a corner.
MOST_RMS_PX, MOST_PX = 0.3, 3.0
#: How far a rotation of a chain may be from orthonormal.
_ORTHONORMAL = 1e-4

_START = re.compile(rb"\A(\xef\xbb\xbf)?\s*(#[^\n]*\n\s*)*(%YAML|---|\{|[A-Za-z_]\w*\s*:)")
_DIRECTIVE = re.compile(r"^%YAML[^\n]*$", re.MULTILINE)
_CHAIN = re.compile(r"cam\d+$")
#: Our names of the lens models by those of the formats.
_PINHOLE = frozenset({"plumb_bob", "rational_polynomial", "radtan", "radial-tangential", "none", "pinhole"})
_FISHEYE = frozenset({"equidistant", "fisheye"})
_ALLOWED = (
    "a calibration of OpenCV (camera_matrix, distortion_coefficients, image_width, image_height), ROS (the same and "
    "distortion_model), Kalibr (cam0: ...) or EuRoC (intrinsics, resolution, ...)"
)


@dataclass(frozen=True)
class Calibration:
    """A camera as read, and what it is off the calibration.

    Attributes
    ----------
    name
        The file's name of the camera; empty where it has none.
    camera
        In OpenCV's axes, those of the first camera of a chain.
    residual
        Distance between its pixels and the calibration's, over the frame.
    """

    name: str
    camera: CameraModel
    residual: Residual


class _Loader(yaml.SafeLoader):  # type: ignore[misc]  # yaml has no types
    """Plain data, OpenCV's matrices as the mappings they are written as; no aliases.

    Aliases of aliases of lists make gigabytes of a few hundred bytes, and no calibration has any.
    """

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose a node of the document. Raises yaml.YAMLError at an alias."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError(f"line {self.peek_event().start_mark.line + 1} has an alias (*), which is not read")
        return super().compose_node(parent, index)


def _matrix(loader: yaml.SafeLoader, node: yaml.Node) -> Any:
    return loader.construct_mapping(node, deep=True) if isinstance(node, yaml.MappingNode) else None


# OpenCV 5 writes matrices of one dimension as the second
for _kind in ("opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_kind}", _matrix)


def is_calibration(head: bytes) -> bool:
    """Whether a file that begins so may be a calibration in YAML or JSON."""
    return _START.match(head) is not None


def read_calibrations(path: str | Path) -> tuple[Calibration, ...]:
    """Every camera of a calibration file, in the file's order.

    Raises
    ------
    CameraFileError
        If the file cannot be read, is no such calibration, states an impossible camera, or a lens that the CAHV family
        cannot hold; it names file, field and what is allowed.
    """
    source = Source(str(path))
    data = _parsed(source)
    names = [name for name in data if isinstance(name, str) and _CHAIN.match(name) and isinstance(data[name], Mapping)]
    if names:
        return _chain([(name, data[name]) for name in names], source)
    reader = _Reader(source, data, "")
    name = str(data.get("camera_name", ""))
    intrinsics = reader.kalibr() if "intrinsics" in data else reader.opencv()
    return (_calibration(name, intrinsics, None, reader),)


@dataclass(frozen=True)
class _Intrinsics:
    """What any of the formats says of a camera: matrix, coefficients, (columns, rows) and whether it is a fisheye."""

    matrix: NDArray[np.float64]
    distortion: NDArray[np.float64]
    size: tuple[int, int]
    fisheye: bool


def _parsed(source: Source) -> Mapping[str, Any]:
    text = source.text().encode("latin-1").decode("utf-8-sig", errors="replace")
    try:
        data = yaml.load(_DIRECTIVE.sub("", text), Loader=_Loader)  # noqa: S506  (a SafeLoader)
    except (yaml.YAMLError, ValueError, RecursionError, TypeError) as fault:
        said = " ".join(str(fault).split())
        raise source.error("file", f"is not valid YAML ({said[:200]})", _ALLOWED) from fault
    if not isinstance(data, Mapping):
        raise source.error("file", "holds no named values", _ALLOWED)
    return data


def _chain(parts: Sequence[tuple[str, Mapping[str, Any]]], source: Source) -> tuple[Calibration, ...]:
    pose: RigidTransform | None = None
    read = []
    for place, (name, data) in enumerate(parts):
        reader = _Reader(source, data, f"{name}.")
        if place:
            step = reader.transform("T_cn_cnm1")
            pose = step if pose is None else step * pose
        read.append(_calibration(name, reader.kalibr(), pose, reader))
    return tuple(read)


def _calibration(name: str, one: _Intrinsics, pose: RigidTransform | None, reader: _Reader) -> Calibration:
    camera: CameraModel
    try:
        fit = from_opencv_fisheye if one.fisheye else from_opencv
        camera, residual = fit(one.matrix, one.distortion, one.size, pose)
    except ValueError as fault:
        raise reader.error("camera", str(fault), "a camera matrix, and a distortion that is one-to-one") from fault
    if not (residual.rms_px <= MOST_RMS_PX and residual.max_px <= MOST_PX):
        raise reader.error(
            "distortion",
            f"the nearest camera of the CAHV family is {residual.rms_px:.2g} px off over the frame (RMS), "
            f"{residual.max_px:.2g} px at most",
            f"{MOST_RMS_PX:g} and {MOST_PX:g} px; crop the picture, or calibrate with fewer coefficients",
        )
    return Calibration(name, camera, residual)


@dataclass(frozen=True)
class _Reader:
    """The values of one camera, and where they stand in the file."""

    source: Source
    data: Mapping[str, Any]
    prefix: str

    def error(self, field: str, fault: str, allowed: str) -> ValueError:
        """The error to raise for a field."""
        return self.source.error(f"{self.prefix}{field}", fault, allowed)

    def opencv(self) -> _Intrinsics:
        """As OpenCV and ROS write a camera."""
        matrix = self.numbers(("camera_matrix", "cameraMatrix", "K"), "a matrix of 3 x 3 numbers")
        if len(matrix) != 9:
            raise self.error("camera_matrix", f"has {len(matrix)} numbers", "3 x 3")
        names = ("distortion_coefficients", "distCoeffs", "dist_coeffs", "D")
        coefficients = self.numbers(names, "a list of numbers", missing=[])
        flagged = bool(self.data.get("fisheye_model", False))
        return self._intrinsics(np.reshape(matrix, (3, 3)), coefficients, self.size(), flagged)

    def kalibr(self) -> _Intrinsics:
        """As Kalibr and EuRoC write a camera."""
        model = self.data.get("camera_model", "pinhole")
        if model != "pinhole":
            raise self.error("camera_model", f"{model!r}", "pinhole")
        intrinsics = self.numbers(("intrinsics",), "fx, fy, cx, cy")
        if len(intrinsics) != 4:
            raise self.error("intrinsics", f"has {len(intrinsics)} numbers", "fx, fy, cx, cy")
        fx, fy, cx, cy = intrinsics
        coefficients = self.numbers(("distortion_coeffs", "distortion_coefficients"), "a list of numbers", missing=[])
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        return self._intrinsics(matrix, coefficients, self.size(), False)

    def _intrinsics(
        self, matrix: NDArray[np.float64], coefficients: list[float], size: tuple[int, int], fisheye: bool
    ) -> _Intrinsics:
        """With the lens model by its name; OpenCV names none, and counts coefficients."""
        model = self.data.get("distortion_model")
        if model is not None and model not in _PINHOLE | _FISHEYE:
            allowed = ", ".join(sorted(_PINHOLE | _FISHEYE))
            raise self.error("distortion_model", f"{model!r}", allowed)
        fisheye = fisheye or model in _FISHEYE
        while not fisheye and len(coefficients) > 8 and coefficients[-1] == 0.0:
            coefficients = coefficients[:-1]  # thin prism and tilt, unused
        return _Intrinsics(np.asarray(matrix, dtype=np.float64), np.array(coefficients), size, fisheye)

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
        """Finite numbers of a list, of nested lists, or of a matrix with `data`."""
        name = next((one for one in names if one in self.data), None)
        if name is None:
            if missing is not None:
                return missing
            raise self.error(names[0], "missing", allowed)
        value = self.data[name]
        flat = _flat(value.get("data") if isinstance(value, Mapping) else value)
        if flat is None:
            raise self.error(name, f"{str(value)[:80]!r} is no list of finite numbers", allowed)
        return flat

    def transform(self, name: str) -> RigidTransform:
        """A rigid transform written as a matrix of 4 x 4."""
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
    """The finite numbers of a list and of the lists in it; None where it holds anything else."""
    if not isinstance(value, list):
        return None
    numbers: list[float] = []
    for one in value:
        inner = _flat(one) if isinstance(one, list) else _number(one)
        if inner is None:
            return None
        numbers += inner
    return numbers


def _number(value: Any) -> list[float] | None:
    """A finite number; YAML 1.1 takes 1e-3, which has no point, for text."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return [number] if math.isfinite(number) else None
