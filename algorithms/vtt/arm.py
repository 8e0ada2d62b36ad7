"""Hand-off of the tracked target to the arm, and placement of an instrument on it (tracking paper, sections 3, 7.4).

After the hand-off the flight software AutoPlace measures the surface around the target by stereo, predicts collisions
of the arm's tools with the terrain, and selects another target nearby if necessary (on sol 1216 a target 8 mm away).
The paper states neither its algorithm nor the tools; both are assumptions (docs/adr/0017).

The sections are those of Kim et al., "Targeted Driving Using Visual Tracking".
"""

from dataclasses import dataclass
from enum import Enum

import numpy as np
from jaxtyping import Float, Float64

from marsyard.algorithms.arrays import Points3, Vector3
from marsyard.algorithms.interface import TargetUpdate
from marsyard.algorithms.navigation.stereo import RectifiedPair
from marsyard.algorithms.vtt.accuracy import drift_error_m, stereo_range_error_m, tracked_approach_error_m
from marsyard.algorithms.vtt.stereo import disparity_px_m
from marsyard.sim.measurements import MastCalibration, RoverMeasurements, StereoMeasurement

#: Assumed drift of the tracked point (paper: 2.5 px from 10 m to 2 m).
DRIFT_PX = 2.5
#: Tools on the arm, metres: radius of the contact disc, radius of the disc that contains the tools around it, and
#: distance of the tools behind the contact disc.
CONTACT_M, TOOLS_M, CLEARANCE_M = 0.02, 0.05, 0.015
#: Maximum distance of a re-selected position from the target, metres.
MAX_RESELECTION_M = 0.008
#: Spacing of the positions that are checked, metres.
_SPACING_M = 0.002
#: Tolerance of distances on this grid, so that rounding errors do not exclude its last positions, metres.
_ROUNDING_M = 1e-9
#: Minimum number of surface points on the contact disc.
_MIN_POINTS = 20
#: Depths of surface points, divided by the target's depth.
_DEPTHS = (0.7, 1.5)


class HandOffOutcome(Enum):
    """Outcome of a hand-off. All members except HANDED_OFF are expected failures: the arm receives no target."""

    HANDED_OFF = "the arm has received the target"
    NOT_TRACKED = "the target is not tracked"
    NOT_AT_GOAL = "the rover is not at the commanded distance from the target"


@dataclass(frozen=True)
class ArmTarget:
    """Target for the arm: position in the rover frame and its 3-sigma error (Eq. 5), metres."""

    position_rover: Float[np.ndarray, "3"]
    error_m: float


@dataclass(frozen=True)
class HandOff:
    """Outcome of a hand-off, and the target; None if it was not handed off."""

    outcome: HandOffOutcome
    target: ArmTarget | None


@dataclass(frozen=True)
class GoalCriterion:
    """Goal of an approach: horizontal distance of the target from the rover's origin, and tolerance, metres."""

    distance_m: float
    tolerance_m: float

    def is_met(self, position_rover: Float[np.ndarray, "3"]) -> bool:
        """Whether a target at this position is at the commanded distance, within the tolerance."""
        return abs(float(np.hypot(position_rover[0], position_rover[1])) - self.distance_m) <= self.tolerance_m


def hand_off(update: TargetUpdate, goal: GoalCriterion, mast: MastCalibration) -> HandOff:
    """Hand the target off to the arm if it is tracked and the rover is at its goal.

    The error is computed for the drift `DRIFT_PX` and the range from the mast's elevation axis.
    """
    position = update.position_rover
    if not update.tracked or position is None:
        return HandOff(HandOffOutcome.NOT_TRACKED, None)
    if not goal.is_met(position):
        return HandOff(HandOffOutcome.NOT_AT_GOAL, None)
    axis = mast.geometry.base_m + np.array([0.0, 0.0, mast.geometry.elbow_m[2]])
    range_m = float(np.linalg.norm(position - axis))
    error = tracked_approach_error_m(
        # focal length times baseline is one argument, so the other one is 1
        stereo_range_error_m(range_m, disparity_px_m(mast.left, mast.right), 1.0),
        drift_error_m(range_m, mast.left.focal_lengths[0], DRIFT_PX),
    )
    return HandOff(HandOffOutcome.HANDED_OFF, ArmTarget(position, error))


class PlacementOutcome(Enum):
    """Outcome of a placement. PLACED and RESELECTED are successes."""

    PLACED = "the instrument is placed on the target"
    RESELECTED = "the instrument is placed on another position near the target"
    COLLISION = "at all positions near the target the tools would collide with the terrain"
    NO_SURFACE = "stereo measured too few points of the surface"


@dataclass(frozen=True)
class Placement:
    """Outcome of a placement, and position and outward normal of the contact disc, rover frame; None if not placed."""

    outcome: PlacementOutcome
    position_rover: Vector3 | None = None
    normal_rover: Vector3 | None = None


