"""Pose of an image from its SIFT features, matched with those of a map (perspective-n-point)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.spatial.transform import Rotation

from marsyard.algorithms.arrays import Points2, Points3, Vector3
from marsyard.algorithms.localisation.interface import MapProduct
from marsyard.algorithms.localisation.map_sampling import elevation_at, sample_raster
from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.algorithms.localisation.posed_image import PosedImage
from marsyard.sim.camera import camera_pose

#: Largest ratio of the descriptor distances of the best and the second-best match (Lowe's ratio test).
MAX_DISTANCE_RATIO = 0.8
#: Number of descriptors that are matched together; limits the memory to 40 MB.
_MATCHED_TOGETHER = 512
#: Number of strips of rows in which the features of the map are extracted, and their margin in pixels. OpenCV's scale
#: space of a whole map of 16 x 16 km needs 0.7 GB.
_STRIPS, _MARGIN_PX = 4, 64
#: Smallest side of a binned image in which `register_image` searches for features, pixels.
_MIN_SIDE_PX = 96
#: Largest ratio of the pixels of map and binned image on the ground, and its inverse, in a registration (assumed): SIFT
#: compares scales in steps of 2, and a wrong pose often places the camera very far from the ground.
_MAX_SCALE_RATIO = 4.0
#: Smallest component along the optical axis of the direction of a match: 84 deg, beyond which it is at the horizon.
_MIN_FORWARD = 0.1
#: Largest distance of an inlier from its position by the homography, pixels of the binned image; standard deviation of
#: the blur of `flatten`, pixels (assumed).
_MAX_RESIDUAL_PX, _FLATTEN_PX = 2.5, 16.0


@dataclass(frozen=True)
class MapFeatures:
    """SIFT features of a map: positions in the world frame, with the elevations of the map, and descriptors."""

    points_m: Points3
    descriptors: Float32[np.ndarray, "n 128"]

    @classmethod
    def extract(cls, map_product: MapProduct, count: int) -> MapFeatures:
        """Extract at most `count` features."""
        pixels, descriptors = extract_map_features(map_product.appearance, count)
        heights = sample_raster(map_product.elevation_m, pixels[:, np.newaxis])[:, 0] if len(pixels) else np.empty(0)
        return cls(np.column_stack([map_product.origin_m + map_product.pixel_m * pixels, heights]), descriptors)


@dataclass(frozen=True)
class FeaturePose:
    """An image with the pose of its camera by matched features, and the number of features that agree with it."""

    image: PosedImage
    inliers: int


def register_image(
    image: PosedImage, map_product: MapProduct, features: MapFeatures, options: LvsOptions
) -> FeaturePose | None:
    """Find the pose of an image over the whole map; None if no scale has enough matches for a plausible pose.

    The pose of `image` is not used. The image is binned by all powers of two that divide its size, and the scale with
    the most inliers is accepted. Inliers agree with a homography between map and image (RANSAC), which includes slopes
    of the ground that the map does not contain. The pose is that with the least squares of their residuals. In a
    plausible pose the camera looks down from above the ground, at a similar scale as the map.

    - features: of the map after `flatten`
    """
    best, factor = None, 1
    while min(image.camera.size) // factor >= _MIN_SIDE_PX and not any(side % factor for side in image.camera.size):
        scaled = image.bin(factor)
        matches = match_with_map(replace(scaled, radiance=flatten(scaled.radiance)), features, options)
        solution = None if matches is None else _solve_by_homography(image, factor, *matches, options)
        if solution is not None and (best is None or solution.inliers > best.inliers):
            posed = solution.image
            height_m = float(posed.position_m[2]) - elevation_at(map_product, posed.position_m[:2])
            ratio = factor * posed.camera.pixel_angle_rad * height_m / map_product.pixel_m
            looks_down = float(posed.world_from_body.apply(posed.camera.boresight())[2]) < 0.0
            if looks_down and 1.0 / _MAX_SCALE_RATIO <= ratio <= _MAX_SCALE_RATIO:
                best = solution
        factor *= 2
    return best


def flatten(raster: Float32[np.ndarray, "rows columns"]) -> Float32[np.ndarray, "rows columns"]:
    """Return the relative deviation of a raster from the blurred raster: without vignetting, haze and large shadows."""
    blurred = cv2.GaussianBlur(raster, (0, 0), _FLATTEN_PX, borderType=cv2.BORDER_REFLECT)
    # the lower limit of the divisor is relative to the brightest part; the constant prevents a division of zero by zero
    return np.asarray(raster / np.maximum(blurred, np.float32(1e-6) + np.abs(blurred).max() * np.float32(1e-3)) - 1.0)


def solve_pose(image: PosedImage, factor: int, features: MapFeatures, options: LvsOptions) -> FeaturePose | None:
    """Solve the pose of an image, binned by `factor`, from features matched with those of a map; None if too few match.

    The pose of `image` is not used. OpenCV's RANSAC for the perspective-n-point problem accepts residuals of 2 pixels.
    """
    matches = match_with_map(image.bin(factor), features, options)
    if matches is None:
        return None
    points, coordinates = matches
    origin = points.mean(axis=0)
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        points - origin,
        coordinates,
        np.eye(3),
        None,
        # two pixels of the binned image, in normalised coordinates
        reprojectionError=2.0 * factor * image.camera.pixel_angle_rad,
        iterationsCount=2000,
        confidence=0.999,
    )
    if not found or inliers is None or len(inliers) < options.min_matches:
        return None
    return _to_pose(image, rotation, translation, origin, len(inliers))


def match_with_map(image: PosedImage, features: MapFeatures, options: LvsOptions) -> tuple[Points3, Points2] | None:
    """Match the SIFT features of an image with those of a map; None if they are too few.

    Returns positions on the map, and normalised image coordinates: columns to the right and rows down at unit distance
    along the optical axis.
    """
    # columns of an image that looks down increase to the east and rows to the south; rows of the map to the north
    sift = cv2.SIFT.create(nfeatures=options.sift_map_features)
    keypoints, descriptors = sift.detectAndCompute(_to_bytes(image.radiance[::-1]), None)
    if descriptors is None or len(keypoints) < options.min_matches:
        return None
    indices, map_indices = match_descriptors(descriptors, features.descriptors)
    if len(indices) < options.min_matches:
        return None
    pixels = np.array([keypoints[index].pt for index in indices], dtype=np.float64)
    pixels[:, 1] = image.camera.size[1] - 1 - pixels[:, 1]
    directions = camera_pose(image.camera).rotation.inv().apply(image.camera.rays(pixels)[1])
    forward = directions[:, 2] >= _MIN_FORWARD
    if np.count_nonzero(forward) < options.min_matches:
        return None
    return features.points_m[map_indices[forward]], directions[forward, :2] / directions[forward, 2:]


def _solve_by_homography(
    image: PosedImage, factor: int, points: Points3, coordinates: Points2, options: LvsOptions
) -> FeaturePose | None:
    """Solve the pose from the matches (see `match_with_map`) that agree with a homography; None if they are too few."""
    origin = points.mean(axis=0)
    relative = points - origin
    pixel_rad = factor * image.camera.pixel_angle_rad
    # from horizontal positions, of order 1000 m, to pixels of the binned image
    homography, mask = cv2.findHomography(
        relative[:, :2], coordinates / pixel_rad, cv2.RANSAC, _MAX_RESIDUAL_PX, maxIters=20000, confidence=0.9999
    )
    inliers = np.zeros(len(points), dtype=np.bool_) if homography is None else mask.ravel() > 0
    # different features of the image can match one feature of the map
    count = len(np.unique(points[inliers], axis=0))
    if count < options.min_matches:
        return None
    found, rotation, translation = cv2.solvePnP(relative[inliers], coordinates[inliers], np.eye(3), None)
    return _to_pose(image, rotation, translation, origin, count) if found else None


def _to_pose(
    image: PosedImage, rotation: np.ndarray, translation: np.ndarray, origin_m: Vector3, inliers: int
) -> FeaturePose:
    """Convert OpenCV's pose, of points relative to an origin, to the pose of the image."""
    world_from_camera = Rotation.from_rotvec(rotation.ravel()).inv()
    world_from_body = world_from_camera * camera_pose(image.camera).rotation.inv()
    position = origin_m - world_from_camera.apply(translation.ravel()) - world_from_body.apply(np.array(image.camera.c))
    return FeaturePose(replace(image, position_m=position, world_from_body=world_from_body), inliers)


