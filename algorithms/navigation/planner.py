"""Local path planner similar to Autonav (GESTALT): arcs to a goal over mapped, traversable ground.

The planner drives the simulated rover while a target tracker is tested (tracking paper, sections 6 and 7; GESTALT:
Maimone, Leger & Biesiadecki 2007). It is not under test. It uses estimated poses and the terrain map of stereo images
(`marsyard.algorithms.navigation.terrain_map`), never the ground truth:

- A single navcam pair, 45 deg wide, is too narrow to pass a near obstacle; two pairs are enough (section 6). The ground
  directly in front of the cameras is not imaged: the rover drives the first metres of a map over unmapped ground
  (section 7.3), which the caller fills with a plane (`TerrainMap.add_plane`).
- Rocks that wheels can climb are not hazards. The ground around the target is excluded if the target is on a large rock
  (section 6).

Each step searches new paths: an optional turn in place, an arc, and a second arc to the goal. The rover follows the
path of minimum cost that is clear and mapped up to the lookahead distance, for one step. The swept area is that of a
disc, which contains the rover's footprint at any heading.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.navigation.terrain_map import Goodness, GroundLimits, TerrainMap
from marsyard.sim.measurements import DriveCommand

#: Distance to the goal below which it is reached, metres.
AT_GOAL_M = 0.02
#: Largest angle between the heading at the start of the second arc and the direction to the goal.
_MAX_HEADING_RAD = np.radians(75.0)
#: Candidate turns in place, deg, in addition to the turn towards the goal.
_TURNS_DEG = (0.0, 20.0, -20.0, 40.0, -40.0, 60.0, -60.0, 80.0, -80.0, 100.0, -100.0)
#: Number of candidate curvatures and of candidate lengths of the first arc, and its maximum length as a fraction of the
#: distance to the goal.
_GRID_COUNT, _MAX_FIRST_FRACTION = 9, 0.75
#: Distance between checked points of a path, metres.
_CHECK_STEP_M = 0.1


@dataclass(frozen=True)
class NavigationOptions:
    """Parameters of the planner; all except those of the wheels (`half_width_m`, `climb_m`) are assumed.

    - half_width_m: Radius of the swept disc: a MER's outer wheels are 0.69 m from its centre line
    - margin_m: Clearance between disc and hazard
    - climb_m: Maximum height of a rock to drive over; MER climbed rocks of a wheel's diameter, 0.25 m
    - tilt_deg: Maximum tilt of the ground
    - roughness_m: Maximum standard deviation of the ground's height from a plane
    - lookahead_m: Length of the path that must be mapped and clear
    - max_curvature_per_m: Maximum curvature, 1/m
    - turn_cost_m: Cost of a turn in place, metres of path per radian
    - bend_cost_m2: Weight of the integral of the squared curvature in the cost (in metres of path)
    """

    half_width_m: float = 0.75
    margin_m: float = 0.1
    climb_m: float = 0.2
    tilt_deg: float = 30.0
    roughness_m: float = 0.06
    lookahead_m: float = 4.0
    max_curvature_per_m: float = 0.6
    turn_cost_m: float = 0.5
    bend_cost_m2: float = 1.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            can_be_zero = name in ("margin_m", "turn_cost_m", "bend_cost_m2")
            if not (0.0 < value < np.inf or (can_be_zero and value == 0.0)):
                raise ValueError(f"{name} is {value}; it must {'not be negative' if can_be_zero else 'be positive'}")

    @property
    def limits(self) -> GroundLimits:
        """Limits of the ground under the disc with its margin."""
        radius_m = self.half_width_m + self.margin_m
        return GroundLimits(radius_m, self.climb_m, float(np.radians(self.tilt_deg)), self.roughness_m)


class NavigationOutcome(Enum):
    """Result of a search. All members except PATH and AT_GOAL are expected failures: the rover does not drive."""

    PATH = "a path was found"
    AT_GOAL = "the goal is reached"
    NOT_MAPPED = "the ground under the rover is not mapped"
    NO_PATH = "no path to the goal is both mapped and clear"


@dataclass(frozen=True)
class NavigationPlan:
    """Result of `navigate`: the next step to drive.

    - commands: Drive commands of one step along the path, in order; empty unless the outcome is PATH
    """

    outcome: NavigationOutcome
    commands: tuple[DriveCommand, ...]


def navigate(
    terrain: TerrainMap,
    world_from_rover: RigidTransform,
    goal_m: Float[np.ndarray, "2"],
    step_m: float,
    options: NavigationOptions,
) -> NavigationPlan:
    """Plan the next step to a goal.

    - goal_m: Position (east, north) for the rover's origin, in the estimated world frame
    - step_m: Maximum path length to drive in this step
    """
    east, north, _ = world_from_rover.rotation.as_matrix()[:, 0]  # the rover's x axis, forward
    position = world_from_rover.translation[:2]
    world_from_forward = _rotation_matrix(np.arctan2(north, east))
    goal = np.asarray((goal_m - position) @ world_from_forward)
    if float(np.hypot(*goal)) < AT_GOAL_M:
        return NavigationPlan(NavigationOutcome.AT_GOAL, ())
    goodness = terrain.goodness(options.limits)
    if np.isnan(goodness.at(position[None])[0]):
        return NavigationPlan(NavigationOutcome.NOT_MAPPED, ())
    for path in _generate_paths(goal, options):
        lookahead_distances = np.arange(0.0, min(path.length_m, options.lookahead_m), _CHECK_STEP_M)
        lookahead_points = position + path.points(lookahead_distances) @ world_from_forward.T
        if _is_clear(lookahead_points, goodness, options):
            return NavigationPlan(NavigationOutcome.PATH, path.commands(step_m))
    return NavigationPlan(NavigationOutcome.NO_PATH, ())


@dataclass(frozen=True)
class _Path:
    """Turn in place, then two arcs with curvatures and lengths; turns and curvatures are positive to the left."""

    turn_rad: float
    curvatures_per_m: tuple[float, float]
    lengths_m: tuple[float, float]

    @property
    def length_m(self) -> float:
        """Length of both arcs, metres."""
        return self.lengths_m[0] + self.lengths_m[1]

    def points(self, distances_m: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 2"]:
        """Positions at distances along the path, in the axes of the rover before the turn."""
        (first_curvature, second_curvature), first_length_m = self.curvatures_per_m, self.lengths_m[0]
        first_distances_m = np.minimum(distances_m, first_length_m)
        first_arc = _arc_positions(first_curvature, first_distances_m)
        first_end = _arc_positions(first_curvature, np.array([first_length_m]))[0]
        heading = _rotation_matrix(first_curvature * first_length_m)
        second_arc = first_end + _arc_positions(second_curvature, distances_m - first_distances_m) @ heading.T
        points = np.where((distances_m > first_length_m)[:, None], second_arc, first_arc)
        return np.asarray(points @ _rotation_matrix(self.turn_rad).T)

    def commands(self, step_m: float) -> tuple[DriveCommand, ...]:
        """Drive commands for the turn and the first `step_m` metres of the arcs."""
        commands = [DriveCommand(turn_left_rad=self.turn_rad)] if self.turn_rad else []
        remaining_m = step_m
        for curvature, length in zip(self.curvatures_per_m, self.lengths_m, strict=True):
            length_m = min(length, remaining_m)
            remaining_m -= length_m
            if length_m > 0.0:
                commands.append(DriveCommand(length_m, 0.0, curvature * length_m))
        return tuple(commands)


def _arc_positions(curvature_per_m: float, distances_m: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 2"]:
    """Positions at distances along an arc that starts at the origin in the direction of x."""
    # the direction of a chord is half of the heading change
    angles = 0.5 * curvature_per_m * distances_m
    chords = distances_m * np.sinc(angles / np.pi)
    return np.stack([chords * np.cos(angles), chords * np.sin(angles)], axis=-1)


def _rotation_matrix(angle_rad: float) -> Float[np.ndarray, "2 2"]:
    """Return the matrix of a rotation in the plane, counterclockwise."""
    sine, cosine = np.sin(angle_rad), np.cos(angle_rad)
    return np.array([[cosine, -sine], [sine, cosine]])


def _generate_paths(goal: Float[np.ndarray, "2"], options: NavigationOptions) -> Iterator[_Path]:
    """Generate paths to the goal by increasing cost: an optional turn, an optional arc, and the arc to the goal.

    `goal` is in the axes of the rover: x forward, y to the left, metres.
    """
    goal_direction = float(np.arctan2(goal[1], goal[0]))
    turns = np.concatenate([np.radians(_TURNS_DEG), [goal_direction]])
    curvatures = options.max_curvature_per_m * np.linspace(-1.0, 1.0, _GRID_COUNT)
    lengths = _MAX_FIRST_FRACTION * float(np.hypot(*goal)) * np.linspace(0.0, 1.0, _GRID_COUNT)
    turn, curvature_1, length_1 = (grid.ravel() for grid in np.meshgrid(turns, curvatures, lengths, indexing="ij"))
    # the end of the first arc, and distance and direction from it to the goal
    half_turn = 0.5 * curvature_1 * length_1
    chord = length_1 * np.sinc(half_turn / np.pi)
    heading = turn + 2.0 * half_turn
    to_goal_x, to_goal_y = goal[0] - chord * np.cos(turn + half_turn), goal[1] - chord * np.sin(turn + half_turn)
    range_m, angle = np.hypot(to_goal_x, to_goal_y), np.arctan2(to_goal_y, to_goal_x) - heading
    angle = (angle + np.pi) % (2.0 * np.pi) - np.pi
    # the chord of the second arc has the length `range_m` and the angle `angle` to the heading
    curvature_2 = 2.0 * np.sin(angle) / np.maximum(range_m, AT_GOAL_M)
    length_2 = range_m / np.sinc(angle / np.pi)
    feasible = (range_m >= AT_GOAL_M) & (np.abs(angle) <= _MAX_HEADING_RAD)
    feasible &= np.abs(curvature_2) <= options.max_curvature_per_m
    bending = curvature_1**2 * length_1 + curvature_2**2 * length_2
    cost = length_1 + length_2 + options.turn_cost_m * np.abs(turn) + options.bend_cost_m2 * bending
    cost = np.where(feasible, cost, np.inf)
    for k in np.argsort(cost, kind="stable")[: np.count_nonzero(feasible)]:
        curvatures_per_m = (float(curvature_1[k]), float(curvature_2[k]))
        yield _Path(float(turn[k]), curvatures_per_m, (float(length_1[k]), float(length_2[k])))


def _is_clear(positions_m: Float[np.ndarray, "n 2"], goodness: Goodness, options: NavigationOptions) -> bool:
    """Whether the swept disc is mapped and avoids all hazards, at positions (east, north) along the path.

    The disc may overlap a hazard at the start, if it never comes closer to a hazard afterwards.
    """
    values, distances = goodness.at(positions_m), goodness.hazard_distances_m(positions_m)
    if np.any(np.isnan(values)):
        return False
    clearance = options.half_width_m + options.margin_m
    if np.any(distances < min(clearance, float(distances[0]))):
        return False
    # tilt and roughness: the path may leave bad ground, but not enter it
    is_bad = (values <= 0.0) & (distances >= clearance)
    return not np.any(is_bad[1:] & ~is_bad[:-1])
