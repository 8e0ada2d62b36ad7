"""Compute columns and products of a run: tracking errors, conditions of the simulated objects, arrays for figures.

Tables and figures are those of Kim et al., "Targeted Driving Using Visual Tracking".
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict

import numpy as np
from jaxtyping import Float64

from marsyard.algorithms.vtt.accuracy import GOAL_M, START_M, stereo_range_error_m
from marsyard.algorithms.vtt.stereo import disparity_px_m
from marsyard.scenarios.condition_columns import sun_columns
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.parts.scores import ScoredRun
from marsyard.scenarios.rover.closed_loop import RoverRun
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.points import rover_shades_patch, sample_template
from marsyard.scenarios.rover.stops import RunOutcome, StopView, evaluate_visibility

NAN = float("nan")
#: Quantities of each update, in the order of the columns of stored updates.
UPDATE_QUANTITIES = (
    "range_m", "azimuth_deg", "elevation_deg", "magnification", "roll_change_deg", "azimuth_change_deg",
    "match_score", "stereo_score", "correction_px", "error_px", "position_error_m", "leg", "time_s",
)  # fmt: skip
#: Columns of `tracking_row`: a quantity and its reduction over the updates.
REDUCTIONS: dict[str, tuple[str, Callable[[np.ndarray], float]]] = {
    "match_score_min": ("match_score", np.nanmin),
    "stereo_score_min": ("stereo_score", np.nanmin),
    "magnification_min": ("magnification", np.nanmin),
    "magnification_max": ("magnification", np.nanmax),
    "roll_change_max_deg": ("roll_change_deg", lambda values: np.nanmax(np.abs(values))),
    "azimuth_change_max_deg": ("azimuth_change_deg", lambda values: np.nanmax(np.abs(values))),
    "correction_max_px": ("correction_px", np.nanmax),
}


def errors_px(run: RoverRun) -> Float64[np.ndarray, "stops 2"]:
    """Compute tracked minus true pixels (u, v) of the designated point at all stops; NaN if it was not tracked."""
    errors = [stop.reported_px(run.setup.rig.calibrated) - stop.point_px for stop in run.stops]
    return np.stack(errors) if errors else np.empty((0, 2))


def score_run(p: RoverScenarioParameters, run: RoverRun) -> dict[str, Scalar]:
    """Compute the columns of tracking success and errors at the goal.

    - `tracked`: whether the run is completed and the last tracked pixel is within `tracked_px` of the true
      projection of the designated point
    - `target_held`: the same at the last stop of a run with any outcome, for example of a stuck rover
    - `stuck`, `mobile`: whether the rover hardly moved at the end (outcome STUCK), and the opposite
    - `position_error_m`: distance of the last reported position from the designated point; NaN if the run was not
      completed
    - `false_updates`: number of updates that report the target farther than `false_track_px` from the true projection
    """
    errors = errors_px(run)
    error_sizes_px = np.hypot(*errors.T)
    is_completed = run.outcome is RunOutcome.COMPLETED
    last_error_px, error_m, range_error, cross_error = np.full(2, np.nan), np.full(3, np.nan), NAN, NAN
    if is_completed:
        # components along the line of sight (positive: too far) and perpendicular to it
        stop, last_error_px = run.stops[-1], errors[-1]
        error_m = stop.error_m()
        viewpoint = stop.stance.world_from_rover.inv().apply(stop.world_from_head.apply(run.setup.rig.left.c.copy()))
        line_of_sight = stop.point_rover - viewpoint
        range_error = float(error_m @ line_of_sight / np.linalg.norm(line_of_sight))
        cross_error = float(np.sqrt(np.maximum(float(error_m @ error_m) - range_error * range_error, 0.0)))
    false_updates = int(np.count_nonzero(error_sizes_px > p.score.false_track_px))
    drift = float(np.hypot(*last_error_px))
    is_held = bool(len(error_sizes_px) and error_sizes_px[-1] <= p.score.tracked_px)
    is_tracked, is_stuck = is_completed and is_held, run.outcome is RunOutcome.STUCK
    loss_reasons = next((stop.update.losses for stop in run.stops if stop.update.losses), ())
    return {
        "tracked": is_tracked,
        "not_tracked": not is_tracked,
        "target_held": is_held,
        "stuck": is_stuck,
        "mobile": not is_stuck,
        "no_false_track": false_updates == 0,
        "false_updates": false_updates,
        "position_error_m": float(np.linalg.norm(error_m)),
        "range_error_m": range_error,
        "cross_error_m": cross_error,
        "drift_px": drift,
        "drift_u_px": float(last_error_px[0]),
        "drift_v_px": float(last_error_px[1]),
        "max_error_px": _finite_max(error_sizes_px),
        "track_margin_px": p.score.false_track_px - _finite_max(error_sizes_px),
        "losses": ", ".join(loss.name for loss in loss_reasons) or "none",
        "lost_range_m": next((stop.range_m for stop in run.stops if not stop.update.tracked), NAN),
        "handed_off": run.handed_off,
    }


def _finite_max(values: Float64[np.ndarray, "n"]) -> float:
    """Return the maximum; NaN without finite values."""
    return float(np.nanmax(values)) if np.any(np.isfinite(values)) else NAN


def tracking_row(run: RoverRun) -> dict[str, Scalar]:
    """Compute the columns of tracking: extremes of Table III's quantities, drift, and designation errors."""
    quantities = update_quantities(run)
    tracked_stops = [stop for stop in run.stops if stop.update.tracked]
    drift_m = designation_error = designation_3_sigma = NAN
    if tracked_stops:
        first_stop, last_stop = tracked_stops[0], tracked_stops[-1]
        first_m, last_m = (
            stop.estimated_pose.apply(np.asarray(stop.update.position_rover).copy()) for stop in (first_stop, last_stop)
        )
        drift_m = float(np.linalg.norm(last_m - first_m))
        designation_error = float(np.linalg.norm(first_stop.error_m()))
        scale = disparity_px_m(run.setup.rig.calibrated.left, run.setup.rig.calibrated.right)
        # for a 3-sigma disparity error of 1 px (paper); `scale` contains the baseline, so the third argument is 1
        designation_3_sigma = stereo_range_error_m(first_stop.range_m, scale, 1.0)
    return {
        "updates": len(run.stops),
        "lost_updates": len(run.stops) - len(tracked_stops),
        "visual_odometry_updates": run.visual_odometry_updates,
        "visual_odometry_failures": run.visual_odometry_failures,
        "autonav_updates": run.autonav_updates,
        **{
            column: float(reduce(quantities[name])) if np.any(np.isfinite(quantities[name])) else NAN
            for column, (name, reduce) in REDUCTIONS.items()
        },
        "roll_total_deg": float(np.nansum(quantities["roll_change_deg"])),
        "azimuth_total_deg": float(np.nansum(quantities["azimuth_change_deg"])),
        "target_motion_m": drift_m,
        "designation_error_m": designation_error,
        "designation_3_sigma_m": designation_3_sigma,
        "update_time_s": float(np.mean([stop.track_time_s for stop in run.stops])) if run.stops else NAN,
    }


