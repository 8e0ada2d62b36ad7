"""Choice of two images of a helicopter flight by on-board data: poses, ranges and the calibrated camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64
from scipy.spatial.transform import RigidTransform

from marsyard.scenarios.landing.parameters import PairParameters
from marsyard.sim.camera import CameraModel
from marsyard.sim.measurements import PoseMeasurement


@dataclass(frozen=True)
class PairChoice:
    """Indices of the chosen images, their baseline perpendicular to the first optical axis, and their overlap."""

    first: int
    second: int
    baseline_m: float
    overlap: float


def choose_pair(
    poses: Sequence[PoseMeasurement],
    ranges_m: Float64[np.ndarray, "n"],
    camera: CameraModel,
    parameters: PairParameters,
    height_m: float,
) -> PairChoice:
    """Choose the pair with the highest score; among equal scores, the earliest pair (landing paper, section V).

    Level ground is assumed. The commanded height `height_m` replaces a missing range (NaN). Pairs with an overlap below
    `min_overlap` are used only if no pair has this overlap.

    Raises ValueError if there are fewer than two images.
    """
    if len(poses) < 2:
        raise ValueError(f"cannot choose a pair from {len(poses)} images; at least 2 are needed")
    columns, rows = camera.size
    rays = camera.rays(np.array([[0.0, 0.0], [columns, 0.0], [columns, rows], [0.0, rows]]) - 0.5)[1]
    transforms = RigidTransform.concatenate([pose.world_from_body for pose in poses])
    centres_m, axes = transforms.apply(np.array(camera.c)), transforms.rotation.apply(np.array(camera.a))
    corner_rays = np.stack([transforms.rotation.apply(ray) for ray in rays], axis=1)
    best, best_score = None, (False, -np.inf)
    for first, axis in enumerate(axes[:-1]):
        distance = float(ranges_m[first]) if np.isfinite(ranges_m[first]) else height_m
        steps_m = centres_m[first:] - centres_m[first]
        baselines_m = np.linalg.norm(steps_m - (steps_m @ axis)[:, None] * axis, axis=1)
        footprints = _level_footprints(corner_rays[first:], steps_m, distance * axis[2])
        area = cv2.contourArea(footprints[0])
        for offset in range(1, len(footprints)):
            # an image that shows the horizon has no footprint
            has_overlap = np.isfinite(footprints[[0, offset]]).all()
            overlap = cv2.intersectConvexConvex(footprints[0], footprints[offset])[0] / area if has_overlap else 0.0
            is_usable = bool(overlap >= parameters.min_overlap)
            score = overlap * min(baselines_m[offset] / (parameters.max_baseline_fraction * distance), 1.0)
            if (is_usable, score) > best_score:
                best_score = (is_usable, score)
                best = PairChoice(first, first + offset, float(baselines_m[offset]), overlap)
    if best is None:
        raise ValueError("no pair of images has finite poses")
    return best


def _level_footprints(
    corner_rays: Float64[np.ndarray, "n 4 3"], centres_m: Float64[np.ndarray, "n 3"], level_m: float
) -> Float32[np.ndarray, "n 4 2"]:
    """Project the corners of images onto a level plane; NaN for an image with a corner at or above the horizon."""
    below = np.all(corner_rays[..., 2] < 0.0, axis=1)
    heights = np.where(below, level_m - centres_m[:, 2], np.nan)
    distances = heights[:, None] / corner_rays[..., 2]
    return np.asarray(centres_m[:, None, :2] + distances[..., None] * corner_rays[..., :2], dtype=np.float32)
