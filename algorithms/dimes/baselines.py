"""Common parts of the baseline velocity estimators `phase_correlation` and `homography`.

Both images of a pair are rectified to one virtual camera that looks straight down (`rectification.rectify_patch`) and
corrected as in DIMES. The baselines match one large square of the overlap region instead of templates. The IMU check of
the two velocities is that of DIMES, with the same threshold. Only the measurement of the shift differs.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from marsyard.algorithms.arrays import Vector2
from marsyard.algorithms.dimes import ground_view, rectification
from marsyard.algorithms.dimes.options import DimesOptions
from marsyard.algorithms.dimes.validity import rank_combinations
from marsyard.algorithms.dimes.views import BinnedView, build_views
from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome
from marsyard.sim.measurements import DescentMeasurements

#: Spacing of the lattice for the search of the overlap region, rectified pixels.
COARSE_STEP_PX = 8


@dataclass(frozen=True)
class CommonOptions:
    """Options of both baselines; options without a description here, and their defaults, are those of `DimesOptions`.

    - min_side_px: Minimum side of the common square, rectified pixels: twice the search range, so that at least half of
      the square is visible in the second image
    - max_side_px: Maximum side of the common square, rectified pixels
    """

    binned_size: tuple[int, int] = DimesOptions.binned_size
    max_speed_m_s: float = DimesOptions.max_speed_m_s
    max_off_nadir_rad: float = DimesOptions.max_off_nadir_rad
    border_px: float = DimesOptions.border_px
    imu_threshold_m_s: float = DimesOptions.imu_threshold_m_s
    min_side_px: int = 64
    max_side_px: int = 256


DEFAULT_COMMON_OPTIONS = CommonOptions()


@dataclass(frozen=True)
class PairPatches:
    """Patches of both images of a pair that show the same square of ground if the camera does not move.

    - first, second: Corrected and rectified patches, counts, north up
    - gsd_m: Ground sample distance, metres per rectified pixel
    """

    first: Float[np.ndarray, "side side"]
    second: Float[np.ndarray, "side side"]
    gsd_m: float


@dataclass(frozen=True)
class PairMatch:
    """Shift between the two images of a pair.

    - shift_px: Shift of the second patch's content: (columns, rows), rectified pixels
    - score: Validity measure of the match (number of inliers, or phase correlation response); larger is better
    - valid: Whether the match is accepted
    """

    shift_px: Vector2
    score: float
    valid: bool


@dataclass(frozen=True)
class BaselineDetails:
    """Intermediate products of a baseline: for each pair the patches (None without overlap) and the match, or None."""

    patches: tuple[PairPatches | None, ...]
    matches: tuple[PairMatch | None, ...]


#: Function that measures the shift between the patches of a pair; None without a match.
Matcher = Callable[[PairPatches], PairMatch | None]


class GroundSquare(NamedTuple):
    """A square of ground: centre (east, north), metres; side, rectified pixels; metres per rectified pixel."""

    centre: Vector2
    side_px: int
    gsd_m: float


def find_common_square(first: BinnedView, second: BinnedView, options: CommonOptions) -> GroundSquare | None:
    """Find the largest square of ground inside both views at zero motion; None if it is too small."""
    gsd = float(second.centre[2]) * second.camera.pixel_angle_rad
    max_offset_m = np.tan(options.max_off_nadir_rad) * float(min(first.centre[2], second.centre[2]))
    points_per_side = 2 * int(np.ceil(max_offset_m / (COARSE_STEP_PX * gsd))) + 1
    lattice = rectification.ground_lattice(np.zeros(2), points_per_side, COARSE_STEP_PX * gsd)
    visible = np.ones(lattice.shape[:2], dtype=bool)
    for view in (first, second):
        visible &= ground_view.inside_frame(view, lattice, options.border_px, options.max_off_nadir_rad)
    # chessboard distance to the nearest invisible point, lattice steps; all closer points are visible
    distances = cv2.distanceTransform(np.pad(visible, 1).astype(np.uint8), cv2.DIST_C, 3)[1:-1, 1:-1]
    row, column = np.unravel_index(int(np.argmax(distances)), distances.shape)
    side = min(2 * (int(distances[row, column]) - 1) * COARSE_STEP_PX, options.max_side_px)
    return GroundSquare(lattice[row, column], side, gsd) if side >= options.min_side_px else None


def rectify_pair(first: BinnedView, second: BinnedView, options: CommonOptions) -> PairPatches | None:
    """Rectify both images of a pair over their largest common square; None if the square is too small."""
    square = find_common_square(first, second, options)
    if square is None:
        return None
    first_patch, second_patch = (rectification.rectify_patch(view, *square) for view in (first, second))
    return PairPatches(first_patch, second_patch, square.gsd_m)


def estimate_by_pairs(measurements: DescentMeasurements, matcher: Matcher, options: CommonOptions) -> VelocityEstimate:
    """Estimate the second pair's velocity, if both pairs match and their velocity change agrees with the IMU."""
    views = build_views(measurements, options.binned_size)
    if views is None:
        return VelocityEstimate(VelocityOutcome.NO_TEMPLATE_AREA, None, BaselineDetails((), ()))
    view_pairs = ((views[0], views[1]), (views[1], views[2]))
    patches = tuple(rectify_pair(first, second, options) for first, second in view_pairs)
    matches = tuple(None if pair_patches is None else matcher(pair_patches) for pair_patches in patches)
    details = BaselineDetails(patches, matches)
    if None in patches:
        return VelocityEstimate(VelocityOutcome.NO_TEMPLATE_AREA, None, details)
    velocities = []
    for (first, second), pair_patches, match in zip(view_pairs, patches, matches, strict=True):
        if pair_patches is None or match is None or not match.valid:
            return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None, details)
        # east and north, m/s: the camera moves opposite to the ground; rows run south
        shift_m = pair_patches.gsd_m * np.array([-match.shift_px[0], match.shift_px[1]])
        velocities.append(shift_m / (second.time_s - first.time_s))
    if max(np.hypot(*velocity) for velocity in velocities) > options.max_speed_m_s + options.imu_threshold_m_s:
        return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None, details)
    tracks = ([(0, velocities[0])], [(0, velocities[1])])
    (combination,) = rank_combinations(*tracks, measurements.interval_velocities_m_s)
    if not combination.discrepancy_m_s < options.imu_threshold_m_s:
        return VelocityEstimate(VelocityOutcome.IMU_MISMATCH, None, details)
    return VelocityEstimate(VelocityOutcome.VALID, velocities[1], details)
