"""A rover of six wheels on a rocker-bogie suspension, at rest on the ground.

Model. Each side has a rocker, which carries the front wheel and the bogie's pivot, and a bogie, which carries the
middle and the rear wheel. Rockers and bogies turn about axes parallel to the body's y axis. A differential turns the
two rockers against the body by opposite angles: the body's pitch is the mean of the rockers'. Wheels are cylinders
whose axles keep the direction of the body's y axis, as if they were not steered; nothing is sprung, and the joints have
no stops.

At a place (east, north) and an azimuth six numbers are left: height, pitch and roll of the body, the differential's
angle and the two bogies'. They are those at which all six wheels touch the ground and none goes into it: six equations,
solved by Levenberg-Marquardt. On a plane the joints rest and the body lies as the plane does.

Frame
-----
The rover's (body) frame has x forward, y to the left and z up. Its origin is the point of the ground between the two
middle wheels when the rover stands on level ground.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float64
from pydantic import Field, model_validator
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.dynamics.kernels import suspension
from marsyard.sim.frames import rigid, turn_matrix
from marsyard.sim.parameters import Parameters

Metres = Annotated[float, Field(gt=0.0, le=5.0)]

#: Names of the wheels in the order of all arrays: two columns, left and right, of three.
WHEELS = ("left front", "left middle", "left rear", "right front", "right middle", "right rear")
#: The sides' signs along y, and in the differential.
_SIDE = np.array([1.0, 1.0, 1.0, -1.0, -1.0, -1.0])
#: Points of a tread that may touch: angles about the axle from straight below, and lines across the tread.
_TREAD_RAD = np.radians(np.linspace(-72.0, 72.0, 25))
_TREAD_LINES = np.array([-0.5, 0.0, 0.5])
#: Steps of the six numbers in which derivatives are taken: metres and radians.
_DIFFERENCE = 1e-6
#: Steps of Newton's method before another is asked, and the gap at which a wheel is on the ground.
_NEWTON_STEPS, _CLOSED_M = 12, 1e-10


@runtime_checkable
class Ground(Protocol):
    """What wheels stand on: `marsyard.sim.terrain.Surface`, or one with rocks
    (`marsyard.sim.dynamics.relief.RockyGround`).
    """

    def height(self, x: Float[np.ndarray, "*batch"], y: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """Height of the ground at world positions, metres."""
        ...


class RoverParameters(Parameters):
    """Shape of a rover. The defaults are a MER's.

    Wheels: 0.25 m across (press kit: 26 cm with cleats; Opportunity's odometer counts 0.8 m a turn), 0.16 m wide; the
    wheel base is 1.41 m and the track 1.06 m, 1.22 m between the middle wheels (Lindemann & Voorhees 2005). Where the
    pivots are is assumed. The body's size is the press kit's (1.6 m long, 2.3 m wide with its solar panels; the mast
    carries the cameras at 1.54 m, Maki et al. 2003).
    """

    wheel_radius_m: Annotated[Metres, Field(description="radius of a wheel, m")] = 0.125
    wheel_width_m: Annotated[Metres, Field(description="width of a wheel's tread, m")] = 0.16
    front_m: Annotated[Metres, Field(description="x of the front wheels, m")] = 0.705
    rear_m: Annotated[Metres, Field(description="how far the rear wheels are behind the middle ones, m")] = 0.705
    half_track_m: Annotated[Metres, Field(description="|y| of the front and rear wheels, m")] = 0.53
    middle_half_track_m: Annotated[Metres, Field(description="|y| of the middle wheels, m")] = 0.61
    rocker_pivot_x_m: Annotated[
        float, Field(ge=-2.0, le=2.0, description="x of the axis about which rockers turn against the body, m")
    ] = 0.08
    rocker_pivot_z_m: Annotated[Metres, Field(description="its height, m")] = 0.40
    bogie_pivot_x_m: Annotated[
        float, Field(ge=-2.0, le=2.0, description="x of the axes about which bogies turn against rockers, m")
    ] = -0.35
    bogie_pivot_z_m: Annotated[Metres, Field(description="their height, m")] = 0.28
    body_length_m: Annotated[Metres, Field(description="length of the body's deck, m")] = 1.6
    body_width_m: Annotated[Metres, Field(description="width of the deck with its panels, m")] = 2.3
    clearance_m: Annotated[Metres, Field(description="height of the body's belly, m")] = 0.29
    deck_m: Annotated[Metres, Field(description="height of the deck, m")] = 0.64

    @model_validator(mode="after")
    def _is_a_rover(self) -> RoverParameters:
        if not -self.rear_m < self.bogie_pivot_x_m < 0.0:
            raise ValueError(
                f"bogie_pivot_x_m is {self.bogie_pivot_x_m:g}; it must lie between the rear wheels ({-self.rear_m:g}) "
                "and the middle ones (0)"
            )
        if not self.bogie_pivot_x_m < self.rocker_pivot_x_m < self.front_m:
            raise ValueError(
                f"rocker_pivot_x_m is {self.rocker_pivot_x_m:g}; it must lie between bogie_pivot_x_m "
                f"({self.bogie_pivot_x_m:g}) and front_m ({self.front_m:g})"
            )
        return self

    @property
    def wheel_places_m(self) -> Float64[np.ndarray, "6 3"]:
        """Centres of the wheels on level ground, rover frame, in the order of `WHEELS`."""
        along = np.tile([self.front_m, 0.0, -self.rear_m], 2)
        across = _SIDE * np.tile([self.half_track_m, self.middle_half_track_m, self.half_track_m], 2)
        return np.stack([along, across, np.full(6, self.wheel_radius_m)], axis=1)

    @property
    def pivots_m(self) -> tuple[Float64[np.ndarray, "2"], Float64[np.ndarray, "2"]]:
        """(x, z) of the rockers' axis and of the bogies' on level ground, rover frame."""
        rocker = np.array([self.rocker_pivot_x_m, self.rocker_pivot_z_m])
        return rocker, np.array([self.bogie_pivot_x_m, self.bogie_pivot_z_m])

    @property
    def reach_m(self) -> float:
        """Radius of the circle about the origin that holds wheels and body, seen from above, metres."""
        wheel = np.hypot(
            max(self.front_m, self.rear_m) + self.wheel_radius_m, self.half_track_m + 0.5 * self.wheel_width_m
        )
        return float(max(wheel, np.hypot(0.5 * self.body_length_m, 0.5 * self.body_width_m)))


#: The Mars Exploration Rover, and its engineering model on Earth.
MER = RoverParameters()
#: The research rover of the tracking paper's section 5: six steered and driven wheels, about as large as a MER without
#: panels (Rocky 8; its exact measures are assumed).
ROCKY_8 = RoverParameters(
    wheel_radius_m=0.10,
    wheel_width_m=0.12,
    front_m=0.60,
    rear_m=0.60,
    half_track_m=0.45,
    middle_half_track_m=0.45,
    rocker_pivot_x_m=0.07,
    rocker_pivot_z_m=0.35,
    bogie_pivot_x_m=-0.30,
    bogie_pivot_z_m=0.24,
    body_length_m=0.9,
    body_width_m=0.7,
    clearance_m=0.28,
    deck_m=0.60,
)


@dataclass(frozen=True)
class Stance:
    """A rover at rest on the ground: truth.

    Attributes
    ----------
    world_from_rover
        Pose of the rover.
    differential_rad
        Angle of the left rocker against the body; the right one's is its opposite. Positive: its front wheel is low.
    bogies_rad
        Angles of the left and the right bogie against their rockers; positive: the middle wheel is low.
    gaps_m
        What is left between each wheel and the ground, in the order of `WHEELS`; not zero where no stance has all six
        on the ground.
    """

    world_from_rover: RigidTransform
    differential_rad: float
    bogies_rad: tuple[float, float]
    gaps_m: Float64[np.ndarray, "6"]

    @property
    def east_m(self) -> float:
        """World x of the rover's origin, metres."""
        return float(self.world_from_rover.translation[0])

    @property
    def north_m(self) -> float:
        """World y of the rover's origin, metres."""
        return float(self.world_from_rover.translation[1])

    @cached_property
    def _yaw_pitch_roll(self) -> tuple[float, float, float]:
        turn = turn_matrix(self.world_from_rover)
        yaw, pitch, roll = (
            np.arctan2(turn[1, 0], turn[0, 0]),
            np.arctan2(-turn[2, 0], np.hypot(turn[2, 1], turn[2, 2])),
            np.arctan2(turn[2, 1], turn[2, 2]),
        )
        return float(yaw), float(pitch), float(roll)

    @property
    def azimuth_rad(self) -> float:
        """Where the rover heads: azimuth of its x axis, clockwise from north, in (-pi, pi]."""
        azimuth = 0.5 * np.pi - self._yaw_pitch_roll[0]
        return float(np.arctan2(np.sin(azimuth), np.cos(azimuth)))

    @property
    def pitch_rad(self) -> float:
        """Elevation of the rover's x axis: positive with the nose up."""
        return -self._yaw_pitch_roll[1]

    @property
    def roll_rad(self) -> float:
        """Turn about the x axis: positive with the left side up."""
        return self._yaw_pitch_roll[2]

    @property
    def tilt_rad(self) -> float:
        """Angle of the rover's z axis from the vertical."""
        return float(np.arccos(np.clip(turn_matrix(self.world_from_rover)[2, 2], -1.0, 1.0)))


def settle(
    rover: RoverParameters,
    ground: Ground,
    east_m: float,
    north_m: float,
    azimuth_rad: float,
    near: Stance | None = None,
) -> Stance:
    """The rover at rest at a place.

    Parameters
    ----------
    rover
        Its shape.
    ground
        What it stands on.
    east_m, north_m
        World place of its origin.
    azimuth_rad
        Where it heads, clockwise from north.
    near
        A stance close by, from which the solution starts; by default from level on the ground's height.
    """
    frame = _Frame(rover, ground, np.array([east_m, north_m]), 0.5 * np.pi - azimuth_rad)
    unknown, gaps = frame.solved(frame.start(near))
    differential, left, right = (float(angle) for angle in unknown[3:])
    pose = rigid(frame.rotation(unknown), np.array([east_m, north_m, unknown[0]]))
    return Stance(pose, differential, (left, right), gaps)


def wheel_centres(
    rover: RoverParameters, differential_rad: float, bogies_rad: tuple[float, float]
) -> Float64[np.ndarray, "6 3"]:
    """Centres of the wheels in the rover frame at these angles of the joints, metres."""
    joints = np.array([differential_rad, *bogies_rad])
    return np.asarray(suspension.wheel_centres(rover.wheel_places_m, *rover.pivots_m, joints))


def bogie_pivots(rover: RoverParameters, differential_rad: float) -> Float64[np.ndarray, "2 3"]:
    """Where the rockers carry the left and the right bogie, rover frame, metres."""
    (x, z), about = rover.pivots_m[1], rover.pivots_m[0]
    half = rover.half_track_m
    left, right = (suspension.turned(x, z, angle, about) for angle in (differential_rad, -differential_rad))
    return np.array([[left[0], half, left[1]], [right[0], -half, right[1]]])


@dataclass(frozen=True)
class _Frame:
    """The equations of a stance: gaps under the wheels as a function of (height, pitch, roll, differential, bogies)."""

    rover: RoverParameters
    ground: Ground
    place_m: Float64[np.ndarray, "2"]
    yaw_rad: float

    def start(self, near: Stance | None) -> Float64[np.ndarray, "6"]:
        if near is None:
            return np.array([float(self.ground.height(*self.place_m[:, None])[0]), 0.0, 0.0, 0.0, 0.0, 0.0])
        height = float(near.world_from_rover.translation[2])
        return np.array([height, near.pitch_rad, near.roll_rad, near.differential_rad, *near.bogies_rad])

    def rotation(self, unknown: Float64[np.ndarray, "6"]) -> Rotation:
        return Rotation.from_euler("ZYX", [self.yaw_rad, -unknown[1], unknown[2]])

    def solved(self, start: Float64[np.ndarray, "6"]) -> tuple[Float64[np.ndarray, "6"], Float64[np.ndarray, "6"]]:
        """What closes the gaps, and what is left of them: by Newton's method, which needs few steps on most ground.

        A wheel's lowest place jumps along its tread; where that leads the method astray, and where no stance has all
        wheels on the ground, Levenberg-Marquardt finds the least gaps.
        """
        unknown = start
        for _ in range(_NEWTON_STEPS):
            gaps, places = self._lowest(unknown)
            if float(np.abs(gaps).max()) < _CLOSED_M:
                return unknown, gaps
            try:
                unknown = unknown - np.linalg.solve(self._slopes(unknown, places), gaps)
            except np.linalg.LinAlgError:
                break
        found = least_squares(self.gaps, start, jac=self.gap_slopes, method="lm", xtol=1e-8, ftol=1e-12)
        return found.x, found.fun

    def gaps(self, unknown: Float64[np.ndarray, "6"]) -> Float64[np.ndarray, "6"]:
        return self._lowest(unknown)[0]

    def gap_slopes(self, unknown: Float64[np.ndarray, "6"]) -> Float64[np.ndarray, "6 6"]:
        return self._slopes(unknown, self._lowest(unknown)[1])

    def _slopes(
        self, unknown: Float64[np.ndarray, "6"], places: Float64[np.ndarray, "6 3"]
    ) -> Float64[np.ndarray, "6 6"]:
        """By differences, how the gaps change with each unknown, given the lowest place of each tread.

        A wheel's gap changes as the height of that place of its tread which is lowest: only there are the differences
        taken.
        """
        beside = _DIFFERENCE * np.eye(6)
        ends = self._heights(np.concatenate([unknown - beside, unknown + beside]), places[:, None])[..., 0]
        return np.asarray(((ends[6:] - ends[:6]) / (2.0 * _DIFFERENCE)).T)

    def _lowest(self, unknown: Float64[np.ndarray, "6"]) -> tuple[Float64[np.ndarray, "6"], Float64[np.ndarray, "6 3"]]:
        """Least height of each tread above the ground, and the place on the tread, from its wheel's middle."""
        heights = self._heights(unknown[None], self.tread[None])[0]
        lowest = heights.argmin(axis=1)
        return heights[np.arange(6), lowest], self.tread[lowest]

    @cached_property
    def shape(self) -> tuple[Float64[np.ndarray, "6 3"], Float64[np.ndarray, "2"], Float64[np.ndarray, "2"]]:
        """Where the wheels are at rest, and the axes that they turn about."""
        return (self.rover.wheel_places_m, *self.rover.pivots_m)

    @cached_property
    def tread(self) -> Float64[np.ndarray, "places 3"]:
        """Places of a wheel's tread that may touch the ground, from its centre."""
        angle, line = np.meshgrid(_TREAD_RAD, _TREAD_LINES)
        radius, width = self.rover.wheel_radius_m, self.rover.wheel_width_m
        return np.stack([radius * np.sin(angle), width * line, -radius * np.cos(angle)], axis=-1).reshape(-1, 3)

    def _heights(
        self, unknown: Float64[np.ndarray, "n 6"], treads: Float64[np.ndarray, "wheels places 3"]
    ) -> Float64[np.ndarray, "n 6 places"]:
        """Heights above the ground of places of the wheels' treads, the same for all wheels or each wheel's own."""
        x, y, z = suspension.tread_places(unknown, self.yaw_rad, self.place_m, *self.shape, treads)
        return np.asarray(z - self.ground.height(x, y))
