"""The navigator's map: wedges of ground that pictures have shown, and the rocks sensed in them, as believed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.navigation import (
    NavigationOptions,
    NavigationPlan,
    Obstacle,
    TerrainMap,
    Wedge,
    navigate,
)
from marsyard.scenarios.rover.parameters import LegParameters
from marsyard.scenarios.rover.route import Belief, goal, step_length_m
from marsyard.scenarios.rover.world import TARGET, RunWorld
from marsyard.sim.dynamics import RoverParameters, Stance

#: Wedges of the mast's cameras: half the 45 deg of a navcam, between where the rover's own deck ends and where stereo
#: still ranges rocks; neighbours overlap by 5 deg. Of the body's: half of 120 deg, from the front wheels on (hazcams).
MAST_HALF_RAD, MAST_NEAREST_M, MAST_FARTHEST_M, MAST_APART_RAD = np.radians(22.5), 1.4, 12.0, np.radians(40.0)
BODY_HALF_RAD, BODY_NEAREST_M, BODY_FARTHEST_M = np.radians(60.0), 0.3, 4.0


@dataclass
class Mapper:
    """What is mapped in a run, and the navigator that drives by it.

    The ground on which the rover stands at the start is known.
    """

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
        """Adds the wedges of a step, with the rocks in them where the rover believes them to be."""
        believed_from_true = estimated * stance.world_from_rover.inv()
        rocks = tuple(_sensed(world, believed_from_true))
        if not self.terrain.wedges:
            here = Wedge(estimated.translation[:2].copy(), 0.0, float(np.pi), 0.0, rover.reach_m + 0.3)
            self.terrain = self.terrain.sensed(here, rocks)
        forward = estimated.rotation.as_matrix()[:2, 0]
        heading = float(np.arctan2(forward[0], forward[1]))
        if leg.map_by == "body":
            apex = estimated.translation[:2] + rover.front_m * forward
            wedge = Wedge(np.asarray(apex), heading, float(BODY_HALF_RAD), BODY_NEAREST_M, BODY_FARTHEST_M)
            self.terrain = self.terrain.sensed(wedge, rocks)
            return
        ahead = goal(leg, belief)
        towards = heading - float(np.arctan2(ahead[1], ahead[0]))
        for number in range(leg.wedges):
            middle = towards + (number - 0.5 * (leg.wedges - 1)) * MAST_APART_RAD
            apex = estimated.translation[:2].copy()
            wedge = Wedge(apex, float(middle), float(MAST_HALF_RAD), MAST_NEAREST_M, MAST_FARTHEST_M)
            self.terrain = self.terrain.sensed(wedge, rocks)

    def plan(self, leg: LegParameters, belief: Belief, estimated: RigidTransform) -> NavigationPlan:
        """The next step to the leg's goal; the target's own rock is not avoided."""
        turn = estimated.rotation.as_matrix()
        place = estimated.translation + turn @ np.array([*goal(leg, belief), 0.0])
        options = NavigationOptions(half_width_m=0.6)
        target = TARGET if leg.target_is_no_obstacle else None
        step = step_length_m(leg, belief)
        return navigate(self.terrain, estimated, np.asarray(place[:2]), step, options, target)


def _sensed(world: RunWorld, believed_from_true: RigidTransform) -> Iterator[Obstacle]:
    """The target's rock and the obstacles, where they are believed to be."""
    rocks = world.rocks
    for name, number in rocks.names.items():
        place = np.asarray(believed_from_true.apply(rocks.position_m[number].copy()))
        yield Obstacle(name, place[:2], 0.5 * float(rocks.diameter_m[number]), float(rocks.height_m[number]))
