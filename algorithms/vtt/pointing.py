"""Mast pointing at the target (section 4.1, action 2).

The mast turns in azimuth and elevation only. Both angles follow from the calibrated camera models and the mast's
geometry, lens distortion included, by Newton's method on the target's pixel.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from marsyard.algorithms.arrays import Points2, Vector2, Vector3
from marsyard.algorithms.image.registration import SURROUND
from marsyard.algorithms.interface import MastAim, PixelBox
from marsyard.algorithms.vtt.options import VttOptions
from marsyard.algorithms.vtt.stereo import epipolar_pixels
from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import turn_matrix
from marsyard.sim.measurements import MastCalibration, MastGeometry, PixelTarget

#: Maximum number of Newton steps, and the error that makes a step the last one (quadratic convergence).
STEPS, TOLERANCE_PX = 12, 1e-2
#: Keeps rounding errors from moving a border that lies on a whole pixel.
_SLACK_PX = 1e-6


def mast_angles(position_rover: Vector3, mast: MastCalibration, pair: bool = False) -> tuple[float, float] | None:
    """Azimuth and elevation that bring a point to the middle of the left frame.

    With `pair`, its pixels in both frames lie equally far, in opposite directions, from the middles: a near target
    stays in both. None without a solution within the mast's limits.
    """
    cameras = (mast.left, mast.right) if pair else (mast.left,)
    min_azimuth, max_azimuth = mast.geometry.azimuth_limits_rad
    min_elevation, max_elevation = mast.geometry.elevation_limits_rad
    # start along the direction from the elevation axis to the point, without the axis' own rotation
    x, y, z = position_rover - mast.geometry.base_m - np.array([0.0, 0.0, mast.geometry.elbow_m[2]])
    angles = np.array([np.arctan2(-y, x), np.arctan2(z, np.hypot(x, y))])
    for _ in range(STEPS):
        offset, slope = _offset(position_rover, mast.geometry, cameras, angles)
        if not np.all(np.isfinite(slope)) or abs(np.linalg.det(slope)) < 1e-9:
            return None
        angles = angles - np.linalg.solve(slope, offset)
        if np.hypot(*offset) < TOLERANCE_PX:
            azimuth, elevation = float(np.arctan2(np.sin(angles[0]), np.cos(angles[0]))), float(angles[1])
            allowed = min_azimuth <= azimuth <= max_azimuth and min_elevation <= elevation <= max_elevation
            return (azimuth, elevation) if allowed else None
    return None


def _offset(
    position_rover: Vector3, mast: MastGeometry, cameras: tuple[CameraModel, ...], angles: Vector2
) -> tuple[Vector2, Float[np.ndarray, "2 2"]]:
    """Mean offset of the point's pixels from the frames' middles, and its derivative by azimuth and elevation.

    For a head rotation about an axis w through a, a point p fixed in the rover moves by -w x (p - a) in the head.
    """
    rover_from_head = mast.rover_from_head(float(angles[0]), float(angles[1]))
    to_head = turn_matrix(rover_from_head).T
    sine, cosine = np.sin(angles[0]), np.cos(angles[0])
    left = np.array([sine, cosine, 0.0])
    elbow = mast.base_m + np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]) @ mast.elbow_m
    axes = ((np.array([0.0, 0.0, -1.0]), mast.base_m), (-left, elbow))
    motion = np.stack([-to_head @ np.cross(axis, position_rover - point) for axis, point in axes], axis=-1)
    point = rover_from_head.inv().apply(position_rover.copy())
    offsets = [camera.project(point)[0] - middle(camera) for camera in cameras]
    slopes = [camera.projection_jacobian(point) @ motion for camera in cameras]
    return np.mean(offsets, axis=0), np.mean(slopes, axis=0)


def middle(camera: CameraModel) -> Vector2:
    """The middle of the frame, pixels."""
    return 0.5 * (np.array(camera.size, dtype=np.float64) - 1.0)


def box_around(pixels: Points2, margin_px: float, camera: CameraModel, horizontal_px: float = 0.0) -> PixelBox | None:
    """The part of the frame within the margin of all pixels, wider by `horizontal_px`; None if a pixel is outside."""
    if not bool(np.all(camera.in_frame(pixels))):
        return None
    margin = margin_px + np.array([horizontal_px, 0.0])
    near = np.maximum(np.floor(pixels.min(axis=0) - margin + _SLACK_PX).astype(int), 0)
    far = np.minimum(np.ceil(pixels.max(axis=0) + margin - _SLACK_PX).astype(int) + 1, camera.size)
    return PixelBox((int(near[0]), int(near[1])), (int(far[0] - near[0]), int(far[1] - near[1])))


def aim_at_position(position_rover: Vector3, mast: MastCalibration, options: VttOptions) -> MastAim | None:
    """Mast aim for a target position; None if the mast cannot show it.

    The right image part covers the searched disparities of the whole left search window.
    """
    angles = mast_angles(position_rover, mast, options.aim_pair)
    if angles is None:
        return None
    point = mast.geometry.rover_from_head(*angles).inv().apply(position_rover[None])
    margin = 0.5 * options.search_px + SURROUND
    across = margin + options.epipolar_tolerance_px
    boxes = (
        box_around(mast.left.project(point)[0], margin, mast.left),
        box_around(mast.right.project(point)[0], across, mast.right, options.disparity_search_px),
    )
    return None if boxes[0] is None or boxes[1] is None else MastAim(*angles, boxes[0], boxes[1])


def aim_at_pixel(target: PixelTarget, mast: MastCalibration, options: VttOptions) -> MastAim | None:
    """The mast aim at the designation; the right image part covers all ranges allowed."""
    margin = 0.5 * options.search_px + SURROUND
    box = box_around(target.pixel[None], margin, mast.left)
    curve = epipolar_pixels(mast.left.rays(target.pixel), mast.left, mast.right, options.seed_range_m)
    visible = curve[mast.right.in_frame(curve)]
    if box is None or len(visible) == 0:
        return None
    right_box = box_around(visible, 0.5 * options.template_px + options.epipolar_tolerance_px + SURROUND, mast.right)
    return None if right_box is None else MastAim(target.azimuth_rad, target.elevation_rad, box, right_box)
