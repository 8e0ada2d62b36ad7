"""Choice of two of a flight's pictures by baseline and overlap (landing paper, section V).

Uses on-board data: the filter's poses, the laser's ranges and the calibrated camera, over ground assumed level.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64
from pydantic import Field

from marsyard.sim.camera import CameraModel
from marsyard.sim.measurements import PoseMeasurement
from marsyard.sim.parameters import Parameters


class PairParameters(Parameters):
    """The criterion: overlap times baseline, which counts up to `wanted_share` of the range.

    The paper names baseline and overlap; their weighting is assumed.
    """

    wanted_share: float = Field(default=0.2, gt=0.0, le=2.0, description="maximum of baseline over range that counts")
    least_overlap: float = Field(default=0.5, ge=0.0, le=1.0, description="of the first picture's ground in the second")


@dataclass(frozen=True)
class PairChoice:
    """Numbers of the chosen pictures, their baseline across the first optical axis, and their overlap."""

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
    """The pair of the highest worth, the earliest of equal ones; the commanded height replaces a missing range.

    Pairs with too little overlap are chosen only if there are no others.

    Raises ValueError if there are fewer than two pictures.
    """
    if len(poses) < 2:
        raise ValueError(f"a pair is to be chosen from {len(poses)} pictures; at least 2 are needed")
    views = [_View.of(camera, pose) for pose in poses]
    best, best_worth = None, (False, -np.inf)
    for i, first in enumerate(views[:-1]):
        distance = float(ranges_m[i]) if np.isfinite(ranges_m[i]) else height_m
        level = float(first.centre_m[2] + distance * first.axis[2])
        own = first.footprint(level, first.centre_m)
        for j, second in enumerate(views[i + 1 :], start=i + 1):
            step = second.centre_m - first.centre_m
            baseline = float(np.linalg.norm(step - (step @ first.axis) * first.axis))
            overlap = _overlap(own, second.footprint(level, first.centre_m))
            worth = overlap * min(baseline / (parameters.wanted_share * distance), 1.0)
            if (overlap >= parameters.least_overlap, worth) > best_worth:
                best_worth = (overlap >= parameters.least_overlap, worth)
                best = PairChoice(i, j, baseline, overlap)
    if best is None:
        raise ValueError("no pair of pictures has poses that are numbers")
    return best


@dataclass(frozen=True)
class _View:
    """A picture's centre of projection, optical axis, and rays of its corners, world axes."""

    centre_m: Float64[np.ndarray, "3"]
    axis: Float64[np.ndarray, "3"]
    corners: Float64[np.ndarray, "4 3"]

    @classmethod
    def of(cls, camera: CameraModel, pose: PoseMeasurement) -> _View:
        turn = pose.world_from_body.rotation
        columns, rows = camera.size
        rays = camera.rays(np.array([[0.0, 0.0], [columns, 0.0], [columns, rows], [0.0, rows]]) - 0.5)[1]
        centre = np.asarray(pose.world_from_body.apply(np.array(camera.c)))
        return cls(centre, np.asarray(turn.apply(np.array(camera.a))), np.asarray(turn.apply(rays)))

    def footprint(self, level_m: float, origin_m: Float64[np.ndarray, "3"]) -> Float32[np.ndarray, "4 2"] | None:
        """Corners of the picture on a level plane, relative to a point; None if it looks at or above the horizon."""
        if not np.all(self.corners[:, 2] < 0.0):
            return None
        reach = (level_m - self.centre_m[2]) / self.corners[:, 2]
        corners = self.centre_m[:2] - origin_m[:2] + reach[:, None] * self.corners[:, :2]
        return np.asarray(corners, dtype=np.float32)


def _overlap(first: Float32[np.ndarray, "4 2"] | None, second: Float32[np.ndarray, "4 2"] | None) -> float:
    """Fraction of the first's area that the second covers."""
    if first is None or second is None:
        return 0.0
    common, _ = cv2.intersectConvexConvex(first, second)
    return float(common / cv2.contourArea(first))
