"""A velocity estimator that processes any number of images one by one; as a Python class and as a program.

    cd docs/examples
    marsyard run dimes-gusev --set images=9 --set descent.interval_s=0.9375 \
        --algorithm velocity_stream:ChainedShifts --algorithm dimes
    marsyard run dimes-gusev --algorithm "serve-stream:python velocity_stream.py" --algorithm dimes
    marsyard run dimes-gusev --set inertial.rate_hz=200 \
        --algorithm velocity_stream:IntegratedShifts --algorithm "serve-stream:python velocity_stream.py --increments"

Each image is compared with the previous image. Both are projected onto level ground with the inertial velocity, and
phase correlation measures their shift. The shift is caused by the error of the inertial velocity, which is the same for
all pairs. Weighted least squares estimate this error from all pairs, so the estimate improves with every image. The
answer is the inertial velocity at the last image minus its error, with a covariance.

`IntegratedShifts` integrates the inertial velocity from inertial increments, if the descent has them.
"""

import sys
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from marsyard.algorithms.exchange import VELOCITY_STREAM
from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome
from marsyard.sim.measurements import DescentFrame, ImuIncrements

SIDE_PX = 128  # side of the compared square of ground
SIDE_TO_HEIGHT_RATIO = 0.35  # side of the square divided by the height above ground
MIN_VISIBLE_FRACTION = 0.9  # minimum fraction of the square that each image contains
MIN_RESPONSE = 0.2  # response of phase correlation; images of different ground reach about 0.12
SHIFT_SD_PX = 0.15  # standard deviation of a shift
ATTITUDE_SD_RAD = 0.003  # attitude error common to all images; multiplied by the vertical speed, a velocity error
MAX_DEVIATION_M_S = 3.0  # maximum deviation of a pair from the median; other pairs are excluded


@dataclass(frozen=True)
class Pair:
    """Error of the inertial velocity (east, north) measured with two images, and its variance."""

    error_m_s: np.ndarray
    variance_m2_s2: float


class ChainedShifts:
    """Estimator that follows `marsyard.algorithms.interface.VelocityStream`; created without arguments."""

    def start(self) -> None:
        """Reset the state for a new descent."""
        self.previous_frame: DescentFrame | None = None
        self.pairs: list[Pair] = []

    def process_image(self, frame: DescentFrame) -> VelocityEstimate | None:
        """Compare an image with the previous one; return the estimate so far."""
        if self.previous_frame is not None:
            pair = compare_frames(self.previous_frame, frame)
            self.pairs += [] if pair is None else [pair]
        self.previous_frame = frame
        return self.correct_velocity(frame) if self.pairs else None

    def finish(self) -> VelocityEstimate:
        """Return the final estimate of the descent."""
        if self.previous_frame is None or not self.pairs:
            return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None)
        return self.correct_velocity(self.previous_frame)

    def correct_velocity(self, frame: DescentFrame) -> VelocityEstimate:
        """Correct the inertial velocity at an image by the mean of all pairs, weighted by their inverse variances."""
        errors = np.array([pair.error_m_s for pair in self.pairs])
        is_consistent = np.hypot(*(errors - np.median(errors, axis=0)).T) < MAX_DEVIATION_M_S
        if not np.any(is_consistent):
            return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None)
        weights = is_consistent / np.array([pair.variance_m2_s2 for pair in self.pairs])
        error = weights @ errors / weights.sum()
        descent_rate = descent_rate_m_s(frame)
        variance = 1.0 / weights.sum() + (ATTITUDE_SD_RAD * descent_rate) ** 2
        # velocity at the time of the image if it is available, otherwise the mean velocity of the last interval
        instantaneous, span = frame.inertial_velocity_m_s, (frame.image.time_s, frame.image.time_s)
        inertial = frame.interval_velocity_m_s if instantaneous is None else instantaneous
        return VelocityEstimate(
            VelocityOutcome.VALID,
            inertial[:2] + error,
            covariance_m2_s2=variance * np.eye(2),
            span_s=None if instantaneous is None else span,
        )


class IntegratedShifts(ChainedShifts):
    """`ChainedShifts` with inertial velocities that are integrated from increments after the first image."""

    def start(self) -> None:
        """Reset the state for a new descent."""
        super().start()
        self.attitude: Rotation | None = None
        self.elapsed_s = 0.0

    def process_increments(self, increments: ImuIncrements) -> None:
        """Integrate attitude, velocity and displacement; increments before the first image are not used."""
        if self.attitude is None:
            return
        period_s, gravity = increments.period_s, np.array([0.0, 0.0, -self.gravity_m_s2])
        for angles, velocities in zip(increments.delta_angles_rad, increments.delta_velocities_m_s, strict=True):
            change = self.attitude.apply(velocities.copy()) + gravity * period_s
            self.displacement_m = self.displacement_m + (self.velocity_m_s + 0.5 * change) * period_s
            self.velocity_m_s = self.velocity_m_s + change
            self.attitude = self.attitude * Rotation.from_rotvec(angles.copy())
            self.elapsed_s += period_s

    def process_image(self, frame: DescentFrame) -> VelocityEstimate | None:
        """Process an image with the integrated velocities; the first image defines the initial state."""
        if self.elapsed_s > 0.0:
            mean_velocity = self.displacement_m / self.elapsed_s
            frame = replace(frame, inertial_velocity_m_s=self.velocity_m_s, interval_velocity_m_s=mean_velocity)
        elif frame.gravity_m_s2 is not None and frame.inertial_velocity_m_s is not None:
            self.attitude, self.gravity_m_s2 = frame.attitude.world_from_body, frame.gravity_m_s2
            self.velocity_m_s = frame.inertial_velocity_m_s
        self.displacement_m, self.elapsed_s = np.zeros(3), 0.0
        return super().process_image(frame)


