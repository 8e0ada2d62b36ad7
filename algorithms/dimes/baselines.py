"""Baseline velocity estimators (OpenCV): phase correlation, and ORB features with a homography.

Both images of a pair are rectified to one virtual camera that looks straight down (`rectification.rectify_patch`) and
corrected as in DIMES. The baselines match one large square of the overlap region instead of templates. The IMU check of
the two velocities is that of DIMES, with the same threshold. Only the measurement of the shift differs.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from marsyard.algorithms.arrays import Points2, Raster, Vector2
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


def rectify_pair(first: BinnedView, second: BinnedView, options: CommonOptions) -> PairPatches | None:
    """Rectify both images over the largest square of ground inside both at zero motion; None if it is too small."""
    gsd = float(second.centre[2]) * second.camera.pixel_angle_rad
    max_offset_m = np.tan(options.max_off_nadir_rad) * float(min(first.centre[2], second.centre[2]))
    points_per_side = 2 * int(np.ceil(max_offset_m / (COARSE_STEP_PX * gsd))) + 1
    lattice = rectification.ground_lattice(np.zeros(2), points_per_side, COARSE_STEP_PX * gsd)
    visible = np.ones(lattice.shape[:2], dtype=bool)
    for view in (first, second):
        visible &= ground_view.inside_frame(view, lattice, options.border_px, options.max_off_nadir_rad)
    # chessboard distance to the nearest invisible point, lattice steps; all closer points are visible
    distances = cv2.distanceTransform(np.pad(visible, 1).astype(np.uint8), cv2.DIST_C, cv2.DIST_MASK_3)[1:-1, 1:-1]
    row, column = np.unravel_index(int(np.argmax(distances)), distances.shape)
    side = min(2 * (int(distances[row, column]) - 1) * COARSE_STEP_PX, options.max_side_px)
    if side < options.min_side_px:
        return None
    first_patch, second_patch = (
        rectification.rectify_patch(view, lattice[row, column], side, gsd) for view in (first, second)
    )
    return PairPatches(first_patch, second_patch, gsd)


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


@dataclass(frozen=True)
class PhaseCorrelationOptions:
    """Options of the phase correlation.

    - common: Geometry and IMU check
    - min_response: Minimum response of `cv2.phaseCorrelate`: energy of the peak, 1 for equal images. Image pairs
      of different ground had up to 0.12; shifted images with the flight camera's noise had at least 0.79.
    """

    common: CommonOptions = DEFAULT_COMMON_OPTIONS
    min_response: float = 0.25


@final
class PhaseCorrelationEstimator:
    """Baseline velocity estimator: shift between rectified images by `cv2.phaseCorrelate` with a Hann window."""

    def __init__(self, options: PhaseCorrelationOptions | None = None) -> None:
        self.options = PhaseCorrelationOptions() if options is None else options

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """Estimate the velocity, with `BaselineDetails`. Raises the same errors as `DimesEstimator.estimate`."""
        return estimate_by_pairs(measurements, self._match, self.options.common)

    def _match(self, patches: PairPatches) -> PairMatch | None:
        """Return the shift and the response; None if a patch is uniform."""
        first, second = patches.first, patches.second
        if np.ptp(first) == 0.0 or np.ptp(second) == 0.0:
            return None
        window = cv2.createHanningWindow((first.shape[1], first.shape[0]), cv2.CV_64F)
        shift, response = cv2.phaseCorrelate(first - first.mean(), second - second.mean(), window)
        return PairMatch(np.array(shift, dtype=np.float64), float(response), response >= self.options.min_response)


@dataclass(frozen=True)
class HomographyOptions:
    """Options of the homography.

    - common: Geometry and IMU check
    - features: Maximum number of features in each image
    - fast_threshold: FAST threshold, grey levels after the stretch to 8 bits
    - max_ratio: Largest ratio of the descriptor distances of the best and the second-best match (Lowe's ratio test)
    - reprojection_px: Largest reprojection error of an inlier, rectified pixels
    - min_inliers: Minimum number of inliers. In tests, image pairs of different ground had up to 6 inliers by chance;
      shifted images with the flight camera's noise had at least 190.
    - max_distortion: Largest relative length change by the homography at the centroid of the inliers. Attitude and
      altitude errors within specification cause up to 0.02.
    - confidence, iterations: Confidence level and maximum number of iterations of MAGSAC++
    """

    common: CommonOptions = DEFAULT_COMMON_OPTIONS
    features: int = 500
    fast_threshold: int = 5
    max_ratio: float = 0.8
    reprojection_px: float = 1.5
    min_inliers: int = 15
    max_distortion: float = 0.1
    confidence: float = 0.999
    iterations: int = 2000


@final
class HomographyEstimator:
    """Baseline velocity estimator: homography of ORB features between rectified images, by MAGSAC++.

    With exact attitude and altitude the homography is a pure shift. Attitude and altitude errors change its other
    parameters. The shift is evaluated at the centroid of the inliers, where it is most accurate.
    """

    def __init__(self, options: HomographyOptions | None = None) -> None:
        self.options = HomographyOptions() if options is None else options

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """Estimate the velocity, with `BaselineDetails`. Raises the same errors as `DimesEstimator.estimate`."""
        return estimate_by_pairs(measurements, self._match, self.options.common)

    def _match(self, patches: PairPatches) -> PairMatch | None:
        """Return the shift at the inliers' centroid; None if no homography is found. The score is the inlier count."""
        options = self.options
        features = [detect_features(patch, options) for patch in (patches.first, patches.second)]
        pairs = match_features(features[0][1], features[1][1], options)
        if len(pairs) < 4:  # the minimum for a homography
            return None
        points = [positions[pairs[:, side]].astype(np.float32) for side, (positions, _) in enumerate(features)]
        homography, inliers = cv2.findHomography(
            points[0],
            points[1],
            cv2.USAC_MAGSAC,
            options.reprojection_px,
            maxIters=options.iterations,
            confidence=options.confidence,
        )
        if homography is None or not inliers.any():
            return None
        is_inlier = inliers.ravel().astype(bool)
        centroid = points[0][is_inlier].mean(axis=0).astype(np.float64)
        homogeneous = homography @ np.array([*centroid, 1.0])
        depth = homogeneous[2]
        if abs(depth) < 1e-9:  # the centroid would be mapped to infinity
            return None
        mapped_point = homogeneous[:2] / depth
        count = int(is_inlier.sum())
        distortion = max_length_change(homography, depth, mapped_point)
        valid = count >= options.min_inliers and distortion <= options.max_distortion
        return PairMatch(np.asarray(mapped_point - centroid), float(count), valid)


def max_length_change(homography: Float[np.ndarray, "3 3"], depth: float | np.floating, mapped_point: Vector2) -> float:
    """Largest relative change of a length near a point, from the singular values of the homography's Jacobian.

    `mapped_point` is the mapped point, `depth` its homogeneous component.
    """
    jacobian = (homography[:2, :2] - np.outer(mapped_point, homography[2, :2])) / depth
    return float(np.abs(np.linalg.svd(jacobian, compute_uv=False) - 1.0).max())


def stretch_to_8_bits(patch: Raster) -> UInt8[np.ndarray, "rows columns"]:
    """Stretch a patch to 8 bits between its 0.5 % and 99.5 % quantiles."""
    low, high = np.quantile(patch, (0.005, 0.995))
    scaled = (patch - low) * (255.0 / max(float(high - low), 1e-9))
    return np.asarray(np.clip(np.rint(scaled), 0, 255).astype(np.uint8))


def detect_features(patch: Raster, options: HomographyOptions) -> tuple[Points2, UInt8[np.ndarray, "n 32"]]:
    """Detect ORB features; return their positions (column, row) and descriptors."""
    orb = cv2.ORB.create(nfeatures=options.features, fastThreshold=options.fast_threshold)
    keypoints, descriptors = orb.detectAndCompute(stretch_to_8_bits(patch), None)
    if descriptors is None:
        return np.zeros((0, 2)), np.zeros((0, 32), dtype=np.uint8)
    return np.array([keypoint.pt for keypoint in keypoints]), descriptors


def match_features(
    first: UInt8[np.ndarray, "n 32"], second: UInt8[np.ndarray, "m 32"], options: HomographyOptions
) -> Int[np.ndarray, "matches 2"]:
    """Match ORB descriptors; return the indices of the pairs that pass the ratio test."""
    if len(second) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    neighbours = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(first, second, k=2)
    pairs = [
        (best.queryIdx, best.trainIdx)
        for best, second_best in neighbours
        if best.distance < options.max_ratio * second_best.distance
    ]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)
