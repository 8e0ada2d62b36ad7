"""A velocity estimator that takes any number of pictures one by one; in Python, and as a program that is asked by line.

    cd docs/examples
    marsyard run dimes-gusev --set pictures=9 --set descent.interval_s=0.9375 \
        --algorithm velocity_stream:ChainedShifts --algorithm dimes
    marsyard run dimes-gusev --algorithm "serve-stream:python velocity_stream.py" --algorithm dimes

Each picture is held against the one before it: both are drawn on the level ground where the inertial unit puts it, and
phase correlation tells by how much that is off. What is off is an error of the inertial velocity, the same in all
pairs: least squares over all of them, each with its weight, give it better with every picture. The answer is the
inertial velocity at the last picture without that error, with its covariance.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from marsyard.algorithms.exchange import read_frame
from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome
from marsyard.sim.measurements import DescentFrame

SIDE_PX = 128  # of the square of ground that is compared
SIDE_HEIGHTS = 0.35  # the same over the height above it
LEAST_SEEN = 0.9  # share of the square that both pictures show
LEAST_RESPONSE = 0.2  # of phase correlation; pictures of other ground give up to about 0.12
SHIFT_SD_PX = 0.15  # of a shift
ATTITUDE_SD_RAD = 0.003  # what all pictures share; the fall makes a velocity of it
APART_M_S = 3.0  # from the median at which a pair is left out


@dataclass(frozen=True)
class Pair:
    """What two pictures say: by how much the inertial velocity is off (east, north), and the variance of that."""

    error_m_s: np.ndarray
    variance_m2_s2: float


class ChainedShifts:
    """Implements `marsyard.algorithms.interface.VelocityStream`; made without arguments."""

    def start(self) -> None:
        """Forgets the descent before."""
        self.last: DescentFrame | None = None
        self.pairs: list[Pair] = []

    def picture(self, frame: DescentFrame) -> VelocityEstimate | None:
        """Holds a picture against the one before; what is known by now."""
        if self.last is not None:
            found = compared(self.last, frame)
            self.pairs += [] if found is None else [found]
        self.last = frame
        return self.answer(frame) if self.pairs else None

    def finish(self) -> VelocityEstimate:
        """The answer to the descent."""
        if self.last is None or not self.pairs:
            return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None)
        return self.answer(self.last)

    def answer(self, frame: DescentFrame) -> VelocityEstimate:
        """The inertial velocity at a picture without its error: the mean of all pairs, weighted by their variances."""
        errors = np.array([pair.error_m_s for pair in self.pairs])
        near = np.hypot(*(errors - np.median(errors, axis=0)).T) < APART_M_S
        if not np.any(near):
            return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None)
        weights = near / np.array([pair.variance_m2_s2 for pair in self.pairs])
        error = weights @ errors / weights.sum()
        fall = fall_m_s(frame)
        variance = 1.0 / weights.sum() + (ATTITUDE_SD_RAD * fall) ** 2
        # of the instant, where the inertial velocity is known at it; else of the last interval
        at, span = frame.inertial_velocity_m_s, (frame.image.time_s, frame.image.time_s)
        inertial = frame.interval_velocity_m_s if at is None else at
        return VelocityEstimate(
            VelocityOutcome.VALID,
            inertial[:2] + error,
            covariance_m2_s2=variance * np.eye(2),
            span_s=None if at is None else span,
        )


def compared(first: DescentFrame, second: DescentFrame) -> Pair | None:
    """The error of the inertial velocity that two pictures show; None where they do not match."""
    interval = second.image.time_s - first.image.time_s
    heights = [height_m(frame) for frame in (first, second)]
    middles = [middle(frame, height) for frame, height in zip((first, second), heights, strict=True)]
    if not interval > 0.0 or not all(np.all(np.isfinite(one)) for one in middles):
        return None
    expected = second.interval_velocity_m_s[:2] * interval
    # the ground between the middles of both pictures, from below the first one and from below the second
    about = 0.5 * (middles[0] + middles[1] + expected)
    gsd = SIDE_HEIGHTS * heights[1] / SIDE_PX
    patches = [on_ground(first, heights[0], about, gsd), on_ground(second, heights[1], about - expected, gsd)]
    if patches[0] is None or patches[1] is None:
        return None
    window = cv2.createHanningWindow((SIDE_PX, SIDE_PX), cv2.CV_64F)
    shift, response = cv2.phaseCorrelate(patches[0], patches[1], window)
    if response < LEAST_RESPONSE:
        return None
    # what lies further east or south in the second picture than expected: the camera went less far, or further north
    error = gsd * np.array([-shift[0], shift[1]]) / interval
    return Pair(error, (SHIFT_SD_PX * gsd / interval) ** 2)


def fall_m_s(frame: DescentFrame) -> float:
    """How fast the lander falls."""
    return -float(frame.interval_velocity_m_s[2])


def height_m(frame: DescentFrame) -> float:
    """The measured altitude, carried to the picture's tag; of the first picture as it was measured."""
    lag = frame.image.time_s - frame.altitude.time_s
    at = frame.inertial_velocity_m_s if frame.interval_velocity_m_s is None else frame.interval_velocity_m_s
    return frame.altitude.altitude_m + (0.0 if at is None else float(at[2]) * lag)


