"""Camera calibrations of other programs: OpenCV, ROS `camera_info`, Kalibr camera chains, EuRoC sensors.

All files are YAML, or are converted to its values (`marsyard.sim.camera.calibration_files`): a camera matrix and
OpenCV's distortion in OpenCV's axes, z forward, x right, y down; the centre of the upper left pixel is (0, 0), as in
Marsyard. Each is converted to the nearest camera of the CAHV family (`from_opencv`, `from_opencv_fisheye`). The
conversion is exact if only k1 and k2 are not zero. A residual above `MAX_RMS_PX` (RMS over the frame) or `MAX_PX` (at
any pixel) is an error (docs/adr/0020). All cameras of a chain are in the axes of its first camera. The matrix of ROS
describes the whole detector: its images are cropped to `roi`, then each block of `binning_x` x `binning_y` pixels
becomes one pixel.

OpenCV's pinhole model distorts about the direction z with k1, k2, k3 (radial) and p1, p2 (tangential), for a point
(x, y) of the plane z = 1:

    r^2 = x^2 + y^2        x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
                           y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

Its rational model divides the radial factor by 1 + k4 r^2 + k5 r^4 + k6 r^6. Its fisheye model projects a ray at the
angle theta from z to the radius theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) (Kannala & Brandt 2006).

CAHVOR with O = A equals the pinhole model with k3 = p1 = p2 = 0; for other coefficients it is fitted, also by tilting
O. CAHVORE with O = A, linearity 0 and a fixed pupil equals the fisheye model with k3 = k4 = 0.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.camera.base import CameraModel
from marsyard.sim.camera.calibration_files import (
    OPENCV_ROOT,
    is_colmap,
    is_pinhole,
    is_xml,
    read_colmap,
    read_opencv_xml,
    read_pinhole,
    refuse_foreign,
    xml_root,
)
from marsyard.sim.camera.models import Cahv, Cahvor, Cahvore
from marsyard.sim.camera.source import CALIBRATION_FILES, Source

Array = NDArray[np.float64]
C = TypeVar("C", bound=CameraModel)

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

#: Number of pixels along each side of the frame, from edge to edge, at which cameras are compared.
_SAMPLES_PER_SIDE = 33
#: A start camera with a smaller residual is exact and is not fitted.
_EXACT_PX = 1e-9
#: Residual during the fit of a direction that is not visible in the camera.
_INVISIBLE_PX = 1e3


@dataclass(frozen=True)
class Residual:
    """Distance in pixels between the images of the same direction in two cameras: RMS and maximum over the frame."""

    rms_px: float
    max_px: float


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


# YAML tags of OpenCV's matrices; the second is that of one-dimensional matrices in OpenCV 5
for _kind in ("opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(
        f"tag:yaml.org,2002:{_kind}",
        lambda loader, node: loader.construct_mapping(node, deep=True) if isinstance(node, yaml.MappingNode) else None,
    )


def is_calibration(head: bytes) -> bool:
    """Return whether a file with these first bytes can be a calibration."""
    if is_xml(head):
        return xml_root(head) == OPENCV_ROOT
    return is_colmap(head) or is_pinhole(head) or _START.match(head) is not None


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
    if is_colmap(head):
        return tuple(
            _Reader(source, values, f"camera {name}: ").read_calibration(name, None)
            for name, values in read_colmap(source)
        )
    if is_pinhole(head):
        return (_Reader(source, read_pinhole(source, size), "").read_calibration("", None),)
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
        if "intrinsics" in self.data or _CHAIN.match(self.prefix.removesuffix(".")):  # EuRoC, Kalibr
            model = self.data.get("camera_model", "pinhole")
            if model != "pinhole":
                raise self.error("camera_model", f"{model!r}", "pinhole")
            intrinsics = self.read_numbers(("intrinsics",), "fx, fy, cx, cy")
            if len(intrinsics) != 4:
                raise self.error("intrinsics", f"has {len(intrinsics)} numbers", "fx, fy, cx, cy")
            fx, fy, cx, cy = intrinsics
            matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
            names: tuple[str, ...] = ("distortion_coeffs", "distortion_coefficients")
            is_fisheye = False
        else:
            flat = self.read_numbers(
                ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "k"), "a matrix of 3 x 3 numbers"
            )
            if len(flat) != 9:
                raise self.error("camera_matrix", f"has {len(flat)} numbers", "3 x 3")
            matrix = np.array(flat, dtype=np.float64).reshape(3, 3)
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
        pair = next((self.data[name] for name in ("resolution", "image_size", "imageSize") if name in self.data), None)
        for width, height in _SIZES:
            pair = pair if pair not in (None, [None, None]) else [self.data.get(width), self.data.get(height)]
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


def from_opencv(
    matrix: Float[np.ndarray, "3 3"],
    distortion: Float[np.ndarray, "coefficients"],
    size: tuple[int, int],
    camera_from_world: RigidTransform | None = None,
) -> tuple[Cahvor, Residual]:
    """Fit the CAHVOR camera nearest to OpenCV's pinhole camera; return it with its residual over the frame.

    Exact if all coefficients except k1 and k2 are zero; otherwise fitted by least squares.

    - matrix: camera matrix ((fx, skew, cx), (0, fy, cy), (0, 0, 1)), pixels
    - distortion: empty, (k1, k2, p1, p2), (k1, k2, p1, p2, k3) or (k1, k2, p1, p2, k3, k4, k5, k6)
    - camera_from_world: transform from the frame of the returned camera to OpenCV's axes; identity by default

    Raises ValueError if the matrix has another form, the number of coefficients is another, or the distortion is not
    one-to-one within the frame.
    """
    if len(distortion) not in (0, 4, 5, 8) or not np.all(np.isfinite(distortion)):
        raise ValueError(
            f"distortion must be none, (k1, k2, p1, p2), (k1, k2, p1, p2, k3) or (k1, k2, p1, p2, k3, k4, k5, k6), "
            f"finite, not {distortion}"
        )
    coefficients = np.concatenate([distortion, np.zeros(8 - len(distortion))])
    linear, pixels, distorted_points = _create_linear_camera(matrix, size, camera_from_world)
    perpendicular = np.cross(linear.a, np.eye(3)[np.argmin(np.abs(linear.a))])
    perpendicular /= np.linalg.norm(perpendicular)
    tilt_axes = np.stack([perpendicular, np.cross(linear.a, perpendicular)])
    points = _invert_pinhole_distortion(distorted_points, coefficients)
    directions = _rotate_to_world(np.concatenate([points, np.ones((len(points), 1))], axis=1), camera_from_world)
    start = Cahvor.from_cahv(linear, r=(0.0, coefficients[0], coefficients[1]))

    def modify_camera(change: Array) -> Cahvor:
        """Tilt O, change rho1 and rho2, rotate the image plane, scale and shift H and V."""
        rotation = Rotation.from_rotvec(change[4:7]).as_matrix()
        scale_u, scale_v, shift_u, shift_v = change[7:]
        o = start.o + change[0] * tilt_axes[0] + change[1] * tilt_axes[1]
        return replace(
            start,
            a=rotation @ start.a,
            h=rotation @ (start.h * (1 + scale_u) + shift_u * start.a),
            v=rotation @ (start.v * (1 + scale_v) + shift_v * start.a),
            o=o / np.linalg.norm(o),
            r=start.r + np.array([0.0, *change[2:4]]),
        )

    scales = np.array([1e-3, 1e-3, 1e-2, 1e-2, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1.0, 1.0])
    return _fit_camera(start, modify_camera, (directions, pixels), scales, method="lm")


def from_opencv_fisheye(
    matrix: Float[np.ndarray, "3 3"],
    distortion: Float[np.ndarray, "coefficients"],
    size: tuple[int, int],
    camera_from_world: RigidTransform | None = None,
) -> tuple[Cahvore, Residual]:
    """Fit the CAHVORE camera nearest to OpenCV's fisheye (Kannala & Brandt); return it with its residual.

    Exact if k3 and k4 are zero; otherwise focal lengths, radial terms and linearity are fitted by least squares.
    `distortion` is (k1, k2, k3, k4); the other parameters and the errors are those of `from_opencv`.
    """
    if len(distortion) != 4 or not np.all(np.isfinite(distortion)):
        raise ValueError(f"distortion of a fisheye must be (k1, k2, k3, k4), finite, not {distortion}")
    linear, pixels, distorted_points = _create_linear_camera(matrix, size, camera_from_world)
    directions = _rotate_to_world(_invert_fisheye(distorted_points, distortion), camera_from_world)
    start = Cahvore.from_cahv(linear, r=(0.0, distortion[0], distortion[1]), linearity=0.0)

    def modify_camera(change: Array) -> Cahvore:
        """Scale the focal lengths, and change rho1, rho2 and the linearity."""
        (hc, vc), a, scale = start.image_centre, start.a, float(change[0])
        h, v = start.h + scale * (start.h - hc * a), start.v + scale * (start.v - vc * a)
        return replace(start, h=h, v=v, r=start.r + np.array([0.0, *change[1:3]]), linearity=float(change[3]))

    limits, scales = np.array([0.5, 10.0, 10.0, 1.0]), np.array([1e-3, 1e-3, 1e-3, 1e-1])  # of the changes
    return _fit_camera(start, modify_camera, (directions, pixels), scales, bounds=(-limits, limits))


def _fit_camera(
    start: C, modify_camera: Callable[[Array], C], samples: tuple[Array, Array], scales: Array, **options: Any
) -> tuple[C, Residual]:
    """Fit the changes of `modify_camera` to samples (directions, pixels); `scales`: typical sizes of changes."""
    directions, pixels = samples
    residual = _compute_residual(_project_directions(start, directions) - pixels)
    if residual.max_px <= _EXACT_PX:
        return start, residual

    def compute_differences(change: Array) -> Array:
        projected = _project_directions(modify_camera(change), directions)
        return np.nan_to_num(projected - pixels, nan=_INVISIBLE_PX).ravel()

    fit = least_squares(compute_differences, np.zeros(len(scales)), x_scale=scales, xtol=1e-14, ftol=1e-14, **options)
    camera = modify_camera(np.asarray(fit.x))
    return camera, _compute_residual(_project_directions(camera, directions) - pixels)


def _create_linear_camera(
    matrix: Array, size: tuple[int, int], camera_from_world: RigidTransform | None
) -> tuple[Cahv, Array, Array]:
    """Create the camera without distortion, a grid of pixels, and their points (x, y) in the plane z = 1."""
    has_allowed_form = matrix[1, 0] == 0 and np.array_equal(matrix[2], [0.0, 0.0, 1.0])
    if not (has_allowed_form and matrix[0, 0] > 0 and matrix[1, 1] > 0):
        raise ValueError("matrix must be ((fx, skew, cx), (0, fy, cy), (0, 0, 1)) with fx and fy positive")
    world_from_camera = np.eye(4) if camera_from_world is None else camera_from_world.inv().as_matrix()
    rotation = world_from_camera[:3, :3]
    columns, rows = (np.linspace(-0.5, extent - 0.5, _SAMPLES_PER_SIDE) for extent in size)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    y = (pixels[:, 1] - matrix[1, 2]) / matrix[1, 1]
    points = np.stack([(pixels[:, 0] - matrix[0, 2] - matrix[0, 1] * y) / matrix[0, 0], y], axis=-1)
    linear = Cahv(world_from_camera[:3, 3], rotation[:, 2], rotation @ matrix[0], rotation @ matrix[1], size)
    return linear, pixels, points


def _invert_fisheye(points: Array, coefficients: Array) -> Array:
    """Invert OpenCV's fisheye model by Newton's method: directions (z is the axis) of points (x, y), shape (n, 2)."""
    distance = np.hypot(points[:, 0], points[:, 1])
    theta = np.minimum(distance, np.pi)
    for _ in range(50):
        gain, slope = _compute_fisheye_gain(theta, coefficients)
        step = (theta * gain - distance) / slope
        theta = np.clip(theta - step, 0.0, np.pi)
        if np.max(np.abs(step)) < 1e-14:
            break
    angles = np.linspace(0.0, float(theta.max()), 1000)
    recomputed_distance = theta * _compute_fisheye_gain(theta, coefficients)[0]
    if not (
        np.max(np.abs(recomputed_distance - distance)) < 1e-9
        and np.all(_compute_fisheye_gain(angles, coefficients)[1] > 0)
    ):
        raise ValueError("the distortion folds over within the frame: some pixels have no direction, or several")
    scale = np.divide(np.sin(theta), distance, out=np.ones_like(theta), where=distance > 0)
    return np.stack([points[:, 0] * scale, points[:, 1] * scale, np.cos(theta)], axis=-1)


def _rotate_to_world(directions: Array, camera_from_world: RigidTransform | None) -> Array:
    return directions if camera_from_world is None else directions @ camera_from_world.as_matrix()[:3, :3]


def _project_directions(camera: CameraModel, directions: Array) -> Array:
    """Project the points C + direction; their distance has no effect, because the entrance pupil does not move."""
    return camera.project(camera.c + directions)[0]


def _invert_pinhole_distortion(distorted_points: Array, coefficients: Array) -> Array:
    """Invert the pinhole distortion by Newton's method in two dimensions."""
    points = distorted_points.copy()
    for _ in range(50):
        image, slope = _apply_pinhole_distortion(points, coefficients)
        step = np.linalg.solve(slope, (image - distorted_points)[..., np.newaxis])[..., 0]
        points -= step
        if np.max(np.abs(step)) < 1e-14:
            break
    image, slope = _apply_pinhole_distortion(points, coefficients)
    if not (np.max(np.abs(image - distorted_points)) < 1e-9 and np.all(np.linalg.det(slope) > 0)):
        raise ValueError("the distortion folds over within the frame: some pixels have no direction, or several")
    return points


