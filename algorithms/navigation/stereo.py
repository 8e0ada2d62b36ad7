"""Stereo images of the rover's navigation: rectification, dense matching, and matching of single features.

Both cameras are calibrated and in the rover frame: images of a panned mast and of body-mounted cameras are processed
in the same way. Both images are resampled to parallel pinhole cameras; a point then has the same row in both, and its
depth is focal length times baseline divided by disparity.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from marsyard.algorithms.arrays import Flags, Points2, Points3
from marsyard.sim.camera import Cahv, CameraModel
from marsyard.sim.measurements import StereoMeasurement

#: Percentile of the counts that is mapped to the brightest 8-bit value.
_WHITE_PERCENTILE = 99.5
#: Maximum angle from the axis in a rectified image: wider parts of a fisheye image are stretched too much.
_MAX_FIELD_RAD = float(np.radians(55.0))
#: Window of dense matching and of feature matching, pixels.
_BLOCK_PX, _FEATURE_PX = 9, 11
#: Dense matching (`cv2.StereoBM`): minimum texture, minimum margin of the best match in %, and maximum difference
#: between the disparities from left to right and from right to left, pixels.
_TEXTURE, _UNIQUENESS, _LEFT_RIGHT_PX = 10, 15, 1
#: Largest area of a speckle, which has no match, in pixels, and disparity range within it, sixteenths of a pixel.
_SPECKLE_PX, _SPECKLE_RANGE = 100, 8
#: OpenCV's unit of disparity, pixels, and the step of its number of disparities.
_DISPARITY_UNIT, _DISPARITY_STEP = 1.0 / 16.0, 16
#: Maximum distance of a feature match from its epipolar line, and maximum forward-backward error, pixels.
_EPIPOLAR_PX, _FORWARD_BACKWARD_PX = 1.0, 0.5
#: Pyramid levels of feature matching above the full resolution.
_LEVELS = 2


@dataclass(frozen=True)
class RectifiedPair:
    """A stereo pair resampled to parallel cameras.

    - left, right: 8-bit images; brightness is the square root of the counts, so that noise is uniform
    - camera: the left rectified camera, rover frame; the right one is shifted by the baseline along `camera.right`
    """

    left: UInt8[np.ndarray, "rows columns"]
    right: UInt8[np.ndarray, "rows columns"]
    camera: Cahv
    baseline_m: float

    @classmethod
    def from_measurement(cls, pair: StereoMeasurement) -> RectifiedPair:
        """Rectify a pair to the focal length of the left camera, with its field of view up to 55 deg from the axis."""
        left, right = pair.cameras
        baseline = right.c - left.c
        baseline_m = float(np.linalg.norm(baseline))
        baseline_direction = baseline / baseline_m
        boresight = left.boresight() + right.boresight()
        axis = boresight - (boresight @ baseline_direction) * baseline_direction
        focal_px = left.focal_lengths[0]
        axis = axis / np.linalg.norm(axis)
        # the field of view at the ends of the camera's central row and column
        columns, rows = left.size
        centre = np.array(left.image_centre)
        row_ends = [[0.0, centre[1]], [columns - 1.0, centre[1]]]
        column_ends = [[centre[0], 0.0], [centre[0], rows - 1.0]]
        cosines = left.rays(np.array(row_ends + column_ends))[1] @ axis
        angles = np.minimum(np.arccos(np.clip(cosines, -1.0, 1.0)), _MAX_FIELD_RAD).reshape(2, 2)
        half_width, half_height = (float(np.tan(ends.max())) * focal_px for ends in angles)
        size = 2 * int(np.ceil(half_width)), 2 * int(np.ceil(half_height))
        camera = Cahv.from_axes((focal_px, focal_px), size, axis=axis, right=baseline_direction, centre=left.c)
        white_counts = max(float(np.percentile(pair.left, _WHITE_PERCENTILE)), 1.0)
        return cls(
            _resample(_to_8_bit(pair.left, white_counts), left, camera),
            _resample(_to_8_bit(pair.right, white_counts), right, camera),
            camera,
            baseline_m,
        )

    @property
    def disparity_px_m(self) -> float:
        """Disparity times depth: focal length times baseline."""
        return self.camera.focal_lengths[0] * self.baseline_m

    def triangulate(self, pixels: Points2, disparity_px: Float64[np.ndarray, "n"]) -> Points3:
        """Compute the points of left pixels with a positive disparity, rover frame, metres."""
        centre, focal = np.array(self.camera.image_centre), self.camera.focal_lengths[0]
        axes = np.stack([self.camera.right, self.camera.down, self.camera.a])
        slopes = np.column_stack([(pixels - centre) / focal, np.ones(len(pixels))])
        depth = self.disparity_px_m / disparity_px
        return np.asarray(self.camera.c + (depth[:, None] * slopes) @ axes)

    def covariances(
        self, pixels: Points2, disparity_px: Float64[np.ndarray, "n"], error_px: float
    ) -> Float64[np.ndarray, "n 3 3"]:
        """Compute the covariances of `triangulate`, rover frame, m2; `error_px`: error of each coordinate, 1 sigma."""
        centre, focal = np.array(self.camera.image_centre), self.camera.focal_lengths[0]
        axes = np.stack([self.camera.right, self.camera.down, self.camera.a])
        depth = self.disparity_px_m / disparity_px
        # derivatives of (right, down, depth) with respect to (u, v of the left pixel, disparity)
        jacobian = np.zeros((len(pixels), 3, 3))
        jacobian[:, 0, 0] = jacobian[:, 1, 1] = depth / focal
        slopes = np.column_stack([(pixels - centre) / focal, np.ones(len(pixels))])
        jacobian[:, :, 2] = -slopes * (depth / disparity_px)[:, None]
        rover_jacobian = axes.T @ jacobian
        variance = np.array([1.0, 1.0, 2.0]) * error_px**2
        return np.asarray((rover_jacobian * variance) @ rover_jacobian.transpose(0, 2, 1))

    def disparity_map(self, min_range_m: float) -> Float32[np.ndarray, "rows columns"]:
        """Compute the disparity of each left pixel by block matching; NaN without a reliable match.

        Occluded, textureless and ambiguous areas have no match. `min_range_m` limits the disparity.
        """
        count = _DISPARITY_STEP * int(np.ceil(self.disparity_px_m / min_range_m / _DISPARITY_STEP))
        matcher = cv2.StereoBM.create(count, _BLOCK_PX)
        matcher.setTextureThreshold(_TEXTURE)
        matcher.setUniquenessRatio(_UNIQUENESS)
        matcher.setDisp12MaxDiff(_LEFT_RIGHT_PX)
        matcher.setSpeckleWindowSize(_SPECKLE_PX)
        matcher.setSpeckleRange(_SPECKLE_RANGE)
        # a border on the left, because the matches of the first columns may be outside the right image
        padded = (cv2.copyMakeBorder(image, 0, 0, count, 0, cv2.BORDER_CONSTANT) for image in (self.left, self.right))
        disparity = matcher.compute(*padded)[:, count:].astype(np.float32) * np.float32(_DISPARITY_UNIT)
        return np.where((disparity > 0.0) & (self.left > 0), disparity, np.float32(np.nan))

    def points(self, min_range_m: float, max_range_m: float) -> Points3:
        """Compute the points of all matched pixels with a depth between the limits, rover frame, metres."""
        disparity = self.disparity_map(min_range_m)
        with np.errstate(invalid="ignore"):
            rows, columns = np.nonzero(disparity >= self.disparity_px_m / max_range_m)
        pixels = np.column_stack([columns, rows]).astype(np.float64)
        return self.triangulate(pixels, disparity[rows, columns].astype(np.float64))

    def feature_disparities(self, pixels: Points2, min_range_m: float) -> tuple[Float64[np.ndarray, "n"], Flags]:
        """Match features of the left image in the right one; return their disparities and which are valid."""
        dense = self.disparity_map(min_range_m)
        columns, rows = np.clip(np.rint(pixels).astype(int), 0, np.array(self.camera.size) - 1).T
        initial = dense[rows, columns].astype(np.float64)
        shifts = np.column_stack([np.nan_to_num(initial), np.zeros(len(initial))])
        right_pixels, valid = track_features(self.left, self.right, pixels, pixels - shifts)
        disparity = pixels[:, 0] - right_pixels[:, 0]
        valid &= np.isfinite(initial) & (np.abs(right_pixels[:, 1] - pixels[:, 1]) <= _EPIPOLAR_PX) & (disparity > 0.0)
        return disparity, valid


def track_features(
    first: UInt8[np.ndarray, "rows columns"],
    second: UInt8[np.ndarray, "rows columns"],
    pixels: Points2,
    predicted_pixels: Points2,
) -> tuple[Points2, Flags]:
    """Track features from one image to another by Lucas-Kanade with pyramids, starting at predicted pixels.

    A track is valid if it converges and the reverse track returns to its start.
    """
    if len(pixels) == 0:
        return np.empty((0, 2)), np.zeros(0, dtype=np.bool_)
    options: dict[str, Any] = {"winSize": (_FEATURE_PX, _FEATURE_PX), "maxLevel": _LEVELS}
    options["flags"] = cv2.OPTFLOW_USE_INITIAL_FLOW
    start, initial = pixels.astype(np.float32), predicted_pixels.astype(np.float32)
    end, status, _ = cv2.calcOpticalFlowPyrLK(first, second, start, initial.copy(), **options)
    reverse_end, reverse_status, _ = cv2.calcOpticalFlowPyrLK(second, first, end, start.copy(), **options)
    valid = (status.ravel() == 1) & (reverse_status.ravel() == 1)
    valid &= np.hypot(*(reverse_end - start).T) <= _FORWARD_BACKWARD_PX
    return end.astype(np.float64), np.asarray(valid)


def _to_8_bit(counts: np.ndarray, white_counts: float) -> UInt8[np.ndarray, "rows columns"]:
    """Convert counts to 1 .. 255 by their square root; `white_counts` becomes 255. The value 0 means no image."""
    scaled = 255.0 * np.sqrt(np.minimum(counts.astype(np.float32) / np.float32(white_counts), 1.0))
    return np.asarray(np.maximum(np.rint(scaled), 1.0).astype(np.uint8))


def _resample(
    image: UInt8[np.ndarray, "rows columns"], camera: CameraModel, rectified: Cahv
) -> UInt8[np.ndarray, "_ _"]:
    """Resample an image to the rectified camera's directions; 0 outside of the image."""
    directions = rectified.rays(rectified.pixel_grid())[1]
    pixels, visible = camera.project(camera.c + directions)
    # the pixel (-10, -10) is outside of every image
    maps = np.where(visible[..., None], pixels, -10.0).astype(np.float32)
    return np.asarray(cv2.remap(image, maps[..., 0], maps[..., 1], cv2.INTER_CUBIC, borderValue=0))