def measure_surface(measurements: RoverMeasurements, target_rover: Vector3) -> Points3:
    """Measure the surface around a target by dense stereo of the mast's pair, rover frame, metres."""
    left, right, mast = measurements.left, measurements.right, measurements.mast
    images, sizes = (left, right), [np.array(image.counts.shape[::-1]) for image in (left, right)]
    # one box that contains both subframes: the rectified images then have a common field of view
    corners = np.array([left.corner, right.corner])
    start = corners.min(axis=0)
    columns, rows = (corners + sizes).max(axis=0) - start
    counts = [np.zeros((rows, columns), dtype=np.uint16) for _ in images]
    for canvas, image, corner, size in zip(counts, images, corners - start, sizes, strict=True):
        canvas[corner[1] : corner[1] + size[1], corner[0] : corner[0] + size[0]] = image.counts
    rover_from_head = mast.geometry.rover_from_head(measurements.azimuth_rad, measurements.elevation_rad)
    box = int(start[0]), int(start[1]), (int(columns), int(rows))
    cameras = (mast.left.transform(rover_from_head).crop(*box), mast.right.transform(rover_from_head).crop(*box))
    pair = RectifiedPair.from_measurement(StereoMeasurement(counts[0], counts[1], cameras))
    depth = float((target_rover - pair.camera.c) @ pair.camera.a)
    return pair.points(_DEPTHS[0] * depth, _DEPTHS[1] * depth)


def cylinder_coordinates(
    surface: Points3, position: Vector3, normal: Vector3
) -> tuple[Float64[np.ndarray, "points"], Float64[np.ndarray, "points"]]:
    """Compute heights along `normal` above `position`, and distances from this axis, of surface points."""
    offsets = surface - position
    heights = offsets @ normal
    squares = np.einsum("na,na->n", offsets, offsets) - heights**2
    return heights, np.sqrt(np.maximum(squares, 0.0))


def tool_overlap_m(surface: Points3, position: Vector3, normal: Vector3) -> float:
    """Compute how far the surface protrudes beyond the tools with the contact disc at its median height under the disc.

    A positive overlap is a collision; negative values are the remaining clearance. NaN without points at the contact.
    """
    heights, distances = cylinder_coordinates(surface, position, normal)
    contact = heights[distances <= CONTACT_M]
    if not contact.size:
        return float("nan")
    return float(heights[distances <= TOOLS_M].max() - np.median(contact) - CLEARANCE_M)


def fit_plane(points: Points3, viewpoint: Vector3) -> tuple[Vector3, Vector3]:
    """Fit a plane by least squares; return its centre and the unit normal towards the viewpoint."""
    centre = points.mean(axis=0)
    *_, principal_axes = np.linalg.svd(points - centre, full_matrices=False)
    normal = principal_axes[-1]  # of least variance
    return centre, normal if normal @ (viewpoint - centre) > 0.0 else -normal


def place_instrument(surface: Points3, target: Vector3, viewpoint: Vector3) -> Placement:
    """Place the instrument at the position nearest to the target at which its tools do not collide.

    `surface` contains measured points, `viewpoint` is the position of the camera; all in the rover frame, metres.
    """
    reach_m = TOOLS_M + MAX_RESELECTION_M
    nearby = surface[np.linalg.norm(surface - target, axis=1) <= 2.0 * reach_m]
    around = nearby[np.linalg.norm(nearby - target, axis=1) <= TOOLS_M]
    if len(around) < _MIN_POINTS:
        return Placement(PlacementOutcome.NO_SURFACE)
    _, across = fit_plane(around, viewpoint)
    is_measured = False
    for offset in _offsets(across, MAX_RESELECTION_M):
        centre = target + offset
        contact = nearby[cylinder_coordinates(nearby, centre, across)[1] <= CONTACT_M]
        if len(contact) < _MIN_POINTS:
            continue
        is_measured = True
        point, normal = fit_plane(contact, viewpoint)
        position = centre + ((point - centre) @ normal) / (across @ normal) * across
        if tool_overlap_m(nearby, position, normal) <= 0.0:
            outcome = PlacementOutcome.PLACED if not np.any(offset) else PlacementOutcome.RESELECTED
            return Placement(outcome, position, normal)
    return Placement(PlacementOutcome.COLLISION if is_measured else PlacementOutcome.NO_SURFACE)


def _offsets(normal: Vector3, radius_m: float) -> Points3:
    """Create the offsets of a square grid within a radius, perpendicular to a normal, from near to far."""
    first = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    first /= np.linalg.norm(first)
    count = int((radius_m + _ROUNDING_M) / _SPACING_M)
    steps = _SPACING_M * np.arange(-count, count + 1)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    radii = np.hypot(*grid.T)
    grid = grid[np.argsort(radii, kind="stable")][: int(np.count_nonzero(radii <= radius_m + _ROUNDING_M))]
    return np.asarray(grid @ np.stack([first, np.cross(normal, first)]))