def middle(frame: DescentFrame, height: float) -> np.ndarray:
    """Where on the level ground the picture's middle is, from below the body (east, north), metres; NaN if nowhere."""
    ray = frame.attitude.world_from_body.apply(frame.image.camera.boresight())
    return ray[:2] * (height / -ray[2]) if ray[2] < 0.0 and height > 0.0 else np.full(2, np.nan)


def on_ground(frame: DescentFrame, height: float, about: np.ndarray, gsd: float) -> np.ndarray | None:
    """The picture as seen from above, a square about a point from below the body; None where little of it is seen."""
    steps = gsd * (np.arange(SIDE_PX) - 0.5 * (SIDE_PX - 1))
    east, south = np.meshgrid(steps, steps)
    ground = np.stack([about[0] + east, about[1] - south, np.full_like(east, -height)], axis=-1)
    body = frame.attitude.world_from_body.inv().apply(ground.reshape(-1, 3))
    pixels, ahead = frame.image.camera.project(body)
    columns, rows = (np.where(ahead, pixels[:, axis], -1.0).reshape(east.shape).astype(np.float32) for axis in (0, 1))
    known = frame.image.calibration
    light = (frame.image.counts - known.offset_dn) / known.flat_field
    size = light.shape
    seen = (columns >= 0) & (columns <= size[1] - 1) & (rows >= 0) & (rows <= size[0] - 1)
    if seen.mean() < LEAST_SEEN:
        return None
    patch = cv2.remap(light, columns, rows, cv2.INTER_LINEAR).astype(np.float64)
    patch -= patch[seen].mean()
    patch[~seen] = 0.0
    return patch if patch.std() > 1.0 else None


def told(estimate: VelocityEstimate | None) -> dict[str, Any]:
    """An answer as the exchange has it."""
    if estimate is None or estimate.velocity_m_s is None:
        return {"outcome": None if estimate is None else estimate.outcome.name}
    return {
        "outcome": estimate.outcome.name,
        "velocity_m_s": estimate.velocity_m_s.tolist(),
        "covariance_m2_s2": estimate.covariance_m2_s2.tolist(),
        "span_s": estimate.span_s,
    }


def main() -> None:
    """Answers line by line until the input ends."""
    stream = ChainedShifts()
    print(json.dumps({"exchange": 2, "ready": True}), flush=True)
    for line in sys.stdin:
        asked = json.loads(line)
        if asked["do"] == "start":
            answer = stream.start()
        elif asked["do"] == "picture":
            answer = stream.picture(read_frame(Path(asked["frame"])))
        else:
            answer = stream.finish()
        print(json.dumps({"exchange": 2, "id": asked["id"], **told(answer)}), flush=True)


if __name__ == "__main__":
    main()
