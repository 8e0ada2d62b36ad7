"""Baselines of localisation: inertial navigation alone, and SIFT features with a perspective-n-point pose (OpenCV)."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int

from marsyard.algorithms.arrays import Points2
from marsyard.algorithms.localisation.details import LocalisationDetails
from marsyard.algorithms.localisation.interface import InitialState, MapProduct, PositionEstimate, PositionOutcome
from marsyard.algorithms.localisation.map_sampling import sample_raster
from marsyard.algorithms.localisation.navigation_filter import FilterOptions, LocalisationFilter
from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.algorithms.localisation.posed_image import PosedImage, binning_factor
from marsyard.sim.measurements import AltitudeMeasurement, DetectorImage, ImuIncrements

#: Largest ratio of the descriptor distances of the best and the second-best match (Lowe's ratio test).
MAX_DISTANCE_RATIO = 0.8
#: Number of descriptors that are matched together; limits the memory to 40 MB.
_MATCHED_TOGETHER = 256
#: Number of strips of rows in which the features of the map are extracted, and their margin in pixels. OpenCV's scale
#: space of a whole map of 16 x 16 km needs 0.7 GB.
_STRIPS, _MARGIN_PX = 4, 64


class InertialEstimator:
    """`PositionEstimator` that only propagates the initial state; always VALID."""

    def __init__(self, options: LvsOptions | None = None) -> None:
        self.options = LvsOptions() if options is None else options

    def start(self, initial: InitialState, map_product: MapProduct) -> None:
        """Reset the state for a new descent."""
        self._map = map_product
        self._filter = LocalisationFilter.from_initial(initial, FilterOptions(imu=self.options.imu))

    def process_increments(self, increments: ImuIncrements) -> None:
        """Propagate the state by inertial increments."""
        self._filter.propagate(increments)

    def process_altitude(self, measurement: AltitudeMeasurement) -> None:
        """Ignore altitudes."""

    def process_image(self, image: DetectorImage) -> PositionEstimate:
        """Return the state at the time of the image."""
        if not self._filter.is_stored(image.time_s):
            return PositionEstimate(PositionOutcome.OUTSIDE_INERTIAL_DATA, self._filter.time_s)
        return self._answer(image.time_s)

    def finish(self) -> PositionEstimate:
        """Return the state at the time of the last increment."""
        return self._answer(self._filter.time_s)

    def _answer(self, time_s: float) -> PositionEstimate:
        """Return the propagated state at a time."""
        return PositionEstimate(PositionOutcome.VALID, time_s, *self._filter.estimate(time_s))


class FeatureEstimator(InertialEstimator):
    """`PositionEstimator` that matches SIFT features of each image with those of the map.

    The pose is that of OpenCV's RANSAC for the perspective-n-point problem with the map's elevations. Its position
    updates the state of inertial navigation; its attitude is not used.
    """

    def start(self, initial: InitialState, map_product: MapProduct) -> None:
        """Reset the state, and extract the features of the map."""
        super().start(initial, map_product)
        self._sift = cv2.SIFT.create(nfeatures=self.options.sift_map_features)
        pixels, self._descriptors = extract_map_features(map_product.appearance, self.options.sift_map_features)
        heights = sample_raster(map_product.elevation_m, pixels[:, np.newaxis])[:, 0] if len(pixels) else np.empty(0)
        self._points = np.column_stack([map_product.origin_m + map_product.pixel_m * pixels, heights])
        self._is_valid = False  # whether a pose was found in this descent
        self._altitude_m: float | None = None

    def process_altitude(self, measurement: AltitudeMeasurement) -> None:
        """Store the altitude, which determines the scale at which an image is matched.

        An altitude is ignored if its time is outside the inertial data.
        """
        if not self._filter.is_stored(measurement.time_s):
            return
        self._altitude_m = measurement.altitude_m

    def process_image(self, image: DetectorImage) -> PositionEstimate:
        """Estimate the pose from features, and update the position. Without a pose, return the propagated state."""
        if not self._filter.is_stored(image.time_s):
            return PositionEstimate(PositionOutcome.OUTSIDE_INERTIAL_DATA, self._filter.time_s)
        state = self._filter.state_at(image.time_s)
        posed = PosedImage.from_detector(image, state.position_m, state.world_from_body)
        solution = None if self._altitude_m is None else self._solve(posed, self._altitude_m)
        if solution is None:
            return self._answer(image.time_s)
        position, inliers = solution
        variance = self.options.sift_sd_m**2
        self._filter.update_position(image.time_s, position[:2], variance * np.eye(2))
        self._is_valid = True
        return self._answer(image.time_s, LocalisationDetails("fine", inliers=inliers))

    def _solve(self, image: PosedImage, altitude_m: float) -> tuple[Float[np.ndarray, "3"], int] | None:
        """Solve the camera's position from matched features; None if there are too few of them."""
        scaled = image.bin(binning_factor(image, altitude_m, self._map.pixel_m))
        # columns of an image that looks down increase to the east and rows to the south; rows of the map to the north
        keypoints, descriptors = self._sift.detectAndCompute(_to_bytes(scaled.radiance[::-1]), None)
        if descriptors is None or len(keypoints) < self.options.min_matches:
            return None
        indices, map_indices = match_descriptors(descriptors, self._descriptors)
        if len(indices) < self.options.min_matches:
            return None
        pixels = np.array([keypoints[index].pt for index in indices], dtype=np.float64)
        pixels[:, 1] = scaled.camera.size[1] - 1 - pixels[:, 1]
        points = self._points[map_indices]
        _, directions = scaled.camera.rays(pixels)
        # a pinhole camera along -z of the body with axes x, -y, -z
        forward = -directions[:, 2]
        normalised = np.column_stack([directions[:, 0] / forward, -directions[:, 1] / forward])
        origin = points.mean(axis=0)
        found, rotation, translation, inliers = cv2.solvePnPRansac(
            points - origin,
            normalised,
            np.eye(3),
            None,
            # two pixels of the binned image, in normalised coordinates
            reprojectionError=2.0 * image.camera.pixel_angle_rad * image.camera.size[0] / scaled.camera.size[0],
            iterationsCount=2000,
            confidence=0.999,
        )
        if not found or inliers is None or len(inliers) < self.options.min_matches:
            return None
        matrix, _ = cv2.Rodrigues(rotation)
        return origin - (matrix.T @ translation).ravel(), len(inliers)

    def _answer(self, time_s: float, details: LocalisationDetails | None = None) -> PositionEstimate:
        """Return the state at a time; NO_COARSE_FIX before the first pose."""
        if not self._is_valid:
            return PositionEstimate(PositionOutcome.NO_COARSE_FIX, time_s, details=details)
        return PositionEstimate(PositionOutcome.VALID, time_s, *self._filter.estimate(time_s), details=details)


