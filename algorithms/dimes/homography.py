"""Baseline velocity estimator: ORB features with a homography (OpenCV) between rectified images."""

from dataclasses import dataclass
from typing import final

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from marsyard.algorithms.arrays import Points2, Raster, Vector2
from marsyard.algorithms.dimes.baselines import (
    DEFAULT_COMMON_OPTIONS,
    CommonOptions,
    PairMatch,
    PairPatches,
    estimate_by_pairs,
)
from marsyard.algorithms.interface import VelocityEstimate
from marsyard.sim.measurements import DescentMeasurements


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
