"""Flight software that drives the rover: steps towards the target, terrain map, and path planning (Fig. 12).

Its inputs are estimated poses, the tracker's target position, and stereo measurements. An import contract forbids
imports of the modules with the simulated truth. The parameters of a leg are the operators' commands.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.navigation.planner import NavigationOptions, NavigationPlan, navigate
from marsyard.algorithms.navigation.stereo import RectifiedPair
from marsyard.algorithms.navigation.terrain_map import TerrainMap
from marsyard.scenarios.rover.parameters import LegParameters
from marsyard.sim.measurements import DriveCommand, StereoMeasurement

#: Maximum distance from the goal at the end of an approach or back-off, metres.
GOAL_TOLERANCE_M = 0.03
#: Maximum angle of the goal from straight ahead for an arc, radians. For a larger angle the rover first turns in place.
MAX_ARC_RAD = np.radians(15.0)
#: Radius around the target in which hazards are ignored, if the navigator ignores the target's rock, metres.
TARGET_RADIUS_M = 1.0
#: Points are mapped up to the height GROUND_STEP_M + GROUND_SLOPE * distance above or below the plane of the wheels.
GROUND_STEP_M, GROUND_SLOPE = 0.3, 0.5
#: Maximum x and maximum |y| of the rover's body and wheels in the rover frame, metres.
BODY_FRONT_M, BODY_SIDE_M = 0.95, 1.2
#: Margin around the rover within which the ground at the start is assumed to be a plane, metres.
START_MARGIN_M = 0.3
#: Parameters of the planner for maps from mast cameras and from body cameras (assumed). The disc swept by the rover is
#: sized for the wheels of a MER, without its solar panels. The range of the body cameras allows a short lookahead only.
NAVIGATION_OPTIONS = {
    "mast": NavigationOptions(half_width_m=0.6),
    "body": NavigationOptions(half_width_m=0.6, lookahead_m=2.0),
}


@dataclass(frozen=True)
class TargetEstimate:
    """On-board estimate of the target's position, used to plan a step."""

    position_rover: Float64[np.ndarray, "3"]  #: latest estimate in the rover frame, metres
    range_m: float  #: distance from the camera

    @property
    def distance_m(self) -> float:
        """Horizontal distance from the rover's origin."""
        return float(np.hypot(*self.position_rover[:2]))


def goal_position(leg: LegParameters, target: TargetEstimate) -> Float64[np.ndarray, "2"]:
    """Compute the goal of the rover's origin, forward and left of its current position, metres.

    The goal is on the line to the target, `goal_m` in front of the target, shifted to the right by `offset_right_m`.
    """
    to_target = target.position_rover[:2] / target.distance_m
    right = np.array([to_target[1], -to_target[0]])
    return np.asarray((target.distance_m - leg.goal_m) * to_target + leg.offset_right_m * right)


def step_length_m(leg: LegParameters, target: TargetEstimate) -> float:
    """Return the maximum step length: a fraction of the target's distance from the camera, or a fixed length."""
    return leg.step_fraction * target.range_m if leg.step_m is None else leg.step_m


def is_finished(leg: LegParameters, step_count: int, target: TargetEstimate) -> bool:
    """Return whether the leg is finished after this number of steps."""
    return step_count >= leg.steps or is_at_goal(leg, target)


def is_at_goal(leg: LegParameters, target: TargetEstimate) -> bool:
    """Return whether an approach or back-off is at its final distance; False for the other motions, without a goal."""
    if leg.motion == "approach":
        return target.distance_m <= leg.goal_m + GOAL_TOLERANCE_M
    return leg.motion == "back-off" and target.distance_m >= leg.goal_m - GOAL_TOLERANCE_M


