"""A target tracker as a program: it reads one request per line, answers in one line, and finds whole pixels only.

    marsyard run vtt-montecarlo -n 20 --algorithm "exec:python docs/examples/target_tracker.py" --algorithm vtt
    marsyard conformance "exec:python docs/examples/target_tracker.py" --task tracking

The template of the last stop is searched in the left image without correction of scale or roll. The patch around the
match is then searched in the right image. The target is the point nearest to both lines of sight. The program uses
Marsyard's readers for files; a program in another language reads the files itself (docs/custom-algorithms.md).
"""

import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from marsyard.algorithms.exchange import read_mast, read_pose, read_stop, read_target
from marsyard.sim.camera import CameraModel
from marsyard.sim.measurements import MastCalibration, MastImage, PixelTarget, RoverMeasurements, RoverTarget

HALF_PX = 10  # half of the template: its side is 2 * HALF_PX + 1 pixels
SEARCH_PX = 70  # maximum distance from the predicted pixel, and maximum disparity error
STEREO_ROWS_PX = 3  # maximum distance from the predicted row in the right image
MIN_SCORE = 0.7  # minimum normalised correlation
ASSUMED_RANGE_M = 6.0  # range of a target that was designated by its pixel


class WholePixelTracker:
    """State of the target, and answers to the requests."""

    def __init__(self) -> None:
        self.state = "NO_TARGET"
        self.target_world: np.ndarray | None = None
        self.pixel_target: PixelTarget | None = None
        self.template: np.ndarray | None = None

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """Return the answer to one request."""
        if request["do"] == "aim":
            return {"aim": self.aim(read_pose(request["world_from_rover"]), read_mast(Path(request["mast"])))}
        if request["do"] == "update":
            return self.update(read_stop(Path(request["stop"]), read_mast(Path(request["mast"]))))
        self.__init__()  # type: ignore[misc]  # all other requests reset the state
        if request["do"] == "designate":
            self.designate(request)
        return {"state": self.state}

    def designate(self, request: dict[str, Any]) -> None:
        """Set the target."""
        target, pose = read_target(request["target"]), read_pose(request["world_from_rover"])
        self.state = "NORMAL"
        if isinstance(target, PixelTarget):
            self.pixel_target = target
        elif isinstance(target, RoverTarget):
            self.target_world = pose.apply(target.position_rover)
        else:
            north, east, down = target.position_site
            self.target_world = np.array([east, north, -down])

    def aim(self, pose: Any, mast: MastCalibration) -> dict[str, Any] | None:
        """Return mast angles that point at the target, with full frames; None if they are outside the limits."""
        if self.target_world is not None:
            x, y, z = pose.inv().apply(self.target_world) - mast.geometry.base_m - mast.geometry.elbow_m
            angles = (float(np.arctan2(-y, x)), float(np.arctan2(z - mast.geometry.head_m[2], np.hypot(x, y))))
        elif self.pixel_target is not None:
            angles = (self.pixel_target.azimuth_rad, self.pixel_target.elevation_rad)
        else:
            return None
        limits = (mast.geometry.azimuth_limits_rad, mast.geometry.elevation_limits_rad)
        if not all(low <= angle <= high for angle, (low, high) in zip(angles, limits, strict=True)):
            return None
        image_areas = {
            name: {"corner": [0, 0], "size": list(camera.size)}
            for name, camera in (("left", mast.left), ("right", mast.right))
        }
        return {"azimuth_rad": angles[0], "elevation_rad": angles[1], **image_areas}

    def update(self, stop: RoverMeasurements) -> dict[str, Any]:
        """Search the target in the images of a stop."""
        if self.state == "NO_TARGET":
            return {"state": "NO_TARGET", "losses": []}
        world_from_head = stop.world_from_rover * stop.mast.geometry.rover_from_head(
            stop.azimuth_rad, stop.elevation_rad
        )
        left, right = stop.mast.left.transform(world_from_head), stop.mast.right.transform(world_from_head)
        pixel = self.predict_pixel(left)
        if pixel is None or (self.template is None and extract_patch(stop.left, pixel) is None):
            return self.report_loss("OUT_OF_VIEW", stop)
        if self.template is not None:
            pixel, score = find_template(stop.left, pixel, SEARCH_PX, SEARCH_PX, self.template)
            if score < MIN_SCORE:
                return self.report_loss("LOW_MATCH_SCORE", stop)
        patch = extract_patch(stop.left, pixel)
        if patch is None:
            return self.report_loss("OUT_OF_VIEW", stop)
        # predicted pixel in the right image, for the last position of the target or for the assumed range
        position_world = self.target_world if self.target_world is not None else point_at(left, pixel, ASSUMED_RANGE_M)
        predicted_pixel = np.asarray(right.project(position_world)[0])
        right_pixel, score = find_template(stop.right, predicted_pixel, SEARCH_PX, STEREO_ROWS_PX, patch)
        if score < MIN_SCORE:
            return self.report_loss("LOW_STEREO_SCORE", stop)
        self.target_world = intersect_rays(left, pixel, right, right_pixel)
        self.template, self.pixel_target, self.state = patch, None, "NORMAL"
        return {"state": self.state, "losses": [], "position_rover": self.position_rover(stop)}

    def predict_pixel(self, left: CameraModel) -> np.ndarray | None:
        """Return the expected pixel of the target in the left image; None if it is not visible."""
        if self.target_world is None:
            return None if self.pixel_target is None else np.asarray(self.pixel_target.pixel)
        pixel, is_in_front = left.project(self.target_world)
        return np.asarray(pixel) if bool(is_in_front) else None

    def report_loss(self, reason: str, stop: RoverMeasurements) -> dict[str, Any]:
        """Return the answer for a lost target, which a later stop can find again."""
        self.state = "LOST"
        return {"state": "LOST", "losses": [reason], "position_rover": self.position_rover(stop)}

    def position_rover(self, stop: RoverMeasurements) -> list[float] | None:
        """Return the position of the target in the rover frame."""
        if self.target_world is None:
            return None
        return list(map(float, stop.world_from_rover.inv().apply(self.target_world)))


