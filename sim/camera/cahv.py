"""CAHV: the linear (pinhole) camera of Yakimovsky & Cunningham 1978."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from marsyard.sim.camera.base import CameraModel
from marsyard.sim.camera.vectors import Gradient, Real, Triple, Vector, dot

_ORIGIN = (0.0, 0.0, 0.0)


@final
@dataclass(frozen=True, eq=False)
class Cahv(CameraModel):
    """A pinhole camera. See `CameraModel` for the attributes.

    Raises
    ------
    ValueError
        If a vector is not finite, A is not a unit vector, A, H and V do not span space or the size is not positive.
    """

    c: Float[np.ndarray, "3"]
    a: Float[np.ndarray, "3"]
    h: Float[np.ndarray, "3"]
    v: Float[np.ndarray, "3"]
    size: tuple[int, int]

    def _image(self, x: Vector, y: Vector, z: Vector) -> tuple[Vector, Vector, NDArray[np.bool_]]:
        depth = dot(self.a, x, y, z)
        return dot(self.h, x, y, z) / depth, dot(self.v, x, y, z) / depth, depth > 0

    def _image_gradient(self, x: Vector, y: Vector, z: Vector) -> tuple[Gradient, Gradient]:
        depth = dot(self.a, x, y, z)
        u, v = dot(self.h, x, y, z) / depth, dot(self.v, x, y, z) / depth
        return _gradient(self.h, self.a, u, depth), _gradient(self.v, self.a, v, depth)

    def _sight(self, u: Vector, v: Vector) -> tuple[Gradient, Vector | None]:
        return self._image_plane_direction(u, v), None

    @classmethod
    def from_axes(
        cls,
        focal_lengths: tuple[Real, Real],
        size: tuple[int, int],
        *,
        axis: Triple,
        right: Triple,
        centre: Triple = _ORIGIN,
        image_centre: tuple[Real, Real] | None = None,
    ) -> Cahv:
        """A camera with square axes from its focal lengths (hs, vs) in pixels.

        Parameters
        ----------
        focal_lengths
            (hs, vs), pixels.
        size
            (columns, rows).
        axis
            Direction in which the camera looks, shape (3,); its length does not matter.
        right
            Direction in which columns grow, shape (3,); its part along `axis` is dropped. Rows grow along axis x right.
        centre
            C, metres.
        image_centre
            (hc, vc), pixels; the middle of the frame if not given.

        Raises
        ------
        ValueError
            If a focal length is not positive, or `axis` and `right` are null or parallel.
        """
        if not (np.all(np.isfinite(focal_lengths)) and min(focal_lengths) > 0):
            raise ValueError(f"focal lengths must be positive and finite, not {focal_lengths}")
        forward = _unit("axis", np.asarray(axis, dtype=np.float64))
        across = _unit("right", np.asarray(right, dtype=np.float64))
        perpendicular = across - (across @ forward) * forward
        if np.linalg.norm(perpendicular) < 1e-6:
            raise ValueError("axis and right must not be parallel")
        perpendicular /= np.linalg.norm(perpendicular)
        hc, vc = ((size[0] - 1) / 2, (size[1] - 1) / 2) if image_centre is None else image_centre
        return cls(
            c=np.asarray(centre, dtype=np.float64),
            a=forward,
            h=focal_lengths[0] * perpendicular + hc * forward,
            v=focal_lengths[1] * np.cross(forward, perpendicular) + vc * forward,
            size=size,
        )

    @classmethod
    def from_focal_length(
        cls,
        focal_m: Real,
        pixel_pitch_m: Real | tuple[Real, Real],
        size: tuple[int, int],
        *,
        axis: Triple,
        right: Triple,
        centre: Triple = _ORIGIN,
        image_centre: tuple[Real, Real] | None = None,
    ) -> Cahv:
        """A camera from its focal length and the pitch of its pixels (one, or along columns and rows), both in metres.

        The other parameters and the errors are those of `from_axes`.
        """
        if isinstance(pixel_pitch_m, tuple):
            column_pitch_m, row_pitch_m = pixel_pitch_m
        else:
            column_pitch_m = row_pitch_m = pixel_pitch_m
        if not (column_pitch_m > 0 and row_pitch_m > 0):
            raise ValueError(f"the pixel pitch must be positive, not {pixel_pitch_m} m")
        focal_lengths = (focal_m / column_pitch_m, focal_m / row_pitch_m)
        return cls.from_axes(focal_lengths, size, axis=axis, right=right, centre=centre, image_centre=image_centre)

    @classmethod
    def from_field_of_view(
        cls,
        horizontal_rad: Real,
        size: tuple[int, int],
        *,
        axis: Triple,
        right: Triple,
        vertical_rad: Real | None = None,
        centre: Triple = _ORIGIN,
    ) -> Cahv:
        """A camera from its full field of view, radians, measured between the frame's outer edges.

        Pixels are square unless `vertical_rad` is given. The other parameters are those of `from_axes`.

        Raises
        ------
        ValueError
            If an angle is not between 0 and pi, or as `from_axes`.
        """
        for angle in (horizontal_rad, vertical_rad):
            if angle is not None and not 0 < angle < np.pi:
                raise ValueError(f"a field of view must lie between 0 and pi radians, not {angle}")
        hs = float(size[0] / 2 / np.tan(horizontal_rad / 2))
        vs = hs if vertical_rad is None else float(size[1] / 2 / np.tan(vertical_rad / 2))
        return cls.from_axes((hs, vs), size, axis=axis, right=right, centre=centre)


def _gradient(image_vector: NDArray[np.float64], axis: NDArray[np.float64], pixel: Vector, depth: Vector) -> Gradient:
    x, y, z = ((image_vector[i] - pixel * axis[i]) / depth for i in range(3))
    return x, y, z


def _unit(name: str, vector: NDArray[np.float64]) -> NDArray[np.float64]:
    length = float(np.linalg.norm(vector))
    if vector.shape != (3,) or not (np.isfinite(length) and length > 0):
        raise ValueError(f"{name} must be a finite vector of three components that are not all zero")
    return np.asarray(vector / length)
