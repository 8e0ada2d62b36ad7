"""Rover on its route: true stance and estimated pose, and the mast with its stereo pair."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.world import RunWorld
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics.driven_ground import DrivenGround
from marsyard.sim.dynamics.driving import Drive, Soil, drive
from marsyard.sim.dynamics.rover import MER, ROCKY_8, RoverParameters, Stance, settle
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DriveCommand, MastCalibration
from marsyard.sim.sensor.mast import Mast, MastState, StereoHead
from marsyard.sim.sensor.odometry import Odometer, PoseEstimate
from marsyard.sim.streams import Streams


@dataclass
class Rig:
    """Simulated mast and stereo pair with sampled errors: true values, calibrated values, and current mast angles."""

    head: StereoHead  #: true and calibrated stereo pair
    calibrated: MastCalibration  #: calibration known to the flight software
    left: CameraModel  #: true left camera in the head's frame
    right: CameraModel  #: true right camera in the head's frame
    mast: Mast
    state: MastState  #: current angles: true, and read by the encoders
    motor_stream: np.random.Generator  #: random stream of the motors' stopping errors

    @classmethod
    def draw(cls, p: RoverScenarioParameters, streams: Streams) -> Rig:
        """Draw the errors of a run's mast and pair."""
        design = p.camera.mast()
        head = StereoHead.draw(design, p.stereo, streams.generator("stereo calibration"))
        mast = Mast.draw(p.pointing, design.geometry, streams.generator("mast zeros"))
        left, right, motor_stream = head.true.left, head.true.right, streams.generator("mast motors")
        return cls(head, head.calibrated, left, right, mast, mast.rest, motor_stream)

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

    def range_m(self, position_rover: Float64[np.ndarray, "3"]) -> float:
        """Compute the estimated distance of a position from the left camera."""
        camera = self.calibrated.left.transform(self.calibrated.geometry.rover_from_head(*self.state.readings_rad))
        return float(np.linalg.norm(position_rover - camera.c))


@dataclass
class Vehicle:
    """A rover on its route: true stance, and pose estimated by odometry."""

    rover: RoverParameters
    ground: DrivenGround
    soil: Soil
    stance: Stance
    odometer: Odometer
    estimate: PoseEstimate
    slip_stream: np.random.Generator
    odometry_stream: np.random.Generator

    @classmethod
    def at_start(cls, p: RoverScenarioParameters, world: RunWorld, rig: Rig, streams: Streams) -> Vehicle:
        """Place the rover on the ground at its start; its estimated pose is exact there."""
        rover = MER if p.camera.preset.startswith("mer") else ROCKY_8
        bearing = p.bearing_rad
        to_start = np.array([np.sin(bearing), np.cos(bearing)])
        azimuth = bearing + np.pi - np.radians(p.start.target_azimuth_deg)
        ahead = np.array([np.sin(azimuth), np.cos(azimuth)])
        left = np.array([-ahead[1], ahead[0]])
        # the start distance is that of the mast's base, not of the rover's origin
        base = rig.calibrated.geometry.base_m
        target = np.array([p.world.east_m, p.world.north_m])
        position = (
            target + (world.face_distance_m(p) + p.start.distance_m) * to_start - base[0] * ahead - base[1] * left
        )
        ground: DrivenGround = world.ground.surface
        if p.world.rocks_underfoot:
            ground = world.route_ground
        stance = settle(rover, ground, float(position[0]), float(position[1]), float(azimuth))
        odometer = Odometer.draw(p.odometry, stance.world_from_rover, streams.generator("odometry"))
        soil = Soil.draw(p.slip, streams.generator("soil"))
        generators = streams.generator("slip"), streams.generator("odometry noise")
        return cls(rover, ground, soil, stance, odometer, odometer.initial_estimate, *generators)

    @property
    def estimated_pose(self) -> RigidTransform:
        """World pose of the rover as estimated on board."""
        return self.estimate.world_from_rover

    def correct_position(self, position_m: Float64[np.ndarray, "3"]) -> None:
        """Replace the estimated position by that of visual odometry, world; the attitude remains that of the IMU."""
        pose = rigid(self.estimated_pose.rotation, position_m)
        self.estimate = replace(self.estimate, world_from_rover=pose)

    def drive(self, command: DriveCommand, visual: bool) -> Drive:
        """Execute a drive command and update the estimated pose.

        With `visual`, the update uses the true motion with the errors of visual odometry, else wheel odometry.
        """
        result = drive(self.rover, self.ground, self.soil, self.stance, command, self.slip_stream)
        self.estimate = self.odometer.step(self.estimate, result, self.odometry_stream, visual)
        self.stance = result.end
        return result
