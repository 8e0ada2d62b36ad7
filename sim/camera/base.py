"""Base class of the CAHV camera models: image plane, rigid motion, binning, scaling and cropping.

The vectors of a camera, the points to project and the rays are in one frame of reference (world frame, body frame or
the rover frame of a label), metres. Pixels are (u, v): u is the column, to the right, and v the row, down. The centre
of the upper left pixel is (0, 0).

A point P' (after distortion, if any) is projected to the pixel (Yakimovsky & Cunningham 1978)

    u = (P' - C).H / (P' - C).A        v = (P' - C).V / (P' - C).A

where H = hs H' + hc A and V = vs V' + vc A. H' and V' are unit vectors in the directions of growing u and growing v,
hs and vs are the focal lengths in pixels, and (hc, vc) is the image centre. H' and V' need not be perpendicular, and
H', V', A need not form a right-handed frame.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, TypeVar, cast

import numpy as np
from jaxtyping import Bool, Float, Num
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.frames import rigid

Vector = NDArray[np.float64]
#: Type of number arguments: the run-time type checks do not accept an integer for a float.
Number = float | int
#: Three components, as an array or a tuple.
Vector3Like = Num[np.ndarray, "3"] | tuple[Number, Number, Number]
#: Components x, y and z of n vectors (points, directions or gradients), shape (n,) each.
Components = tuple[Vector, Vector, Vector]

#: Tolerance on the length of A and O: labels round them to six digits or fewer.
UNIT_TOLERANCE = 1e-4
#: Points per block: a block fits into the processor's cache, and NumPy's overhead per call is small against its work.
_BLOCK_POINTS = 16384

M = TypeVar("M", bound="CameraModel")  # beartype does not support typing.Self


class CameraModel(ABC):
    """A camera of the CAHV family: `Cahv`, `Cahvor` or `Cahvore`; all are immutable.

    - c: centre of projection C, metres
    - a: unit vector A, perpendicular to the image plane and pointing into the scene
    - h, v: horizontal and vertical image vectors H and V, pixels
    - size: (columns, rows) of the image
    """

    c: Float[np.ndarray, "3"]
    a: Float[np.ndarray, "3"]
    h: Float[np.ndarray, "3"]
    v: Float[np.ndarray, "3"]
    size: tuple[int, int]

    # ----- implemented by each model: x, y, z are the coordinates of P - C; all arrays have the shape (n,) -----

    @abstractmethod
    def _compute_pixels(self, x: Vector, y: Vector, z: Vector) -> tuple[Vector, Vector, NDArray[np.bool_]]:
        """Compute columns and rows, and whether each point lies in the valid range of the lens."""

    @abstractmethod
    def _compute_gradients(self, x: Vector, y: Vector, z: Vector) -> tuple[Components, Components]:
        """Compute the derivatives of column and row with respect to x, y and z."""

    @abstractmethod
    def _compute_rays(self, u: Vector, v: Vector) -> tuple[Components, Vector | None]:
        """Compute directions (of any length) of pixels, and the rays' origins minus C, (n, 3); None if they are C."""

    def project(
        self, points: Float[np.ndarray, "*batch 3"]
    ) -> tuple[Float[np.ndarray, "*batch 2"], Bool[np.ndarray, "*batch"]]:
        """Project points (metres) to pixels (u, v) and report whether they are visible.

        A point is visible if it lies in front of the camera, the distortion is one-to-one there, and its coordinates
        are finite. The pixels of the other points are NaN. Points outside the frame can be visible in this sense; use
        ``visible & camera.in_frame(pixels)`` to exclude them.
        """
        flat = points.reshape(-1, 3)
        pixels = np.empty((len(flat), 2))
        visible = np.empty(len(flat), dtype=np.bool_)
        with np.errstate(all="ignore"):
            for block in _split_into_blocks(len(flat)):
                u, v, is_valid = self._compute_pixels(*self._subtract_centre(flat[block]))
                pixels[block, 0], pixels[block, 1] = u, v
                visible[block] = is_valid & np.isfinite(u) & np.isfinite(v)
        pixels[~visible] = np.nan
        return pixels.reshape(*points.shape[:-1], 2), visible.reshape(points.shape[:-1])

    def projection_jacobian(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2 3"]:
        """Return the Jacobian of the pixels with respect to the points, pixels per metre; NaN for invisible points."""
        flat = points.reshape(-1, 3)
        jacobian = np.empty((len(flat), 2, 3))
        with np.errstate(all="ignore"):
            for block in _split_into_blocks(len(flat)):
                coordinates = self._subtract_centre(flat[block])
                jacobian[block] = np.moveaxis(np.array(self._compute_gradients(*coordinates)), -1, 0)
                jacobian[block][~self._compute_pixels(*coordinates)[2]] = np.nan
        return jacobian.reshape(*points.shape[:-1], 2, 3)

    def rays(
        self, pixels: Float[np.ndarray, "*batch 2"]
    ) -> tuple[Float[np.ndarray, "*batch 3"], Float[np.ndarray, "*batch 3"]]:
        """Return the origins (metres) and unit directions of the rays of pixels.

        Pixels may be fractional or outside the frame. The origin is C; for `Cahvore` it lies on the optical axis
        through C and depends on the pixel. The array of origins may be read-only. Directions are NaN for pixels beyond
        the valid range of the distortion.
        """
        flat = pixels.reshape(-1, 2)
        directions = np.empty((len(flat), 3))
        origins = np.broadcast_to(self.c, (len(flat), 3))
        with np.errstate(all="ignore"):
            for block in _split_into_blocks(len(flat)):
                (x, y, z), offset = self._compute_rays(*np.array(flat[block].T, dtype=np.float64, order="C"))
                length = np.sqrt(x * x + y * y + z * z)
                directions[block, 0], directions[block, 1], directions[block, 2] = x / length, y / length, z / length
                if offset is not None:
                    origins = origins if origins.flags.writeable else np.empty((len(flat), 3))
                    origins[block] = self.c + offset
        shape = (*pixels.shape[:-1], 3)
        return origins.reshape(shape), directions.reshape(shape)

    def in_frame(self, pixels: Float[np.ndarray, "*batch 2"]) -> Bool[np.ndarray, "*batch"]:
        """Return whether -0.5 <= u < columns - 0.5 and -0.5 <= v < rows - 0.5; False for NaN."""
        return np.asarray(np.all((pixels >= -0.5) & (pixels < np.array(self.size) - 0.5), axis=-1))

    def pixel_grid(self) -> Float[np.ndarray, "rows columns 2"]:
        """Return (u, v) of every pixel's centre."""
        columns, rows = self.size
        return np.stack(np.meshgrid(np.arange(columns, dtype=np.float64), np.arange(rows, dtype=np.float64)), axis=-1)

    def transform(self: M, new_from_old: RigidTransform) -> M:
        """Return the camera after a rigid motion: ``transform(T).project(T.apply(points))`` equals ``project(points)``.

        If the camera is in the body frame, ``transform(world_from_body)`` is the camera in the world frame. Raises
        ValueError if `new_from_old` contains more than one transform.
        """
        if not new_from_old.single:
            raise ValueError("a camera is transformed by a single transform, not by an array of transforms")
        matrix = new_from_old.as_matrix()
        vectors = {name: matrix[:3, :3] @ getattr(self, name) for name in self._vectors if name in "ahvo"}
        return self._with(c=matrix[:3, :3] @ self.c + matrix[:3, 3], **vectors)

    def bin(self: M, columns: int, rows: int) -> M:
        """Return the camera of the binned image: each block of `columns` x `rows` pixels becomes one pixel.

        Column u becomes (u - (columns - 1) / 2) / columns, row v becomes (v - (rows - 1) / 2) / rows. Raises ValueError
        if a factor is not positive or does not divide the image's size (crop first).
        """
        for factor, extent, name in ((columns, self.size[0], "columns"), (rows, self.size[1], "rows")):
            if factor < 1 or extent % factor:
                raise ValueError(f"cannot bin {extent} {name} by {factor}: the factor must be positive and divide them")
        return self._with_image_map(
            (1 / columns, 1 / rows),
            (-(columns - 1) / (2 * columns), -(rows - 1) / (2 * rows)),
            (self.size[0] // columns, self.size[1] // rows),
        )

    def scale(self: M, factor: Number) -> M:
        """Return the camera of the resized image: u becomes (u + 0.5) * factor - 0.5; ValueError if factor <= 0."""
        if not (np.isfinite(factor) and factor > 0):
            raise ValueError(f"the factor of an image's scale must be positive and finite, not {factor}")
        scale, (columns, rows) = float(factor), self.size
        shift = 0.5 * scale - 0.5
        return self._with_image_map((scale, scale), (shift, shift), (round(columns * factor), round(rows * factor)))

    def crop(self: M, column: int, row: int, size: tuple[int, int]) -> M:
        """Return the camera of the part of the image with upper left pixel (column, row). Raises ValueError outside."""
        if column < 0 or row < 0 or column + size[0] > self.size[0] or row + size[1] > self.size[1]:
            crop, frame = (f"{columns} x {rows}" for columns, rows in (size, self.size))
            raise ValueError(f"a crop of {crop} pixels at ({column}, {row}) extends beyond the frame of {frame}")
        return self._with_image_map((1.0, 1.0), (-float(column), -float(row)), size)

    def magnify(self: M, factor: Number) -> M:
        """Return the camera with its focal lengths multiplied by `factor`; its image centre is unchanged."""
        column, row = self.image_centre
        h = self.h + (factor - 1.0) * (self.h - column * self.a)
        return self._with(h=h, v=self.v + (factor - 1.0) * (self.v - row * self.a))

    def recentre(self: M, columns: Number, rows: Number) -> M:
        """Return the camera whose images are shifted by `columns` pixels to the right and `rows` pixels down."""
        return self._with(h=self.h + columns * self.a, v=self.v + rows * self.a)

    def _with_image_map(self: M, scale: tuple[float, float], shift: tuple[float, float], size: tuple[int, int]) -> M:
        """Return the camera whose pixels are scale * pixel + shift, for columns and rows separately."""
        return self._with(h=scale[0] * self.h + shift[0] * self.a, v=scale[1] * self.v + shift[1] * self.a, size=size)

    def _with(self: M, **changes: Any) -> M:
        """Return a copy in which these fields have new values."""
        return cast(M, replace(cast(Any, self), **changes))

    @property
    def image_centre(self) -> tuple[float, float]:
        """Image centre (hc, vc): the pixel of the direction A before distortion."""
        scale = self.a @ self.a
        return float(self.a @ self.h / scale), float(self.a @ self.v / scale)

    @property
    def focal_lengths(self) -> tuple[float, float]:
        """Focal lengths (hs, vs): the focal length divided by the pixel pitch along a row and along a column."""
        hs, vs = (float(np.linalg.norm(_cross(self.a, vector)) / (self.a @ self.a)) for vector in (self.h, self.v))
        return hs, vs

    @property
    def right(self) -> Float[np.ndarray, "3"]:
        """Unit vector H', perpendicular to A, along which u grows."""
        return _normalise(self.h - self.image_centre[0] * self.a)

    @property
    def down(self) -> Float[np.ndarray, "3"]:
        """Unit vector V', perpendicular to A, along which v grows."""
        return _normalise(self.v - self.image_centre[1] * self.a)

    @property
    def theta(self) -> float:
        """Angle from V' to H' about A, radians: -pi/2 if the axes are perpendicular; positive for mirrored images."""
        right, down = self.right, self.down
        return float(np.arctan2(self.a @ np.cross(down, right), down @ right))

    def corner_rays(self) -> tuple[Float[np.ndarray, "4 3"], Float[np.ndarray, "4 3"]]:
        """Return the `rays` of the frame's four outer corners, clockwise from the upper left one at (-0.5, -0.5)."""
        return self.rays(self.border(1))

    def boresight(self) -> Float[np.ndarray, "3"]:
        """Return the unit direction of the ray through the middle of the frame."""
        return self.rays(np.array([(self.size[0] - 1) / 2, (self.size[1] - 1) / 2]))[1]

    @property
    def pixel_angle_rad(self) -> float:
        """Mean angle of one pixel along columns and rows at the middle of the frame."""
        centre = (np.array(self.size) - 1) / 2.0
        _, directions = self.rays(centre + np.array([[-0.5, 0.0], [0.5, 0.0], [0.0, -0.5], [0.0, 0.5]]))
        return float(np.linalg.norm(directions[[1, 3]] - directions[[0, 2]], axis=1).mean())

    def border(self, steps: int) -> Float[np.ndarray, "pixels 2"]:
        """Return points (u, v) on the frame's outer edge, clockwise from the upper left, `steps` on each side."""
        right, bottom = self.size[0] - 0.5, self.size[1] - 0.5
        corners = np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom], [-0.5, -0.5]])
        fractions = np.arange(steps)[:, np.newaxis] / steps
        return np.concatenate([start + fractions * (end - start) for start, end in pairwise(corners)])

    @property
    def _vectors(self) -> str:
        """Names of the model's vectors: the letters of its name; "a", "h", "v" and "o" are directions."""
        return type(self).__name__.lower()

    def __post_init__(self) -> None:
        for name in self._vectors:
            # the sum is a copy, and converts -0.0 to 0.0, so that equal cameras have equal hashes
            vector = np.asarray(getattr(self, name), dtype=np.float64) + 0.0
            if vector.shape != (3,):
                raise ValueError(f"{name} must have three components, not shape {vector.shape}")
            if not np.all(np.isfinite(vector)):
                raise ValueError(f"{name} must be finite, not {vector.tolist()}")
            vector.flags.writeable = False
            object.__setattr__(self, name, vector)
        columns, rows = self.size
        if int(columns) != columns or int(rows) != rows or columns < 1 or rows < 1:
            raise ValueError(f"size must be two positive integers (columns, rows), not {self.size}")
        object.__setattr__(self, "size", (int(columns), int(rows)))
        length = float(np.linalg.norm(self.a))
        if abs(length - 1) > UNIT_TOLERANCE:
            raise ValueError(f"a must be a unit vector (to {UNIT_TOLERANCE:g}); its length is {length!r}")
        if not abs(self._determinant) > 1e-9 * float(np.linalg.norm(self.h) * np.linalg.norm(self.v)):
            raise ValueError("h and v must span an image plane with a: the three must be linearly independent")

    def _fields(self) -> Mapping[str, Any]:
        """Return the values of all fields, which define equality, hash and pickling."""
        return {field.name: getattr(self, field.name) for field in fields(cast(Any, self))}

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return all(np.array_equal(value, getattr(other, name)) for name, value in self._fields().items())

    def __hash__(self) -> int:
        values = (value.tobytes() if isinstance(value, np.ndarray) else value for value in self._fields().values())
        return hash((type(self), *values))

    def __reduce__(self) -> tuple[Callable[..., CameraModel], tuple[()]]:
        return partial(type(self), **self._fields()), ()

    @cached_property
    def _determinant(self) -> float:
        return float(self.a @ _cross(self.h, self.v))

    @cached_property
    def _direction_from_pixel(self) -> NDArray[np.float64]:
        """Matrix that maps (u, v, 1) to the vector d with d.A = 1, d.H = u, d.V = v."""
        columns = (_cross(self.v, self.a), _cross(self.a, self.h), _cross(self.h, self.v))
        return np.stack(columns, axis=1) / self._determinant

    def _subtract_centre(self, points: NDArray[Any]) -> Components:
        x, y, z = points.T
        return x - self.c[0], y - self.c[1], z - self.c[2]

    def _compute_linear_directions(self, u: Vector, v: Vector) -> Components:
        """Compute the directions of pixels of the camera without distortion."""
        matrix = self._direction_from_pixel
        x, y, z = (matrix[i, 0] * u + matrix[i, 1] * v + matrix[i, 2] for i in range(3))
        return x, y, z


