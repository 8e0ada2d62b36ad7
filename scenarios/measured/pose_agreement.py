"""Agreement of images with measured poses: match features, and compute their distances from the epipolar curves.

SIFT features (Lowe, "Distinctive Image Features from Scale-Invariant Keypoints", IJCV 60, 2004) are matched with the
ratio test and a cross check. An essential matrix, fitted by RANSAC without the poses, separates inliers from outliers.
Outliers are ignored. The poses define the epipolar curve of a feature of the earlier image: the projection of its ray
into the later image, from the position of the earlier camera to infinity. The residual is the distance of the match
from the nearest point of this curve. For two images from one position, the curve is a single point.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import cv2
import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial.transform import RigidTransform

from marsyard.scenarios.interface import Scalar
from marsyard.sim.camera import CameraModel
from marsyard.sim.measurements import DetectorImage

#: Maximum number of features of an image; maximum distance of the best match / second-best match (Lowe, Fig. 11).
_MAX_FEATURES, _MAX_DISTANCE_RATIO = 4000, 0.8
#: RANSAC: maximum distance of an inlier from its epipolar line, pixels, and probability of a sample without outlier.
_MAX_DISTANCE_PX, _CONFIDENCE = 2.0, 0.9999
#: Minimum number of matches: an essential matrix can be fitted exactly to any five matches, right or wrong.
MIN_MATCHES = 15
#: Smallest cosine between a ray and the optical axis for normalised coordinates: 89.9 deg; limits those of wider rays.
_MIN_AXIS_COSINE = 1e-3
#: Distance that represents infinity, m.
_INFINITY_M = 1e7
#: Quantiles of the counts that are mapped to black and white before feature detection, and their minimum difference.
_CONTRAST_QUANTILES, _MIN_CONTRAST = (0.005, 0.995), 1e-9

_Features: TypeAlias = tuple[Float64[np.ndarray, "n 2"], np.ndarray]


@dataclass(frozen=True, eq=False)
class PairMatches:
    """Pixels (u, v) of features matched between an earlier and a later image; inliers fit one rigid motion."""

    pixels: Float64[np.ndarray, "2 n 2"]
    inliers: Bool[np.ndarray, "n"]


@dataclass(frozen=True, eq=False)
class PairAgreement:
    """Agreement of two images with their poses: matches, and offsets (u, v) from the epipolar curves of the poses.

    The offsets are in pixels of the later image; NaN if its camera cannot see the predicted point.
    """

    matches: PairMatches
    offsets: Float64[np.ndarray, "n 2"]

    @cached_property
    def residuals_px(self) -> Float64[np.ndarray, "k"]:
        """Lengths of the inliers' offsets; empty with fewer than `MIN_MATCHES` inliers."""
        if np.count_nonzero(self.matches.inliers) < MIN_MATCHES:
            return np.empty(0)
        lengths = np.hypot(*self.offsets[self.matches.inliers].T)
        return np.asarray(np.where(np.isfinite(lengths), lengths, np.inf))


def match_images(images: Sequence[DetectorImage]) -> list[PairMatches]:
    """Match the features of each image with the features of the next image."""
    features = [_detect_features(image) for image in images]
    return list(map(_match_pair, itertools.pairwise(images), itertools.pairwise(features)))


def compare_with_poses(
    images: Sequence[DetectorImage], pairs: Sequence[PairMatches], poses: Sequence[RigidTransform]
) -> list[PairAgreement]:
    """Compare the matches of a case's images with the body's pose at each image."""
    cameras = [image.camera.transform(pose) for image, pose in zip(images, poses, strict=True)]
    return [
        PairAgreement(pair, epipolar_offsets_px(earlier, later, pair.pixels[0], pair.pixels[1]))
        for pair, (earlier, later) in zip(pairs, itertools.pairwise(cameras), strict=True)
    ]


def agreement_row(pairs: Sequence[PairAgreement]) -> dict[str, Scalar]:
    """Return the columns of a case: number of matches, residuals over all pairs, and the largest median of a pair.

    Residuals are NaN without matches.
    """
    residuals = np.concatenate([pair.residuals_px for pair in pairs])
    inliers = np.concatenate([pair.matches.inliers for pair in pairs])
    medians = [float(np.median(pair.residuals_px)) for pair in pairs if pair.residuals_px.size]
    return {
        "matches": int(inliers.sum()),
        "outlier_fraction": 1.0 - float(inliers.mean()) if inliers.size else np.nan,
        "pairs_matched": len(medians),
        "residual_median_px": float(np.median(residuals)) if medians else np.nan,
        "residual_90_percent_px": float(np.quantile(residuals, 0.9, method="higher")) if medians else np.nan,
        "residual_worst_pair_px": max(medians, default=np.nan),
    }


def agreement_products(images: Sequence[DetectorImage], pairs: Sequence[PairAgreement]) -> dict[str, object]:
    """Return arrays for figures: `image_<k>`, and `matches_<k>` of each pair of images k and k + 1.

    Columns of `matches_<k>`: (u, v) in the earlier image, (u, v) in the later image, offset (u, v), 1 for inliers.
    """
    products: dict[str, object] = {f"image_{number}": image.counts for number, image in enumerate(images, start=1)}
    for number, pair in enumerate(pairs, start=1):
        columns = [*pair.matches.pixels, pair.offsets, pair.matches.inliers[:, None].astype(np.float64)]
        products[f"matches_{number}"] = np.concatenate(columns, axis=1)
    return products