def extract_map_features(
    appearance: Float[np.ndarray, "rows columns"], count: int, valid: Bool[np.ndarray, "rows columns"] | None = None
) -> tuple[Points2, Float32[np.ndarray, "n 128"]]:
    """Extract SIFT features of a map, at most an equal part of `count` from each strip of rows.

    Returns their pixels (u, v) and descriptors. Features at pixels that are not `valid` are left out.
    """
    raster, sift = _to_bytes(appearance), cv2.SIFT.create(nfeatures=count // _STRIPS)
    pixels, descriptors = [np.zeros((0, 2))], [np.zeros((0, 128), dtype=np.float32)]
    for first, last in pairwise(np.linspace(0, len(raster), _STRIPS + 1).astype(int).tolist()):
        # a multiple of the margin, so that the scale space has the same samples as that of the whole map
        top = max(first // _MARGIN_PX - 1, 0) * _MARGIN_PX
        strip = raster[top : last + _MARGIN_PX]
        inside = np.zeros(strip.shape, dtype=np.uint8)
        inside[first - top : last - top] = 255 if valid is None else 255 * valid[first:last].astype(np.uint8)
        keypoints, strip_descriptors = sift.detectAndCompute(strip, inside)
        if len(keypoints):
            positions = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64)
            pixels.append(positions + np.array([0.0, top]))
            descriptors.append(strip_descriptors)
    return np.concatenate(pixels), np.concatenate(descriptors)


def match_descriptors(
    descriptors: Float32[np.ndarray, "n 128"], map_descriptors: Float32[np.ndarray, "m 128"]
) -> tuple[Int[np.ndarray, " matches"], Int[np.ndarray, " matches"]]:
    """Match each descriptor with the nearest one of the map; return the indices of both that pass Lowe's ratio test.

    The result is that of `cv2.BFMatcher`, which takes five times as long as a matrix product. The product contains the
    squares of the map's descriptors as a further column, so that it is the squared distance minus that of the origin.
    The elements of SIFT descriptors are whole numbers up to 255, so squared distances are exact in single precision.
    """
    if len(map_descriptors) < 2:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    columns = np.column_stack([-2.0 * map_descriptors, np.square(map_descriptors).sum(axis=1)]).T
    pairs = []
    for start in range(0, len(descriptors), _MATCHED_TOGETHER):
        block = descriptors[start : start + _MATCHED_TOGETHER]
        distances = np.column_stack([block, np.ones(len(block), dtype=np.float32)]) @ columns
        rows, nearest = np.arange(len(block)), distances.argmin(axis=1)
        offset = np.square(block).sum(axis=1)
        best = np.sqrt(distances[rows, nearest] + offset)
        distances[rows, nearest] = np.inf
        is_good = best < MAX_DISTANCE_RATIO * np.sqrt(distances.min(axis=1) + offset)
        pairs.append(np.column_stack([start + rows, nearest])[is_good])
    indices = np.concatenate([np.zeros((0, 2), dtype=np.int64), *pairs])
    return indices[:, 0], indices[:, 1]


def _to_bytes(raster: Float[np.ndarray, "rows columns"]) -> np.ndarray:
    """Scale a raster to 8 bits between its 1 % and 99 % quantiles."""
    low, high = np.quantile(raster, (0.01, 0.99))
    scaled = np.clip(255.0 * (raster - low) / max(float(high - low), 1e-9), 0.0, 255.0)
    return np.ascontiguousarray(scaled.astype(np.uint8))
