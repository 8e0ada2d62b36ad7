"""Drive commands of each step of a leg, from the believed target position, and the navigator's map of the terrain."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.navigation import NavigationOptions, NavigationPlan, Obstacle, TerrainMap, Wedge, navigate
from marsyard.scenarios.rover.parameters import LegParameters
from marsyard.scenarios.rover.world import TARGET, RunWorld
from marsyard.sim.dynamics import RoverParameters, Stance
from marsyard.sim.measurements import DriveCommand

#: An approach or retreat ends this near to its goal, metres.
GOAL_TOLERANCE_M = 0.03
#: The rover turns in place towards a goal beyond this direction; within, the step is an arc.
MAX_ARC_RAD = np.radians(15.0)
#: Wedges of the mast's cameras: half the 45 deg of a navcam, between where the rover's own deck ends and where stereo
#: still ranges rocks; neighbours overlap by 5 deg. Of the body's: half of 120 deg, from the front wheels on (hazcams).
MAST_HALF_RAD, MAST_NEAREST_M, MAST_FARTHEST_M, MAST_APART_RAD = np.radians(22.5), 1.4, 12.0, np.radians(40.0)
BODY_HALF_RAD, BODY_NEAREST_M, BODY_FARTHEST_M = np.radians(60.0), 0.3, 4.0


@dataclass(frozen=True)
class Belief:
    """Target position as the on-board computer has it when it plans a step."""

    target_rover: Float64[np.ndarray, "3"]  #: latest estimate in the rover frame, metres
    range_m: float  #: from the camera to it

    @property
    def distance_m(self) -> float:
        """Horizontal distance from the rover's origin."""
        return float(np.hypot(*self.target_rover[:2]))


def goal_position(leg: LegParameters, belief: Belief) -> Float64[np.ndarray, "2"]:
    """Final position of the rover's origin: forward and left of the present one, metres.

    On the line to the target, `goal_m` before it, and to the right of that by the offset.
    """
    ahead = belief.target_rover[:2] / belief.distance_m
    right = np.array([ahead[1], -ahead[0]])
    return np.asarray((belief.distance_m - leg.goal_m) * ahead + leg.offset_right_m * right)


def step_length_m(leg: LegParameters, belief: Belief) -> float:
    """Longest step: a fraction of the target's distance from the camera, or a length."""
    return leg.step_share * belief.range_m if leg.step_m is None else leg.step_m


def is_finished(leg: LegParameters, done: int, belief: Belief) -> bool:
    """Whether the leg has come to its end after so many steps."""
    if done >= leg.steps:
        return True
    if leg.motion == "approach":
        return belief.distance_m <= leg.goal_m + GOAL_TOLERANCE_M
    return leg.motion == "back-off" and belief.distance_m >= leg.goal_m - GOAL_TOLERANCE_M


def step_commands(leg: LegParameters, done: int, belief: Belief) -> Iterator[DriveCommand]:
    """The commands of the next step; more than one where it turns in place before it drives."""
    if leg.motion == "turn":
        yield DriveCommand(turn_left_rad=-float(np.radians(leg.step_deg)))
        if leg.shuffle_m:
            yield DriveCommand(forward_m=leg.shuffle_m if done % 2 == 0 else -leg.shuffle_m)
    elif leg.motion == "circle":
        # a rotation about the target moves the origin across the line to it
        turn = -float(np.radians(leg.step_deg))
        x, y, _ = belief.target_rover
        yield DriveCommand(forward_m=turn * float(y), left_m=-turn * float(x), turn_left_rad=turn)
    elif leg.motion == "straight":
        yield DriveCommand(forward_m=step_length_m(leg, belief))
    elif leg.motion == "back-off":
        yield DriveCommand(forward_m=-min(step_length_m(leg, belief), leg.goal_m - belief.distance_m))
    elif leg.motion == "approach":
        yield from drive_towards(goal_position(leg, belief), step_length_m(leg, belief))


def drive_towards(position: Float64[np.ndarray, "2"], max_length_m: float) -> Iterator[DriveCommand]:
    """A step to a position (forward, left): the arc to it, or a turn in place and a straight drive."""
    angle = float(np.arctan2(position[1], position[0]))
    chord = float(np.hypot(*position))
    if abs(angle) > MAX_ARC_RAD:
        yield DriveCommand(turn_left_rad=angle)
        yield DriveCommand(forward_m=min(chord, max_length_m))
        return
    # an arc that starts ahead turns by twice the angle of its chord
    path = chord / float(np.sinc(angle / np.pi))
    length = min(path, max_length_m)
    yield DriveCommand(forward_m=length, turn_left_rad=2.0 * angle * length / path)


@dataclass
class Mapper:
    """Map of the ground in pictures and of the rocks in it; the ground below the rover at the start is known."""

    terrain: TerrainMap = field(default_factory=TerrainMap)

    def sense(
        self,
        leg: LegParameters,
        belief: Belief,
        world: RunWorld,
        rover: RoverParameters,
        stance: Stance,
        estimated: RigidTransform,
    ) -> None:
        """Add the wedges of a step, with the rocks in them at their believed positions."""
        rocks = tuple(_believed_rocks(world, estimated * stance.world_from_rover.inv()))
        position = estimated.translation[:2]
        wedges = [] if self.terrain.wedges else [Wedge(position.copy(), 0.0, float(np.pi), 0.0, rover.reach_m + 0.3)]
        forward = estimated.rotation.as_matrix()[:2, 0]
        heading = float(np.arctan2(forward[0], forward[1]))
        if leg.map_by == "body":
            apex = np.asarray(position + rover.front_m * forward)
            wedges.append(Wedge(apex, heading, float(BODY_HALF_RAD), BODY_NEAREST_M, BODY_FARTHEST_M))
        else:
            ahead = goal_position(leg, belief)
            towards = heading - float(np.arctan2(ahead[1], ahead[0]))
            for number in range(leg.wedges):
                middle = float(towards + (number - 0.5 * (leg.wedges - 1)) * MAST_APART_RAD)
                wedges.append(Wedge(position.copy(), middle, float(MAST_HALF_RAD), MAST_NEAREST_M, MAST_FARTHEST_M))
        for wedge in wedges:
            self.terrain = self.terrain.sensed(wedge, rocks)

    def plan(self, leg: LegParameters, belief: Belief, estimated: RigidTransform) -> NavigationPlan:
        """The next step to the leg's goal; the target's own rock is not avoided."""
        position = estimated.translation + estimated.rotation.as_matrix() @ np.array([*goal_position(leg, belief), 0.0])
        ignored = TARGET if leg.target_is_no_obstacle else None
        options, step = NavigationOptions(half_width_m=0.6), step_length_m(leg, belief)
        return navigate(self.terrain, estimated, np.asarray(position[:2]), step, options, ignored)


def _believed_rocks(world: RunWorld, believed_from_true: RigidTransform) -> Iterator[Obstacle]:
    """The target's rock and the obstacles at their believed positions."""
    rocks = world.rocks
    for name, number in rocks.names.items():
        position = np.asarray(believed_from_true.apply(rocks.position_m[number].copy()))
        yield Obstacle(name, position[:2], 0.5 * float(rocks.diameter_m[number]), float(rocks.height_m[number]))
