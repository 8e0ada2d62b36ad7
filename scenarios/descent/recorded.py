"""Recorded flight from a file, instead of the simulated dynamics: `[parameters.flight]` of a descent campaign."""

from collections.abc import Sequence
from decimal import Decimal
from enum import Enum
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field
from scipy.spatial.transform import Rotation

from marsyard.scenarios.recorded_axes import RecordedAxes
from marsyard.scenarios.user_files import UserFile
from marsyard.sim.dynamics.pose_files import TrajectoryFileError, read_poses
from marsyard.sim.dynamics.recorded import RecordedMotion
from marsyard.sim.parameters import bounded_field

#: Required duration of the flight after the last image, and tolerance of its start for rounding, s.
END_MARGIN_S, _ROUNDING_S = 0.5, 1e-9
#: Maximum time between two poses while the instruments measure (assumed): a lander on a parachute swings in a few
#: seconds, so that splines over longer gaps invent its motion. Times in another unit than seconds also exceed it.
MAX_GAP_S = 2.0


class FlightOrigin(Enum):
    """Origin of the positions of a recorded flight: the case's location on the ground, or the terrain's origin."""

    LOCATION = "location"
    TERRAIN = "terrain"


class FlightFile(UserFile, RecordedAxes):
    """A recorded flight: a CSV, Parquet, TUM or EuRoC file of poses, or SPICE kernels.

    Positions are those of the camera or, with `lever_m`, of the vehicle. The first image is taken at the file's time
    `first_image_s`, the next images at intervals of `descent.interval_s`. Instruments measure this motion like a
    simulated flight.
    """

    origin: Annotated[
        FlightOrigin, Field(description="origin of positions: ground below the first image, or the terrain's origin")
    ] = FlightOrigin.LOCATION
    first_image_s: Annotated[
        float | None, Field(description="file's time of the first image; default: file's start + `lead_s`")
    ] = None
    lead_s: Annotated[float, bounded_field(0.2, 30.0, "navigation time before the first image")] = 5.0
    heading_offset_deg: Annotated[
        float, bounded_field(-720.0, 720.0, "rotation of the flight about the vertical, clockwise from above")
    ] = 0.0

    @classmethod
    def file_hash(cls, file: str) -> str:
        """Check the poses of the file and return its SHA-256."""
        return read_poses(file).sha256

    @property
    def first_image_time_s(self) -> float:
        """File's time of the first image."""
        return self.first_image_s if self.first_image_s is not None else float(self._exact_first_image_time_s)

    @property
    def _exact_first_image_time_s(self) -> Decimal:
        """File's time of the first image; a large time in floating point would be rounded."""
        if self.first_image_s is not None:
            return Decimal(repr(self.first_image_s))
        return read_poses(self.file).start_s + Decimal(repr(self.lead_s))

    def check(self, image_times_s: Sequence[float]) -> None:
        """Raise ValueError if the flight does not cover the images, or its camera looks up or is below the ground.

        The poses from the start of navigation to the last image must not be more than `MAX_GAP_S` apart.
        """
        trajectory = self.create_trajectory(np.zeros(3), 0.0)
        first, last = trajectory.span_s
        if first > -self.lead_s + _ROUNDING_S or last < max(image_times_s) + END_MARGIN_S:
            poses = read_poses(self.file)
            last_image_time_s = self.first_image_time_s + max(image_times_s)
            begin, end = (poses.start_s + Decimal(time) for time in poses.times_s[[0, -1]].tolist())
            raise TrajectoryFileError(
                f"{self.file}: covers {begin:.3f} to {end:.3f} s; images from "
                f"{self.first_image_time_s:.3f} to {last_image_time_s:.3f} s, lead_s {self.lead_s:g} s before and "
                f"{END_MARGIN_S:g} s after them are needed"
            )
        times, gaps = trajectory.times_s, np.diff(trajectory.times_s)
        gaps[(times[1:] <= -self.lead_s) | (times[:-1] >= max(image_times_s) + END_MARGIN_S)] = 0.0
        if gaps.max() > MAX_GAP_S:
            raise TrajectoryFileError(
                f"{self.file}: pose {gaps.argmax() + 2} is {gaps.max():.6g} s after the pose before it; allowed from "
                f"the start of navigation to the last image: up to {MAX_GAP_S:g} s (times are in seconds, integers in "
                "a column time_ns in nanoseconds)"
            )
        check_looks_down(self.file, trajectory, image_times_s)
        for number, position in enumerate(trajectory.motion(np.array(image_times_s)).positions_m, start=1):
            if self.origin is FlightOrigin.LOCATION and position[2] <= 0.0:
                raise TrajectoryFileError(
                    f"{self.file}: at image {number} the camera is {-position[2]:.1f} m below the ground at the "
                    'location; allowed: above it (with origin = "terrain", heights refer to the terrain\'s origin)'
                )

    def create_trajectory(self, ground_m: Float64[np.ndarray, "3"], gravity_m_s2: float) -> RecordedMotion:
        """Transform the flight to world axes with time 0 at the first image; `ground_m` is the ground below it."""
        poses = read_poses(self.file)
        world_from_file = (
            Rotation.from_rotvec(np.radians(-self.heading_offset_deg) * np.array([0.0, 0.0, 1.0])) * self.enu_from_axes
        )
        attitudes = world_from_file * Rotation.from_quat(poses.quaternions)
        positions = world_from_file.apply(poses.positions_m) + self.lever_arms(attitudes)
        if self.origin is FlightOrigin.LOCATION:
            positions = positions + ground_m
        times = poses.times_s - float(self._exact_first_image_time_s - poses.start_s)
        return RecordedMotion(times, positions, self.body_attitudes(attitudes), gravity_m_s2)


def check_looks_down(name: str, trajectory: RecordedMotion, image_times_s: Sequence[float]) -> None:
    """Raise TrajectoryFileError if the camera of the flight looks up at an image; `name` is used in the message."""
    for number, attitude in enumerate(trajectory.motion(np.array(image_times_s)).attitudes, start=1):
        axis = attitude.apply(np.array([0.0, 0.0, -1.0]))
        if axis[2] >= 0.0:
            elevation = np.degrees(np.arcsin(np.clip(axis[2], -1.0, 1.0)))
            raise TrajectoryFileError(
                f"{name}: at image {number} the camera looks up, {elevation:.1f} deg above the horizon; "
                "allowed: down (flight.axes, attitude_of and mounting define the axes)"
            )