def _apply_pinhole_distortion(points: Array, coefficients: Array) -> tuple[Array, Array]:
    """Apply OpenCV's pinhole distortion to (x, y), shape (n, 2); return also its derivative, shape (n, 2, 2)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    x, y = points.T
    r2 = x * x + y * y
    numerator = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    denominator = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    gain = numerator / denominator
    slope = (k1 + r2 * (2 * k2 + r2 * 3 * k3) - gain * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / denominator
    mixed_derivative = 2 * (x * y * slope + p1 * x + p2 * y)
    distorted_points = np.stack(
        [x * gain + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * gain + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], axis=-1
    )
    derivative_x = np.stack([gain + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x, mixed_derivative], axis=-1)
    derivative_y = np.stack([mixed_derivative, gain + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x], axis=-1)
    return distorted_points, np.stack([derivative_x, derivative_y], axis=-2)


def _compute_fisheye_gain(theta: Array, coefficients: Array) -> tuple[Array, Array]:
    """Compute d(theta) / theta for the image distance d of OpenCV's fisheye model, and the derivative of d."""
    k1, k2, k3, k4 = coefficients
    theta2 = theta * theta
    gain = 1 + theta2 * (k1 + theta2 * (k2 + theta2 * (k3 + theta2 * k4)))
    return gain, 1 + theta2 * (3 * k1 + theta2 * (5 * k2 + theta2 * (7 * k3 + theta2 * 9 * k4)))


def _compute_residual(differences: Array) -> Residual:
    """Compute RMS and maximum of the lengths of pixel differences, shape (n, 2)."""
    squares = np.sum(differences * differences, axis=-1)
    return Residual(rms_px=float(np.sqrt(np.mean(squares))), max_px=float(np.sqrt(np.max(squares))))