def extract_patch(image: MastImage, pixel: np.ndarray) -> np.ndarray | None:
    """Return the patch around a pixel of the full frame; None if a part of it is outside the image."""
    column, row = np.rint(pixel).astype(int) - np.array(image.corner)
    rows, columns = image.counts.shape
    if not (HALF_PX <= column < columns - HALF_PX and HALF_PX <= row < rows - HALF_PX):
        return None
    return image.counts[row - HALF_PX : row + HALF_PX + 1, column - HALF_PX : column + HALF_PX + 1].astype(np.float32)


def find_template(
    image: MastImage, pixel: np.ndarray, columns: int, rows: int, template: np.ndarray
) -> tuple[np.ndarray, float]:
    """Search a template within some columns and rows around a pixel; return the best pixel (full frame) and score."""
    if not np.all(np.isfinite(pixel)):
        return pixel, 0.0
    start = np.rint(pixel).astype(int) - np.array(image.corner) - (HALF_PX + np.array([columns, rows]))
    end = start + 2 * (HALF_PX + np.array([columns, rows])) + 1
    start, end = np.maximum(start, 0), np.maximum(end, 0)
    window = image.counts[start[1] : end[1], start[0] : end[0]].astype(np.float32)
    if min(window.shape) < 2 * HALF_PX + 1 or template.std() < 1.0:
        return pixel, 0.0
    scores = cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED)
    _, score, _, location = cv2.minMaxLoc(np.where(np.isfinite(scores), scores, 0.0))
    return np.array(location, dtype=np.float64) + start + HALF_PX + np.array(image.corner), float(score)


def point_at(camera: CameraModel, pixel: np.ndarray, range_m: float) -> np.ndarray:
    """Return the point at a range along a pixel's line of sight."""
    origin, direction = camera.rays(pixel)
    return np.asarray(origin + range_m * direction)


def intersect_rays(left: CameraModel, left_px: np.ndarray, right: CameraModel, right_px: np.ndarray) -> np.ndarray:
    """Return the midpoint of the shortest segment between two lines of sight."""
    (left_origin, left_ray), (right_origin, right_ray) = left.rays(left_px), right.rays(right_px)
    ranges = np.linalg.lstsq(np.stack([left_ray, -right_ray], axis=-1), right_origin - left_origin, rcond=None)[0]
    return np.asarray(0.5 * (left_origin + ranges[0] * left_ray + right_origin + ranges[1] * right_ray))


def main() -> None:
    """Answer the requests on standard input, one per line, until the input ends."""
    tracker = WholePixelTracker()
    # "exchange" is the version of the exchange format (docs/custom-algorithms.md)
    print(json.dumps({"exchange": 3, "ready": True}), flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        print(json.dumps({"exchange": 3, "id": request["id"], **tracker.answer(request)}), flush=True)


if __name__ == "__main__":
    main()
