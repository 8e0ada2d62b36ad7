"""What the rover is told to drive at each step of a leg, from where it believes its target to be."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from marsyard.scenarios.rover.parameters import LegParameters
from marsyard.sim.measurements import DriveCommand

#: An approach or retreat ends this near to its goal, metres.
GOAL_TOLERANCE_M = 0.03
#: Directions of the goal beyond this are first turned to in place; within, the step is an arc.
WIDEST_ARC_RAD = np.radians(15.0)


@dataclass(frozen=True)
class Belief:
    """What the rover's computer knows when it plans a step."""

    target_rover: Float64[np.ndarray, "3"]  #: The target's latest estimate in the rover frame, metres, shape (3,)
    range_m: float  #: From the camera to it

    @property
    def distance_m(self) -> float:
        """Horizontal distance from the rover's origin."""
        return float(np.hypot(*self.target_rover[:2]))


def goal(leg: LegParameters, belief: Belief) -> Float64[np.ndarray, "2"]:
    """Where the rover's origin shall be in the end: forward and left of where it is, metres.

    On the line to the target, `goal_m` before it, and to the right of that by the offset.
    """
    ahead = belief.target_rover[:2] / belief.distance_m
    right = np.array([ahead[1], -ahead[0]])
    return np.asarray((belief.distance_m - leg.goal_m) * ahead + leg.offset_right_m * right)


def step_length_m(leg: LegParameters, belief: Belief) -> float:
    """Longest step: a share of the target's distance from the camera, or a length."""
    return leg.step_share * belief.range_m if leg.step_m is None else leg.step_m


def finished(leg: LegParameters, done: int, belief: Belief) -> bool:
    """Whether the leg has come to its end after so many steps."""
    if done >= leg.steps:
        return True
    if leg.motion == "approach":
        return belief.distance_m <= leg.goal_m + GOAL_TOLERANCE_M
    if leg.motion == "back-off":
        return belief.distance_m >= leg.goal_m - GOAL_TOLERANCE_M
    return False


def commands(leg: LegParameters, done: int, belief: Belief) -> Iterator[DriveCommand]:
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
        yield from towards(goal(leg, belief), step_length_m(leg, belief))


def towards(place: Float64[np.ndarray, "2"], longest_m: float) -> Iterator[DriveCommand]:
    """A step to a place ahead: the arc that leads there, or a turn in place and a straight drive."""
    angle = float(np.arctan2(place[1], place[0]))
    chord = float(np.hypot(*place))
    if abs(angle) > WIDEST_ARC_RAD:
        yield DriveCommand(turn_left_rad=angle)
        yield DriveCommand(forward_m=min(chord, longest_m))
        return
    # an arc that starts ahead turns by twice the angle of its chord
    path = chord / float(np.sinc(angle / np.pi))
    length = min(path, longest_m)
    yield DriveCommand(forward_m=length, turn_left_rad=2.0 * angle * length / path)
