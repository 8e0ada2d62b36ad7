"""Mast angles and image regions that point the mast cameras at the target (section 4.1, action 2).

The mast rotates in azimuth and elevation only. Newton's method determines both angles for which the target's pixel is
at the image centre, with the calibrated camera models (including lens distortion) and the mast's geometry.

Sections are those of Kim et al., "Targeted Driving Using Visual Tracking".
"""

import numpy as np
from jaxtyping import Float

from marsyard.algorithms.arrays import Points2, Vector2, Vector3
from marsyard.algorithms.image.registration import MARGIN_PX
from marsyard.algorithms.interface import MastAim, PixelBox
from marsyard.algorithms.vtt.options import VttOptions
from marsyard.algorithms.vtt.stereo import epipolar_pixels
from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import rotation_matrix
from marsyard.sim.measurements import MastCalibration, MastGeometry, PixelTarget

#: Maximum number of Newton steps, and the pixel error below which only one more step is made (quadratic convergence).
STEPS, TOLERANCE_PX = 12, 1e-2
#: Minimum determinant of the pixel's derivatives with respect to both angles, (pixels per radian)^2.
_MIN_DETERMINANT = 1e-9
#: Tolerance of region borders, so that rounding errors do not move a border that lies on a whole pixel.
_BORDER_TOLERANCE_PX = 1e-6


def mast_angles(position_rover: Vector3, mast: MastCalibration, use_both: bool = False) -> tuple[float, float] | None:
    """Compute azimuth and elevation (radians) of the mast that centre a point in the left image.

    With `use_both`, the mean of the point's offsets from both image centres is zero, so that both images show a near
    target. None if there is no solution within the mast's limits.
    """
    cameras = (mast.left, mast.right) if use_both else (mast.left,)
    min_azimuth, max_azimuth = mast.geometry.azimuth_limits_rad
    min_elevation, max_elevation = mast.geometry.elevation_limits_rad
    # initial angles: direction from the elevation axis to the point, with the axis at azimuth 0
    x, y, z = position_rover - mast.geometry.base_m - np.array([0.0, 0.0, mast.geometry.elbow_m[2]])
    angles = np.array([np.arctan2(-y, x), np.arctan2(z, np.hypot(x, y))])
    for _ in range(STEPS):
        offset, jacobian = _compute_offset(position_rover, mast.geometry, cameras, angles)
        # a point on the azimuth axis does not move in the image if the mast turns
        if not np.all(np.isfinite(jacobian)) or abs(np.linalg.det(jacobian)) < _MIN_DETERMINANT:
            return None
        angles = angles - np.linalg.solve(jacobian, offset)
        if np.hypot(*offset) < TOLERANCE_PX:
            azimuth, elevation = float(np.arctan2(np.sin(angles[0]), np.cos(angles[0]))), float(angles[1])
            within_limits = min_azimuth <= azimuth <= max_azimuth and min_elevation <= elevation <= max_elevation
            return (azimuth, elevation) if within_limits else None
    return None


def _compute_offset(
    position_rover: Vector3, mast: MastGeometry, cameras: tuple[CameraModel, ...], angles: Vector2
) -> tuple[Vector2, Float[np.ndarray, "2 2"]]:
    """Compute the mean offset of the point's pixels from the image centres, and its Jacobian (azimuth, elevation).

    If the head rotates about an axis w through a, a point p fixed to the rover moves by -w x (p - a) in the head frame.
    """
    rover_from_head = mast.rover_from_head(float(angles[0]), float(angles[1]))
    to_head = rotation_matrix(rover_from_head).T
    sine, cosine = np.sin(angles[0]), np.cos(angles[0])
    left_direction = np.array([sine, cosine, 0.0])
    elbow = mast.base_m + np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]) @ mast.elbow_m
    axes = ((np.array([0.0, 0.0, -1.0]), mast.base_m), (-left_direction, elbow))
    derivatives = np.stack([-to_head @ np.cross(axis, position_rover - origin) for axis, origin in axes], axis=-1)
    position_head = rover_from_head.inv().apply(position_rover.copy())
    offsets = [camera.project(position_head)[0] - frame_centre(camera) for camera in cameras]
    jacobians = [camera.projection_jacobian(position_head) @ derivatives for camera in cameras]
    return np.mean(offsets, axis=0), np.mean(jacobians, axis=0)


def frame_centre(camera: CameraModel) -> Vector2:
    """Centre of the full frame, pixels."""
    return 0.5 * (np.array(camera.size, dtype=np.float64) - 1.0)


def bounding_box(pixels: Points2, margin_px: float, camera: CameraModel, horizontal_px: float = 0.0) -> PixelBox | None:
    """Bounding box of pixels with a margin, in columns plus `horizontal_px`; None if a pixel is out of frame."""
    if not bool(np.all(camera.in_frame(pixels))):
        return None
    margin = margin_px + np.array([horizontal_px, 0.0])
    start = np.maximum(np.floor(pixels.min(axis=0) - margin + _BORDER_TOLERANCE_PX).astype(int), 0)
    end = np.minimum(np.ceil(pixels.max(axis=0) + margin - _BORDER_TOLERANCE_PX).astype(int) + 1, camera.size)
    return PixelBox((int(start[0]), int(start[1])), (int(end[0] - start[0]), int(end[1] - start[1])))


def aim_at_position(position_rover: Vector3, mast: MastCalibration, options: VttOptions) -> MastAim | None:
    """Compute the mast aim for a target position; None if the mast cannot point at it.

    The right image region covers the searched disparities of the complete left search window.
    """
    angles = mast_angles(position_rover, mast, options.aim_pair)
    if angles is None:
        return None
    point = mast.geometry.rover_from_head(*angles).inv().apply(position_rover[None])
    margin = 0.5 * options.search_px + MARGIN_PX
    right_margin_px = margin + options.epipolar_tolerance_px
    boxes = (
        bounding_box(mast.left.project(point)[0], margin, mast.left),
        bounding_box(mast.right.project(point)[0], right_margin_px, mast.right, options.disparity_search_px),
    )
    return None if boxes[0] is None or boxes[1] is None else MastAim(*angles, boxes[0], boxes[1])


def aim_at_pixel(target: PixelTarget, mast: MastCalibration, options: VttOptions) -> MastAim | None:
    """Compute the mast aim for a designated pixel, or None; the right region covers all ranges in `seed_range_m`."""
    margin = 0.5 * options.search_px + MARGIN_PX
    box = bounding_box(target.pixel[None], margin, mast.left)
    curve = epipolar_pixels(mast.left.rays(target.pixel), mast.left, mast.right, options.seed_range_m)
    visible = curve[mast.right.in_frame(curve)]
    if box is None or len(visible) == 0:
        return None
    right_box = bounding_box(visible, 0.5 * options.template_px + options.epipolar_tolerance_px + MARGIN_PX, mast.right)
    return None if right_box is None else MastAim(target.azimuth_rad, target.elevation_rad, box, right_box)
