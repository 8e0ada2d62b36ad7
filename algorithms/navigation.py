"""Local path planner in the manner of Autonav: arcs to a goal around obstacles, over mapped ground.

This is flight software: it sees estimated poses and sensed rocks, never the truth. It is not under test but closes the
loop of the tracking paper's sections 6 and 7 (GESTALT: Maimone, Leger & Biesiadecki 2007), with these properties:

- It drives only where wedges of stereo images have mapped the ground. A single navcam wedge, 45 deg wide, is too narrow
  to pass a near obstacle; two wedges are enough (section 6). The ground right in front of the cameras is not imaged:
  the first metres after the start of a map are driven without it (section 7.3).
- Rocks that wheels can climb are no obstacles. A large rock that carries the target is excluded by name (section 6).

Each step searches all paths again: an optional turn in place, an arc, and the arc from its end to the goal. The
cheapest path that is clear and mapped up to the lookahead distance is followed for one step. The swept area is that of
a disc: the footprint of a rover of any heading.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import Enum

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import RigidTransform

from marsyard.sim.measurements import DriveCommand

#: Points of a footprint of unit radius at which the map is sampled: centre and rim.
_FOOTPRINT_POINTS = np.concatenate(
    [np.zeros((1, 2)), [(np.cos(a), np.sin(a)) for a in np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)]]
)
#: Distance below which the goal counts as reached, metres.
AT_GOAL_M = 0.02
#: Largest angle between the heading at the start of the last arc and the goal: a wider arc turns back.
_MAX_ARC_HEADING_RAD = np.radians(75.0)
#: Initial turns in place, in addition to the turn towards the goal.
_TURNS_DEG = (0.0, 20.0, -20.0, 40.0, -40.0, 60.0, -60.0, 80.0, -80.0, 100.0, -100.0)


@dataclass(frozen=True)
class Wedge:
    """Ground mapped by one stereo pair, in the estimated world frame.

    - apex_m: Position of the cameras, east and north
    - azimuth_rad: Centre direction, clockwise from north
    - nearest_m, farthest_m: Limits of the stereo range
    """

    apex_m: Float[np.ndarray, "2"]
    azimuth_rad: float
    half_width_rad: float
    nearest_m: float
    farthest_m: float

    def covers(self, positions_m: Float[np.ndarray, "*batch 2"]) -> Bool[np.ndarray, "*batch"]:
        """Whether positions (east, north) are mapped."""
        offset = positions_m - self.apex_m
        distance = np.hypot(offset[..., 0], offset[..., 1])
        angle = np.arctan2(offset[..., 0], offset[..., 1]) - self.azimuth_rad
        angle = np.abs((angle + np.pi) % (2.0 * np.pi) - np.pi)
        return np.asarray((angle <= self.half_width_rad) & (distance >= self.nearest_m) & (distance <= self.farthest_m))


@dataclass(frozen=True)
class Obstacle:
    """A sensed rock: identifying name, centre (east, north) in the estimated world frame, and extent."""

    name: str
    place_m: Float[np.ndarray, "2"]
    radius_m: float
    height_m: float


@dataclass(frozen=True)
class TerrainMap:
    """Mapped wedges, and the rocks sensed in them."""

    wedges: tuple[Wedge, ...] = ()
    obstacles: tuple[Obstacle, ...] = ()

    def add_wedge(self, wedge: Wedge, rocks: Iterable[Obstacle]) -> TerrainMap:
        """The map with a wedge added, and with every rock of which the wedge covers a part; occlusion is neglected.

        The latest sighting of a rock replaces earlier ones.
        """
        rims = ((rock, rock.place_m + rock.radius_m * _FOOTPRINT_POINTS) for rock in rocks)
        newly_seen = {rock.name: rock for rock, rim in rims if wedge.covers(rim).any()}
        kept = tuple(rock for rock in self.obstacles if rock.name not in newly_seen)
        return TerrainMap((*self.wedges, wedge), kept + tuple(newly_seen.values()))

    def contains(self, positions_m: Float[np.ndarray, "*batch 2"]) -> Bool[np.ndarray, "*batch"]:
        """Whether positions (east, north) lie in any wedge."""
        covered = np.zeros(positions_m.shape[:-1], dtype=np.bool_)
        for wedge in self.wedges:
            covered |= wedge.covers(positions_m)
        return covered


@dataclass(frozen=True)
class NavigationOptions:
    """Parameters of the planner; all but those of the wheels are assumed.

    - half_width_m: Radius of the swept disc: a MER's outer wheels reach 0.69 m to the side
    - margin_m: Clearance between disc and obstacle
    - climb_m: Height of the highest rock that wheels climb (MER: about a wheel's radius)
    - lookahead_m: Length of the path that must be mapped and clear
    - curvature_m: Largest curvature, 1/m
    - turn_cost_m: Cost of a radian of turning in place, in metres of path
    - bend_cost_m2: Cost of the integral of the squared curvature, in metres of path
    """

    half_width_m: float = 0.75
    margin_m: float = 0.1
    climb_m: float = 0.13
    lookahead_m: float = 4.0
    curvature_m: float = 0.6
    turn_cost_m: float = 0.5
    bend_cost_m2: float = 1.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name in ("half_width_m", "lookahead_m", "curvature_m") and not 0.0 < value < np.inf:
                raise ValueError(f"{name} is {value}; it must be positive")
            if not 0.0 <= value < np.inf:
                raise ValueError(f"{name} is {value}; it must not be negative")


class NavigationOutcome(Enum):
    """How a search ended. Every member but PATH and AT_GOAL is an expected failure: nothing is driven."""

    PATH = "a path was found"
    AT_GOAL = "the goal is reached"
    NOT_MAPPED = "the ground under the rover is not mapped"
    NO_PATH = "no path to the goal is both mapped and clear"


@dataclass(frozen=True)
class NavigationPlan:
    """The next step to drive.

    - commands: One step along the path, in order; empty unless the outcome is PATH
    - path_m: The whole path (east, north) in the estimated world frame; empty without one
    """

    outcome: NavigationOutcome
    commands: tuple[DriveCommand, ...]
    path_m: Float[np.ndarray, "n 2"]


def navigate(
    terrain: TerrainMap,
    world_from_rover: RigidTransform,
    goal_m: Float[np.ndarray, "2"],
    step_m: float,
    options: NavigationOptions,
    target: str | None = None,
    backwards: bool = False,
) -> NavigationPlan:
    """Plan the next step to a goal.

    - goal_m: Position (east, north) for the rover's origin, in the estimated world frame
    - step_m: Longest path to drive in this step
    - target: Name of a rock that is not avoided; None avoids all
    - backwards: Whether to drive with the rear ahead
    """
    forward = world_from_rover.rotation.as_matrix()[:2, 0] * (-1.0 if backwards else 1.0)
    position, heading = world_from_rover.translation[:2], _rotation_matrix(np.arctan2(forward[1], forward[0]))
    goal = np.asarray((goal_m - position) @ heading)
    none = np.empty((0, 2))
    if float(np.hypot(*goal)) < AT_GOAL_M:
        return NavigationPlan(NavigationOutcome.AT_GOAL, (), none)
    if not bool(terrain.contains(position + options.half_width_m * _FOOTPRINT_POINTS).all()):
        return NavigationPlan(NavigationOutcome.NOT_MAPPED, (), none)
    avoided = [rock for rock in terrain.obstacles if rock.name != target and rock.height_m > options.climb_m]
    for path in _candidates(goal, options):
        lookahead = position + path.points(np.arange(0.0, min(path.length_m, options.lookahead_m), 0.1)) @ heading.T
        disc = lookahead[:, None] + options.half_width_m * _FOOTPRINT_POINTS
        if _is_clear(lookahead, avoided, options) and bool(terrain.contains(disc).all()):
            footprint = np.asarray(position + path.points(np.linspace(0.0, path.length_m, 60)) @ heading.T)
            return NavigationPlan(NavigationOutcome.PATH, path.commands(step_m, backwards), footprint)
    return NavigationPlan(NavigationOutcome.NO_PATH, (), none)


@dataclass(frozen=True)
class _Path:
    """A turn in place, then two arcs, each of a curvature (to the left) and a length."""

    turn_rad: float
    curvatures_m: tuple[float, float]
    lengths_m: tuple[float, float]

    @property
    def length_m(self) -> float:
        return self.lengths_m[0] + self.lengths_m[1]

    def points(self, along_m: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 2"]:
        """Positions at distances along the path, in the axes of the rover before the turn."""
        first = np.minimum(along_m, self.lengths_m[0])
        bend = _arc(self.curvatures_m[0], np.array([self.lengths_m[0]]))[0]
        heading = self.curvatures_m[0] * self.lengths_m[0]
        beyond = bend + _arc(self.curvatures_m[1], along_m - first) @ _rotation_matrix(heading).T
        points = np.where((along_m > self.lengths_m[0])[:, None], beyond, _arc(self.curvatures_m[0], first))
        return np.asarray(points @ _rotation_matrix(self.turn_rad).T)

    def commands(self, step_m: float, backwards: bool) -> tuple[DriveCommand, ...]:
        """The turn, and the first `step_m` metres of the arcs."""
        commands = [DriveCommand(turn_left_rad=self.turn_rad)] if self.turn_rad else []
        remaining_m = step_m
        for curvature, length in zip(self.curvatures_m, self.lengths_m, strict=True):
            driven = min(length, remaining_m)
            remaining_m -= driven
            if driven > 0.0:
                commands.append(DriveCommand(-driven if backwards else driven, 0.0, curvature * driven))
        return tuple(commands)


def _arc(curvature_m: float, along_m: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 2"]:
    """Positions along an arc that starts at the origin along x."""
    half = 0.5 * curvature_m * along_m
    chord = along_m * np.sinc(half / np.pi)
    return np.stack([chord * np.cos(half), chord * np.sin(half)], axis=-1)


def _rotation_matrix(angle_rad: float) -> Float[np.ndarray, "2 2"]:
    sine, cosine = np.sin(angle_rad), np.cos(angle_rad)
    return np.array([[cosine, -sine], [sine, cosine]])


def _candidates(goal: Float[np.ndarray, "2"], options: NavigationOptions) -> Iterator[_Path]:
    """Paths to the goal by increasing cost: an optional turn, an optional arc, and the arc to the goal."""
    straight = float(np.arctan2(goal[1], goal[0]))
    turns = np.concatenate([np.radians(_TURNS_DEG), [straight]])
    curvatures = options.curvature_m * np.linspace(-1.0, 1.0, 9)
    lengths = 0.75 * float(np.hypot(*goal)) * np.linspace(0.0, 1.0, 9)
    turn, first, length = (grid.ravel() for grid in np.meshgrid(turns, curvatures, lengths, indexing="ij"))
    # the end of the first arc, and the goal seen from there
    half = 0.5 * first * length
    chord = length * np.sinc(half / np.pi)
    heading = turn + 2.0 * half
    east, north = goal[0] - chord * np.cos(turn + half), goal[1] - chord * np.sin(turn + half)
    left, angle = np.hypot(east, north), np.arctan2(north, east) - heading
    angle = (angle + np.pi) % (2.0 * np.pi) - np.pi
    second = 2.0 * np.sin(angle) / np.maximum(left, AT_GOAL_M)
    rest = left / np.sinc(angle / np.pi)
    fits = (left >= AT_GOAL_M) & (np.abs(angle) <= _MAX_ARC_HEADING_RAD) & (np.abs(second) <= options.curvature_m)
    bent = first**2 * length + second**2 * rest
    cost = np.where(fits, length + rest + options.turn_cost_m * np.abs(turn) + options.bend_cost_m2 * bent, np.inf)
    for best in np.argsort(cost, kind="stable")[: np.count_nonzero(fits)]:
        arcs = (float(first[best]), float(second[best])), (float(length[best]), float(rest[best]))
        yield _Path(float(turn[best]), *arcs)


def _is_clear(positions_m: Float[np.ndarray, "n 2"], rocks: Iterable[Obstacle], options: NavigationOptions) -> bool:
    """Whether the disc avoids all rocks, except a rock that it already overlaps and moves away from."""
    for rock in rocks:
        distances = np.hypot(*(positions_m - rock.place_m).T)
        clearance = options.half_width_m + options.margin_m + rock.radius_m
        if float(distances.min()) < min(clearance, float(distances[0])):
            return False
    return True