def extract_map_features(
    appearance: Float[np.ndarray, "rows columns"], count: int
) -> tuple[Points2, Float32[np.ndarray, "n 128"]]:
    """Extract SIFT features of a map, at most an equal part of `count` from each strip of rows.

    Returns their pixels (u, v) and descriptors.
    """
    raster, sift = _to_bytes(appearance), cv2.SIFT.create(nfeatures=count // _STRIPS)
    pixels, descriptors = [np.zeros((0, 2))], [np.zeros((0, 128), dtype=np.float32)]
    for first, last in pairwise(np.linspace(0, len(raster), _STRIPS + 1).astype(int).tolist()):
        # a multiple of the margin, so that the scale space has the same samples as that of the whole map
        top = max(first // _MARGIN_PX - 1, 0) * _MARGIN_PX
        strip = raster[top : last + _MARGIN_PX]
        inside = np.zeros(strip.shape, dtype=np.uint8)
        inside[first - top : last - top] = 255
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

    The result is that of `cv2.BFMatcher`, which takes four times as long as a matrix product. The elements of SIFT
    descriptors are whole numbers up to 255, so squared distances are exact in single precision.
    """
    if len(map_descriptors) < 2:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    squares = np.square(map_descriptors).sum(axis=1)
    pairs = []
    for start in range(0, len(descriptors), _MATCHED_TOGETHER):
        block = descriptors[start : start + _MATCHED_TOGETHER]
        distances = squares - 2.0 * (block @ map_descriptors.T)
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
