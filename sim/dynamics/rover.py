"""Static pose of a six-wheeled rover with a rocker-bogie suspension on ground with rocks.

Each side of the rover has a rocker and a bogie. The front wheel and the pivot of the bogie are mounted on the rocker,
the middle and the rear wheel on the bogie. Rockers and bogies rotate about axes parallel to the body's y axis. A
differential rotates the two rockers against the body by opposite angles: the body's pitch is the mean of their
pitches. One side, with the front to the right::

      bogie pivot ----- rocker pivot (on the body)
       |       |              |
     rear    middle         front

Wheels are unsteered cylinders with axles parallel to the y axis. There are no springs or joint limits.

For a position (east, north) and an azimuth there are six unknowns: height, pitch and roll of the body, and the angles
of the differential and of both bogies. The six equations are that the gap between each wheel and the ground is zero.
They are solved by Newton's method or Levenberg-Marquardt. On a plane all joint angles are zero.

The rover (body) frame has x forward, y to the left and z up. Its origin lies on level ground midway between the two
middle wheels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.dynamics.driven_ground import DrivenGround
from marsyard.sim.frames import rigid, rotation_matrix
from marsyard.sim.parameters import Parameters, bounded_field

Metres = Annotated[float, Field(gt=0.0, le=5.0)]
Vector6 = Float64[np.ndarray, "6"]
WheelPoints = Float64[np.ndarray, "6 3"]
Point = Float64[np.ndarray, "2"]
Coordinates = float | NDArray[np.float64]

#: Names of the wheels, in the order of all arrays.
WHEELS = ("left front", "left middle", "left rear", "right front", "right middle", "right rear")
#: Signs of the wheels' y coordinates, and of their rockers' angles.
_SIDE_SIGNS = np.array([1.0, 1.0, 1.0, -1.0, -1.0, -1.0])
#: Whether a wheel is on a bogie, and the index of its side's bogie among the joints (differential, left, right bogie).
_ON_BOGIE, _BOGIES = np.array([False, True, True] * 2), np.array([1, 1, 1, 2, 2, 2])
#: Sample points of a tread: angles about the axle from straight below, and lateral positions in widths of the tread.
_TREAD_RAD = np.radians(np.linspace(-72.0, 72.0, 25))
_TREAD_OFFSETS = np.array([-0.5, 0.0, 0.5])
#: Step of finite differences, metres or radians.
_DIFFERENCE_STEP = 1e-6
#: Iterations of Newton's method, and the gap below which a wheel touches the ground.
_NEWTON_STEPS, _GAP_TOLERANCE_M = 12, 1e-10


class RoverParameters(Parameters):
    """Dimensions of a rover in the rover frame on level ground; the defaults are those of MER.

    Wheels: 0.25 m in diameter (press kit: 26 cm with cleats; Opportunity's odometer: 0.8 m per revolution), 0.16 m
    wide; wheel base 1.41 m, track 1.06 m, 1.22 m between the middle wheels (Lindemann & Voorhees 2005). Positions of
    the pivots are assumed. Body: 1.6 m long, 2.3 m wide with solar panels (press kit), cameras at 1.54 m (Maki 2003).
    """

    wheel_radius_m: Annotated[Metres, Field(description="radius of a wheel")] = 0.125
    wheel_width_m: Annotated[Metres, Field(description="width of a wheel's tread")] = 0.16
    front_m: Annotated[Metres, Field(description="x of the front wheels")] = 0.705
    rear_m: Annotated[Metres, Field(description="distance of the rear wheels behind the middle wheels")] = 0.705
    half_track_m: Annotated[Metres, Field(description="|y| of the front and rear wheels")] = 0.53
    middle_half_track_m: Annotated[Metres, Field(description="|y| of the middle wheels")] = 0.61
    rocker_pivot_x_m: Annotated[float, bounded_field(-2.0, 2.0, "x of the rockers' axis on the body")] = 0.08
    rocker_pivot_z_m: Annotated[Metres, Field(description="height of the rockers' axis on the body")] = 0.40
    bogie_pivot_x_m: Annotated[float, bounded_field(-2.0, 2.0, "x of the bogies' axes on the rockers")] = -0.35
    bogie_pivot_z_m: Annotated[Metres, Field(description="height of the bogies' axes on the rockers")] = 0.28
    body_length_m: Annotated[Metres, Field(description="length of the body's deck")] = 1.6
    body_width_m: Annotated[Metres, Field(description="width of the deck with its panels")] = 2.3
    clearance_m: Annotated[Metres, Field(description="height of the body's underside")] = 0.29
    deck_m: Annotated[Metres, Field(description="height of the deck")] = 0.64

    @model_validator(mode="after")
    def _check_pivots(self) -> RoverParameters:
        if not -self.rear_m < self.bogie_pivot_x_m < 0.0:
            raise ValueError(
                f"bogie_pivot_x_m is {self.bogie_pivot_x_m:g}; it must lie between the rear wheels ({-self.rear_m:g}) "
                "and the middle wheels (0)"
            )
        if not self.bogie_pivot_x_m < self.rocker_pivot_x_m < self.front_m:
            raise ValueError(
                f"rocker_pivot_x_m is {self.rocker_pivot_x_m:g}; it must lie between bogie_pivot_x_m "
                f"({self.bogie_pivot_x_m:g}) and front_m ({self.front_m:g})"
            )
        return self

    @property
    def wheel_centres_m(self) -> WheelPoints:
        """Centres of the wheels on level ground, rover frame, in the order of `WHEELS`."""
        x = np.tile([self.front_m, 0.0, -self.rear_m], 2)
        y = _SIDE_SIGNS * np.tile([self.half_track_m, self.middle_half_track_m, self.half_track_m], 2)
        return np.stack([x, y, np.full(6, self.wheel_radius_m)], axis=1)

    @property
    def pivots_m(self) -> tuple[Point, Point]:
        """(x, z) of the rockers' axis and of the bogies' on level ground, rover frame."""
        rocker = np.array([self.rocker_pivot_x_m, self.rocker_pivot_z_m])
        return rocker, np.array([self.bogie_pivot_x_m, self.bogie_pivot_z_m])

    @property
    def enclosing_radius_m(self) -> float:
        """Radius of the circle about the origin that encloses wheels and body in the top view."""
        wheel = np.hypot(
            max(self.front_m, self.rear_m) + self.wheel_radius_m, self.half_track_m + 0.5 * self.wheel_width_m
        )
        return float(max(wheel, np.hypot(0.5 * self.body_length_m, 0.5 * self.body_width_m)))


#: A Mars Exploration Rover (Spirit, Opportunity), and its engineering model on Earth.
MER = RoverParameters()
#: Rocky 8, the research rover of the tracking paper's section 5: six steered and driven wheels, about the size of a MER
#: without panels. Its exact dimensions are assumed.
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
    """True pose and joint angles of a rover at rest on the ground.

    - world_from_rover: pose of the rover frame in the world
    - differential_rad: angle of the left rocker against the body; positive: the left front wheel is lowered. The right
      rocker has the opposite angle
    - bogies_rad: angles of the left and the right bogie against their rockers; positive: the middle wheel is lowered
    - gaps_m: height of each wheel's lowest point above the ground, in the order of `WHEELS`; zero (to rounding) if a
      pose with all six wheels on the ground was found, otherwise with minimal sum of squares
    """

    world_from_rover: RigidTransform
    differential_rad: float
    bogies_rad: tuple[float, float]
    gaps_m: Vector6

    @cached_property
    def _yaw_pitch_roll(self) -> tuple[float, float, float]:
        axes = rotation_matrix(self.world_from_rover)
        pitch = np.arctan2(-axes[2, 0], np.hypot(axes[2, 1], axes[2, 2]))
        return (float(np.arctan2(axes[1, 0], axes[0, 0])), float(pitch), float(np.arctan2(axes[2, 1], axes[2, 2])))

    @property
    def azimuth_rad(self) -> float:
        """Heading: azimuth of the x axis, clockwise from north, in (-pi, pi]."""
        azimuth = 0.5 * np.pi - self._yaw_pitch_roll[0]
        return float(np.arctan2(np.sin(azimuth), np.cos(azimuth)))

    @property
    def pitch_rad(self) -> float:
        """Elevation of the rover's x axis: positive with the nose up."""
        return -self._yaw_pitch_roll[1]

    @property
    def roll_rad(self) -> float:
        """Rotation about the x axis: positive with the left side up."""
        return self._yaw_pitch_roll[2]

    @property
    def tilt_rad(self) -> float:
        """Angle of the rover's z axis from the vertical."""
        return float(np.arccos(np.clip(rotation_matrix(self.world_from_rover)[2, 2], -1.0, 1.0)))


def settle(
    rover: RoverParameters,
    ground: DrivenGround,
    east_m: float,
    north_m: float,
    azimuth_rad: float,
    initial: Stance | None = None,
) -> Stance:
    """Compute the rover's pose and joint angles at rest at a position (east, north).

    The azimuth is clockwise from north. The iteration starts at the stance `initial`, or at a level pose without it.
    """
    equations = _StanceEquations(rover, ground, np.array([east_m, north_m]), 0.5 * np.pi - azimuth_rad)
    if initial is None:
        start = np.array([float(ground.height(*equations.position_m[:, None])[0]), 0.0, 0.0, 0.0, 0.0, 0.0])
    else:
        height = float(initial.world_from_rover.translation[2])
        start = np.array([height, initial.pitch_rad, initial.roll_rad, initial.differential_rad, *initial.bogies_rad])
    unknowns, gaps = equations.solve(start)
    height, pitch, roll, differential, left, right = unknowns.tolist()
    rotation = Rotation.from_euler("ZYX", [equations.yaw_rad, -pitch, roll])
    return Stance(rigid(rotation, np.array([east_m, north_m, height])), differential, (left, right), gaps)


def compute_wheel_centres(
    rover: RoverParameters, differential_rad: float, bogies_rad: tuple[float, float]
) -> WheelPoints:
    """Compute the centres of the wheels in the rover frame from the joint angles, metres."""
    joints = np.array([[differential_rad, *bogies_rad]])
    return np.asarray(_rotate_wheels(rover.wheel_centres_m, rover.pivots_m, joints)[0])


def compute_bogie_pivots(rover: RoverParameters, differential_rad: float) -> Float64[np.ndarray, "2 3"]:
    """Compute the positions of the left and the right bogie's pivot, rover frame, metres."""
    rocker_pivot, (x, z) = rover.pivots_m
    x, z = _rotate_about_pivot(x, z, np.array([differential_rad, -differential_rad]), rocker_pivot)
    return np.stack([x, np.array([rover.half_track_m, -rover.half_track_m]), z], axis=1)


def _rotate_wheels(
    level_centres: WheelPoints, pivots: tuple[Point, Point], joints: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "n 6 3"]:
    """Rotate the wheels' centres by n sets of angles of the differential, the left and the right bogie."""
    x, y, z = level_centres.T
    bogie_x, bogie_z = _rotate_about_pivot(x, z, joints[:, _BOGIES], pivots[1])
    x, z = np.where(_ON_BOGIE, bogie_x, x), np.where(_ON_BOGIE, bogie_z, z)
    x, z = _rotate_about_pivot(x, z, _SIDE_SIGNS * joints[:, :1], pivots[0])
    return np.stack([x, np.broadcast_to(y, x.shape), z], axis=-1)


def _rotate_about_pivot(
    x: Coordinates, z: Coordinates, angles: NDArray[np.float64], pivot: Point
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotate points (x, z) about a pivot (x, z); a positive angle lowers points in front of the pivot."""
    sine, cosine = np.sin(angles), np.cos(angles)
    x, z = x - pivot[0], z - pivot[1]
    return pivot[0] + cosine * x + sine * z, pivot[1] + cosine * z - sine * x


@dataclass(frozen=True)
class _StanceEquations:
    """Gaps under the wheels as a function of the unknowns.

    They are height, pitch (positive: nose up) and roll of the body, and the angles of the differential, the left and
    the right bogie.
    """

    rover: RoverParameters
    ground: DrivenGround
    position_m: Float64[np.ndarray, "2"]
    yaw_rad: float

    def solve(self, start: Vector6) -> tuple[Vector6, Vector6]:
        """Solve for the unknowns with gaps of zero; return the unknowns and the remaining gaps.

        Newton's method needs few iterations on most ground. It can diverge where a wheel's lowest point jumps along the
        tread, or where no stance has all wheels on the ground. Then Levenberg-Marquardt minimizes the squared gaps.
        """
        unknowns = start
        for _ in range(_NEWTON_STEPS):
            gaps, points = self._find_lowest_points(unknowns)
            if float(np.abs(gaps).max()) < _GAP_TOLERANCE_M:
                return unknowns, gaps
            try:
                unknowns = unknowns - np.linalg.solve(self._compute_jacobian(unknowns, points), gaps)
            except np.linalg.LinAlgError:
                break

        def compute_gaps(x: Vector6) -> Vector6:
            return self._find_lowest_points(x)[0]

        def compute_jacobian(x: Vector6) -> Float64[np.ndarray, "6 6"]:
            return self._compute_jacobian(x, self._find_lowest_points(x)[1])

        solution = least_squares(compute_gaps, start, jac=compute_jacobian, method="lm", xtol=1e-8, ftol=1e-12)
        return solution.x, solution.fun

    def _compute_jacobian(self, unknowns: Vector6, points: WheelPoints) -> Float64[np.ndarray, "6 6"]:
        """Compute the derivatives of the gaps by finite differences, at the lowest point of each tread only."""
        step = _DIFFERENCE_STEP * np.eye(6)
        heights = self._compute_heights(np.concatenate([unknowns - step, unknowns + step]), points[:, None])[..., 0]
        before, after = np.split(heights, 2)
        return np.asarray(((after - before) / (2.0 * _DIFFERENCE_STEP)).T)

    def _find_lowest_points(self, unknowns: Vector6) -> tuple[Vector6, WheelPoints]:
        """Find each tread's smallest height above the ground, and the point there, relative to the wheel's centre."""
        heights = self._compute_heights(unknowns[None], self._tread[None])[0]
        lowest = heights.argmin(axis=1)
        return heights[np.arange(6), lowest], self._tread[lowest]

    @cached_property
    def _geometry(self) -> tuple[WheelPoints, tuple[Point, Point]]:
        return self.rover.wheel_centres_m, self.rover.pivots_m

    @cached_property
    def _tread(self) -> Float64[np.ndarray, "points 3"]:
        angle, line = np.meshgrid(_TREAD_RAD, _TREAD_OFFSETS)
        radius, width = self.rover.wheel_radius_m, self.rover.wheel_width_m
        return np.stack([radius * np.sin(angle), width * line, -radius * np.cos(angle)], axis=-1).reshape(-1, 3)

    def _compute_heights(
        self, unknowns: Float64[np.ndarray, "n 6"], treads: Float64[np.ndarray, "wheels points 3"]
    ) -> Float64[np.ndarray, "n 6 points"]:
        """Compute the heights of tread points above the ground, for n sets of unknowns.

        `treads` are points relative to the wheels' centres, for each wheel or once if common to all wheels.
        """
        body_height, angles, joints = np.split(unknowns, [1, 3], axis=1)
        a, b, c = np.moveaxis(_rotate_wheels(*self._geometry, joints)[:, :, None] + treads, -1, 0)
        # rotation by roll about x, then by -pitch about y, then by yaw about z
        (sp, sr), (cp, cr) = (function(angles.T[:, :, None, None]) for function in (np.sin, np.cos))
        sy, cy = np.sin(self.yaw_rad), np.cos(self.yaw_rad)
        up = sr * b + cr * c
        forward, left = cp * a - sp * up, cr * b - sr * c
        x = self.position_m[0] + cy * forward - sy * left
        y = self.position_m[1] + sy * forward + cy * left
        return np.asarray(body_height[:, :, None] + cp * up + sp * a - self.ground.height(x, y))
