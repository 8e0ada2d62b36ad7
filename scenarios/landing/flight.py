"""True states and on-board poses at the two pictures of a case, and their choice on a helicopter's flight."""

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
    draw_arrivals,
    faulty_helicopter,
    faulty_ranges,
)
from marsyard.scenarios.views import nadir_pose
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics import State
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import PoseMeasurement
from marsyard.sim.sensor.ranging import DOWN, RangingUnit, range_along
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import Surface

#: Minimum time between pictures, for a camera at rest.
MIN_INTERVAL_S = 0.1


@dataclass(frozen=True)
class Flight:
    """True states and estimated poses at the two pictures."""

    states: tuple[State, State]  #: true states of the body; the camera is at its origin
    poses: tuple[PoseMeasurement, PoseMeasurement]  #: by the on-board filter
    up_body: Float64[np.ndarray, "3"]  #: up vector at the first picture by the inclinometers, in body axes
    transit: Transit | None = None  #: the helicopter's flight; None for a pair as stated

    @classmethod
    def of(cls, p: LandingScenarioParameters, surface: Surface, streams: Streams) -> Flight:
        """The flight of a case: the chosen pair of a helicopter's flight, or the pair as stated."""
        if p.helicopter is None:
            stated = true_states(p, surface, streams)
            upright = stated[0].attitude.inv().apply(np.array([0.0, 0.0, 1.0]))
            tilt = np.radians(p.navigation.inclinometer_deg) * streams.generator("inclinometers").standard_normal(3)
            up_body = Rotation.from_rotvec(tilt).apply(upright)
            return cls(stated, measure_poses(p, stated, streams), up_body)
        helicopter = faulty_helicopter(p.faults, p.helicopter)
        ground = float(surface.height(p.location.east_m, p.location.north_m))
        height = helicopter.transit.height_m
        over = np.array([p.location.east_m, p.location.north_m, ground + height])
        heading = -np.radians(p.flown.heading_deg)
        course = np.pi / 2 - np.radians(p.flown.heading_deg + p.flown.course_deg)
        gravity = p.preset.environment.gravity_m_s2
        transit = Transit.fly(helicopter, over, float(course), float(heading), gravity, streams)
        numbers = draw_arrivals(p.faults, transit.times_s.size, streams.generator("lost pictures"))
        # the laser's ranges to the ground at all pictures, without rocks
        states = [transit.state(number) for number in range(transit.times_s.size)]
        axes = [np.asarray(state.attitude.apply(DOWN)) for state in states]
        true = [
            range_along(surface, state.position_m, axis, 5.0 * height) for state, axis in zip(states, axes, strict=True)
        ]
        unit = RangingUnit.draw(p.laser, streams.generator("laser"))
        readings = unit.readings(transit.times_s, np.array(true), streams.generator("laser noise, transit"))
        ranges = faulty_ranges(p.faults, readings.values, height)[numbers]
        calibrated = draw_calibrated(p.optics, p.calibration, streams.generator("camera calibration"))
        choice = choose_pair([transit.pose(int(n)) for n in numbers], ranges, calibrated, p.pair, height)
        first, second = int(numbers[choice.first]), int(numbers[choice.second])
        poses = (transit.pose(first), transit.pose(second))
        return cls((states[first], states[second]), poses, transit.up_body(first), transit)

    @property
    def position_error_m(self) -> Float64[np.ndarray, "3"]:
        """Estimated minus true position at the first picture."""
        return np.asarray(np.array(self.poses[0].world_from_body.translation) - self.states[0].position_m)


def true_states(p: LandingScenarioParameters, surface: Surface, streams: Streams) -> tuple[State, State]:
    """The body's states at the pictures, as the parameters state them."""
    flown = p.flown
    first = nadir_pose(surface, p.location.east_m, p.location.north_m, flown.height_m, flown.heading_deg)
    towards = np.radians(flown.tilt_towards_deg)
    # turned about the horizontal axis to the right of the azimuth, the axis below moves towards it
    tilt = Rotation.from_rotvec(np.radians(flown.tilt_deg) * np.array([np.cos(towards), -np.sin(towards), 0.0]))
    attitude = tilt * first.rotation
    # the body's x runs along the picture's columns to its right, y to its upper edge, z against the optical axis
    change = Rotation.from_rotvec(np.radians([flown.pitch_deg, flown.yaw_deg, flown.roll_deg]))
    course = np.radians(flown.heading_deg + flown.course_deg)
    along = flown.baseline_fraction * flown.height_m
    moved = np.array([along * np.sin(course), along * np.cos(course), flown.climb_fraction * flown.height_m])
    interval = max(float(np.linalg.norm(moved)) / max(flown.speed_m_s, 1e-6), MIN_INTERVAL_S)
    velocity = flown.speed_m_s * np.array([np.sin(course), np.cos(course), 0.0])
    rates = np.radians(flown.rate_deg_s) * streams.generator("attitude rates").standard_normal((2, 3))
    start = np.array(first.translation)
    return (
        State(0.0, start, velocity, attitude, rates[0], np.zeros(3)),
        State(interval, start + moved, velocity, attitude * change, rates[1], np.zeros(3)),
    )


