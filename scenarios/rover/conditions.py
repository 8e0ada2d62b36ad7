"""Columns of a run's conditions from the simulated objects, with the visibility of the designated point."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.vtt import VttOptions
from marsyard.algorithms.vtt.accuracy import GOAL_M, START_M
from marsyard.scenarios.condition_columns import sun_columns
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.rover import points
from marsyard.scenarios.rover.designation import is_on_edge
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.points import Vector, rover_shades_patch, sample_template
from marsyard.scenarios.rover.rig import Rig
from marsyard.scenarios.rover.run_state import RoverRun, StopView
from marsyard.scenarios.rover.score import errors_px, known_max
from marsyard.scenarios.rover.world import RunWorld


@dataclass(frozen=True)
class Visibility:
    """Visibility of a point of the rock along a run.

    Obliquity is the angle between the left camera's line of sight and the surface normal in the first template; it is 0
    face-on. The apparent width of a patch is proportional to the cosine of its obliquity: an increase by 10 deg reduces
    the width by a sixth near 45 deg and by a third near 65 deg. Scale and roll of a template do not compensate this.
    """

    in_view: bool  #: whether at every stop both cameras see the point, and it is not on an occluding edge
    obliquity_start_deg: float
    obliquity_max_deg: float


def evaluate_visibility(
    world: RunWorld, rig: Rig, point: Vector, heads: Sequence[RigidTransform], options: VttOptions
) -> Visibility:
    """Evaluate the visibility of a point on the rock from true poses of the mast's head, world axes."""
    half_rad, triangles = 0.5 * options.template_px * rig.pixel_rad, world.target_triangles
    cameras_m = [rig.camera_positions(head) for head in heads]
    normal = points.patch_normal(triangles, cameras_m[0][0], point, half_rad)
    to_cameras = np.array([left - point for left, _ in cameras_m])
    to_cameras /= np.linalg.norm(to_cameras, axis=1, keepdims=True)
    obliquity_deg = np.degrees(np.arccos(np.clip(to_cameras @ normal, -1.0, 1.0)))
    foot_m, spheres = float(world.rocks.position_m[world.target_number, 2]), points.enclosing_spheres(triangles)

    def is_clear(viewpoint: Vector) -> bool:
        nearby = triangles[points.spheres_near_line(spheres, viewpoint, point, half_rad)]
        is_occluded = points.find_self_occlusion(nearby, point[None], viewpoint)[0]
        return not is_occluded and not is_on_edge(nearby, foot_m, viewpoint, point, half_rad)

    in_view = all(is_clear(viewpoint) for pair in cameras_m for viewpoint in pair)
    return Visibility(in_view, float(obliquity_deg[0]), float(obliquity_deg.max()))


def fixed_conditions(p: RoverScenarioParameters, run: RoverRun) -> dict[str, Scalar]:
    """Compute the columns of conditions that do not depend on the tracker, from the simulated objects."""
    target, rocks, number = run.target, run.setup.world.rocks, run.setup.world.target_number
    azimuth_error, elevation_error = np.degrees(run.setup.rig.mast.zeros_rad)
    return {
        "site": p.world.site,
        "terrain": p.world.terrain,
        "camera": p.camera.name,
        "navcam": p.camera.name.endswith("navcam"),
        "pancam": p.camera.name.endswith("pancam"),
        "search_px": p.vtt.search_px,
        "rock_diameter_m": float(rocks.diameter_m[number]),
        "rock_height_m": float(rocks.height_m[number]),
        "point_on_edge": target.on_edge,
        "point_lit": target.lit,
        "selectable": target.lit and not target.on_edge,
        "incline": p.world.incline.name,
        "visual_odometry": any(leg.visual_odometry for leg in p.legs),
        "autonav": any(leg.autonav for leg in p.legs),
        "map_by": next((leg.map_by for leg in p.legs if leg.uses_map), "none"),
        "roll_compensated": p.vtt.roll and p.algorithm != "pure-ncc",
        "roll_ignored": not p.vtt.roll or p.algorithm == "pure-ncc",
        "clear_sky": p.clouds is None or p.clouds.cover == 0.0,
        "disparity_error_start_px": run.setup.rig.head.disparity_error_px(START_M),
        "disparity_error_goal_px": run.setup.rig.head.disparity_error_px(GOAL_M),
        "mast_azimuth_error_deg": float(azimuth_error),
        "mast_elevation_error_deg": float(elevation_error),
    }


