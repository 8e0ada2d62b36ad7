"""True states and on-board poses at the two images of a case: from the parameters, or of a helicopter flight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.scenarios.cameras import draw_calibrated
from marsyard.scenarios.landing.faults import add_range_faults, add_receiver_outage, draw_received_images
from marsyard.scenarios.landing.helicopter import LandingHelicopterParameters, Transit
from marsyard.scenarios.landing.pair_choice import choose_pair
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.views import nadir_pose
from marsyard.sim.camera import CameraModel, camera_pose
from marsyard.sim.dynamics import State
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import PoseMeasurement
from marsyard.sim.sensor.altimeters import RangingUnit, range_along
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import Surface

#: Minimum time between the two images, s, and minimum speed from which it follows, m/s.
MIN_INTERVAL_S, MIN_SPEED_M_S = 0.1, 1e-6
#: Largest range of the laser's echo divided by the commanded height.
MAX_RANGE_HEIGHTS = 5.0


@dataclass(frozen=True)
class LandingFlight:
    """True states and estimated poses at the two images."""

    states: tuple[State, State]  #: true states of the body; the camera is at the body's origin
    poses: tuple[PoseMeasurement, PoseMeasurement]  #: estimates of the on-board filter
    up_body: Float64[np.ndarray, "3"]  #: up vector of the inclinometers at the first image, body axes
    transit: Transit | None = None  #: the helicopter flight; None if the parameters define the poses
    first: int = 0  #: number of the first image among those of the flight

    @classmethod
    def from_parameters(cls, p: LandingScenarioParameters, surface: Surface, streams: Streams) -> LandingFlight:
        """Create the flight of a case: choose a pair from a helicopter flight, or use the poses of the parameters."""
        if p.helicopter is not None:
            return cls._from_helicopter(p, add_receiver_outage(p.faults, p.helicopter), surface, streams)
        states = true_states(p, surface, streams)
        upright = states[0].attitude.inv().apply(np.array([0.0, 0.0, 1.0]))
        tilt = np.radians(p.navigation.inclinometer_deg) * streams.generator("inclinometers").standard_normal(3)
        up_body = Rotation.from_rotvec(tilt).apply(upright)
        return cls(states, measure_poses(p, states, streams), up_body)

    @classmethod
    def _from_helicopter(
        cls, p: LandingScenarioParameters, helicopter: LandingHelicopterParameters, surface: Surface, streams: Streams
    ) -> LandingFlight:
        """Fly a helicopter, and choose two of its images."""
        ground = float(surface.height(p.location.east_m, p.location.north_m))
        height = helicopter.transit.height_m
        start_m = np.array([p.location.east_m, p.location.north_m, ground + height])
        # azimuths are clockwise from north, angles counterclockwise from east; `heading` is that of the image's right
        heading = -np.radians(p.image_poses.heading_deg)
        course = np.pi / 2 - np.radians(p.image_poses.heading_deg + p.image_poses.course_deg)
        gravity = p.site_preset.environment.gravity_m_s2
        transit = Transit.fly(helicopter, start_m, float(course), float(heading), gravity, streams)
        # another name of a random stream would change the random values
        received_indices = draw_received_images(p.faults, transit.times_s.size, streams.generator("lost images"))
        # laser ranges to the ground, without rocks, at all images
        motion = transit.flight.path.motion(transit.times_s)
        laser = RangingUnit.draw(p.laser, streams.generator("laser"))
        true_ranges = [
            range_along(surface, position, axis, MAX_RANGE_HEIGHTS * height)
            for position, axis in zip(motion.positions_m, motion.attitudes.apply(laser.axis), strict=True)
        ]
        readings = laser.read(np.array(true_ranges), streams.generator("laser noise"))
        ranges = add_range_faults(p.faults, readings, height)[received_indices]
        calibrated = draw_calibrated(p.optics, p.calibration, streams.generator("camera calibration"))
        choice = choose_pair(
            [transit.pose(int(index)) for index in received_indices], ranges, calibrated, p.pair, height
        )
        first, second = int(received_indices[choice.first]), int(received_indices[choice.second])
        poses = (transit.pose(first), transit.pose(second))
        return cls((motion.state(first), motion.state(second)), poses, transit.up_body(first), transit, first)

    @property
    def position_error_m(self) -> Float64[np.ndarray, "3"]:
        """Estimated minus true position at the first image."""
        return np.asarray(np.array(self.poses[0].world_from_body.translation) - self.states[0].position_m)

    def true_motion(self, cameras: tuple[CameraModel, CameraModel]) -> RigidTransform:
        """Compute the true motion from the first to the second camera's frame; `cameras` are in the body frame."""
        first, second = (
            state.world_from_body * camera_pose(camera) for state, camera in zip(self.states, cameras, strict=True)
        )
        return second.inv() * first


def true_states(p: LandingScenarioParameters, surface: Surface, streams: Streams) -> tuple[State, State]:
    """Compute the body's states at the two images from `ImagePoseParameters`."""
    pair = p.image_poses
    first = nadir_pose(surface, p.location.east_m, p.location.north_m, pair.height_m, pair.heading_deg)
    tilt_azimuth = np.radians(pair.tilt_towards_deg)
    # a rotation about the horizontal axis to the right of the azimuth tilts the optical axis towards the azimuth
    tilt = Rotation.from_rotvec(
        np.radians(pair.tilt_deg) * np.array([np.cos(tilt_azimuth), -np.sin(tilt_azimuth), 0.0])
    )
    attitude = tilt * first.rotation
    # body axes: x towards the image's right, y towards its upper edge, z opposite to the optical axis
    rotation = Rotation.from_rotvec(np.radians([pair.pitch_deg, pair.yaw_deg, pair.roll_deg]))
    course = np.radians(pair.heading_deg + pair.course_deg)
    distance = pair.baseline_fraction * pair.height_m
    step = np.array([distance * np.sin(course), distance * np.cos(course), pair.climb_fraction * pair.height_m])
    interval = max(float(np.linalg.norm(step)) / max(pair.speed_m_s, MIN_SPEED_M_S), MIN_INTERVAL_S)
    velocity = step / interval
    rates = np.radians(pair.rate_deg_s) * streams.generator("attitude rates").standard_normal((2, 3))
    start = np.array(first.translation)
    return (
        State(0.0, start, velocity, attitude, rates[0], np.zeros(3)),
        State(interval, start + step, velocity, attitude * rotation, rates[1], np.zeros(3)),
    )


def measure_poses(
    p: LandingScenarioParameters, states: tuple[State, State], streams: Streams
) -> tuple[PoseMeasurement, PoseMeasurement]:
    """Draw the filter's poses with an error common to both poses, and an error of the motion between them."""
    deviations, rng = p.navigation, streams.generator("navigation")
    position = deviations.position_m * rng.standard_normal(3)
    motion = deviations.motion_m * rng.standard_normal(3)
    tilt_x, tilt_y = np.radians(deviations.tilt_deg) * rng.standard_normal(2)
    azimuth = np.radians(deviations.azimuth_deg) * rng.standard_normal()
    rotation_error = np.radians(deviations.rotation_deg) * rng.standard_normal(3)
    common_rotation = Rotation.from_rotvec(np.array([tilt_x, tilt_y, azimuth]))
    positions = (position, position + motion)
    rotations = (common_rotation, Rotation.from_rotvec(rotation_error) * common_rotation)
    first, second = (
        PoseMeasurement(rigid(rotation * state.attitude, state.position_m + offset), state.time_s)
        for state, offset, rotation in zip(states, positions, rotations, strict=True)
    )
    return first, second
