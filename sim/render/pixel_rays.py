"""The ray of every pixel of a camera, and pinhole views that contain all of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import drjit as dr
import numpy as np
from jaxtyping import Float32, Float64, UInt8
from scipy.spatial.transform import RigidTransform

from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import rotation_matrix
from marsyard.sim.render.arrays import Values, compiled, to_device, to_host, vectors_to_device
from marsyard.sim.render.backend import RenderingError
from marsyard.sim.render.cones import Cone
from marsyard.sim.render.device import Array3f, Array3f64, Float, UInt32
from marsyard.sim.render.rays import PixelGrid, Rays

#: Sizes of the pinhole views, samples along a side. A camera uses the smallest view that is at least `_SPARE_PX` larger
#: than its image (or than the quarter of its image that the view covers), otherwise the largest view. For 1024 x 1024
#: pixels and 45 deg the largest view has about the resolution of the camera.
VIEW_SIDES_PX = (208, 288, 352, 544, 1088)
VIEW_SIDE_PX = VIEW_SIDES_PX[-1]
_SPARE_PX = 16
#: Margin around the rays' field of view in a pinhole view, in samples.
MARGIN_PX = 2.0
#: Maximum angle between a ray and the axis of its view; a wider field of view is divided into quarters.
MAX_HALF_ANGLE_RAD = np.radians(52.0)


@dataclass(frozen=True)
class PixelRays:
    """The ray of every pixel in body axes, and the pinhole views that contain all rays.

    - centre: centre of projection in the body frame, metres; for CAHVORE the mean position of the entrance pupil
    - origins, directions: rays relative to `centre`; directions are unit vectors
    - size: columns and rows
    - pixel_angles: square root of each pixel's solid angle, radians
    - view_side_px: samples along each side of the pinhole views
    - focal_px: focal length of each view, in samples
    - view_from_body: rotation matrices from body axes to those of each view (x right, y down, z forward)
    - view_of_pixel: number of the view that contains each pixel
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

    @cached_property
    def device_rays(self) -> Rays:
        """The rays on the device."""
        origins = vectors_to_device(Array3f, self.origins) if self.origin_radius_m > 0.0 else None
        return Rays(vectors_to_device(Array3f, self.directions), origins, to_device(Float, self.pixel_angles))

    @cached_property
    def device_view_of_pixel(self) -> Values:
        """The view of each pixel on the device."""
        return to_device(UInt32, self.view_of_pixel)

    @cached_property
    def axis(self) -> Float64[np.ndarray, "3"]:
        """Mean direction of all rays, unit vector in body axes."""
        mean = self.directions.sum(axis=0, dtype=np.float64)
        mean /= np.linalg.norm(mean)
        return np.asarray(mean)

    @cached_property
    def pixel_rad(self) -> float:
        """Median pixel angle, radians."""
        return float(np.median(self.pixel_angles))

    @cached_property
    def half_angle_rad(self) -> float:
        """Maximum angle between a ray and the axis."""
        return float(np.arccos(np.clip((self.directions @ self.axis).min(), -1.0, 1.0)))

    @cached_property
    def origin_radius_m(self) -> float:
        """Maximum distance of a ray's origin from the centre of projection."""
        return float(np.linalg.norm(self.origins, axis=1).max()) if self.origins.any() else 0.0

    def cone(self, world_from_body: RigidTransform) -> Cone:
        """The cone that contains all rays of a camera in this pose."""
        axis = rotation_matrix(world_from_body) @ self.axis
        return world_from_body.apply(self.centre.copy()), axis, self.half_angle_rad

    @classmethod
    def from_camera(cls, camera: CameraModel) -> PixelRays:
        """Compute the rays of a camera in the body frame. Raises RenderingError where pixels have no ray."""
        columns, rows = camera.size
        ray_origins, directions = camera.rays(camera.pixel_grid())
        if not np.isfinite(directions).all():
            raise RenderingError("the camera model has pixels without a ray")
        parts, axes = _divide_field_of_view(directions)
        view_of_pixel = np.zeros((rows, columns), dtype=np.uint8)
        for number, part in enumerate(parts):
            view_of_pixel[part] = number
        longest = max(max(directions[part].shape[:2]) for part in parts)
        side = next((size for size in VIEW_SIDES_PX if longest <= size - _SPARE_PX), VIEW_SIDE_PX)
        # focal lengths with which the rays fill the views
        focal = [
            float((side / 2.0 - MARGIN_PX) / _max_image_radius(directions[part], part_axes))
            for part, part_axes in zip(parts, axes, strict=True)
        ]
        if ray_origins.strides[:2] == (0, 0):
            centre, origins = ray_origins[0, 0].copy(), np.zeros((rows * columns, 3), dtype=np.float32)
        else:
            centre = ray_origins.reshape(-1, 3).mean(axis=0)
            origins = (ray_origins - centre).reshape(-1, 3).astype(np.float32)
        vectors, pixel = vectors_to_device(Array3f64, directions.reshape(-1, 3)), dr.arange(UInt32, rows * columns)
        return cls(
            centre=centre,
            origins=origins,
            directions=directions.reshape(-1, 3).astype(np.float32),
            size=(columns, rows),
            pixel_angles=to_host(_pixel_angles(vectors, pixel, UInt32(columns), UInt32(rows))),
            view_side_px=side,
            view_from_body=np.stack(axes),
            focal_px=np.array(focal),
            view_of_pixel=view_of_pixel.ravel(),
        )


