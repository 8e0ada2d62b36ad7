"""A homography between rectified pictures from ORB features, as OpenCV has it."""

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
    - max_ratio: Largest distance of the best match over that of the second best (Lowe's ratio)
    - reprojection_px: Largest reprojection error of an inlier, rectified pixels
    - min_inliers: Minimum number of inliers: chance matches of images of different ground agreed in up to 6, those of
      shifted ones with the flight camera's noise in 190 and above.
    - max_distortion: Largest relative length change by the homography in the middle of the inliers: attitudes and
      altitudes within specification leave 0.02.
    - confidence, iterations: Of the robust estimation
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
    taken in the middle of the inliers, where it is most accurate.
    """

    def __init__(self, options: HomographyOptions | None = None) -> None:
        self.options = HomographyOptions() if options is None else options

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """The estimate, with `BaselineDetails`. Raises as `DimesEstimator.estimate`."""
        return estimate_by_pairs(measurements, self._match, self.options.common)

    def _match(self, patches: PairPatches) -> PairMatch | None:
        o, points = self.options, match_features(patches, self.options)
        if points is None:
            return None
        homography, inliers = cv2.findHomography(
            *points, cv2.USAC_MAGSAC, o.reprojection_px, maxIters=o.iterations, confidence=o.confidence
        )
        if homography is None or not inliers.any():
            return None
        inlier = inliers.ravel().astype(bool)
        middle = points[0][inlier].mean(axis=0).astype(np.float64)
        moved = homography @ np.array([*middle, 1.0])
        if abs(moved[2]) < 1e-9:
            return None
        point = moved[:2] / moved[2]
        count = int(inlier.sum())
        valid = count >= o.min_inliers and distortion(homography, moved[2], point) <= o.max_distortion
        return PairMatch(np.asarray(point - middle), float(count), valid)


def distortion(homography: Float[np.ndarray, "3 3"], depth: float | np.floating, place: Vector2) -> float:
    """Largest relative length change by the homography about the point that it maps to `place`.

    `depth` is the third homogeneous component of the mapped point.
    """
    jacobian = (homography[:2, :2] - np.outer(place, homography[2, :2])) / depth
    return float(np.abs(np.linalg.svd(jacobian, compute_uv=False) - 1.0).max())


def stretch_to_8_bits(patch: Raster) -> UInt8[np.ndarray, "rows columns"]:
    """The patch stretched to 8 bits between its 0.5 % and 99.5 % quantiles."""
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
