"""Six-wheeled rover on a rocker-bogie suspension, at rest on ground with rocks.

Each side has a rocker, which carries the front wheel and the bogie's pivot, and a bogie, which carries the middle and
the rear wheel. Rockers and bogies rotate about axes parallel to the body's y axis. A differential rotates the two
rockers against the body by opposite angles: the body's pitch is the mean of the rockers'. Wheels are unsteered
cylinders whose axles are parallel to the body's y axis. There are no springs, and the joints have no stops.

At a position (east, north) and an azimuth six unknowns remain: height, pitch and roll of the body, the angles of the
differential and of both bogies. All six wheels touch the ground and none penetrates it: six equations, solved by
Newton's method or Levenberg-Marquardt. On a plane the joint angles are zero and the body is parallel to the plane.

The rover (body) frame has x forward, y to the left and z up. Its origin is the point of level ground between the two
middle wheels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float64
from pydantic import Field, model_validator
from scipy.ndimage import map_coordinates
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.dynamics.kernels import suspension
from marsyard.sim.frames import rigid, rotation_matrix
from marsyard.sim.parameters import Parameters, bounded_field

Metres = Annotated[float, Field(gt=0.0, le=5.0)]
Six = Float64[np.ndarray, "6"]
WheelPoints = Float64[np.ndarray, "6 3"]

#: Names of the wheels in the order of all arrays: two columns, left and right, of three.
WHEELS = ("left front", "left middle", "left rear", "right front", "right middle", "right rear")
#: Signs of the sides along y and in the differential.
_SIDE = np.array([1.0, 1.0, 1.0, -1.0, -1.0, -1.0])
#: Sample points of a tread: angles about the axle from straight below, and lines across the tread.
_TREAD_RAD = np.radians(np.linspace(-72.0, 72.0, 25))
_TREAD_LINES = np.array([-0.5, 0.0, 0.5])
#: Steps of finite differences, metres and radians.
_DIFFERENCE = 1e-6
#: Iterations of Newton's method, and the gap at which a wheel touches the ground.
_NEWTON_STEPS, _CLOSED_M = 12, 1e-10

#: Side of the grid's cells, metres: a tenth of a wheel's radius.
CELL_M = 0.0125
#: Largest distance between sample points on a triangle, in cells.
_SAMPLE_SPACING = 0.7


@runtime_checkable
class Ground(Protocol):
    """Ground under the wheels: `marsyard.sim.terrain.Surface`, or `RockyGround`."""

    def height(self, x: Float[np.ndarray, "*batch"], y: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """Height of the ground at world positions, metres."""


@dataclass(frozen=True)
class RockyGround:
    """Ground with bodies on it within a square; the ground alone outside.

    Heights are interpolated bilinearly between cell centres. A cell is as high as the highest body point in it, so
    that steep sides extend up to one cell outwards. Overhangs are filled.

    - corner_m: world x, y of the centre of cell (0, 0)
    - above_m: height of each cell above the ground, 0 without a body; row i lies at y = corner + i cells
    """

    ground: Ground
    corner_m: tuple[float, float]
    above_m: Float64[np.ndarray, "rows columns"]

    @classmethod
    def of(
        cls,
        ground: Ground,
        triangles: Float64[np.ndarray, "triangles 3 3"],
        centre_m: tuple[float, float],
        half_m: float,
    ) -> RockyGround:
        """Rasterize bodies (triangles in world axes, metres) within `half_m` of a centre along x and y.

        A `marsyard.sim.terrain.RockMesh` gives the triangles of a rock field as ``mesh.vertices[mesh.faces]``.
        """
        cells = 2 * int(np.ceil(half_m / CELL_M)) + 1
        corner = np.array(centre_m) - 0.5 * (cells - 1) * CELL_M
        # sample points on the triangles, at most `_SAMPLE_SPACING` cells apart
        edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
        steps = np.ceil(edges / (_SAMPLE_SPACING * CELL_M)).astype(np.int64)
        samples = [np.empty((0, 3))]
        for count in np.unique(steps):
            i, j = np.meshgrid(np.arange(count + 1), np.arange(count + 1))
            first, second = i[i + j <= count] / count, j[i + j <= count] / count
            weights = np.stack([1.0 - first - second, first, second], axis=1)
            samples.append(np.einsum("pk,tki->tpi", weights, triangles[steps == count]).reshape(-1, 3))
        points = np.concatenate(samples)
        cell = np.rint((points[:, :2] - corner) / CELL_M).astype(np.int64)
        inside = np.all((cell >= 0) & (cell < cells), axis=1)
        column, row = cell[inside].T
        top = np.full((cells, cells), -np.inf)
        np.maximum.at(top, (row, column), points[inside, 2])
        y, x = np.nonzero(np.isfinite(top))
        above = np.zeros((cells, cells))
        below = ground.height(corner[0] + CELL_M * x, corner[1] + CELL_M * y)
        above[y, x] = np.maximum(top[y, x] - below, 0.0)
        above.setflags(write=False)
        return cls(ground, (float(corner[0]), float(corner[1])), above)

    def height(self, x: Float[np.ndarray, "*batch"], y: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """Height of ground or rocks at world positions, metres."""
        cells = [(y - self.corner_m[1]) / CELL_M, (x - self.corner_m[0]) / CELL_M]
        above = map_coordinates(self.above_m, cells, order=1, mode="constant", prefilter=False)
        return np.asarray(self.ground.height(x, y) + above)


class RoverParameters(Parameters):
    """Dimensions of a rover; the defaults are MER's.

    Wheels: 0.25 m in diameter (press kit: 26 cm with cleats; Opportunity's odometer counts 0.8 m a turn), 0.16 m wide;
    wheel base 1.41 m, track 1.06 m, 1.22 m between the middle wheels (Lindemann & Voorhees 2005). Positions of the
    pivots are assumed. Body: press kit (1.6 m long, 2.3 m wide with solar panels; cameras at 1.54 m, Maki et al. 2003).
    """

    wheel_radius_m: Annotated[Metres, Field(description="radius of a wheel")] = 0.125
    wheel_width_m: Annotated[Metres, Field(description="width of a wheel's tread")] = 0.16
    front_m: Annotated[Metres, Field(description="x of the front wheels")] = 0.705
    rear_m: Annotated[Metres, Field(description="distance of the rear wheels behind the middle wheels")] = 0.705
    half_track_m: Annotated[Metres, Field(description="|y| of the front and rear wheels")] = 0.53
    middle_half_track_m: Annotated[Metres, Field(description="|y| of the middle wheels")] = 0.61
    rocker_pivot_x_m: Annotated[float, bounded_field(-2.0, 2.0, "x of the axis of rockers against the body")] = 0.08
    rocker_pivot_z_m: Annotated[Metres, Field(description="its height")] = 0.40
    bogie_pivot_x_m: Annotated[float, bounded_field(-2.0, 2.0, "x of the axes of bogies against rockers")] = -0.35
    bogie_pivot_z_m: Annotated[Metres, Field(description="their height")] = 0.28
    body_length_m: Annotated[Metres, Field(description="length of the body's deck")] = 1.6
    body_width_m: Annotated[Metres, Field(description="width of the deck with its panels")] = 2.3
    clearance_m: Annotated[Metres, Field(description="height of the body's belly")] = 0.29
    deck_m: Annotated[Metres, Field(description="height of the deck")] = 0.64

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
    def wheel_centres_m(self) -> WheelPoints:
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
        """Radius of the circle about the origin that encloses wheels and body, seen from above."""
        wheel = np.hypot(
            max(self.front_m, self.rear_m) + self.wheel_radius_m, self.half_track_m + 0.5 * self.wheel_width_m
        )
        return float(max(wheel, np.hypot(0.5 * self.body_length_m, 0.5 * self.body_width_m)))


#: The Mars Exploration Rover, and its engineering model on Earth.
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

    - differential_rad: angle of the left rocker against the body, the negative of the right one's; positive: its front
      wheel is lowered
    - bogies_rad: angles of the left and the right bogie against their rockers; positive: the middle wheel is lowered
    - gaps_m: height of each wheel above the ground in the order of `WHEELS`; not zero where no pose has all six on it
    """

    world_from_rover: RigidTransform
    differential_rad: float
    bogies_rad: tuple[float, float]
    gaps_m: Six

    @cached_property
    def _yaw_pitch_roll(self) -> tuple[float, float, float]:
        m = rotation_matrix(self.world_from_rover)
        pitch = np.arctan2(-m[2, 0], np.hypot(m[2, 1], m[2, 2]))
        return float(np.arctan2(m[1, 0], m[0, 0])), float(pitch), float(np.arctan2(m[2, 1], m[2, 2]))

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
    ground: Ground,
    east_m: float,
    north_m: float,
    azimuth_rad: float,
    near: Stance | None = None,
) -> Stance:
    """Solve for the rover's pose and joint angles at rest at a position.

    The azimuth is clockwise from north. The solution starts from the stance `near`, or from level on the ground.
    """
    equations = _StanceEquations(rover, ground, np.array([east_m, north_m]), 0.5 * np.pi - azimuth_rad)
    if near is None:
        start = np.array([float(ground.height(*equations.position_m[:, None])[0]), 0.0, 0.0, 0.0, 0.0, 0.0])
    else:
        height = float(near.world_from_rover.translation[2])
        start = np.array([height, near.pitch_rad, near.roll_rad, near.differential_rad, *near.bogies_rad])
    unknowns, gaps = equations.solve(start)
    differential, left, right = (float(angle) for angle in unknowns[3:])
    rotation = Rotation.from_euler("ZYX", [equations.yaw_rad, -unknowns[1], unknowns[2]])
    return Stance(rigid(rotation, np.array([east_m, north_m, unknowns[0]])), differential, (left, right), gaps)


