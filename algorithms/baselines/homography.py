"""Baseline for DIMES: homography between rectified images from OpenCV's ORB features."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from marsyard.algorithms.arrays import Points2, Raster, Vector2
from marsyard.algorithms.baselines.pairs import (
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
    - min_inliers: Minimum number of inliers. Images of different ground gave up to 6 inliers by chance; shifted images
      with the flight camera's noise gave at least 190.
    - max_distortion: Largest relative length change by the homography at the centroid of the inliers. Attitude and
      altitude errors within specification cause up to 0.02.
    - confidence, iterations: Parameters of the robust estimation
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
    """Horizontal velocity from a homography of ORB features between rectified images, by MAGSAC++.

    With exact attitude and altitude the homography is a shift; its other parameters absorb their errors. The shift is
    evaluated at the centroid of the inliers, where it is most accurate.
    """

    def __init__(self, options: HomographyOptions | None = None) -> None:
        self.options = HomographyOptions() if options is None else options

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """Estimate the velocity, with `BaselineDetails`. Raises as `DimesEstimator.estimate`."""
        return estimate_by_pairs(measurements, self._match, self.options.common)

    def _match(self, patches: PairPatches) -> PairMatch | None:
        opts, points = self.options, match_features(patches, self.options)
        if points is None:
            return None
        homography, inliers = cv2.findHomography(
            *points, cv2.USAC_MAGSAC, opts.reprojection_px, maxIters=opts.iterations, confidence=opts.confidence
        )
        if homography is None or not inliers.any():
            return None
        inlier = inliers.ravel().astype(bool)
        centroid = points[0][inlier].mean(axis=0).astype(np.float64)
        homogeneous = homography @ np.array([*centroid, 1.0])
        depth = homogeneous[2]
        if abs(depth) < 1e-9:
            return None
        mapped_point = homogeneous[:2] / depth
        count = int(inlier.sum())
        valid = count >= opts.min_inliers and distortion(homography, depth, mapped_point) <= opts.max_distortion
        return PairMatch(np.asarray(mapped_point - centroid), float(count), valid)


def distortion(homography: Float[np.ndarray, "3 3"], depth: float | np.floating, mapped_point: Vector2) -> float:
    """Largest relative length change near the point mapped to `mapped_point`, with homogeneous component `depth`."""
    jacobian = (homography[:2, :2] - np.outer(mapped_point, homography[2, :2])) / depth
    return float(np.abs(np.linalg.svd(jacobian, compute_uv=False) - 1.0).max())


def stretch_to_8_bits(patch: Raster) -> UInt8[np.ndarray, "rows columns"]:
    """Stretch a patch to 8 bits between its 0.5 % and 99.5 % quantiles."""
    low, high = np.quantile(patch, (0.005, 0.995))
    scaled = (patch - low) * (255.0 / max(float(high - low), 1e-9))
    return np.asarray(np.clip(np.rint(scaled), 0, 255).astype(np.uint8))


def match_features(patches: PairPatches, options: HomographyOptions) -> tuple[Points2, Points2] | None:
    """Positions (column, row) of matching features in both images; None if too few for a homography."""
    orb = cv2.ORB.create(nfeatures=options.features, fastThreshold=options.fast_threshold)
    images = (stretch_to_8_bits(patch) for patch in (patches.first, patches.second))
    (first, first_bits), (second, second_bits) = (orb.detectAndCompute(image, None) for image in images)
    if first_bits is None or second_bits is None or len(second) < 2:
        return None
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(first_bits, second_bits, k=2)
    good = [best for best, next_best in pairs if best.distance < options.max_ratio * next_best.distance]
    if len(good) < 4:
        return None
    return (
        np.array([first[match.queryIdx].pt for match in good], dtype=np.float32),
        np.array([second[match.trainIdx].pt for match in good], dtype=np.float32),
    )
