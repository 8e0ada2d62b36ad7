"""The mast and its stereo pair in a run: as they are, as calibrated, and where they point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.vtt.accuracy import GOAL_M, START_M
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.sim.camera import CameraModel
from marsyard.sim.measurements import MastCalibration
from marsyard.sim.sensor import Mast, MastState, StereoHead
from marsyard.sim.streams import Streams


@dataclass
class Rig:
    """A mast and its pair."""

    head: StereoHead  #: The pair as it is and as calibrated
    mast: Mast  #: The mast with its errors
    state: MastState  #: Where it points now
    motors: np.random.Generator  #: Stream of where its motors stop

    @classmethod
    def of(cls, p: RoverScenarioParameters, streams: Streams) -> Rig:
        """The mast and pair of a run, their errors drawn."""
        design = p.camera.mast()
        head = StereoHead.drawn(design, p.stereo, streams.generator("stereo calibration"))
        mast = Mast.drawn(p.pointing, design.geometry, streams.generator("mast zeros"))
        return cls(head, mast, mast.rest, streams.generator("mast motors"))

    @property
    def calibrated(self) -> MastCalibration:
        """What flight software is given."""
        return self.head.calibrated

    @property
    def left(self) -> CameraModel:
        """The left camera as it is, in the head's frame."""
        return self.head.true.left

    @property
    def right(self) -> CameraModel:
        """The right camera as it is, in the head's frame."""
        return self.head.true.right

    @property
    def pixel_rad(self) -> float:
        """Angle that a pixel in the middle of the frame takes."""
        return 1.0 / self.left.focal_lengths[0]

    def eyes(self, world_from_head: RigidTransform) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
        """Where the left and the right camera truly are, world, metres."""
        left, right = world_from_head.apply(np.stack([self.left.c, self.right.c]))
        return left, right

    def point(self, azimuth_rad: float, elevation_rad: float) -> None:
        """Points the mast; where it reads these angles already, it stays."""
        if self.state.readings_rad != (azimuth_rad, elevation_rad):
            self.state = self.mast.pointed(self.state, azimuth_rad, elevation_rad, self.motors)

    @property
    def rover_from_head(self) -> RigidTransform:
        """True pose of the head in the rover frame."""
        return self.mast.rover_from_head(self.state)

    def range_m(self, position_rover: Float64[np.ndarray, "3"]) -> float:
        """From the left camera to a place, as the rover believes."""
        camera = self.calibrated.left.moved(self.calibrated.geometry.rover_from_head(*self.state.readings_rad))
        return float(np.linalg.norm(position_rover - camera.c))

    def applied(self) -> dict[str, Scalar]:
        """The errors that were drawn, read back."""
        azimuth, elevation = np.degrees(self.mast.zeros_rad)
        return {
            "disparity_error_start_px": self.head.disparity_error_px(START_M),
            "disparity_error_goal_px": self.head.disparity_error_px(GOAL_M),
            "mast_azimuth_error_deg": float(azimuth),
            "mast_elevation_error_deg": float(elevation),
        }