def mount_looking_down(camera: CameraModel) -> CameraModel:
    """Move a camera to the origin with A along -z, u growing along +x. Raises ValueError if its image is mirrored."""
    if not camera.theta < 0:
        raise ValueError("the camera's image is mirrored: u right, v down and A forward must be right-handed")
    axis = _normalise(camera.a)
    right = _normalise(camera.right - (camera.right @ axis) * axis)
    rotation = Rotation.from_matrix(np.stack([right, np.cross(right, axis), -axis]))
    return camera.transform(RigidTransform.from_components(-rotation.apply(camera.c.copy()), rotation))


def camera_pose(camera: CameraModel) -> RigidTransform:
    """Transform from the camera frame (columns right, rows down, optical axis forward) to the camera model's frame."""
    axes = np.column_stack([camera.right, np.cross(camera.a, camera.right), camera.a])
    return rigid(Rotation.from_matrix(axes), np.array(camera.c))


def dot(vector: Vector, x: Vector, y: Vector, z: Vector) -> Vector:
    """Compute the scalar products of one vector with n vectors; each is bit-identical for any n (unlike with BLAS)."""
    return np.asarray(vector[0] * x + vector[1] * y + vector[2] * z)


def _cross(first: Vector, second: Vector) -> Vector:
    """Compute the vector product of two vectors, five times faster than `numpy.cross`."""
    a, b, c = first.tolist()
    x, y, z = second.tolist()
    return np.array([b * z - c * y, c * x - a * z, a * y - b * x])


def _normalise(vector: Vector) -> Vector:
    return np.asarray(vector / np.linalg.norm(vector))


def _split_into_blocks(count: int) -> list[slice]:
    return [slice(start, min(start + _BLOCK_POINTS, count)) for start in range(0, count, _BLOCK_POINTS)]