def compare_frames(first: DescentFrame, second: DescentFrame) -> Pair | None:
    """Measure the error of the inertial velocity with two images; None if they do not match."""
    interval_s = second.image.time_s - first.image.time_s
    heights = [height_m(frame) for frame in (first, second)]
    centres = [intersect_boresight(frame, height) for frame, height in zip((first, second), heights, strict=True)]
    if not interval_s > 0.0 or not all(np.all(np.isfinite(centre)) for centre in centres):
        return None
    displacement = second.interval_velocity_m_s[:2] * interval_s
    # centre of the square: the mean of the centres of both images, relative to the first body position
    centre = 0.5 * (centres[0] + centres[1] + displacement)
    gsd_m = SIDE_TO_HEIGHT_RATIO * heights[1] / SIDE_PX
    patches = [rectify(first, heights[0], centre, gsd_m), rectify(second, heights[1], centre - displacement, gsd_m)]
    if patches[0] is None or patches[1] is None:
        return None
    window = cv2.createHanningWindow((SIDE_PX, SIDE_PX), cv2.CV_64F)
    shift, response = cv2.phaseCorrelate(patches[0], patches[1], window)
    if response < MIN_RESPONSE:
        return None
    # a shift to the east or south in the second image: the camera moved less to the east, or more to the north
    error = gsd_m * np.array([-shift[0], shift[1]]) / interval_s
    return Pair(error, (SHIFT_SD_PX * gsd_m / interval_s) ** 2)


def descent_rate_m_s(frame: DescentFrame) -> float:
    """Return the downward velocity, m/s."""
    return -float(frame.interval_velocity_m_s[2])


def height_m(frame: DescentFrame) -> float:
    """Propagate the measured altitude (m) to the time of the image; without a velocity, return it unchanged."""
    delay_s = frame.image.time_s - frame.altitude.time_s
    velocity = frame.inertial_velocity_m_s if frame.interval_velocity_m_s is None else frame.interval_velocity_m_s
    return frame.altitude.altitude_m + (0.0 if velocity is None else float(velocity[2]) * delay_s)


def intersect_boresight(frame: DescentFrame, height: float) -> np.ndarray:
    """Intersect the boresight with level ground, relative to the body (east, north), metres; NaN if none."""
    ray = frame.attitude.world_from_body.apply(frame.image.camera.boresight())
    return ray[:2] * (height / -ray[2]) if ray[2] < 0.0 and height > 0.0 else np.full(2, np.nan)


def rectify(frame: DescentFrame, height: float, centre: np.ndarray, gsd_m: float) -> np.ndarray | None:
    """Project the image onto a square of level ground around a point; None if the image contains too little of it."""
    offsets = gsd_m * (np.arange(SIDE_PX) - 0.5 * (SIDE_PX - 1))
    east, south = np.meshgrid(offsets, offsets)
    ground = np.stack([centre[0] + east, centre[1] - south, np.full_like(east, -height)], axis=-1)
    body = frame.attitude.world_from_body.inv().apply(ground.reshape(-1, 3))
    pixels, is_in_front = frame.image.camera.project(body)
    columns, rows = (
        np.where(is_in_front, pixels[:, axis], -1.0).reshape(east.shape).astype(np.float32) for axis in (0, 1)
    )
    calibration = frame.image.calibration
    signal = (frame.image.counts - calibration.offset_dn) / calibration.flat_field
    size = signal.shape
    is_visible = (columns >= 0) & (columns <= size[1] - 1) & (rows >= 0) & (rows <= size[0] - 1)
    if is_visible.mean() < MIN_VISIBLE_FRACTION:
        return None
    patch = cv2.remap(signal, columns, rows, cv2.INTER_LINEAR).astype(np.float64)
    patch -= patch[is_visible].mean()
    patch[~is_visible] = 0.0
    return patch if patch.std() > 1.0 else None


if __name__ == "__main__":
    # answers the requests on standard input until the input ends (docs/custom-algorithms.md)
    VELOCITY_STREAM.serve(IntegratedShifts() if "--increments" in sys.argv else ChainedShifts())
