"""The rover of a run: where it truly stands, where it believes to stand, and how it is driven."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.rig import Rig
from marsyard.scenarios.rover.world import RunWorld
from marsyard.sim.dynamics import MER, ROCKY_8, Drive, Ground, RockyGround, RoverParameters, Soil, Stance, drive, settle
from marsyard.sim.measurements import DriveCommand
from marsyard.sim.sensor.odometry import Odometer, PoseEstimate
from marsyard.sim.streams import Streams

#: Rocks are felt by the wheels within this of the way, metres.
FELT_M = 1.5


@dataclass
class Vehicle:
    """A rover under way."""

    rover: RoverParameters  #: What drives on what
    ground: Ground  #: What drives on what
    soil: Soil  #: What drives on what
    stance: Stance  #: Truth
    odometer: Odometer  #: What it believes
    estimate: PoseEstimate  #: What it believes
    slips: np.random.Generator  #: Streams of its slip and of its odometry
    errors: np.random.Generator  #: Streams of its slip and of its odometry

    @classmethod
    def placed(cls, p: RoverScenarioParameters, world: RunWorld, rig: Rig, streams: Streams) -> Vehicle:
        """The rover at its start, its pose known there."""
        rover = rover_of(p.camera.preset)
        bearing = p.bearing_rad
        away = np.array([np.sin(bearing), np.cos(bearing)])
        azimuth = bearing + np.pi - np.radians(p.start.target_azimuth_deg)
        ahead = np.array([np.sin(azimuth), np.cos(azimuth)])
        left = np.array([-ahead[1], ahead[0]])
        base = rig.calibrated.geometry.base_m
        target = np.array([p.world.east_m, p.world.north_m])
        place = target + (world.face_m(p) + p.start.distance_m) * away - base[0] * ahead - base[1] * left
        ground = _felt_ground(p, world)
        stance = settle(rover, ground, float(place[0]), float(place[1]), float(azimuth))
        odometer = Odometer.drawn(p.odometry, stance.world_from_rover, streams.generator("odometry"))
        return cls(
            rover=rover,
            ground=ground,
            soil=Soil.drawn(p.slip, streams.generator("soil")),
            stance=stance,
            odometer=odometer,
            estimate=odometer.first,
            slips=streams.generator("slip"),
            errors=streams.generator("odometry noise"),
        )

    @property
    def estimated(self) -> RigidTransform:
        """World pose of the rover as it believes."""
        return self.estimate.world_from_rover

    def drive(self, command: DriveCommand, visual: bool) -> Drive:
        """Drives a command, and renews the estimate."""
        driven = drive(self.rover, self.ground, self.soil, self.stance, command, self.slips)
        self.estimate = self.odometer.step(self.estimate, driven, self.errors, visual)
        self.stance = driven.end
        return driven


def rover_of(camera: str) -> RoverParameters:
    """The rover that carries a camera of `marsyard.sim.sensor.PRESETS`."""
    return MER if camera.startswith("mer") else ROCKY_8


def _felt_ground(p: RoverScenarioParameters, world: RunWorld) -> Ground:
    """The ground, with the rocks that wheels may meet where the campaign wants them felt."""
    if not p.world.rocks_underfoot:
        return world.surface
    half = p.start.distance_m + FELT_M
    return RockyGround.of(world.surface, world.base.objects.triangles, (p.world.east_m, p.world.north_m), half)