def update_quantities(run: RoverRun) -> dict[str, Float64[np.ndarray, "stops"]]:
    """Collect the quantities of all updates in arrays; NaN if missing: for a tracker without details, for example."""
    rows = []
    for stop, error in zip(run.stops, errors_px(run), strict=True):
        azimuth, elevation = np.degrees(stop.angles_rad)
        row = {
            "range_m": stop.range_m,
            "azimuth_deg": float(azimuth),
            "elevation_deg": float(elevation),
            "error_px": float(np.hypot(*error)),
            "position_error_m": float(np.linalg.norm(stop.error_m())),
            "leg": float(stop.leg),
            "time_s": stop.time_s,
        }
        details = stop.details
        if details is not None and details.change is not None:
            row["magnification"] = details.change.magnification
            row["roll_change_deg"] = float(np.degrees(details.change.roll_rad))
        if details is not None and details.stereo is not None:
            row["stereo_score"] = details.stereo.score
        if details is not None and not details.seeded and stop.update.tracked:
            row["azimuth_change_deg"] = float(np.degrees(details.azimuth_change_rad))
        if details is not None and not details.seeded and details.match is not None:
            row["match_score"] = details.match.score
            if details.predicted_pixel is not None:
                row["correction_px"] = float(np.max(np.abs(details.match.pixel - details.predicted_pixel)))
        rows.append(row)
    return {name: np.array([row.get(name, NAN) for row in rows], dtype=np.float64) for name in UPDATE_QUANTITIES}


