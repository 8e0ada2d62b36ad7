"""Surveyed targets of the attitude reference: panels on the ground, their detection in images, and their sightings.

The panels are detected as small bright spots: a white top-hat removes the ground, and a connected region above a
threshold is a candidate. The prior attitude predicts the pixels of the targets. The common displacement with the most
pairs of candidates and targets determines which candidates are targets; a rotation fitted to the pairs rejects the
others. The paper states that the centroids were extracted, not how: all parameters of the detection are assumed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64, UInt16
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from marsyard.scenarios.fieldtest.parameters import ImageTargetParameters
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics import Motion
from marsyard.sim.render import Objects
from marsyard.sim.terrain import Surface

#: Minimum distance of a measured target from the edge of the image, pixels.
_BORDER_PX = 4.0
#: Height of a panel above the ground, metres.
_CLEARANCE_M = 0.03
#: Side lengths of the structuring element of the top-hat, divided by those of a target in the image, and their minimum.
_TOP_HAT_SIDES, _MIN_TOP_HAT_PX = 3.0, 3
#: Threshold of candidates: standard deviations of the top-hat image, estimated from its quantiles.
_THRESHOLD_SD = 5.0
#: Maximum displacement of the predicted targets, in standard deviations of the prior attitude.
_PRIOR_SD = 4.0
#: Half side of the window of a centroid, divided by the side length of a target in the image.
_WINDOW_SIDES = 1.5
#: Maximum distance of a candidate from a predicted target, in metres on the ground: for the common displacement (the
#: displacement with the most such candidates is selected), and after the fit.
_MAX_VOTE_DISTANCE_M, _MAX_FIT_DISTANCE_M = 3.0, 1.2
#: Iterations of assignment and fit, and minimum number of detected targets in a valid image.
_ITERATIONS, _MIN_TARGETS = 3, 5


@dataclass(frozen=True)
class Targets:
    """Targets on the ground: true corners of the panels and surveyed positions of their centres, world axes, metres."""

    corners_m: Float64[np.ndarray, "targets 4 3"]
    surveyed_m: Float64[np.ndarray, "targets 3"]
    side_m: float

    @classmethod
    def draw(
        cls, p: ImageTargetParameters, surface: Surface, centre_m: Float64[np.ndarray, "2"], rng: np.random.Generator
    ) -> Targets:
        """Draw `placed` panels on the ground around a position; return the first `used` of them.

        The first `central` panels are evenly spaced on a circle, the others are at random positions in a square.
        """
        points = rng.uniform(-p.within_m, p.within_m, (p.placed, 2))
        azimuths = rng.uniform(0.0, 2.0 * np.pi) + 2.0 * np.pi * np.arange(p.central) / max(p.central, 1)
        points[: p.central] = p.central_m * np.column_stack([np.cos(azimuths), np.sin(azimuths)])
        points = centre_m + points[: p.used]
        error = p.survey_m * rng.standard_normal((p.used, 3))
        # corners of squares of any azimuth, counterclockwise
        angles = rng.uniform(0.0, 0.5 * np.pi, p.used)[:, None] + np.radians([0.0, 90.0, 180.0, 270.0])
        offsets = p.side_m * np.sqrt(0.5) * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        corners = points[:, None] + offsets
        heights = surface.height(corners[..., 0], corners[..., 1]) + _CLEARANCE_M
        corners = np.concatenate([corners, heights[..., None]], axis=-1)
        return cls(corners, corners.mean(axis=1) + error, p.side_m)

    @property
    def true_m(self) -> Float64[np.ndarray, "targets 3"]:
        """True positions of the centres."""
        return np.asarray(self.corners_m.mean(axis=1))

    def panels(self, albedo: float) -> Objects:
        """Build the panels as objects for the renderer."""
        corners, count = self.corners_m, len(self.corners_m)
        normals = normalize(np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]))
        faces = (4 * np.arange(count)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
        names = np.repeat(np.arange(count, dtype=np.int32), 2)
        return Objects.of_mesh(
            corners.reshape(-1, 3), np.repeat(normals, 4, axis=0), faces.astype(np.int32), names, albedo
        )


@dataclass(frozen=True)
class Sightings:
    """Target directions measured in the images of a pass: one row per target and image.

    - times_s: time tag of the image
    - body_directions: unit vector to the target in body axes, from its centroid in the image
    - world_directions: unit vector to the target in world axes, from the survey and the helicopter's GPS position
    """

    times_s: Float64[np.ndarray, "n"]
    body_directions: Float64[np.ndarray, "n 3"]
    world_directions: Float64[np.ndarray, "n 3"]

    @classmethod
    def from_centroids(
        cls,
        targets: Targets,
        camera: CameraModel,
        tags_s: Float64[np.ndarray, "images"],
        gps_m: Float64[np.ndarray, "images 3"],
        centroids_px: Sequence[Float64[np.ndarray, "targets 2"]],
    ) -> Sightings:
        """Compute the directions from the centroids in each image (columns, rows); NaN for targets not detected."""
        rows = []
        for tag, position, centroids in zip(tags_s, gps_m, centroids_px, strict=True):
            is_measured = np.isfinite(centroids).all(axis=1)
            _, directions = camera.rays(centroids[is_measured])
            offsets = targets.surveyed_m[is_measured] - position
            rows.append((np.full(len(offsets), tag), normalize(directions), normalize(offsets)))
        times, camera_vectors, world_vectors = (np.concatenate(arrays) for arrays in zip(*rows, strict=True))
        return cls(times, camera_vectors, world_vectors)


def normalize(vectors: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Return the unit vectors."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def project_targets(
    targets: Targets, camera: CameraModel, motion: Motion, centroid_px: float, rng: np.random.Generator
) -> list[Float64[np.ndarray, "targets 2"]]:
    """Project the true targets into the images of a pass and add centroid errors, without rendering.

    - camera: the true camera in the body frame, with the pixels of a delivered image
    - motion: true motion at the exposures
    - centroid_px: standard deviation of a centroid per axis
    """
    centroids = []
    for attitude, position in zip(motion.attitudes, motion.positions_m, strict=True):
        pixels, visible = camera.project(attitude.inv().apply(targets.true_m - position))
        pixels = pixels + centroid_px * rng.standard_normal(pixels.shape)
        centroids.append(np.where((visible & is_measurable(pixels, camera))[:, None], pixels, np.nan))
    return centroids


def is_measurable(pixels: Float64[np.ndarray, "n 2"], camera: CameraModel) -> np.ndarray:
    """Return whether each pixel is in the image, away from its edge."""
    high = np.array(camera.size) - 1.0 - _BORDER_PX
    return np.asarray(((pixels >= _BORDER_PX) & (pixels <= high)).all(axis=1))


def detect_targets(
    image: UInt16[np.ndarray, "rows columns"],
    targets: Targets,
    camera: CameraModel,
    position_m: Float64[np.ndarray, "3"],
    prior: Rotation,
    prior_sd_rad: float,
) -> Float64[np.ndarray, "targets 2"]:
    """Detect the targets in an image; return their centroids (column, row), NaN for targets not detected.

    - camera: the calibrated camera in the body frame
    - position_m: measured position of the camera, world axes
    - prior: approximate attitude from the platform, world from body
    - prior_sd_rad: standard deviation of the prior per axis
    """
    no_centroids = np.full((len(targets.surveyed_m), 2), np.nan)
    height = float(position_m[2] - targets.surveyed_m[:, 2].mean())
    px_per_m = np.array(camera.focal_lengths) / height
    candidates = find_bright_spots(image, targets.side_m * px_per_m)
    offsets = targets.surveyed_m - position_m
    if len(candidates) < _MIN_TARGETS:
        return no_centroids
    # distances in metres on the ground, as pixels need not be square
    tree = cKDTree(candidates / px_per_m)
    predicted = camera.project(prior.inv().apply(offsets))[0] / px_per_m
    displacement = _find_displacement(tree, predicted, _PRIOR_SD * prior_sd_rad * height)
    attitude, max_distance_m = prior, _MAX_VOTE_DISTANCE_M
    predicted = predicted + displacement
    for _ in range(_ITERATIONS):
        distances, nearest = tree.query(predicted)
        matches = np.flatnonzero(distances < max_distance_m)
        if len(matches) < _MIN_TARGETS:
            return no_centroids
        _, measured_directions = camera.rays(candidates[np.asarray(nearest)[matches]])
        attitude = Rotation.align_vectors(normalize(offsets[matches]), normalize(measured_directions))[0]
        predicted, max_distance_m = camera.project(attitude.inv().apply(offsets))[0] / px_per_m, _MAX_FIT_DISTANCE_M
    distances, nearest = tree.query(predicted)
    is_target = (distances < max_distance_m) & is_measurable(predicted * px_per_m, camera)
    if is_target.sum() < _MIN_TARGETS:
        return no_centroids
    return np.where(is_target[:, None], candidates[nearest], np.nan)


def find_bright_spots(
    image: UInt16[np.ndarray, "rows columns"], side_px: Float64[np.ndarray, "2"]
) -> Float64[np.ndarray, "spots 2"]:
    """Find spots that are brighter than the ground around them; return their centroids (column, row).

    - side_px: side lengths of a target in the image (columns, rows)
    """
    half_sides = np.ceil(0.5 * np.maximum(_TOP_HAT_SIDES * side_px, _MIN_TOP_HAT_PX)).astype(int)
    columns, rows = (2 * half_sides + 1).tolist()
    top_hat = ndimage.white_tophat(image.astype(np.float32), size=(rows, columns))
    # 84.13 % of a normal distribution are below its mean plus one standard deviation
    median, high = np.percentile(top_hat, (50.0, 84.13))
    labels, count = ndimage.label(top_hat > median + _THRESHOLD_SD * (high - median), np.ones((3, 3)))
    peaks = np.array(ndimage.maximum_position(top_hat, labels, np.arange(1, count + 1)), dtype=np.int64).reshape(-1, 2)
    half_columns, half_rows = np.ceil(_WINDOW_SIDES * side_px).astype(np.int64)
    return _compute_centroids(top_hat, peaks, np.array([half_rows, half_columns]))


def _compute_centroids(
    top_hat: np.ndarray, peaks: Int64[np.ndarray, "spots 2"], half_size: Int64[np.ndarray, "2"]
) -> Float64[np.ndarray, "spots 2"]:
    """Compute the centroids (column, row) of intensity in windows around peaks (row, column).

    - half_size: half sides of the windows (rows, columns), without the pixel of the peak
    """
    is_inside = ((peaks >= half_size) & (peaks < np.array(top_hat.shape) - half_size)).all(axis=1)
    rows, columns = np.mgrid[-half_size[0] : half_size[0] + 1, -half_size[1] : half_size[1] + 1]
    windows = top_hat[peaks[is_inside, 0, None, None] + rows, peaks[is_inside, 1, None, None] + columns].astype(
        np.float64
    )
    # the top-hat of noise is positive; without this subtraction it would bias centroids to the window centres
    windows = np.maximum(windows - np.median(top_hat), 0.0)
    total = windows.sum(axis=(1, 2))
    shift = np.stack([(windows * axis).sum(axis=(1, 2)) / total for axis in (columns, rows)], axis=-1)
    return np.asarray(peaks[is_inside, ::-1] + shift)


def _find_displacement(
    tree: cKDTree, predicted_m: Float64[np.ndarray, "targets 2"], radius_m: float
) -> Float64[np.ndarray, "2"]:
    """Find the displacement that moves the largest number of predicted targets to a candidate.

    The displacements from each target to the candidates within `radius_m` are tried; the first of equal ones is
    returned, and zero without any candidate.
    """
    neighbours = tree.query_ball_point(predicted_m, radius_m)
    displacements = np.concatenate(
        [tree.data[indices] - point for indices, point in zip(neighbours, predicted_m, strict=True)]
    )
    if len(displacements) == 0:
        return np.zeros(2)
    distances, _ = tree.query(predicted_m + displacements[:, None])
    votes = np.count_nonzero(distances < _MAX_VOTE_DISTANCE_M, axis=1)
    return np.asarray(displacements[np.argmax(votes)])
