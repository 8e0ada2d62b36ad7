"""A target tracker that is a program: it reads a line, answers in a line, and finds the target to whole pixels.

    marsyard run vtt-montecarlo -n 20 --algorithm "exec:python docs/examples/target_tracker.py" --algorithm vtt
    marsyard conformance "exec:python docs/examples/target_tracker.py" --task tracking

The template of the last stop is looked for in the left picture as it is, neither magnified nor rolled, then its patch
in the right picture; the target is where the two lines of sight come nearest to each other. Marsyard's readers are used
for files; a program in another language reads them itself (docs/custom-algorithms.md).
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from marsyard.algorithms.exchange import read_mast, read_pose, read_stop, read_target
from marsyard.sim.camera import CameraModel
from marsyard.sim.measurements import MastCalibration, MastImage, PixelTarget, RoverMeasurements, RoverTarget

HALF = 10  # of the template
REACH = 70  # of its search around the expected place, and of the disparity
LEAST_SCORE = 0.7


class WholePixelTracker:
    """What is known of the target, and the answers to what is asked."""

    def __init__(self) -> None:
        self.state = "NO_TARGET"
        self.target_world: np.ndarray | None = None
        self.picked: PixelTarget | None = None
        self.template: np.ndarray | None = None

    def answer(self, asked: dict[str, Any]) -> dict[str, Any]:
        """The answer to one line."""
        if asked["do"] == "aim":
            return {"aim": self.aim(read_pose(asked["world_from_rover"]), read_mast(Path(asked["mast"])))}
        if asked["do"] == "update":
            return self.update(read_stop(Path(asked["stop"]), read_mast(Path(asked["mast"]))))
        self.__init__()  # type: ignore[misc]  # whatever comes, the last target is forgotten
        if asked["do"] == "designate":
            self.designate(asked)
        return {"state": self.state}

    def designate(self, asked: dict[str, Any]) -> None:
        """Takes a target."""
        target, pose = read_target(asked["target"]), read_pose(asked["world_from_rover"])
        self.state = "NORMAL"
        if isinstance(target, PixelTarget):
            self.picked = target
        elif isinstance(target, RoverTarget):
            self.target_world = pose.apply(target.position_rover)
        else:
            north, east, down = target.position_site
            self.target_world = np.array([east, north, -down])

    def aim(self, pose: Any, mast: MastCalibration) -> dict[str, Any] | None:
        """Straight at the target, and the frames whole."""
        if self.target_world is not None:
            x, y, z = pose.inv().apply(self.target_world) - mast.geometry.base_m - mast.geometry.elbow_m
            angles = (float(np.arctan2(-y, x)), float(np.arctan2(z - mast.geometry.head_m[2], np.hypot(x, y))))
        elif self.picked is not None:
            angles = (self.picked.azimuth_rad, self.picked.elevation_rad)
        else:
            return None
        limits = (mast.geometry.azimuth_limits_rad, mast.geometry.elevation_limits_rad)
        if not all(least <= angle <= most for angle, (least, most) in zip(angles, limits, strict=True)):
            return None
        boxes = {
            name: {"corner": [0, 0], "size": list(camera.size)}
            for name, camera in (("left", mast.left), ("right", mast.right))
        }
        return {"azimuth_rad": angles[0], "elevation_rad": angles[1], **boxes}

    def update(self, stop: RoverMeasurements) -> dict[str, Any]:
        """Looks for the target in a stop's pictures."""
        if self.state == "NO_TARGET":
            return {"state": "NO_TARGET", "losses": []}
        world_from_head = stop.world_from_rover * stop.mast.geometry.rover_from_head(
            stop.azimuth_rad, stop.elevation_rad
        )
        left, right = stop.mast.left.transform(world_from_head), stop.mast.right.transform(world_from_head)
        place = self.expected(left)
        if place is None or (self.template is None and patch(stop.left, place) is None):
            return self.lost("OUT_OF_VIEW", stop)
        if self.template is not None:
            place, score = best(stop.left, place, REACH, REACH, self.template)
            if score < LEAST_SCORE:
                return self.lost("LOW_MATCH_SCORE", stop)
        found = patch(stop.left, place)
        if found is None:
            return self.lost("OUT_OF_VIEW", stop)
        # where the right camera sees it if it is as far as expected, or where the picture was taken of
        ahead = self.target_world if self.target_world is not None else seen_at(left, place, 6.0)
        guess = np.asarray(right.project(ahead)[0])
        other, score = best(stop.right, guess, REACH, 3, found)
        if score < LEAST_SCORE:
            return self.lost("LOW_STEREO_SCORE", stop)
        self.target_world = between(left, place, right, other)
        self.template, self.picked, self.state = found, None, "NORMAL"
        return {"state": self.state, "losses": [], "position_rover": self.position(stop)}

    def expected(self, left: CameraModel) -> np.ndarray | None:
        """The pixel at which the target should be."""
        if self.target_world is None:
            return None if self.picked is None else np.asarray(self.picked.pixel)
        pixel, ahead = left.project(self.target_world)
        return np.asarray(pixel) if bool(ahead) else None

    def lost(self, why: str, stop: RoverMeasurements) -> dict[str, Any]:
        """The answer where it was not found; it may be again."""
        self.state = "LOST"
        return {"state": "LOST", "losses": [why], "position_rover": self.position(stop)}

    def position(self, stop: RoverMeasurements) -> list[float] | None:
        """The target from here."""
        if self.target_world is None:
            return None
        return list(map(float, stop.world_from_rover.inv().apply(self.target_world)))


