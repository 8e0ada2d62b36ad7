"""Rover on its route: true stance, and pose estimated by odometry."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.rig import Rig
from marsyard.scenarios.rover.world import RunWorld
from marsyard.sim.dynamics.driven_ground import DrivenGround
from marsyard.sim.dynamics.driving import Drive, Soil, drive
from marsyard.sim.dynamics.rover import MER, ROCKY_8, RoverParameters, Stance, settle
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DriveCommand
from marsyard.sim.sensor.odometry import Odometer, PoseEstimate
from marsyard.sim.streams import Streams


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
        base_forward_m, base_left_m, _ = rig.calibrated.geometry.base_m
        target = np.array([p.world.east_m, p.world.north_m])
        base = target + (world.face_distance_m(p) + p.start.distance_m) * to_start
        position = base - base_forward_m * ahead - base_left_m * left
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