def wheel_centres(rover: RoverParameters, differential_rad: float, bogies_rad: tuple[float, float]) -> WheelPoints:
    """Centres of the wheels in the rover frame at the given joint angles, metres."""
    joints = np.array([differential_rad, *bogies_rad])
    return np.asarray(suspension.wheel_centres(rover.wheel_centres_m, *rover.pivots_m, joints))


def bogie_pivots(rover: RoverParameters, differential_rad: float) -> Float64[np.ndarray, "2 3"]:
    """Positions of the left and the right bogie's pivot, rover frame, metres."""
    (x, z), about = rover.pivots_m[1], rover.pivots_m[0]
    half = rover.half_track_m
    left, right = (suspension.rotate(x, z, angle, about) for angle in (differential_rad, -differential_rad))
    return np.array([[left[0], half, left[1]], [right[0], -half, right[1]]])


@dataclass(frozen=True)
class _StanceEquations:
    """Gaps under the wheels as a function of (height, pitch, roll, differential, left bogie, right bogie)."""

    rover: RoverParameters
    ground: Ground
    position_m: Float64[np.ndarray, "2"]
    yaw_rad: float

    def solve(self, start: Six) -> tuple[Six, Six]:
        """Unknowns that close the gaps, and the remaining gaps, by Newton's method: few iterations on most ground.

        A wheel's lowest point jumps along its tread. If Newton's method then diverges, or no stance has all wheels on
        the ground, Levenberg-Marquardt minimizes the gaps.
        """
        unknowns = start
        for _ in range(_NEWTON_STEPS):
            gaps, points = self._lowest_points(unknowns)
            if float(np.abs(gaps).max()) < _CLOSED_M:
                return unknowns, gaps
            try:
                unknowns = unknowns - np.linalg.solve(self._jacobian(unknowns, points), gaps)
            except np.linalg.LinAlgError:
                break

        def gaps_of(x: Six) -> Six:
            return self._lowest_points(x)[0]

        def jacobian(x: Six) -> Float64[np.ndarray, "6 6"]:
            return self._jacobian(x, self._lowest_points(x)[1])

        solution = least_squares(gaps_of, start, jac=jacobian, method="lm", xtol=1e-8, ftol=1e-12)
        return solution.x, solution.fun

    def _jacobian(self, unknowns: Six, points: WheelPoints) -> Float64[np.ndarray, "6 6"]:
        """Derivatives of the gaps by finite differences, at the lowest point of each tread alone."""
        step = _DIFFERENCE * np.eye(6)
        heights = self._heights(np.concatenate([unknowns - step, unknowns + step]), points[:, None])[..., 0]
        return np.asarray(((heights[6:] - heights[:6]) / (2.0 * _DIFFERENCE)).T)

    def _lowest_points(self, unknowns: Six) -> tuple[Six, WheelPoints]:
        """Smallest height of each tread above the ground, and its point on the tread, from the wheel's centre."""
        heights = self._heights(unknowns[None], self._tread[None])[0]
        lowest = heights.argmin(axis=1)
        return heights[np.arange(6), lowest], self._tread[lowest]

    @cached_property
    def _shape(self) -> tuple[WheelPoints, Float64[np.ndarray, "2"], Float64[np.ndarray, "2"]]:
        return (self.rover.wheel_centres_m, *self.rover.pivots_m)

    @cached_property
    def _tread(self) -> Float64[np.ndarray, "points 3"]:
        angle, line = np.meshgrid(_TREAD_RAD, _TREAD_LINES)
        radius, width = self.rover.wheel_radius_m, self.rover.wheel_width_m
        return np.stack([radius * np.sin(angle), width * line, -radius * np.cos(angle)], axis=-1).reshape(-1, 3)

    def _heights(
        self, unknowns: Float64[np.ndarray, "n 6"], treads: Float64[np.ndarray, "wheels points 3"]
    ) -> Float64[np.ndarray, "n 6 points"]:
        """Heights of tread points above the ground; the points are common to all wheels, or each wheel's own."""
        x, y, z = suspension.tread_points(unknowns, self.yaw_rad, self.position_m, *self._shape, treads)
        return np.asarray(z - self.ground.height(x, y))
