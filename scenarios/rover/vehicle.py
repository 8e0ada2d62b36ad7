"""The rover of a run with its mast: true pose, estimated pose, stereo head and where the mast points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.vtt.accuracy import GOAL_M, START_M
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.world import RunWorld
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics import MER, ROCKY_8, Drive, Ground, RockyGround, RoverParameters, Soil, Stance, drive, settle
from marsyard.sim.measurements import DriveCommand, MastCalibration
from marsyard.sim.sensor import Mast, MastState, StereoHead
from marsyard.sim.sensor.odometry import Odometer, PoseEstimate
from marsyard.sim.streams import Streams

#: Wheels feel rocks within this of the route, metres.
FELT_M = 1.5


@dataclass
class Rig:
    """A mast and its stereo pair, with their errors."""

    head: StereoHead  #: the pair, true and calibrated
    mast: Mast
    state: MastState  #: present angles
    motors: np.random.Generator  #: stream of the motors' stopping errors

    @classmethod
    def of(cls, p: RoverScenarioParameters, streams: Streams) -> Rig:
        """The mast and pair of a run, their errors drawn."""
        design = p.camera.mast()
        head = StereoHead.drawn(design, p.stereo, streams.generator("stereo calibration"))
        mast = Mast.drawn(p.pointing, design.geometry, streams.generator("mast zeros"))
        return cls(head, mast, mast.rest, streams.generator("mast motors"))

    @property
    def calibrated(self) -> MastCalibration:
        """The calibration that flight software is given."""
        return self.head.calibrated

    @property
    def left(self) -> CameraModel:
        """The true left camera in the head's frame."""
        return self.head.true.left

    @property
    def right(self) -> CameraModel:
        """The true right camera in the head's frame."""
        return self.head.true.right

    @property
    def pixel_rad(self) -> float:
        """Angle of a pixel in the middle of the frame."""
        return 1.0 / self.left.focal_lengths[0]

    @property
    def rover_from_head(self) -> RigidTransform:
        """True pose of the head in the rover frame."""
        return self.mast.rover_from_head(self.state)

    def eyes(self, world_from_head: RigidTransform) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
        """True positions of the left and the right camera, world, metres."""
        left, right = world_from_head.apply(np.stack([self.left.c, self.right.c]))
        return left, right

    def point(self, azimuth_rad: float, elevation_rad: float) -> None:
        """Point the mast; it stays where its encoders read these angles already."""
        if self.state.readings_rad != (azimuth_rad, elevation_rad):
            self.state = self.mast.point(self.state, azimuth_rad, elevation_rad, self.motors)

    def range_m(self, position_rover: Float64[np.ndarray, "3"]) -> float:
        """Believed distance of a position from the left camera."""
        camera = self.calibrated.left.moved(self.calibrated.geometry.rover_from_head(*self.state.readings_rad))
        return float(np.linalg.norm(position_rover - camera.c))

    def error_columns(self) -> dict[str, Scalar]:
        """The errors that were drawn."""
        azimuth, elevation = np.degrees(self.mast.zeros_rad)
        return {
            "disparity_error_start_px": self.head.disparity_error_px(START_M),
            "disparity_error_goal_px": self.head.disparity_error_px(GOAL_M),
            "mast_azimuth_error_deg": float(azimuth),
            "mast_elevation_error_deg": float(elevation),
        }


@dataclass
class Vehicle:
    """A rover on its route: true stance, and pose estimate by odometry."""

    rover: RoverParameters
    ground: Ground
    soil: Soil
    stance: Stance
    odometer: Odometer
    estimate: PoseEstimate
    slip_stream: np.random.Generator
    odometry_stream: np.random.Generator

    @classmethod
    def at_start(cls, p: RoverScenarioParameters, world: RunWorld, rig: Rig, streams: Streams) -> Vehicle:
        """The rover at its start, its pose known there."""
        rover = rover_of(p.camera.preset)
        bearing = p.bearing_rad
        away = np.array([np.sin(bearing), np.cos(bearing)])
        azimuth = bearing + np.pi - np.radians(p.start.target_azimuth_deg)
        ahead = np.array([np.sin(azimuth), np.cos(azimuth)])
        left = np.array([-ahead[1], ahead[0]])
        base = rig.calibrated.geometry.base_m
        target = np.array([p.world.east_m, p.world.north_m])
        position = target + (world.face_m(p) + p.start.distance_m) * away - base[0] * ahead - base[1] * left
        ground: Ground = world.surface
        if p.world.rocks_underfoot:
            half = p.start.distance_m + FELT_M
            ground = RockyGround.of(ground, world.base.objects.triangles, (p.world.east_m, p.world.north_m), half)
        stance = settle(rover, ground, float(position[0]), float(position[1]), float(azimuth))
        odometer = Odometer.drawn(p.odometry, stance.world_from_rover, streams.generator("odometry"))
        soil = Soil.draw(p.slip, streams.generator("soil"))
        generators = streams.generator("slip"), streams.generator("odometry noise")
        return cls(rover, ground, soil, stance, odometer, odometer.first, *generators)

    @property
    def estimated(self) -> RigidTransform:
        """World pose of the rover as estimated on board."""
        return self.estimate.world_from_rover

    def drive(self, command: DriveCommand, visual: bool) -> Drive:
        """Drive a command and update the estimate."""
        driven = drive(self.rover, self.ground, self.soil, self.stance, command, self.slip_stream)
        self.estimate = self.odometer.step(self.estimate, driven, self.odometry_stream, visual)
        self.stance = driven.end
        return driven


def rover_of(camera: str) -> RoverParameters:
    """The rover that carries a camera of `marsyard.sim.sensor.PRESETS`."""
    return MER if camera.startswith("mer") else ROCKY_8