def update_columns(run: RoverRun, count: int) -> dict[str, Scalar]:
    """Compute the columns of the first updates (as in Table III), NaN for missing updates."""
    return {
        f"update_{number + 1}_{name}": float(values[number]) if number < len(values) else NAN
        for number in range(count)
        for name, values in update_quantities(run).items()
    }


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
        "map_by": next((leg.map_by for leg in p.legs if leg.autonav), "none"),
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
    # range and time at the first and last stop, pose error at the last stop
    ranges, times, pose_error = (NAN, NAN), (0.0, 0.0), NAN
    if stops:
        ranges, times = (stops[0].range_m, stops[-1].range_m), (stops[0].time_s, stops[-1].time_s)
        position_error = stops[-1].estimated_pose.translation - stops[-1].stance.world_from_rover.translation
        pose_error = float(np.linalg.norm(position_error))
    sun = [world.sun.direction(time_s) for time_s in times]
    exposures = np.array([stop.images.exposure_s for stop in stops], dtype=np.float64)
    return {
        "range_start_m": ranges[0],
        "range_end_m": ranges[1],
        "max_tilt_deg": float(np.degrees(_finite_max(np.array([stop.stance.tilt_rad for stop in stops])))),
        "distance_driven_m": distance,
        "slip_mean": float(np.sum(slips * lengths[is_moving]) / distance) if distance > 0.0 else 0.0,
        "slip_max": _finite_max(slips) if np.any(is_moving) else 0.0,
        "pose_error_m": pose_error,
        "pose_error_fraction": pose_error / distance if distance > 0.0 else NAN,
        "duration_min": times[1] / 60.0,
        **sun_columns(sun[0]),
        "sun_motion_deg": float(np.degrees(np.arccos(np.clip(sun[0] @ sun[1], -1.0, 1.0)))),
        "min_exposure_s": -_finite_max(-exposures),  # minimum of the finite values
        "max_exposure_s": _finite_max(exposures),
    }


def visibility_columns(p: RoverScenarioParameters, run: RoverRun) -> dict[str, Scalar]:
    """Compute the columns of the designated point's visibility at the stops of a run, and of the rover's shadow on it.

    Stops count up to the first one with a lost or falsely tracked point: later poses follow from the tracker's error.

    A run without stops has not lost sight of the point: it counts, as a failure, in the population of visible targets.
    """
    if not run.stops:
        obliquity = {"obliquity_start_deg": NAN, "obliquity_max_deg": NAN}
        return {"point_in_view": True, **obliquity, **shadow_columns(p, run, [])}
    heads = [stop.world_from_head for stop in run.stops]
    columns = asdict(evaluate_visibility(run.setup.world, run.setup.rig, run.target.point_world, heads, p.vtt))
    # NaN (not tracked) is an error, too
    errors = np.nan_to_num(np.hypot(*errors_px(run).T), nan=np.inf) > p.score.false_track_px
    end = int(np.argmax(errors)) + 1 if np.any(errors) else len(run.stops)
    return {"point_in_view": columns.pop("in_view"), **columns, **shadow_columns(p, run, run.stops[:end])}


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


