"""True states and on-board poses at the two pictures of a case."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from marsyard.scenarios.landing.faults import arrived_numbers, faulty_helicopter, faulty_ranges
from marsyard.scenarios.landing.helicopter import HelicopterParameters, Transit
from marsyard.scenarios.landing.pair_choice import choose_pair
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.optics import draw_calibrated
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
        """The flight of a case."""
        if p.helicopter is not None:
            return _helicopter_flight(p, p.helicopter, surface, streams)
        states = true_states(p, surface, streams)
        poses = believed_poses(p, states, streams)
        upright = states[0].attitude.inv().apply(np.array([0.0, 0.0, 1.0]))
        tilt = np.radians(p.navigation.inclinometer_deg) * streams.generator("inclinometers").standard_normal(3)
        return cls(states, poses, Rotation.from_rotvec(tilt).apply(upright))

    @property
    def position_error_m(self) -> Float64[np.ndarray, "3"]:
        """Estimated minus true position at the first picture."""
        return np.asarray(np.array(self.poses[0].world_from_body.translation) - self.states[0].position_m)


def calibrated_camera(p: LandingScenarioParameters, streams: Streams) -> CameraModel:
    """The calibrated camera in the body frame: the true one with calibration errors."""
    return draw_calibrated(p.optics, p.calibration, streams.generator("camera calibration"))


def _helicopter_flight(
    p: LandingScenarioParameters, helicopter: HelicopterParameters, surface: Surface, streams: Streams
) -> Flight:
    """The chosen pair of a helicopter's flight."""
    helicopter = faulty_helicopter(p.faults, helicopter)
    ground = float(surface.height(p.place.east_m, p.place.north_m))
    over = np.array([p.place.east_m, p.place.north_m, ground + helicopter.transit.height_m])
    heading = -np.radians(p.flown.heading_deg)
    course = np.pi / 2 - np.radians(p.flown.heading_deg + p.flown.course_deg)
    gravity = p.preset.environment.gravity_m_s2
    transit = Transit.flown(helicopter, over, float(course), float(heading), gravity, streams)
    numbers = arrived_numbers(p.faults, transit.times_s.size, streams.generator("lost pictures"))
    poses, height = transit.poses(), helicopter.transit.height_m
    ranges = faulty_ranges(p.faults, _laser_ranges(p, transit, surface, streams), height)
    choice = choose_pair(
        [poses[number] for number in numbers], ranges[numbers], calibrated_camera(p, streams), p.pair, height
    )
    first, second = int(numbers[choice.first]), int(numbers[choice.second])
    return Flight(
        (transit.state(first), transit.state(second)),
        (transit.pose(first), transit.pose(second)),
        transit.up_body(first),
        transit,
    )


def _laser_ranges(
    p: LandingScenarioParameters, transit: Transit, surface: Surface, streams: Streams
) -> Float64[np.ndarray, "pictures"]:
    """The laser's ranges to the ground at all pictures, without rocks."""
    states = [transit.state(number) for number in range(transit.times_s.size)]
    longest = 5.0 * transit.parameters.transit.height_m
    true = [range_along(surface, state.position_m, np.asarray(state.attitude.apply(DOWN)), longest) for state in states]
    unit = RangingUnit.drawn(p.laser, streams.generator("laser"))
    return unit.readings(transit.times_s, np.array(true), streams.generator("laser noise, transit")).values


def true_states(p: LandingScenarioParameters, surface: Surface, streams: Streams) -> tuple[State, State]:
    """The body's states at the pictures, as the parameters state them."""
    flown = p.flown
    first = nadir_pose(surface, p.place.east_m, p.place.north_m, flown.height_m, flown.heading_deg)
    towards = np.radians(flown.tilt_towards_deg)
    # turned about the horizontal axis to the right of the azimuth, the axis below moves towards it
    tilt = Rotation.from_rotvec(np.radians(flown.tilt_deg) * np.array([np.cos(towards), -np.sin(towards), 0.0]))
    attitude = tilt * first.rotation
    # the body's x runs along the picture's columns to its right, y to its upper edge, z against the optical axis
    change = Rotation.from_rotvec(np.radians([flown.pitch_deg, flown.yaw_deg, flown.roll_deg]))
    course = np.radians(flown.heading_deg + flown.course_deg)
    along = flown.baseline_share * flown.height_m
    moved = np.array([along * np.sin(course), along * np.cos(course), flown.climb_share * flown.height_m])
    interval = max(float(np.linalg.norm(moved)) / max(flown.speed_m_s, 1e-6), MIN_INTERVAL_S)
    velocity = flown.speed_m_s * np.array([np.sin(course), np.cos(course), 0.0])
    rates = np.radians(flown.rate_deg_s) * streams.generator("attitude rates").standard_normal((2, 3))
    start = np.array(first.translation)
    return (
        State(0.0, start, velocity, attitude, rates[0], np.zeros(3)),
        State(interval, start + moved, velocity, attitude * change, rates[1], np.zeros(3)),
    )


def believed_poses(
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
    turns = (common, Rotation.from_rotvec(turn) * common)
    first, second = (
        PoseMeasurement(rigid(turned * state.attitude, state.position_m + off), state.time_s)
        for state, off, turned in zip(states, positions, turns, strict=True)
    )
    return first, second
