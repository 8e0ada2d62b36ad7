"""Surveyed targets of the attitude reference: panels on the ground, and their sightings in a pass (paper, III.D.2).

The paper is Johnson et al., "Field Testing of the MER DIMES".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from marsyard.scenarios.fieldtest.parameters import ImageTargetParameters
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics import Motion
from marsyard.sim.render import Objects
from marsyard.sim.terrain import Surface

#: Minimum distance of a measured target from the edge of the image, pixels.
_BORDER_PX = 4.0
#: Height of a panel above the ground, metres.
_CLEARANCE_M = 0.03


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
            directions = camera.rays(centroids[is_measured])[1]
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