def products(p: RoverScenarioParameters, run: RoverRun) -> dict[str, object]:
    """Collect the arrays for a run's figures (Figs. 15, 16b and 17 of the paper).

    ================== ================================================================================================
    stop_N_left        counts of the left subframe of stop N (from 1); `stop_N_right`: those of the right subframe
    stop_N_corners     full-frame (u, v) of the upper left pixels of both subframes, (2, 2)
    stop_N_window      search window in the left frame: (u, v) of its upper left pixel, columns, rows; or NaN
    stop_N_matches     tracked (u, v) in the left and the right frame, (2, 2); NaN if not tracked
    stop_N_point       (u, v) of the designated point's true projection in the left frame
    template_px        side of the template around `stop_N_matches`
    figures            arrays over the stops by name, see `update_quantities`
    states             the tracker's state at each stop
    rover_true_m       world positions of the rover's origin, (stops, 3); `rover_estimated_m`: estimated positions
    heading_deg        true azimuth of the rover at each stop, clockwise from north
    target_m           designated point, world, (3,); `target_estimated_m`: its estimated world position at each stop,
                       (stops, 3), NaN if not tracked
    path_true_m        world positions of the rover's origin along its path, (points, 2)
    rocks_m            east, north and diameter of the target's rock and the obstacles, (rocks, 3)
    ================== ================================================================================================
    """
    stops, rocks, rock_indices = run.stops, run.setup.world.rocks, list(run.setup.world.rocks.names.values())
    arrays: dict[str, object] = {}
    for number, stop in enumerate(stops, start=1):
        left, right, details = stop.images.left, stop.images.right, stop.details
        window, matched_px = np.full(4, np.nan), np.full((2, 2), np.nan)
        if details is not None and details.window is not None and details.window_corner is not None:
            window = np.array([*details.window_corner, *details.window.shape[::-1]], dtype=np.float64)
        matched_px[0] = stop.reported_px(run.setup.rig.calibrated)
        if details is not None and details.stereo is not None and stop.update.tracked:
            matched_px[1] = details.stereo.pixel
        stop_arrays = {
            "left": left.counts,
            "right": right.counts,
            "corners": np.array([left.corner, right.corner], dtype=np.float64),
            "window": window,
            "matches": matched_px,
            "point": stop.point_px,
        }
        arrays |= {f"stop_{number}_{name}": values for name, values in stop_arrays.items()}
    estimated_targets = [
        np.full(3, np.nan)
        if stop.reported_position_rover is None
        else stop.estimated_pose.apply(stop.reported_position_rover.copy())
        for stop in stops
    ]
    stances = [stance for stop in stops for drive in stop.drives for stance in drive.stances]
    path = [stance.world_from_rover.translation[:2] for stance in stances]
    arrays |= {
        "template_px": p.vtt.template_px,
        "figures": update_quantities(run),
        "states": [stop.update.state.name for stop in stops],
        "rover_true_m": np.array([stop.stance.world_from_rover.translation for stop in stops]).reshape(-1, 3),
        "rover_estimated_m": np.array([stop.estimated_pose.translation for stop in stops]).reshape(-1, 3),
        "heading_deg": np.degrees(np.array([stop.stance.azimuth_rad for stop in stops])),
        "target_m": run.target.point_world,
        "target_estimated_m": np.array(estimated_targets).reshape(-1, 3),
        "path_true_m": np.array(path).reshape(-1, 2),
        "rocks_m": np.column_stack([rocks.position_m[rock_indices, :2], rocks.diameter_m[rock_indices]]),
    }
    return arrays


def create_scored_run(run: RoverRun) -> ScoredRun:
    """Create the input of custom scores."""
    mast = run.setup.rig.calibrated
    return ScoredRun(
        outcome=run.outcome.name,
        target_world=run.target.point_world.copy(),
        world_from_rover=tuple(stop.stance.world_from_rover for stop in run.stops),
        point_px=np.array([stop.point_px for stop in run.stops]).reshape(-1, 2),
        measurements=tuple(stop.measurements(mast) for stop in run.stops),
        answers=tuple(stop.update for stop in run.stops),
    )