def run_conditions(p: RoverScenarioParameters, run: RoverRun) -> dict[str, Scalar]:
    """Compute the columns of conditions that depend on the tracker's run, from the simulated objects."""
    stops, world = run.stops, run.setup.world
    drives = [drive for stop in stops for drive in stop.drives]
    lengths = np.array([drive.command.length_m for drive in drives])
    is_moving = lengths > 0.0
    slips = np.array([drive.slip for drive in drives])[is_moving]
    distance = float(lengths.sum())
    # at the first and the last stop: range, and time since the start of the run; at the last stop: pose error
    ranges, times, pose_error = (np.nan, np.nan), (0.0, 0.0), np.nan
    if stops:
        ranges, times = (stops[0].range_m, stops[-1].range_m), (stops[0].time_s, stops[-1].time_s)
        position_error = stops[-1].estimated_pose.translation - stops[-1].stance.world_from_rover.translation
        pose_error = float(np.linalg.norm(position_error))
    sun = [world.sun.direction(time_s) for time_s in times]
    exposures = np.array([stop.images.exposure_s for stop in stops], dtype=np.float64)
    return {
        "range_start_m": ranges[0],
        "range_end_m": ranges[1],
        "max_tilt_deg": float(np.degrees(known_max(np.array([stop.stance.tilt_rad for stop in stops])))),
        "distance_driven_m": distance,
        "slip_mean": float(np.sum(slips * lengths[is_moving]) / distance) if distance > 0.0 else 0.0,
        "slip_max": known_max(slips) if np.any(is_moving) else 0.0,
        "pose_error_m": pose_error,
        "pose_error_fraction": pose_error / distance if distance > 0.0 else np.nan,
        "duration_min": times[1] / 60.0,
        **sun_columns(sun[0]),
        "sun_motion_deg": float(np.degrees(np.arccos(np.clip(sun[0] @ sun[1], -1.0, 1.0)))),
        "min_exposure_s": -known_max(-exposures),  # minimum of the known values
        "max_exposure_s": known_max(exposures),
    }


def visibility_columns(p: RoverScenarioParameters, run: RoverRun) -> dict[str, Scalar]:
    """Compute the columns of the designated point's visibility at the stops of a run, and of the rover's shadow on it.

    The shadow is evaluated up to the first stop with a lost or falsely tracked point: later poses of the rover follow
    from the tracker's error. A run without stops has not lost sight of the point: it counts, as a failure, in the
    population of visible targets.
    """
    if not run.stops:
        obliquity = {"obliquity_start_deg": np.nan, "obliquity_max_deg": np.nan}
        return {"point_in_view": True, **obliquity, **shadow_columns(p, run, [])}
    heads = [stop.world_from_head for stop in run.stops]
    visibility = path_visibility(p, run, heads)
    # NaN (not tracked) is an error, too
    errors = np.nan_to_num(np.hypot(*errors_px(run).T), nan=np.inf) > p.score.false_track_px
    end = int(np.argmax(errors)) + 1 if np.any(errors) else len(run.stops)
    return {**visibility, **shadow_columns(p, run, run.stops[:end])}


def path_visibility(p: RoverScenarioParameters, run: RoverRun, heads: Sequence[RigidTransform]) -> dict[str, Scalar]:
    """Compute the columns of the designated point's visibility from poses of the mast's head; empty without poses."""
    if not heads:
        return {}
    columns = asdict(evaluate_visibility(run.setup.world, run.setup.rig, run.target.point_world, heads, p.vtt))
    return {"point_in_view": columns.pop("in_view"), **columns}


def shadow_columns(p: RoverScenarioParameters, run: RoverRun, views: Sequence[StopView]) -> dict[str, Scalar]:
    """Compute the columns of the rover's shadow: whether it is on the template of the designated point in any view."""
    half_angle, mast = 0.5 * p.vtt.template_px * run.setup.rig.pixel_rad, run.setup.rig.calibrated.geometry

    def is_in_shadow(view: StopView) -> bool:
        viewpoint = run.setup.rig.camera_positions(view.world_from_head)[0]
        patch = sample_template(viewpoint, run.target.point_world, half_angle)
        sun = run.setup.world.sun.direction(view.time_s)
        return rover_shades_patch(run.setup.vehicle.rover, view.stance, mast, view.angles_rad, patch, sun)

    is_shadowed = p.rover_shadow and any(is_in_shadow(view) for view in views)
    return {"rover_shadow_on_target": is_shadowed, "no_rover_shadow_on_target": not is_shadowed}