def _detect_features(image: DetectorImage) -> _Features:
    """Detect SIFT features on nearly square pixels, without the flat field; return delivered pixels and descriptors."""
    fu, fv = image.camera.focal_lengths
    rows, columns = image.counts.shape
    column_bin, row_bin = _square_pixel_factor(fu / fv, columns), _square_pixel_factor(fv / fu, rows)
    signal = (image.counts - image.calibration.offset_dn) / image.calibration.flat_field
    binned = signal.reshape(rows // row_bin, row_bin, columns // column_bin, column_bin).mean(axis=(1, 3))
    black, white = np.quantile(binned, _CONTRAST_QUANTILES)
    grey = np.clip((binned - black) / max(white - black, _MIN_CONTRAST) * 255.0, 0.0, 255.0).astype(np.uint8)
    points, descriptors = cv2.SIFT.create(nfeatures=_MAX_FEATURES).detectAndCompute(grey, None)
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 128), dtype=np.float32)
    binned_points = np.array([point.pt for point in points], dtype=np.float64)
    return (binned_points + 0.5) * np.array([column_bin, row_bin]) - 0.5, descriptors


def _square_pixel_factor(ratio: float, extent: int) -> int:
    """Return the number of pixels to average along a side whose focal length, in pixels, is larger by `ratio`."""
    factor = max(round(ratio), 1)
    return factor if extent % factor == 0 else 1


def _match_pair(images: tuple[DetectorImage, DetectorImage], features: tuple[_Features, _Features]) -> PairMatches:
    """Match features that are mutual nearest neighbours and pass the ratio test; find the inliers by RANSAC.

    Inliers are consistent with one rigid motion between the cameras. The measured poses are not used.
    """
    (earlier, descriptors), (later, later_descriptors) = features
    matches: dict[tuple[float, ...], tuple[int, int]] = {}
    if len(earlier) >= 2 and len(later) >= 2:
        matcher = cv2.BFMatcher(cv2.NORM_L2)
        reverse = {match.queryIdx: match.trainIdx for (match,) in matcher.knnMatch(later_descriptors, descriptors, k=1)}
        # several orientations of one feature are one match
        matches = {
            tuple(earlier[best.queryIdx].tolist()): (best.queryIdx, best.trainIdx)
            for best, next_best in matcher.knnMatch(descriptors, later_descriptors, k=2)
            if best.distance < _MAX_DISTANCE_RATIO * next_best.distance and reverse.get(best.trainIdx) == best.queryIdx
        }
    indices = np.array(list(matches.values()), dtype=np.intp).reshape(-1, 2)
    pixels = np.stack([earlier[indices[:, 0]], later[indices[:, 1]]])
    inliers = np.zeros(len(indices), dtype=np.bool_)
    if len(indices) >= MIN_MATCHES:
        points = []
        for image, image_pixels in zip(images, pixels, strict=True):
            # normalised image coordinates: intersections of the rays with the plane at unit distance
            axes = np.stack([image.camera.right, image.camera.down, image.camera.a])
            _, directions = image.camera.rays(image_pixels)
            x, y, z = (directions @ axes.T).T
            points.append(np.stack([x, y], axis=1) / np.maximum(z, _MIN_AXIS_COSINE)[:, None])
        focal = 0.5 * sum(float(np.sqrt(np.prod(image.camera.focal_lengths))) for image in images)
        limit = _MAX_DISTANCE_PX / focal
        _, mask = cv2.findEssentialMat(
            points[0], points[1], np.eye(3), method=cv2.RANSAC, prob=_CONFIDENCE, threshold=limit
        )
        inliers = inliers if mask is None else np.asarray(mask).ravel() > 0
    return PairMatches(pixels, inliers)


def epipolar_offsets_px(
    first: CameraModel,
    second: CameraModel,
    pixels: Float64[np.ndarray, "n 2"],
    later_pixels: Float64[np.ndarray, "n 2"],
) -> Float64[np.ndarray, "n 2"]:
    """Return the offsets of matches from the nearest points of their epipolar curves in the second image, pixels.

    The cameras are in one frame. NaN if the second camera cannot see the point. Seen from the second camera, a ray of
    the first camera is an arc. It starts at the direction to the first camera, `baseline`, and ends at the direction of
    the ray. The second camera's ray p of the match is projected onto the plane of the arc. The nearest point of the arc
    is the intersection of the projected ray with the first ray: ``p x (baseline + s direction) = 0``.
    """
    origins, directions = first.rays(pixels)
    later_origins, later_directions = second.rays(later_pixels)
    baselines = origins - later_origins
    normals = np.cross(baselines, directions)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0.0)
    projected_directions = later_directions - np.sum(later_directions * normals, axis=1, keepdims=True) * normals
    baseline_cross, direction_cross = (
        np.cross(projected_directions, baselines),
        np.cross(projected_directions, directions),
    )
    scale = np.sum(direction_cross * direction_cross, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = -np.sum(baseline_cross * direction_cross, axis=1) / scale
    is_in_front = np.sum((baselines + distances[:, None] * directions) * projected_directions, axis=1) > 0.0
    is_inside_arc = np.isfinite(distances) & (distances > 0.0) & is_in_front & (lengths[:, 0] > 0.0)
    # outside the arc, use its end at infinity; the other end is the first camera, where no ground is visible
    distances = np.where(is_inside_arc, np.minimum(distances, _INFINITY_M), _INFINITY_M)
    predicted, _ = second.project(origins + distances[:, None] * directions)
    return np.asarray(later_pixels - predicted)