def plan_step(leg: LegParameters, step_count: int, target: TargetEstimate) -> Iterator[DriveCommand]:
    """Plan the commands of the next step: two if the rover turns in place before it drives, none if it stays."""
    if leg.motion == "turn":
        yield DriveCommand(turn_left_rad=-float(np.radians(leg.step_deg)))
        if leg.shuffle_m:
            # a short drive after each turn, alternately forward and back
            yield DriveCommand(forward_m=leg.shuffle_m if step_count % 2 == 0 else -leg.shuffle_m)
    elif leg.motion == "circle":
        # a rotation about the target moves the origin perpendicular to the line to the target
        angle = -float(np.radians(leg.step_deg))
        x, y, _ = target.position_rover
        yield DriveCommand(forward_m=angle * float(y), left_m=-angle * float(x), turn_left_rad=angle)
    elif leg.motion == "straight":
        yield DriveCommand(forward_m=step_length_m(leg, target))
    elif leg.motion == "back-off":
        yield DriveCommand(forward_m=-min(step_length_m(leg, target), leg.goal_m - target.distance_m))
    elif leg.motion == "approach":
        yield from plan_drive(goal_position(leg, target), step_length_m(leg, target))


def plan_drive(position: Float64[np.ndarray, "2"], max_length_m: float) -> Iterator[DriveCommand]:
    """Plan a step to a position (forward, left; metres): an arc, or a turn in place and a straight drive."""
    angle = float(np.arctan2(position[1], position[0]))
    chord = float(np.hypot(*position))
    if abs(angle) > MAX_ARC_RAD:
        yield DriveCommand(turn_left_rad=angle)
        yield DriveCommand(forward_m=min(chord, max_length_m))
        return
    # an arc that starts straight ahead turns by twice the angle of its chord; its length is chord * angle / sin(angle)
    arc = chord / float(np.sinc(angle / np.pi))
    length = min(arc, max_length_m)
    yield DriveCommand(forward_m=length, turn_left_rad=2.0 * angle * length / arc)


@dataclass
class Navigator:
    """Terrain map and path planner of a run; the map is in the estimated world frame."""

    terrain: TerrainMap | None = None

    def map_start(self, world_from_rover: RigidTransform, radius_m: float) -> None:
        """Create the map if there is none: the plane of the wheels, within `radius_m` and a margin of the rover."""
        if self.terrain is None:
            origin, up = world_from_rover.translation, world_from_rover.rotation.as_matrix()[:, 2]
            terrain = TerrainMap.empty(np.asarray(origin[:2]))
            self.terrain = terrain.add_plane(origin, up, radius_m + START_MARGIN_M)

    def map_pair(
        self, pair: StereoMeasurement, world_from_rover: RigidTransform, ranges_m: tuple[float, float]
    ) -> None:
        """Add the points of a stereo pair, taken at an estimated pose, with depths within `ranges_m`."""
        points = RectifiedPair.from_measurement(pair).points(*ranges_m)
        # steeper points, seen from the rover, are false matches; the body cameras also see the rover
        is_ground = np.abs(points[:, 2]) <= GROUND_STEP_M + GROUND_SLOPE * np.hypot(points[:, 0], points[:, 1])
        is_ground &= (points[:, 0] > BODY_FRONT_M) | (np.abs(points[:, 1]) > BODY_SIDE_M)
        if np.any(is_ground):
            self.map_points(np.asarray(world_from_rover.apply(points[is_ground])))

    def map_points(self, points: Float64[np.ndarray, "n 3"]) -> None:
        """Add points in the estimated world frame. Raises ValueError before `map_start`."""
        if self.terrain is None:
            raise ValueError("the map is empty; call `map_start` first")
        self.terrain = self.terrain.add_points(points)

    def plan(self, leg: LegParameters, target: TargetEstimate, world_from_rover: RigidTransform) -> NavigationPlan:
        """Plan the next step of a leg around the hazards of the map. Raises ValueError before `map_start`."""
        if self.terrain is None:
            raise ValueError("the map is empty; call `map_start` first")
        axes, origin = world_from_rover.rotation.as_matrix(), world_from_rover.translation
        goal = origin + axes @ np.array([*goal_position(leg, target), 0.0])
        terrain = self.terrain
        if leg.target_is_no_obstacle:
            position = origin + axes @ target.position_rover
            terrain = terrain.without_hazards(np.asarray(position[:2]), TARGET_RADIUS_M)
        options = NAVIGATION_OPTIONS[leg.map_by]
        return navigate(terrain, world_from_rover, np.asarray(goal[:2]), step_length_m(leg, target), options)
