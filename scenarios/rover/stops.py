"""What a run leaves behind: its stops, each with truth, estimates and pictures."""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import Enum

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.interface import TargetUpdate
from marsyard.algorithms.vtt import VttDetails
from marsyard.scenarios.rover.pictures import StereoPictures
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics.driving import Drive
from marsyard.sim.dynamics.rover import Stance
from marsyard.sim.measurements import MastCalibration


class RunOutcome(Enum):
    """How a run ended. Every member but COMPLETED is an expected failure: no position is reported at the goal."""

    COMPLETED = "the run went to its end with the target tracked there"
    NOT_SEEDED = "the target was not found in the first pictures"
    LOST = "the target was lost and not found again"
    OUT_OF_REACH = "the mast or the cameras cannot show the target"
    NO_PATH = "the navigator found no way"
    STUCK = "the steps ran out before the goal"


@dataclass(frozen=True)
class View:
    """The pictures of a stop, and where they were taken."""

    leg: int  #: Number of the leg that led here; -1 for the start
    time_s: float  #: Since the start of the run
    stance: Stance  #: The rover as it stands
    estimated: RigidTransform  #: World pose of the rover as estimated on board
    angles_rad: tuple[float, float]  #: Azimuth and elevation that the mast's encoders read
    world_from_head: RigidTransform  #: True pose of the mast's head
    pictures: StereoPictures  #: As delivered
    drives: tuple[Drive, ...]  #: The commands driven since the stop before


@dataclass(frozen=True)
class Stop(View):
    """A stop at which the target was tracked."""

    update: TargetUpdate  #: The tracker's answer
    track_time_s: float  #: Processor time of the update
    #: Where the left camera truly shows the designated point, full-frame (u, v); NaN where it does not
    point_px: Float64[np.ndarray, "2"]
    point_rover: Float64[np.ndarray, "3"]  #: The designated point in the rover's true frame, metres
    range_m: float  #: From the left camera's true centre to it

    @classmethod
    def of(
        cls, view: View, point_m: Float64[np.ndarray, "3"], left: CameraModel, update: TargetUpdate, track_time_s: float
    ) -> Stop:
        """A view with a tracker's answer; `point_m` is the designated point in the world, `left` the true camera."""
        in_head = np.asarray(view.world_from_head.inv().apply(point_m.copy()))
        return cls(
            **{one.name: getattr(view, one.name) for one in fields(View)},
            update=update,
            track_time_s=track_time_s,
            point_px=np.asarray(left.project(in_head)[0]),
            point_rover=np.asarray(view.stance.world_from_rover.inv().apply(point_m.copy())),
            range_m=float(np.linalg.norm(in_head - left.c)),
        )

    @property
    def details(self) -> VttDetails | None:
        """Those of our own trackers."""
        found = self.update.details
        return found if isinstance(found, VttDetails) else None

    def found_px(self, mast: MastCalibration) -> Float64[np.ndarray, "2"]:
        """Where the tracker says that the left picture shows the target; NaN where it found none.

        A tracker that keeps no details is taken at its word: its position, through the camera as calibrated.
        """
        if not self.update.found or self.update.position_rover is None:
            return np.full(2, np.nan)
        if self.details is not None and self.details.match is not None:
            return np.asarray(self.details.match.pixel, dtype=np.float64)
        camera = calibrated_left(mast, self.angles_rad)
        return np.asarray(camera.project(self.update.position_rover)[0], dtype=np.float64)

    def error_m(self) -> Float64[np.ndarray, "3"]:
        """Reported less true position in the rover frame; NaN where none was reported."""
        if not self.update.found or self.update.position_rover is None:
            return np.full(3, np.nan)
        return np.asarray(self.update.position_rover - self.point_rover)


def calibrated_left(mast: MastCalibration, angles_rad: tuple[float, float]) -> CameraModel:
    """The left camera in the rover frame as the rover believes."""
    return mast.left.moved(mast.geometry.rover_from_head(*angles_rad))
