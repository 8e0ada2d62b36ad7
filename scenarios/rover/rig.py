"""Mast with its stereo pair: sampled errors of pointing and calibration, and the current angles of the mast."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.sim.camera import CameraModel
from marsyard.sim.measurements import MastCalibration
from marsyard.sim.sensor.mast import Mast, MastState, StereoHead
from marsyard.sim.streams import Streams


@dataclass
class Rig:
    """Simulated mast and stereo pair with sampled errors: true values, calibrated values, and current mast angles."""

    head: StereoHead  #: true and calibrated stereo pair
    mast: Mast
    state: MastState  #: current angles: true, and read by the encoders
    motor_stream: np.random.Generator  #: random stream of the motors' stopping errors

    @classmethod
    def draw(cls, p: RoverScenarioParameters, streams: Streams) -> Rig:
        """Draw the errors of a run's mast and pair."""
        design = p.camera.mast()
        head = StereoHead.draw(design, p.stereo, streams.generator("stereo calibration"))
        mast = Mast.draw(p.pointing, design.geometry, streams.generator("mast zeros"))
        return cls(head, mast, mast.rest, streams.generator("mast motors"))

    @property
    def calibrated(self) -> MastCalibration:
        """Calibration known to the flight software."""
        return self.head.calibrated

    @property
    def left(self) -> CameraModel:
        """True left camera in the head's frame."""
        return self.head.true.left

    @property
    def right(self) -> CameraModel:
        """True right camera in the head's frame."""
        return self.head.true.right

    @property
    def pixel_rad(self) -> float:
        """Angle of a pixel at the image centre."""
        return 1.0 / self.left.focal_lengths[0]

    @property
    def rover_from_head(self) -> RigidTransform:
        """True pose of the head in the rover frame."""
        return self.mast.rover_from_head(self.state)

    def camera_positions(
        self, world_from_head: RigidTransform
    ) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
        """Compute the true positions of the left and the right camera, world, metres."""
        left, right = world_from_head.apply(np.stack([self.left.c, self.right.c]))
        return left, right

    def point(self, azimuth_rad: float, elevation_rad: float) -> None:
        """Point the mast; it does not move if its encoders already read these angles."""
        if self.state.readings_rad != (azimuth_rad, elevation_rad):
            self.state = self.mast.point(self.state, azimuth_rad, elevation_rad, self.motor_stream)

    def estimated_range_m(self, position_rover: Float64[np.ndarray, "3"]) -> float:
        """Estimate the distance of a position from the left camera by the calibration and the encoder readings."""
        camera = self.calibrated.left.transform(self.calibrated.geometry.rover_from_head(*self.state.readings_rad))
        return float(np.linalg.norm(position_rover - camera.c))
