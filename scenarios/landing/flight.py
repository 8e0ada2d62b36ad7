"""True states and on-board poses at the two images of a case: from the parameters, or of a helicopter flight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.scenarios.cameras import draw_calibrated
from marsyard.scenarios.landing.faults import add_range_faults, add_receiver_outage, draw_received_images
from marsyard.scenarios.landing.helicopter import Transit
from marsyard.scenarios.landing.parameters import LandingScenarioParameters, PairParameters
from marsyard.scenarios.views import nadir_pose
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics import State
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import PoseMeasurement
from marsyard.sim.sensor.altimeters import RangingUnit, range_along
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import Surface

#: Minimum time between the two images, s; applies to a camera at rest.
MIN_INTERVAL_S = 0.1


@dataclass(frozen=True)
class LandingFlight:
    """True states and estimated poses at the two images."""

    states: tuple[State, State]  #: true states of the body; the camera is at the body's origin
    poses: tuple[PoseMeasurement, PoseMeasurement]  #: estimates of the on-board filter
    up_body: Float64[np.ndarray, "3"]  #: up vector of the inclinometers at the first image, body axes
    transit: Transit | None = None  #: the helicopter flight; None if the parameters define the poses

    @classmethod
    def from_parameters(cls, p: LandingScenarioParameters, surface: Surface, streams: Streams) -> LandingFlight:
        """Create the flight of a case: choose a pair from a helicopter flight, or use the poses of the parameters."""
        if p.helicopter is None:
            states = true_states(p, surface, streams)
            upright = states[0].attitude.inv().apply(np.array([0.0, 0.0, 1.0]))
            tilt = np.radians(p.navigation.inclinometer_deg) * streams.generator("inclinometers").standard_normal(3)
            up_body = Rotation.from_rotvec(tilt).apply(upright)
            return cls(states, measure_poses(p, states, streams), up_body)
        helicopter = add_receiver_outage(p.faults, p.helicopter)
        ground = float(surface.height(p.location.east_m, p.location.north_m))
        height = helicopter.transit.height_m
        start_m = np.array([p.location.east_m, p.location.north_m, ground + height])
        # azimuths are clockwise from north, angles counterclockwise from east; `heading` is that of the image's right
        heading = -np.radians(p.image_poses.heading_deg)
        course = np.pi / 2 - np.radians(p.image_poses.heading_deg + p.image_poses.course_deg)
        gravity = p.preset.environment.gravity_m_s2
        transit = Transit.fly(helicopter, start_m, float(course), float(heading), gravity, streams)
        # another name of a random stream would change the random values
        received_indices = draw_received_images(p.faults, transit.times_s.size, streams.generator("lost pictures"))
        # laser ranges to the ground, without rocks, at all images; no echo beyond five times the height
        motion = transit.flight.path.motion(transit.times_s)
        laser = RangingUnit.draw(p.laser, streams.generator("laser"))
        true_ranges = [
            range_along(surface, position, axis, 5.0 * height)
            for position, axis in zip(motion.positions_m, motion.attitudes.apply(laser.axis), strict=True)
        ]
        readings = laser.readings(transit.times_s, np.array(true_ranges), streams.generator("laser noise, transit"))
        ranges = add_range_faults(p.faults, readings.values, height)[received_indices]
        calibrated = draw_calibrated(p.optics, p.calibration, streams.generator("camera calibration"))
        choice = choose_pair(
            [transit.pose(int(index)) for index in received_indices], ranges, calibrated, p.pair, height
        )
        first, second = int(received_indices[choice.first]), int(received_indices[choice.second])
        poses = (transit.pose(first), transit.pose(second))
        return cls((motion.state(first), motion.state(second)), poses, transit.up_body(first), transit)

    @property
    def position_error_m(self) -> Float64[np.ndarray, "3"]:
        """Estimated minus true position at the first image."""
        return np.asarray(np.array(self.poses[0].world_from_body.translation) - self.states[0].position_m)


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
    interval = max(float(np.linalg.norm(step)) / max(pair.speed_m_s, 1e-6), MIN_INTERVAL_S)
    velocity = pair.speed_m_s * np.array([np.sin(course), np.cos(course), 0.0])
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
    tilt, azimuth = (
        np.radians(deviations.tilt_deg) * rng.standard_normal(2),
        np.radians(deviations.azimuth_deg) * rng.standard_normal(),
    )
    rotation_error = np.radians(deviations.rotation_deg) * rng.standard_normal(3)
    common_rotation = Rotation.from_rotvec(np.array([tilt[0], tilt[1], azimuth]))
    positions = (position, position + motion)
    rotations = (common_rotation, Rotation.from_rotvec(rotation_error) * common_rotation)
    first, second = (
        PoseMeasurement(rigid(rotation * state.attitude, state.position_m + offset), state.time_s)
        for state, offset, rotation in zip(states, positions, rotations, strict=True)
    )
    return first, second


@dataclass(frozen=True)
class PairChoice:
    """Indices of the chosen images, their baseline perpendicular to the first optical axis, and their overlap."""

    first: int
    second: int
    baseline_m: float
    overlap: float


def choose_pair(
    poses: Sequence[PoseMeasurement],
    ranges_m: Float64[np.ndarray, "n"],
    camera: CameraModel,
    parameters: PairParameters,
    height_m: float,
) -> PairChoice:
    """Choose the pair with the highest score; among equal scores, the earliest pair (landing paper, section V).

    The choice uses on-board data: poses of the filter, ranges of the laser, and the calibrated camera; level ground is
    assumed. The commanded height replaces a missing range. Pairs with an overlap below `min_overlap` are used only if
    no pair has this overlap.

    Raises ValueError if there are fewer than two images.
    """
    if len(poses) < 2:
        raise ValueError(f"cannot choose a pair from {len(poses)} images; at least 2 are needed")
    columns, rows = camera.size
    rays = camera.rays(np.array([[0.0, 0.0], [columns, 0.0], [columns, rows], [0.0, rows]]) - 0.5)[1]
    transforms = RigidTransform.concatenate([pose.world_from_body for pose in poses])
    centres_m, axes = transforms.apply(np.array(camera.c)), transforms.rotation.apply(np.array(camera.a))
    corner_rays = np.stack([transforms.rotation.apply(ray) for ray in rays], axis=1)
    best, best_score = None, (False, -np.inf)
    for first, axis in enumerate(axes[:-1]):
        distance = float(ranges_m[first]) if np.isfinite(ranges_m[first]) else height_m
        steps_m = centres_m[first:] - centres_m[first]
        baselines_m = np.linalg.norm(steps_m - (steps_m @ axis)[:, None] * axis, axis=1)
        footprints = _level_footprints(corner_rays[first:], steps_m, distance * axis[2])
        area = cv2.contourArea(footprints[0])
        for k in range(1, len(footprints)):
            # an image that shows the horizon has no footprint
            has_overlap = np.isfinite(footprints[[0, k]]).all()
            overlap = cv2.intersectConvexConvex(footprints[0], footprints[k])[0] / area if has_overlap else 0.0
            is_usable = bool(overlap >= parameters.min_overlap)
            score = overlap * min(baselines_m[k] / (parameters.max_baseline_fraction * distance), 1.0)
            if (is_usable, score) > best_score:
                best_score = (is_usable, score)
                best = PairChoice(first, first + k, float(baselines_m[k]), overlap)
    if best is None:
        raise ValueError("no pair of images has finite poses")
    return best


def _level_footprints(
    corner_rays: Float64[np.ndarray, "n 4 3"], centres_m: Float64[np.ndarray, "n 3"], level_m: float
) -> Float32[np.ndarray, "n 4 2"]:
    """Project the corners of images onto a level plane; NaN for an image with a corner at or above the horizon."""
    below = np.all(corner_rays[..., 2] < 0.0, axis=1)
    heights = np.where(below, level_m - centres_m[:, 2], np.nan)
    distances = heights[:, None] / corner_rays[..., 2]
    return np.asarray(centres_m[:, None, :2] + distances[..., None] * corner_rays[..., :2], dtype=np.float32)
