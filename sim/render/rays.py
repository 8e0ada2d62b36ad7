"""Every pixel's ray, and the pinhole views that contain them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from scipy.spatial.transform import RigidTransform

from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import turn_matrix
from marsyard.sim.render.backend import RenderingError
from marsyard.sim.render.kernels.rays import extent, least_along, pixel_angles, summed
from marsyard.sim.render.kernels.structs import Rays
from marsyard.sim.render.reach import Cone

#: Samples along each side of the pinhole views: a camera takes the first that leaves `_SPARE_PX` of them beside its own
#: pixels, and the last where none does (full frames of 1024 x 1024 and 45 deg are drawn at about their own resolution).
VIEW_SIDES_PX = (208, 288, 352, 544, 1088)
VIEW_SIDE_PX = VIEW_SIDES_PX[-1]
_SPARE_PX = 16
#: Samples left free around the pixels' field in a view.
MARGIN_PX = 2.0
#: Widest angle from its axis that a view is given; a wider field is cut into quarters.
WIDEST_HALF_ANGLE_RAD = np.radians(52.0)


@dataclass(frozen=True)
class PixelRays:
    """Every pixel's ray in body axes, and the pinhole views that contain them all.

    Attributes
    ----------
    centre
        Centre of projection in the body frame, metres; for CAHVORE the mean of the moving entrance pupil.
    origins, directions
        Rays relative to `centre`, shape (rows * columns, 3), float32; directions are unit vectors.
    size
        Columns and rows.
    pixel_angles
        Angle that each pixel takes: the square root of its solid angle, radians.
    view_side_px
        Samples along each side of the pinhole views.
    view_from_body
        Rotation matrices from body axes to those of each view (x right, y down, z forward).
    focal_px
        Focal length of each view.
    view_of_pixel
        Number of the view that holds each pixel.
    """

    centre: Float64[np.ndarray, "3"]
    origins: Float32[np.ndarray, "pixels 3"]
    directions: Float32[np.ndarray, "pixels 3"]
    size: tuple[int, int]
    pixel_angles: Float32[np.ndarray, "pixels"]
    view_side_px: int
    view_from_body: Float64[np.ndarray, "views 3 3"]
    focal_px: Float64[np.ndarray, "views"]
    view_of_pixel: UInt8[np.ndarray, "pixels"]

    @property
    def rays(self) -> Rays:
        """The rays alone."""
        return Rays(self.origins, self.directions, self.pixel_angles)

    @cached_property
    def axis(self) -> Float64[np.ndarray, "3"]:
        """Unit vector along the middle of all rays, body axes."""
        middle = np.array(summed(self.directions))
        middle /= np.linalg.norm(middle)
        return middle

    @cached_property
    def pixel_rad(self) -> float:
        """Median of the angles that pixels take, radians."""
        return float(np.median(self.pixel_angles))

    @cached_property
    def half_angle_rad(self) -> float:
        """Widest angle of a ray from the axis, radians."""
        return float(np.arccos(np.clip(least_along(self.directions, self.axis), -1.0, 1.0)))

    def cone(self, world_from_body: RigidTransform) -> Cone:
        """What holds all rays where the camera stands so."""
        return world_from_body.apply(self.centre.copy()), turn_matrix(world_from_body) @ self.axis, self.half_angle_rad

    @classmethod
    def of(cls, camera: CameraModel) -> PixelRays:
        """The rays of this camera, given in the body frame. Raises RenderingError where pixels have no ray."""
        columns, rows = camera.size
        starts, directions = camera.rays(camera.pixel_grid())
        if not np.isfinite(directions).all():
            raise RenderingError("the camera model has pixels without a ray")
        side = next((one for one in VIEW_SIDES_PX if max(columns, rows) <= one - _SPARE_PX), VIEW_SIDE_PX)
        view_of_pixel = np.zeros((rows, columns), dtype=np.uint8)
        axes: list[Float64[np.ndarray, "3 3"]] = []
        focal: list[float] = []
        for part in _parts(directions):
            view_of_pixel[part] = len(axes)
            axes.append(_view_axes(directions[part]))
            focal.append(_focal_length(directions[part], axes[-1], side))
        centre, origins = _from_centre(starts)
        return cls(
            centre=centre,
            origins=origins,
            directions=directions.reshape(-1, 3).astype(np.float32),
            size=(columns, rows),
            pixel_angles=pixel_angles(directions).ravel(),
            view_side_px=side,
            view_from_body=np.stack(axes),
            focal_px=np.array(focal),
            view_of_pixel=view_of_pixel.ravel(),
        )


def _from_centre(
    starts: Float64[np.ndarray, "rows columns 3"],
) -> tuple[Float64[np.ndarray, "3"], Float32[np.ndarray, "pixels 3"]]:
    """The mean of where rays start, and where each starts from there."""
    count = starts.shape[0] * starts.shape[1]
    if starts.strides[:2] == (0, 0):
        return starts[0, 0].copy(), np.zeros((count, 3), dtype=np.float32)
    centre = starts.reshape(-1, 3).mean(axis=0)
    return centre, (starts - centre).reshape(-1, 3).astype(np.float32)


def _parts(directions: Float64[np.ndarray, "rows columns 3"]) -> list[tuple[slice, slice]]:
    """The picture whole, or cut into quarters until each fits a view."""
    rows, columns = directions.shape[:2]
    pending, parts = [(slice(0, rows), slice(0, columns))], []
    while pending:
        part = pending.pop(0)
        axes = _view_axes(directions[part])
        if (directions[part] @ axes[2]).min() >= np.cos(WIDEST_HALF_ANGLE_RAD):
            parts.append(part)
            continue
        (top, bottom), (left, right) = ((side.start, side.stop) for side in part)
        if bottom - top < 4 or right - left < 4:
            raise RenderingError("neighbouring pixels of the camera look in wholly different directions")
        middle_row, middle_column = (top + bottom) // 2, (left + right) // 2
        pending += [
            (vertical, horizontal)
            for vertical in (slice(top, middle_row), slice(middle_row, bottom))
            for horizontal in (slice(left, middle_column), slice(middle_column, right))
        ]
    return parts


def _view_axes(directions: Float64[np.ndarray, "rows columns 3"]) -> Float64[np.ndarray, "3 3"]:
    """Rows: right, down and forward of a view that looks along the middle of these rays, in body axes."""
    corners = directions[[0, 0, -1, -1], [0, -1, 0, -1]]
    forward = corners.mean(axis=0) + directions[directions.shape[0] // 2, directions.shape[1] // 2]
    forward /= np.linalg.norm(forward)
    right = corners[1] + corners[3] - corners[0] - corners[2]
    right -= forward * (right @ forward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def _focal_length(
    directions: Float64[np.ndarray, "rows columns 3"], axes: Float64[np.ndarray, "3 3"], side: int
) -> float:
    """The focal length at which these rays just fill a view."""
    return float((side / 2.0 - MARGIN_PX) / extent(directions, axes))