def patch(image: MastImage, place: np.ndarray) -> np.ndarray | None:
    """The picture about a pixel of the full frame; None where it is not all there."""
    column, row = np.rint(place).astype(int) - np.array(image.corner)
    rows, columns = image.counts.shape
    if not (HALF <= column < columns - HALF and HALF <= row < rows - HALF):
        return None
    return image.counts[row - HALF : row + HALF + 1, column - HALF : column + HALF + 1].astype(np.float32)


def best(
    image: MastImage, place: np.ndarray, columns: int, rows: int, template: np.ndarray
) -> tuple[np.ndarray, float]:
    """Where a template matches best within so many columns and rows of a pixel of the full frame, and how well."""
    if not np.all(np.isfinite(place)):
        return place, 0.0
    near = np.rint(place).astype(int) - np.array(image.corner) - (HALF + np.array([columns, rows]))
    far = near + 2 * (HALF + np.array([columns, rows])) + 1
    near, far = np.maximum(near, 0), np.maximum(far, 0)
    window = image.counts[near[1] : far[1], near[0] : far[0]].astype(np.float32)
    if min(window.shape) < 2 * HALF + 1 or template.std() < 1.0:
        return place, 0.0
    scores = cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED)
    _, score, _, at = cv2.minMaxLoc(np.where(np.isfinite(scores), scores, 0.0))
    return np.array(at, dtype=np.float64) + near + HALF + np.array(image.corner), float(score)


def seen_at(camera: CameraModel, pixel: np.ndarray, range_m: float) -> np.ndarray:
    """The point so far along a pixel's line of sight."""
    origin, direction = camera.rays(pixel)
    return np.asarray(origin + range_m * direction)


def between(left: CameraModel, left_px: np.ndarray, right: CameraModel, right_px: np.ndarray) -> np.ndarray:
    """Where two lines of sight come nearest to each other."""
    (a, along_a), (b, along_b) = left.rays(left_px), right.rays(right_px)
    distances = np.linalg.lstsq(np.stack([along_a, -along_b], axis=-1), b - a, rcond=None)[0]
    return np.asarray(0.5 * (a + distances[0] * along_a + b + distances[1] * along_b))


def main() -> None:
    """Answers line by line until the input ends."""
    tracker = WholePixelTracker()
    print(json.dumps({"exchange": 2, "ready": True}), flush=True)
    for line in sys.stdin:
        asked = json.loads(line)
        print(json.dumps({"exchange": 2, "id": asked["id"], **tracker.answer(asked)}), flush=True)


if __name__ == "__main__":
    main()
