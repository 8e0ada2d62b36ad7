"""Stops of a run: truth, estimates, pictures and the tracker's answer at each."""

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
    """The pictures of a stop, with the poses at which they were taken."""

    leg: int  #: number of the leg that led here; -1 for the start
    time_s: float  #: since the start of the run
    stance: Stance  #: truth
    estimated: RigidTransform  #: world pose of the rover as estimated on board
    angles_rad: tuple[float, float]  #: azimuth and elevation of the mast's encoders
    world_from_head: RigidTransform  #: true pose of the mast's head
    pictures: StereoPictures
    drives: tuple[Drive, ...]  #: the commands driven since the stop before


@dataclass(frozen=True)
class Stop(View):
    """A stop at which the target was tracked."""

    update: TargetUpdate  #: the tracker's answer
    track_time_s: float  #: processor time of the update
    point_px: Float64[np.ndarray, "2"]  #: true full-frame (u, v) of the target in the left picture; NaN outside of it
    point_rover: Float64[np.ndarray, "3"]  #: the designated point in the rover's true frame, metres
    range_m: float  #: from the left camera's true centre to it

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
        """The details of our own trackers' answers."""
        return self.update.details if isinstance(self.update.details, VttDetails) else None

    @property
    def reported_rover(self) -> Float64[np.ndarray, "3"] | None:
        """The reported position in the rover frame; None where the target was not found."""
        return self.update.position_rover if self.update.found else None

    def found_px(self, mast: MastCalibration) -> Float64[np.ndarray, "2"]:
        """Pixel of the target in the left picture by the tracker; NaN where it was not found.

        Without details of the match the reported position is projected through the calibrated camera.
        """
        if self.reported_rover is None:
            return np.full(2, np.nan)
        if self.details is not None and self.details.match is not None:
            return np.asarray(self.details.match.pixel, dtype=np.float64)
        camera = mast.left.moved(mast.geometry.rover_from_head(*self.angles_rad))
        return np.asarray(camera.project(self.reported_rover)[0], dtype=np.float64)

    def error_m(self) -> Float64[np.ndarray, "3"]:
        """Reported minus true position in the rover frame; NaN where none was reported."""
        return np.full(3, np.nan) if self.reported_rover is None else np.asarray(self.reported_rover - self.point_rover)
