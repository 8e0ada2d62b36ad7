"""Point stereo: match of one point along the epipolar curve of the right image, and triangulation (section 4.4).

Sections are those of Kim et al., "Targeted Driving Using Visual Tracking".
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from marsyard.algorithms.arrays import Patch, Points2, Vector2, Vector3
from marsyard.algorithms.image.correlation import normalized_correlation
from marsyard.algorithms.image.peaks import biquadratic_offset, highest_peak
from marsyard.algorithms.vtt.matching import Refinement, refine_match
from marsyard.algorithms.vtt.options import VttOptions
from marsyard.sim.camera import CameraModel
from marsyard.sim.measurements import MastImage

#: Inverse of the largest searched range, 1/m; at 1000 km the disparity is below a hundredth of a pixel.
_MIN_INVERSE_RANGE = 1e-6
#: Squared sine of the angle between two lines of sight above which they are not parallel; above its rounding errors.
_MIN_SQUARED_SINE = 1e-14


@dataclass(frozen=True)
class StereoMatch:
    """The target in the right image.

    - pixel: (u, v) in the right full frame
    - score: Normalised correlation of the warped template. A slanted face is stretched in the right image. At slants of
      63 to 76 deg the correlation at the correct position is 0.66 to 0.70 without the warp, and above 0.9 with it.
    """

    pixel: Vector2
    score: float


#: Origin and unit direction of a line of sight.
LineOfSight = tuple[Vector3, Vector3]


def epipolar_pixels(
    sight: LineOfSight, left: CameraModel, right: CameraModel, ranges_m: tuple[float, float]
) -> Points2:
    """Project points along a left pixel's line of sight to the right image, from far to near: the epipolar curve.

    The points have a spacing of about half a pixel of disparity; points invisible to the right camera are omitted. Both
    cameras are in one frame. With lens distortion the curve is not straight.
    """
    origin, direction = sight
    max_inverse, min_inverse = (1.0 / ranges_m[0], 1.0 / ranges_m[1])
    count = max(int(np.ceil(2.0 * disparity_px_m(left, right) * (max_inverse - min_inverse))) + 1, 2)
    points = origin + direction / np.linspace(min_inverse, max_inverse, count)[:, None]
    pixels, visible = right.project(points)
    return np.asarray(pixels[visible])


@lru_cache(maxsize=32)
def disparity_px_m(left: CameraModel, right: CameraModel) -> float:
    """Focal length times baseline, which equals disparity times range, in pixels times metres."""
    return right.focal_lengths[0] * float(np.linalg.norm(right.c - left.c))


def search_ranges(left: CameraModel, right: CameraModel, range_m: float, disparity_px: float) -> tuple[float, float]:
    """Smallest and largest range whose disparity differs by at most `disparity_px` from that of `range_m`."""
    inverse_step = disparity_px / disparity_px_m(left, right)
    inverse = 1.0 / range_m
    return 1.0 / (inverse + inverse_step), 1.0 / max(inverse - inverse_step, _MIN_INVERSE_RANGE)


def point_stereo(
    template: Patch, image: MastImage, curve: Float[np.ndarray, "points 2"], options: VttOptions
) -> StereoMatch | None:
    """Match the left template near the epipolar `curve` (full-frame pixels) of the right image.

    None if the image contains no position of the template within the tolerance of the curve.
    """
    half, tolerance = (len(template) - 1) // 2, options.epipolar_tolerance_px
    curve_px = curve - np.array(image.corner, dtype=np.float64)
    rows, columns = image.counts.shape
    curve_px = curve_px[(curve_px[:, 0] > half - 1.0) & (curve_px[:, 0] < columns - half)]
    if len(curve_px) == 0:
        return None
    half_height = half + int(np.ceil(tolerance))
    start = np.maximum(np.ceil(curve_px.min(axis=0)).astype(int) - np.array([half, half_height]), 0)
    end = np.minimum(np.floor(curve_px.max(axis=0)).astype(int) + np.array([half, half_height]) + 1, [columns, rows])
    if np.any(end - start < len(template)):
        return None
    band = image.counts[start[1] : end[1], start[0] : end[0]].astype(np.float64)
    surface = normalized_correlation(template, band)
    # accept only positions within the tolerance above or below the curve
    columns_px, rows_px = (curve_px[np.argsort(curve_px[:, 0])] - start - half).T
    curve_rows = np.interp(np.arange(surface.shape[1]), columns_px, rows_px)
    is_near_curve = np.abs(np.arange(surface.shape[0])[:, None] - curve_rows) <= tolerance
    if not np.any(is_near_curve):
        return None
    peak = highest_peak(np.where(is_near_curve, surface, -1.0))
    # pixels and corners of images are (u, v), positions in arrays (row, column)
    corner_row_column = start[::-1] + np.array([peak.row, peak.column], dtype=np.float64)
    best = Refinement(corner=corner_row_column, score=peak.value, warped_score=peak.value)
    if options.subpixel:
        best = refine_match(template, image, corner_row_column, biquadratic_offset(surface, peak), peak, options)
    return StereoMatch(pixel=best.corner[::-1] + half + image.corner, score=best.warped_score)


def triangulate(left: CameraModel, right: CameraModel, left_pixel: Vector2, right_pixel: Vector2) -> Vector3 | None:
    """Triangulate a left and a right pixel: `nearest_point` of their lines of sight."""
    return nearest_point(left.rays(left_pixel), right.rays(right_pixel))


def nearest_point(left: LineOfSight, right: LineOfSight) -> Vector3 | None:
    """Midpoint of the shortest segment between two lines of sight, in their frame, metres.

    None if they are parallel or an end of the segment is behind its camera.
    """
    (left_origin, left_ray), (right_origin, right_ray) = left, right
    offset, cosine = right_origin - left_origin, float(left_ray @ right_ray)
    determinant = 1.0 - cosine * cosine  # squared sine of the angle between the lines
    if not determinant > _MIN_SQUARED_SINE:
        return None
    left_range_m = float(offset @ (left_ray - cosine * right_ray)) / determinant
    right_range_m = float(offset @ (cosine * left_ray - right_ray)) / determinant
    if not (left_range_m > 0.0 and right_range_m > 0.0):
        return None
    return np.asarray(0.5 * (left_origin + left_range_m * left_ray + right_origin + right_range_m * right_ray))
