"""Placement of the instrument at the end of a run, and its truth: collisions with the rendered rock (section 7.4)."""

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.arrays import Points3
from marsyard.algorithms.vtt.arm import Placement, PlacementOutcome, measure_surface, place_instrument, tool_overlap_m
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.rover.points import Vector, enclosing_spheres, ray_distances, sight_axes, spheres_near_line
from marsyard.scenarios.rover.run_state import RoverRun
from marsyard.sim.measurements import MastCalibration, RoverMeasurements

#: Maximum distance of the placed instrument from the designated point, metres (section 4.2).
MAX_ERROR_M = 0.03
#: Spacing and half width of the true surface's grid of rays at the target, metres.
_SPACING_M, _HALF_WIDTH_M = 0.002, 0.12
#: Outcomes in which the instrument is placed.
_PLACED = (PlacementOutcome.PLACED, PlacementOutcome.RESELECTED)


def camera_position(mast: MastCalibration, rover_from_head: RigidTransform) -> Vector:
    """Compute the position of the left camera in the rover frame."""
    return np.asarray(rover_from_head.apply(mast.left.c.copy()))


def place_on_target(run: RoverRun) -> RoverRun:
    """Place the instrument on a target that was handed off to the arm; return the run."""
    target = run.stops[-1].update.position_rover if run.handed_off else None
    if target is not None:
        run.placement = auto_place(run.stops[-1].measurements(run.setup.rig.calibrated), np.asarray(target))
    return run


def auto_place(measurements: RoverMeasurements, target_rover: Vector) -> Placement:
    """Measure the surface around the tracked target, and place the instrument on it; rover frame."""
    mast = measurements.mast
    head = mast.geometry.rover_from_head(measurements.azimuth_rad, measurements.elevation_rad)
    surface = measure_surface(measurements, target_rover)
    return place_instrument(surface, target_rover, camera_position(mast, head))


def sample_surface(run: RoverRun, viewpoint: Vector) -> Points3:
    """Sample the rock's surface around the designated point, as seen from a viewpoint; world axes, metres."""
    point = run.target.point_world
    _, right, up = sight_axes(point - viewpoint)
    steps = np.arange(-_HALF_WIDTH_M, _HALF_WIDTH_M + 0.5 * _SPACING_M, _SPACING_M)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    rays = point - viewpoint + grid @ np.stack([right, up])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    triangles = run.setup.world.target_triangles
    half_diagonal_rad = float(np.arctan(np.sqrt(2.0) * _HALF_WIDTH_M / np.linalg.norm(point - viewpoint)))
    nearby = triangles[spheres_near_line(enclosing_spheres(triangles), viewpoint, point, half_diagonal_rad)]
    distances = ray_distances(nearby, viewpoint, rays)
    is_hit = np.isfinite(distances)
    return np.asarray(viewpoint + distances[is_hit, None] * rays[is_hit])


def placement_truth(run: RoverRun) -> dict[str, Scalar]:
    """Compute whether a position near the designated point is free of collisions; for a run at its start."""
    mast, stance = run.setup.rig.calibrated, run.setup.vehicle.stance
    position = camera_position(mast, mast.geometry.rover_from_head(*run.setup.rig.state.readings_rad))
    viewpoint = np.asarray(stance.world_from_rover.apply(position))
    placement = place_instrument(sample_surface(run, viewpoint), run.target.point_world, viewpoint)
    return {"placeable": placement.outcome in _PLACED}


def placement_row(run: RoverRun) -> dict[str, Scalar]:
    """Compute the columns of the placement at the end of a run; NaN if the instrument was not placed.

    - `placed`: whether a position without a predicted collision was found
    - `reselection_m`: its distance from the tracked target
    - `placement_error_m`: its distance from the designated point, in the true rover frame
    - `tool_overlap_m`: true protrusion of the rock beyond the tools; positive: a collision
    - `placement_safe`: placed within 3 cm of the designated point, without a collision
    """
    placement = run.placement
    if placement is None or placement.position_rover is None or placement.normal_rover is None:
        lengths = dict.fromkeys(("reselection_m", "placement_error_m", "tool_overlap_m"), np.nan)
        return {"placed": False, "placement_safe": False, **lengths}
    stop = run.stops[-1]
    target, world_from_rover = stop.update.position_rover, stop.stance.world_from_rover
    position = np.asarray(world_from_rover.apply(placement.position_rover.copy()))
    normal = np.asarray(world_from_rover.rotation.apply(placement.normal_rover.copy()))
    viewpoint = run.setup.rig.camera_positions(stop.world_from_head)[0]
    overlap_m = tool_overlap_m(sample_surface(run, viewpoint), position, normal)
    error_m = float(np.linalg.norm(position - run.target.point_world))
    return {
        "placed": True,
        "reselection_m": float(np.linalg.norm(placement.position_rover - target)) if target is not None else np.nan,
        "placement_error_m": error_m,
        "tool_overlap_m": overlap_m,
        "placement_safe": error_m <= MAX_ERROR_M and overlap_m <= 0.0,
    }