@compiled
def _pixel_angles(directions: Values, pixel: Values, columns: Values, rows: Values) -> Values:
    """Square root of each pixel's solid angle, radians; the sides of a pixel are differences of the unit vectors."""
    grid = PixelGrid.of(pixel, columns, rows)
    return Float(dr.sqrt(dr.norm(dr.cross(grid.derivative(directions, 1, 0), grid.derivative(directions, 0, 1)))))


def _max_image_radius(directions: Float64[np.ndarray, "rows columns 3"], view: Float64[np.ndarray, "3 3"]) -> float:
    """Maximum absolute image coordinate (x or y) of rays at a focal length of 1; the rows of `view` are its axes."""
    components = directions @ view.T
    return float(np.abs(components[..., :2] / components[..., 2:]).max())


def _divide_field_of_view(
    directions: Float64[np.ndarray, "rows columns 3"],
) -> tuple[list[tuple[slice, slice]], list[Float64[np.ndarray, "3 3"]]]:
    """Divide an image into quarters until each fits in a view; return rows and columns, and view axes, of each part."""
    parts: list[tuple[slice, slice]] = []
    axes: list[Float64[np.ndarray, "3 3"]] = []
    pending = [(slice(0, directions.shape[0]), slice(0, directions.shape[1]))]
    while pending:
        part = pending.pop(0)
        part_axes = _view_axes(directions[part])
        if (directions[part] @ part_axes[2]).min() >= np.cos(MAX_HALF_ANGLE_RAD):
            parts.append(part)
            axes.append(part_axes)
            continue
        (top, bottom), (left, right) = ((extent.start, extent.stop) for extent in part)
        if bottom - top < 4 or right - left < 4:
            raise RenderingError("the rays of neighbouring pixels have very different directions")
        row, column = (top + bottom) // 2, (left + right) // 2
        pending += list(product((slice(top, row), slice(row, bottom)), (slice(left, column), slice(column, right))))
    return parts, axes


def _view_axes(directions: Float64[np.ndarray, "rows columns 3"]) -> Float64[np.ndarray, "3 3"]:
    """Axes of a view along the mean direction of these rays: rows are right, down and forward, in body axes."""
    corners = directions[[0, 0, -1, -1], [0, -1, 0, -1]]
    forward = corners.mean(axis=0) + directions[directions.shape[0] // 2, directions.shape[1] // 2]
    forward /= np.linalg.norm(forward)
    right = corners[1] + corners[3] - corners[0] - corners[2]
    right -= forward * (right @ forward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])