def measure_poses(
    p: LandingScenarioParameters, states: tuple[State, State], streams: Streams
) -> tuple[PoseMeasurement, PoseMeasurement]:
    """The filter's poses: a common error of both, and an error of the motion between them."""
    n, rng = p.navigation, streams.generator("navigation")
    position = n.position_m * rng.standard_normal(3)
    motion = n.motion_m * rng.standard_normal(3)
    tilt, azimuth = np.radians(n.tilt_deg) * rng.standard_normal(2), np.radians(n.azimuth_deg) * rng.standard_normal()
    turn = np.radians(n.turn_deg) * rng.standard_normal(3)
    common = Rotation.from_rotvec(np.array([tilt[0], tilt[1], azimuth]))
    positions = (position, position + motion)
    rotations = (common, Rotation.from_rotvec(turn) * common)
    first, second = (
        PoseMeasurement(rigid(rotation * state.attitude, state.position_m + offset), state.time_s)
        for state, offset, rotation in zip(states, positions, rotations, strict=True)
    )
    return first, second


@dataclass(frozen=True)
class PairChoice:
    """Numbers of the chosen pictures, their baseline across the first optical axis, and their overlap."""

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
    """Choose the pair of the highest worth, the earliest of equal ones (landing paper, section V).

    Uses on-board data: poses of the filter, ranges of the laser, the calibrated camera, over ground assumed level. The
    commanded height replaces a missing range. Pairs with too little overlap are chosen only if there are no others.

    Raises ValueError if there are fewer than two pictures.
    """
    if len(poses) < 2:
        raise ValueError(f"a pair is to be chosen from {len(poses)} pictures; at least 2 are needed")
    views = [_PictureView.of(camera, pose) for pose in poses]
    best, best_worth = None, (False, -np.inf)
    for i, first in enumerate(views[:-1]):
        distance = float(ranges_m[i]) if np.isfinite(ranges_m[i]) else height_m
        level = float(first.centre_m[2] + distance * first.axis[2])
        own = first.footprint(level, first.centre_m)
        for j, second in enumerate(views[i + 1 :], start=i + 1):
            step = second.centre_m - first.centre_m
            baseline = float(np.linalg.norm(step - (step @ first.axis) * first.axis))
            other = second.footprint(level, first.centre_m)
            overlap = 0.0
            if own is not None and other is not None:
                overlap = float(cv2.intersectConvexConvex(own, other)[0] / cv2.contourArea(own))
            worth = overlap * min(baseline / (parameters.max_baseline_fraction * distance), 1.0)
            if (overlap >= parameters.min_overlap, worth) > best_worth:
                best_worth = (overlap >= parameters.min_overlap, worth)
                best = PairChoice(i, j, baseline, overlap)
    if best is None:
        raise ValueError("no pair of pictures has poses that are numbers")
    return best


@dataclass(frozen=True)
class _PictureView:
    """A picture's centre of projection, optical axis, and rays of its corners, world axes."""

    centre_m: Float64[np.ndarray, "3"]
    axis: Float64[np.ndarray, "3"]
    corners: Float64[np.ndarray, "4 3"]

    @classmethod
    def of(cls, camera: CameraModel, pose: PoseMeasurement) -> _PictureView:
        turn = pose.world_from_body.rotation
        columns, rows = camera.size
        rays = camera.rays(np.array([[0.0, 0.0], [columns, 0.0], [columns, rows], [0.0, rows]]) - 0.5)[1]
        centre = np.asarray(pose.world_from_body.apply(np.array(camera.c)))
        return cls(centre, np.asarray(turn.apply(np.array(camera.a))), np.asarray(turn.apply(rays)))

    def footprint(self, level_m: float, origin_m: Float64[np.ndarray, "3"]) -> Float32[np.ndarray, "4 2"] | None:
        """Corners of the picture on a level plane, relative to a point; None if it looks at or above the horizon."""
        if not np.all(self.corners[:, 2] < 0.0):
            return None
        reach = (level_m - self.centre_m[2]) / self.corners[:, 2]
        corners = self.centre_m[:2] - origin_m[:2] + reach[:, None] * self.corners[:, :2]
        return np.asarray(corners, dtype=np.float32)
