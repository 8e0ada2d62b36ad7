"""Compute true states and on-board poses at the two images of a case; choose the pair from a helicopter flight.

Section V is that of Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64
from scipy.spatial.transform import Rotation

from marsyard.scenarios.exposure import draw_calibrated
from marsyard.scenarios.landing.helicopter import Transit
from marsyard.scenarios.landing.parameters import (
    LandingScenarioParameters,
    PairParameters,
    add_range_faults,
    add_receiver_outage,
    draw_received_images,
)
from marsyard.scenarios.views import nadir_pose
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics import State
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import PoseMeasurement
from marsyard.sim.sensor.ranging import RangingUnit, range_along
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import Surface

#: Minimum time between the two images, s; applies to a camera at rest.
MIN_INTERVAL_S = 0.1


@dataclass(frozen=True)
class Flight:
    """True states and estimated poses at the two images."""

    states: tuple[State, State]  #: true states of the body; the camera is at the body's origin
    poses: tuple[PoseMeasurement, PoseMeasurement]  #: estimates of the on-board filter
    up_body: Float64[np.ndarray, "3"]  #: up vector of the inclinometers at the first image, body axes
    transit: Transit | None = None  #: the helicopter flight; None if the parameters define the poses

    @classmethod
    def from_parameters(cls, p: LandingScenarioParameters, surface: Surface, streams: Streams) -> Flight:
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
        transit_states = [transit.state(number) for number in range(transit.times_s.size)]
        laser = RangingUnit.draw(p.laser, streams.generator("laser"))
        axes = [np.asarray(state.attitude.apply(laser.axis)) for state in transit_states]
        true_ranges = [
            range_along(surface, state.position_m, axis, 5.0 * height)
            for state, axis in zip(transit_states, axes, strict=True)
        ]
        readings = laser.readings(transit.times_s, np.array(true_ranges), streams.generator("laser noise, transit"))
        ranges = add_range_faults(p.faults, readings.values, height)[received_indices]
        calibrated = draw_calibrated(p.optics, p.calibration, streams.generator("camera calibration"))
        choice = choose_pair(
            [transit.pose(int(index)) for index in received_indices], ranges, calibrated, p.pair, height
        )
        first, second = int(received_indices[choice.first]), int(received_indices[choice.second])
        poses = (transit.pose(first), transit.pose(second))
        return cls((transit_states[first], transit_states[second]), poses, transit.up_body(first), transit)

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
    assumed. The commanded height replaces a missing range. A pair is usable if its overlap is at least `min_overlap`
    and the motion of the ground in the image is at most `max_shift_px`. Other pairs are used only if no pair is usable.

    Raises ValueError if there are fewer than two images.
    """
    if len(poses) < 2:
        raise ValueError(f"cannot choose a pair from {len(poses)} images; at least 2 are needed")
    views = [_ImageView.from_pose(camera, pose) for pose in poses]
    best, best_score = None, (False, -np.inf)
    max_shift_px = np.inf if parameters.max_shift_px is None else parameters.max_shift_px
    for first_index, first in enumerate(views[:-1]):
        distance = float(ranges_m[first_index]) if np.isfinite(ranges_m[first_index]) else height_m
        ground_m = float(first.centre_m[2] + distance * first.axis[2])
        first_footprint = first.footprint(ground_m, first.centre_m)
        for second_index, second in enumerate(views[first_index + 1 :], start=first_index + 1):
            step = second.centre_m - first.centre_m
            baseline = float(np.linalg.norm(step - (step @ first.axis) * first.axis))
            second_footprint = second.footprint(ground_m, first.centre_m)
            overlap, shift_px = 0.0, np.inf
            if first_footprint is not None and second_footprint is not None:
                shared_area = cv2.intersectConvexConvex(first_footprint, second_footprint)[0]
                overlap = float(shared_area / cv2.contourArea(first_footprint))
                pixel_m = np.sqrt(cv2.contourArea(first_footprint) / np.prod(camera.size))
                shift_px = float(np.linalg.norm(second_footprint - first_footprint, axis=1).max() / pixel_m)
            is_usable = overlap >= parameters.min_overlap and shift_px <= max_shift_px
            score = overlap * min(baseline / (parameters.max_baseline_fraction * distance), 1.0)
            if (is_usable, score) > best_score:
                best_score = (is_usable, score)
                best = PairChoice(first_index, second_index, baseline, overlap)
    if best is None:
        raise ValueError("no pair of images has finite poses")
    return best


@dataclass(frozen=True)
class _ImageView:
    """An image's projection centre, optical axis, and corner rays, world axes."""

    centre_m: Float64[np.ndarray, "3"]
    axis: Float64[np.ndarray, "3"]
    corners: Float64[np.ndarray, "4 3"]

    @classmethod
    def from_pose(cls, camera: CameraModel, pose: PoseMeasurement) -> _ImageView:
        rotation = pose.world_from_body.rotation
        columns, rows = camera.size
        rays = camera.rays(np.array([[0.0, 0.0], [columns, 0.0], [columns, rows], [0.0, rows]]) - 0.5)[1]
        centre = np.asarray(pose.world_from_body.apply(np.array(camera.c)))
        return cls(centre, np.asarray(rotation.apply(np.array(camera.a))), np.asarray(rotation.apply(rays)))

    def footprint(self, level_m: float, origin_m: Float64[np.ndarray, "3"]) -> Float32[np.ndarray, "4 2"] | None:
        """Project the corners onto a level plane, relative to a point; None if a corner is at or above the horizon."""
        if not np.all(self.corners[:, 2] < 0.0):
            return None
        distances = (level_m - self.centre_m[2]) / self.corners[:, 2]
        corners = self.centre_m[:2] - origin_m[:2] + distances[:, None] * self.corners[:, :2]
        return np.asarray(corners, dtype=np.float32)
