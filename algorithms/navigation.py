"""A navigator in the manner of Autonav: steers to a goal around obstacles, over ground that pictures have mapped.

This is flight software, which is why it lies with the algorithms: it knows the rover's estimated pose and what was
sensed, and nothing of the truth. It is no subject of validation but closes the loop of the tracking paper's sections 6
and 7 (GESTALT: Maimone, Leger & Biesiadecki 2007), with the properties that the paper tells:

- It drives only where wedges of stereo pictures have mapped the ground. A single navcam wedge, 45 deg wide, leaves no
  room beside an obstacle near by; two wedges do (section 6). The ground right before a mast's cameras is not in their
  pictures: the first metres after a map was begun are driven without it (section 7.3).
- Rocks that wheels can climb are no obstacles. A target on a large rock would be avoided; naming it keeps the
  navigator from that (section 6).

Paths are searched anew at every step: a turn in place or none, an arc, and the arc that leads from its end to the goal.
The cheapest of those that are clear and mapped, as far as the navigator looks ahead, is followed for one step. What
must be clear and mapped is the way of a disc: the footprint of a rover that may turn anywhere.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import Enum

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import RigidTransform

from marsyard.sim.measurements import DriveCommand

#: Points at which a footprint is looked up in the map: its middle and its rim.
_RIM = np.concatenate(
    [np.zeros((1, 2)), [(np.cos(a), np.sin(a)) for a in np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)]]
)
#: A goal nearer than this is reached, metres.
AT_GOAL_M = 0.02
#: Widest angle between the heading at the last arc's start and the goal: beyond, the arc would come back on itself.
_WIDEST_ARC_RAD = np.radians(75.0)
#: Turns in place that may begin a path, besides that to the goal.
_TURNS_DEG = (0.0, 20.0, -20.0, 40.0, -40.0, 60.0, -60.0, 80.0, -80.0, 100.0, -100.0)


@dataclass(frozen=True)
class Wedge:
    """Ground that one pair of pictures has mapped, in the world as estimated.

    Attributes
    ----------
    apex_m
        Where the pictures were taken, east and north, metres, shape (2,).
    azimuth_rad, half_width_rad
        Middle of the wedge, clockwise from north, and half its width.
    nearest_m, farthest_m
        Between these distances the ground was seen and ranged.
    """

    apex_m: Float[np.ndarray, "2"]
    azimuth_rad: float
    half_width_rad: float
    nearest_m: float
    farthest_m: float

    def covers(self, places_m: Float[np.ndarray, "*batch 2"]) -> Bool[np.ndarray, "*batch"]:
        """Whether places (east, north) are mapped."""
        away = places_m - self.apex_m
        distance = np.hypot(away[..., 0], away[..., 1])
        aside = np.arctan2(away[..., 0], away[..., 1]) - self.azimuth_rad
        aside = np.abs((aside + np.pi) % (2.0 * np.pi) - np.pi)
        covered = (aside <= self.half_width_rad) & (distance >= self.nearest_m) & (distance <= self.farthest_m)
        return np.asarray(covered)


@dataclass(frozen=True)
class Obstacle:
    """A rock as sensed.

    Attributes
    ----------
    name
        What it is called, so that the same rock seen twice is one.
    place_m
        Its middle in the world as estimated, east and north, metres, shape (2,).
    radius_m, height_m
        Its extent.
    """

    name: str
    place_m: Float[np.ndarray, "2"]
    radius_m: float
    height_m: float


@dataclass(frozen=True)
class TerrainMap:
    """What is known of the ground: wedges that were mapped, and the rocks seen in them."""

    wedges: tuple[Wedge, ...] = ()
    obstacles: tuple[Obstacle, ...] = ()

    def sensed(self, wedge: Wedge, rocks: Iterable[Obstacle]) -> TerrainMap:
        """The map with a wedge added, and those of the rocks of which that shows any part.

        A rock seen before is taken as seen last. That rocks hide what is behind them is left out.
        """
        seen = {rock.name: rock for rock in rocks if bool(wedge.covers(rock.place_m + rock.radius_m * _RIM).any())}
        kept = tuple(rock for rock in self.obstacles if rock.name not in seen)
        return TerrainMap((*self.wedges, wedge), kept + tuple(seen.values()))

    def mapped(self, places_m: Float[np.ndarray, "*batch 2"]) -> Bool[np.ndarray, "*batch"]:
        """Whether places (east, north) lie in any wedge."""
        known = np.zeros(places_m.shape[:-1], dtype=np.bool_)
        for wedge in self.wedges:
            known |= wedge.covers(places_m)
        return known


@dataclass(frozen=True)
class NavigationOptions:
    """Numbers of the navigator; all but the wheels' are assumed.

    Attributes
    ----------
    half_width_m
        Radius of the disc that must be mapped and clear along the way: a MER's outer wheels reach 0.69 m to the side.
    margin_m
        Room left between the disc and an obstacle.
    climb_m
        Height of the highest rock that wheels take (MER: about a wheel's radius).
    lookahead_m
        Length of the path that must be mapped and clear.
    curvature_m
        Sharpest arc, 1/m.
    turn_cost_m, bend_cost_m2
        What a radian of turning in place, and the integral of the squared curvature, cost beside a metre of path.
    """

    half_width_m: float = 0.75
    margin_m: float = 0.1
    climb_m: float = 0.13
    lookahead_m: float = 4.0
    curvature_m: float = 0.6
    turn_cost_m: float = 0.5
    bend_cost_m2: float = 1.0

    def __post_init__(self) -> None:
        for name in ("half_width_m", "lookahead_m", "curvature_m"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be positive")
        for name in ("margin_m", "climb_m", "turn_cost_m", "bend_cost_m2"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} is {getattr(self, name)}; it must not be negative")


class NavigationOutcome(Enum):
    """How a search ended. Every member but PATH and AT_GOAL is an expected failure: nothing is driven."""

    PATH = "a path was found"
    AT_GOAL = "the goal is reached"
    NOT_MAPPED = "the ground under the rover is not mapped"
    NO_PATH = "no path to the goal is both mapped and clear"


@dataclass(frozen=True)
class NavigationPlan:
    """An answer to "what to drive next".

    Attributes
    ----------
    outcome
        How the search ended.
    commands
        One step along the path, in order; empty unless the outcome is PATH.
    path_m
        The whole path in the world as estimated, east and north, shape (n, 2), n = 0 where there is none.
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
    """The next step to a goal.

    Parameters
    ----------
    terrain
        What was sensed.
    world_from_rover
        The rover's pose as estimated.
    goal_m
        Where its origin shall come to lie, east and north in the world as estimated.
    step_m
        Longest path to drive in this step.
    options
        Numbers of the navigator.
    target
        Name of a rock that is driven to and not avoided; None avoids all.
    backwards
        Whether to drive with the rear ahead.
    """
    pose = _Planar.of(world_from_rover, backwards)
    goal = pose.local(goal_m)
    none = np.empty((0, 2))
    if float(np.hypot(*goal)) < AT_GOAL_M:
        return NavigationPlan(NavigationOutcome.AT_GOAL, (), none)
    if not bool(terrain.mapped(pose.place_m + options.half_width_m * _RIM).all()):
        return NavigationPlan(NavigationOutcome.NOT_MAPPED, (), none)
    avoided = [rock for rock in terrain.obstacles if rock.name != target and rock.height_m > options.climb_m]
    for path in _candidates(goal, options):
        ahead = pose.world(path.points(np.arange(0.0, min(path.length_m, options.lookahead_m), 0.1)))
        if _clear(ahead, avoided, options) and _mapped(ahead, terrain, options):
            whole = pose.world(path.points(np.linspace(0.0, path.length_m, 60)))
            return NavigationPlan(NavigationOutcome.PATH, path.commands(step_m, backwards), whole)
    return NavigationPlan(NavigationOutcome.NO_PATH, (), none)


@dataclass(frozen=True)
class _Planar:
    """Place and direction of motion of a rover, seen from above; counterclockwise from east."""

    place_m: Float[np.ndarray, "2"]
    yaw_rad: float

    @classmethod
    def of(cls, world_from_rover: RigidTransform, backwards: bool) -> _Planar:
        forward = world_from_rover.rotation.as_matrix()[:2, 0] * (-1.0 if backwards else 1.0)
        return cls(np.asarray(world_from_rover.translation[:2]), float(np.arctan2(forward[1], forward[0])))

    def world(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        return np.asarray(self.place_m + points @ _turn(self.yaw_rad).T)

    def local(self, place_m: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        return np.asarray((place_m - self.place_m) @ _turn(self.yaw_rad))


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
        """Places at distances along the path, in the axes of the rover before the turn."""
        first = np.minimum(along_m, self.lengths_m[0])
        bend = _arc(self.curvatures_m[0], np.array([self.lengths_m[0]]))[0]
        heading = self.curvatures_m[0] * self.lengths_m[0]
        beyond = bend + _arc(self.curvatures_m[1], along_m - first) @ _turn(heading).T
        points = np.where((along_m > self.lengths_m[0])[:, None], beyond, _arc(self.curvatures_m[0], first))
        return np.asarray(points @ _turn(self.turn_rad).T)

    def commands(self, step_m: float, backwards: bool) -> tuple[DriveCommand, ...]:
        """The turn, and so much of the arcs as makes a step."""
        told = [DriveCommand(turn_left_rad=self.turn_rad)] if self.turn_rad else []
        left = step_m
        for curvature, length in zip(self.curvatures_m, self.lengths_m, strict=True):
            driven = min(length, left)
            left -= driven
            if driven > 0.0:
                told.append(DriveCommand(-driven if backwards else driven, 0.0, curvature * driven))
        return tuple(told)


def _arc(curvature_m: float, along_m: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 2"]:
    """Places along an arc that starts at the origin along x."""
    half = 0.5 * curvature_m * along_m
    chord = along_m * np.sinc(half / np.pi)
    return np.stack([chord * np.cos(half), chord * np.sin(half)], axis=-1)


def _turn(angle_rad: float) -> Float[np.ndarray, "2 2"]:
    sine, cosine = np.sin(angle_rad), np.cos(angle_rad)
    return np.array([[cosine, -sine], [sine, cosine]])


def _candidates(goal: Float[np.ndarray, "2"], options: NavigationOptions) -> Iterator[_Path]:
    """Paths to the goal, the cheapest first: with a turn or not, along an arc or not, and then along the arc to it."""
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
    fits = (left >= AT_GOAL_M) & (np.abs(angle) <= _WIDEST_ARC_RAD) & (np.abs(second) <= options.curvature_m)
    bent = first**2 * length + second**2 * rest
    cost = np.where(fits, length + rest + options.turn_cost_m * np.abs(turn) + options.bend_cost_m2 * bent, np.inf)
    for best in np.argsort(cost, kind="stable")[: np.count_nonzero(fits)]:
        yield _Path(
            float(turn[best]),
            (float(first[best]), float(second[best])),
            (float(length[best]), float(rest[best])),
        )


def _clear(places_m: Float[np.ndarray, "n 2"], rocks: Iterable[Obstacle], options: NavigationOptions) -> bool:
    """Whether no rock is in the way of the disc, unless it stands there already and moves away."""
    for rock in rocks:
        away = np.hypot(*(places_m - rock.place_m).T)
        room = options.half_width_m + options.margin_m + rock.radius_m
        if float(away.min()) < min(room, float(away[0])):
            return False
    return True


def _mapped(places_m: Float[np.ndarray, "n 2"], terrain: TerrainMap, options: NavigationOptions) -> bool:
    """Whether the disc stays on mapped ground."""
    return bool(terrain.mapped(places_m[:, None] + options.half_width_m * _RIM).all())
