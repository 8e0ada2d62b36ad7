"""What every camera model of the CAHV family shares: image plane, rigid motion, changes of the image.

Vectors and pixels
------------------
A camera holds its vectors in one frame of reference (the world's, a body's, a label's rover frame); points given to it
and rays got from it are in that same frame, metres. Pixels are (u, v): column to the right, row down, the centre of the
upper left pixel at (0, 0).

The image plane is that of Yakimovsky & Cunningham 1978: a point P' (after distortion, if any) falls on

    u = (P' - C).H / (P' - C).A        v = (P' - C).V / (P' - C).A

so that H = hs H' + hc A and V = vs V' + vc A, with H' and V' the unit vectors of the image's columns and rows, hs and
vs the focal lengths in pixels and (hc, vc) the image centre. Nothing assumes that H' and V' are perpendicular, or that
the three are right-handed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, TypeVar, cast

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from marsyard.sim.camera.vectors import Gradient, Real, Vector, blocks, checked_size, cross, frozen_vector, unit

#: Labels round A and O to six digits or fewer.
UNIT_TOLERANCE = 1e-4


M = TypeVar("M", bound="CameraModel")  # beartype does not know typing.Self


class CameraModel(ABC):
    """A camera of the CAHV family. `Cahv`, `Cahvor` and `Cahvore` are its final forms; all are immutable.

    Attributes
    ----------
    c
        Centre of projection C, metres, shape (3,).
    a
        Unit vector A, perpendicular to the image plane and pointing into the scene, shape (3,).
    h, v
        Horizontal and vertical image vectors H and V, pixels, shape (3,).
    size
        (columns, rows) of the image.
    """

    c: Float[np.ndarray, "3"]
    a: Float[np.ndarray, "3"]
    h: Float[np.ndarray, "3"]
    v: Float[np.ndarray, "3"]
    size: tuple[int, int]

    # ----- what a model defines: x, y, z are the coordinates of P - C, all arguments and results of shape (n,) -----

    @abstractmethod
    def _image(self, x: Vector, y: Vector, z: Vector) -> tuple[Vector, Vector, NDArray[np.bool_]]:
        """Columns, rows and whether the optics can image the point."""

    @abstractmethod
    def _image_gradient(self, x: Vector, y: Vector, z: Vector) -> tuple[Gradient, Gradient]:
        """Derivatives of column and row with respect to x, y and z."""

    @abstractmethod
    def _sight(self, u: Vector, v: Vector) -> tuple[Gradient, Vector | None]:
        """Direction (of any length) of a pixel, and how far along `_pupil_axis` its ray starts (None: at C)."""

    @property
    def _pupil_axis(self) -> Vector:
        return self.a

    # ----- projection -----

    def project(
        self, points: Float[np.ndarray, "*batch 3"]
    ) -> tuple[Float[np.ndarray, "*batch 2"], Bool[np.ndarray, "*batch"]]:
        """Pixels of points.

        Parameters
        ----------
        points
            Points in the camera's frame of reference, metres, shape (..., 3).

        Returns
        -------
        pixels
            (u, v), shape (..., 2); NaN where not visible.
        visible
            Whether the optics image the point, shape (...): it lies before the image plane, within the range in which
            the distortion is one-to-one, and its coordinates are finite. It says nothing of the frame's border:
            ``visible & camera.in_frame(pixels)`` does.
        """
        flat = points.reshape(-1, 3)
        pixels = np.empty((len(flat), 2))
        visible = np.empty(len(flat), dtype=np.bool_)
        with np.errstate(all="ignore"):
            for block in blocks(len(flat)):
                u, v, seen = self._image(*self._from_centre(flat[block]))
                pixels[block, 0] = u
                pixels[block, 1] = v
                visible[block] = seen & np.isfinite(u) & np.isfinite(v)
        pixels[~visible] = np.nan
        return pixels.reshape(*points.shape[:-1], 2), visible.reshape(points.shape[:-1])

    def projection_jacobian(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2 3"]:
        """Derivative of `project`'s pixels with respect to the points, pixels per metre, shape (..., 2, 3).

        NaN where the point is not visible.
        """
        flat = points.reshape(-1, 3)
        jacobian = np.empty((len(flat), 2, 3))
        with np.errstate(all="ignore"):
            for block in blocks(len(flat)):
                coordinates = self._from_centre(flat[block])
                for row, gradient in enumerate(self._image_gradient(*coordinates)):
                    for column, derivative in enumerate(gradient):
                        jacobian[block, row, column] = derivative
                jacobian[block][~self._image(*coordinates)[2]] = np.nan
        return jacobian.reshape(*points.shape[:-1], 2, 3)

    def rays(
        self, pixels: Float[np.ndarray, "*batch 2"]
    ) -> tuple[Float[np.ndarray, "*batch 3"], Float[np.ndarray, "*batch 3"]]:
        """Lines of sight of pixels, which may lie between pixel centres and outside the frame.

        Parameters
        ----------
        pixels
            (u, v), shape (..., 2).

        Returns
        -------
        origins
            Where each ray starts, metres, shape (..., 3): C, moved along the optical axis by `Cahvore`.
            May be read-only.
        directions
            Unit vectors, shape (..., 3); NaN where no ray reaches the pixel (the distortion's range ends before it).
        """
        flat = pixels.reshape(-1, 2)
        directions = np.empty((len(flat), 3))
        origins: NDArray[np.float64] | None = None
        with np.errstate(all="ignore"):
            for block in blocks(len(flat)):
                u, v = np.array(flat[block].T, dtype=np.float64, order="C")
                sight, shift = self._sight(u, v)
                length = np.sqrt(sight[0] * sight[0] + sight[1] * sight[1] + sight[2] * sight[2])
                for column, component in enumerate(sight):
                    directions[block, column] = component / length
                if shift is not None:
                    origins = np.empty((len(flat), 3)) if origins is None else origins
                    origins[block] = self.c + shift[:, np.newaxis] * self._pupil_axis
        if origins is None:
            origins = np.broadcast_to(self.c, (len(flat), 3))
        shape = (*pixels.shape[:-1], 3)
        return origins.reshape(shape), directions.reshape(shape)

    def in_frame(self, pixels: Float[np.ndarray, "*batch 2"]) -> Bool[np.ndarray, "*batch"]:
        """Whether pixels lie in the frame, -0.5 <= u < columns - 0.5 and the same for rows; false for NaN."""
        u, v = pixels[..., 0], pixels[..., 1]
        inside = (u >= -0.5) & (u < self.size[0] - 0.5) & (v >= -0.5) & (v < self.size[1] - 0.5)
        return np.asarray(inside)

    def pixel_grid(self) -> Float[np.ndarray, "rows columns 2"]:
        """(u, v) of every pixel's centre, shape (rows, columns, 2)."""
        columns, rows = self.size
        return np.stack(np.meshgrid(np.arange(columns, dtype=np.float64), np.arange(rows, dtype=np.float64)), axis=-1)

    # ----- motion and changes of the image -----

    def moved(self: M, new_from_old: RigidTransform) -> M:
        """The camera after a rigid motion: ``moved(T).project(T.apply(points))`` equals ``project(points)``.

        With the camera in the body frame, ``moved(world_from_body)`` is the camera in the world.

        Raises
        ------
        ValueError
            If `new_from_old` holds more than one transform.
        """
        if not new_from_old.single:
            raise ValueError("a camera moves by a single transform, not by an array of them")
        matrix = new_from_old.as_matrix()
        turned = {name: matrix[:3, :3] @ getattr(self, name) for name in ("a", "h", "v", "o") if hasattr(self, name)}
        return self._with(c=matrix[:3, :3] @ self.c + matrix[:3, 3], **turned)

    def binned(self: M, columns: int, rows: int) -> M:
        """The camera of an image in which blocks of `columns` x `rows` pixels are summed or averaged into one.

        Column u becomes (u - (columns - 1) / 2) / columns, and rows likewise.

        Raises
        ------
        ValueError
            If a factor is not positive, or does not divide the image's size (crop first).
        """
        for factor, extent, name in ((columns, self.size[0], "columns"), (rows, self.size[1], "rows")):
            if factor < 1 or extent % factor:
                raise ValueError(f"cannot bin {extent} {name} by {factor}: the factor must be positive and divide them")
        return self._with_image_map(
            (1 / columns, 1 / rows),
            (-(columns - 1) / (2 * columns), -(rows - 1) / (2 * rows)),
            (self.size[0] // columns, self.size[1] // rows),
        )

    def scaled(self: M, factor: Real) -> M:
        """The camera of the image resized by `factor`: u becomes (u + 0.5) * factor - 0.5.

        The new size is the old one times `factor`, rounded to the nearest integer; the scale is `factor` all the same.

        Raises
        ------
        ValueError
            If `factor` is not positive and finite, or leaves no pixel.
        """
        if not (np.isfinite(factor) and factor > 0):
            raise ValueError(f"an image is scaled by a positive, finite factor, not {factor}")
        scale = float(factor)
        shift = 0.5 * scale - 0.5
        size = (round(self.size[0] * factor), round(self.size[1] * factor))
        return self._with_image_map((scale, scale), (shift, shift), size)

    def cropped(self: M, column: int, row: int, size: tuple[int, int]) -> M:
        """The camera of a part of the image, given its upper left pixel (column, row) and its size (columns, rows).

        Raises
        ------
        ValueError
            If the part is empty or leaves the frame.
        """
        if column < 0 or row < 0 or column + size[0] > self.size[0] or row + size[1] > self.size[1]:
            raise ValueError(
                f"a crop of {size[0]} x {size[1]} pixels at ({column}, {row}) leaves the frame of "
                f"{self.size[0]} x {self.size[1]}"
            )
        return self._with_image_map((1.0, 1.0), (-float(column), -float(row)), size)

    def magnified(self: M, factor: Real) -> M:
        """The camera with its focal lengths scaled about its image centre."""
        column, row = self.image_centre
        h = self.h + (factor - 1.0) * (self.h - column * self.a)
        return self._with(h=h, v=self.v + (factor - 1.0) * (self.v - row * self.a))

    def recentred(self: M, columns: Real, rows: Real) -> M:
        """The camera whose pictures are moved by so much to the right and down."""
        return self._with(h=self.h + columns * self.a, v=self.v + rows * self.a)

    def _with_image_map(self: M, scale: tuple[float, float], shift: tuple[float, float], size: tuple[int, int]) -> M:
        """The camera whose pixels are scale * pixel + shift."""
        return self._with(h=scale[0] * self.h + shift[0] * self.a, v=scale[1] * self.v + shift[1] * self.a, size=size)

    def _with(self: M, **changes: Any) -> M:
        return cast(M, replace(cast(Any, self), **changes))

    # ----- derived quantities -----

    @property
    def image_centre(self) -> tuple[float, float]:
        """(hc, vc): the pixel in which the direction A falls before distortion."""
        scale = self.a @ self.a
        return float(self.a @ self.h / scale), float(self.a @ self.v / scale)

    @property
    def focal_lengths(self) -> tuple[float, float]:
        """(hs, vs): the focal length in units of a column's width and of a row's height."""
        scale = self.a @ self.a
        return (
            float(np.linalg.norm(np.cross(self.a, self.h)) / scale),
            float(np.linalg.norm(np.cross(self.a, self.v)) / scale),
        )

    @property
    def right(self) -> Float[np.ndarray, "3"]:
        """Unit vector H', perpendicular to A, along which u grows."""
        return unit(self.h - self.image_centre[0] * self.a)

    @property
    def down(self) -> Float[np.ndarray, "3"]:
        """Unit vector V', perpendicular to A, along which v grows."""
        return unit(self.v - self.image_centre[1] * self.a)

    @property
    def theta(self) -> float:
        """Angle from V' to H' about A, radians: -pi/2 for square axes, +pi/2 if they are mirrored."""
        right, down = self.right, self.down
        return float(np.arctan2(self.a @ np.cross(down, right), down @ right))

    @property
    def right_handed(self) -> bool:
        """Whether u right, v down and A forward are right-handed, as in any picture that is not mirrored."""
        return self.theta < 0

    def corner_rays(self) -> tuple[Float[np.ndarray, "4 3"], Float[np.ndarray, "4 3"]]:
        """`rays` of the frame's outer corners (half a pixel beyond the centres), clockwise from the upper left."""
        right, bottom = self.size[0] - 0.5, self.size[1] - 0.5
        return self.rays(np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]]))

    def boresight(self) -> Float[np.ndarray, "3"]:
        """Unit direction in which the middle of the frame looks."""
        return self.rays(np.array([(self.size[0] - 1) / 2, (self.size[1] - 1) / 2]))[1]

    def half_angle(self) -> float:
        """Half angle of the cone about `boresight` that holds the whole frame, radians; NaN if any of it is blind."""
        directions = self.rays(self.border(64))[1]
        axis = self.boresight()
        across = np.linalg.norm(np.cross(directions, axis), axis=-1)
        return float(np.max(np.arctan2(across, directions @ axis)))

    def border(self, steps: int) -> Float[np.ndarray, "pixels 2"]:
        """Pixels along the frame's outer edge, clockwise from the upper left, `steps` on each side."""
        right, bottom = self.size[0] - 0.5, self.size[1] - 0.5
        corners = np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom], [-0.5, -0.5]])
        along = np.arange(steps)[:, np.newaxis] / steps
        return np.concatenate([start + along * (end - start) for start, end in pairwise(corners)])

    # ----- construction, comparison, storage -----

    def __post_init__(self) -> None:
        for field in fields(cast(Any, self)):
            if field.name not in ("size", "linearity"):
                object.__setattr__(self, field.name, frozen_vector(field.name, getattr(self, field.name)))
        object.__setattr__(self, "size", checked_size(self.size))
        length = float(np.linalg.norm(self.a))
        if abs(length - 1) > UNIT_TOLERANCE:
            raise ValueError(f"a must be a unit vector (to {UNIT_TOLERANCE:g}); its length is {length!r}")
        if not abs(self._determinant) > 1e-9 * float(np.linalg.norm(self.h) * np.linalg.norm(self.v)):
            raise ValueError("h and v must span an image plane with a: the three must be linearly independent")

    def _fields(self) -> Mapping[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(cast(Any, self))}

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        theirs = other._fields()
        return all(np.array_equal(value, theirs[name]) for name, value in self._fields().items())

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        values = (value.tobytes() if isinstance(value, np.ndarray) else value for value in self._fields().values())
        return hash((type(self), *values))

    def __reduce__(self) -> tuple[Callable[..., CameraModel], tuple[type[CameraModel], Mapping[str, Any]]]:
        return _rebuilt, (type(self), self._fields())

    # ----- linear algebra shared by the models -----

    @cached_property
    def _determinant(self) -> float:
        return float(self.a @ cross(self.h, self.v))

    @cached_property
    def _direction_from_pixel(self) -> NDArray[np.float64]:
        """Matrix that takes (u, v, 1) to the vector d with d.A = 1, d.H = u, d.V = v."""
        columns = (cross(self.v, self.a), cross(self.a, self.h), cross(self.h, self.v))
        return np.stack(columns, axis=1) / self._determinant

    def _from_centre(self, points: NDArray[Any]) -> Gradient:
        x, y, z = points.T
        return x - self.c[0], y - self.c[1], z - self.c[2]

    def _image_plane_direction(self, u: Vector, v: Vector) -> Gradient:
        m = self._direction_from_pixel
        x, y, z = (m[i, 0] * u + m[i, 1] * v + m[i, 2] for i in range(3))
        return x, y, z


def _rebuilt(model: type[M], values: Mapping[str, Any]) -> M:
    return model(**values)
