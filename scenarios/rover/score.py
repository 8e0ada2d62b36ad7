"""Columns and products of a run: tracking errors, conditions read from the simulated objects, arrays for figures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict

import numpy as np
from jaxtyping import Float64

from marsyard.algorithms.vtt.accuracy import GOAL_M, START_M, stereo_range_error_m
from marsyard.algorithms.vtt.stereo import disparity_px_m
from marsyard.scenarios.conditions import sun_columns
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.parts.scores import ScoredRun
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.points import rover_shades_patch, template_patch
from marsyard.scenarios.rover.run import Run
from marsyard.scenarios.rover.stops import RunOutcome, evaluate_visibility
from marsyard.sim.measurements import RoverMeasurements

NAN = float("nan")
#: Figures of each update, in the order of the columns of stored updates.
FIGURES = (
    "range_m", "azimuth_deg", "elevation_deg", "magnification", "roll_change_deg", "azimuth_change_deg",
    "match_score", "stereo_score", "correction_px", "error_px", "position_error_m", "leg", "time_s",
)  # fmt: skip
#: Columns of `tracking`: the figure and its reduction over the updates.
EXTREMES: dict[str, tuple[str, Callable[[np.ndarray], float]]] = {
    "match_score_min": ("match_score", np.nanmin),
    "stereo_score_min": ("stereo_score", np.nanmin),
    "magnification_min": ("magnification", np.nanmin),
    "magnification_max": ("magnification", np.nanmax),
    "roll_change_max_deg": ("roll_change_deg", lambda values: np.nanmax(np.abs(values))),
    "azimuth_change_max_deg": ("azimuth_change_deg", lambda values: np.nanmax(np.abs(values))),
    "correction_max_px": ("correction_px", np.nanmax),
}


def errors_px(run: Run) -> Float64[np.ndarray, "stops 2"]:
    """Tracked minus true pixel of the designated point at every stop, (u, v); NaN where it was not found."""
    errors = [stop.found_px(run.rig.calibrated) - stop.point_px for stop in run.stops]
    return np.stack(errors) if errors else np.empty((0, 2))


def score(p: RoverScenarioParameters, run: Run) -> dict[str, Scalar]:
    """Tracking success and errors at the goal.

    `tracked`: the run is completed and the last tracked pixel is within `tracked_px` of the true projection of the
    designated point. `position_error_m`: the last reported position minus the designated point, in the rover frame; NaN
    where the run was not completed. `false_updates`: updates that report the target further than `tracked_px` from the
    true projection.
    """
    errors = errors_px(run)
    sizes = np.hypot(*errors.T)
    completed = run.outcome is RunOutcome.COMPLETED
    last, error, along, across = np.full(2, np.nan), np.full(3, np.nan), NAN, NAN
    if completed:
        # components along the line of sight (positive: too far) and across it
        stop, last = run.stops[-1], errors[-1]
        error = stop.error_m()
        eye = stop.stance.world_from_rover.inv().apply(stop.world_from_head.apply(run.rig.left.c.copy()))
        sight = stop.point_rover - eye
        along = float(error @ sight / np.linalg.norm(sight))
        across = float(np.sqrt(np.maximum(float(error @ error) - along * along, 0.0)))
    false_updates = int(np.count_nonzero(sizes > p.score.tracked_px))
    drift = float(np.hypot(*last))
    tracked = completed and drift <= p.score.tracked_px
    losses = next((one.update.losses for one in run.stops if one.update.losses), ())
    return {
        "tracked": tracked,
        "not_tracked": not tracked,
        "true_track": false_updates == 0,
        "false_updates": false_updates,
        "position_error_m": float(np.linalg.norm(error)),
        "range_error_m": along,
        "cross_error_m": across,
        "drift_px": drift,
        "drift_u_px": float(last[0]),
        "drift_v_px": float(last[1]),
        "worst_error_px": _max(sizes),
        "losses": ", ".join(loss.name for loss in losses) or "none",
        "lost_range_m": next((one.range_m for one in run.stops if not one.update.found), NAN),
        "handed_over": run.handed_over,
    }


def _max(values: Float64[np.ndarray, "n"]) -> float:
    """The maximum; NaN without finite values."""
    return float(np.nanmax(values)) if np.any(np.isfinite(values)) else NAN


def tracking(run: Run) -> dict[str, Scalar]:
    """Table III's figures at their extremes, and the tracker's corrections."""
    figures = update_figures(run)
    sighted = [one for one in run.stops if one.update.found]
    drift_m = seed_error = seed_3_sigma = NAN
    if sighted:
        seed, last = (
            one.estimated.apply(np.asarray(one.update.position_rover).copy()) for one in (sighted[0], sighted[-1])
        )
        drift_m, seed_error = float(np.linalg.norm(last - seed)), float(np.linalg.norm(sighted[0].error_m()))
        scale = disparity_px_m(run.rig.calibrated.left, run.rig.calibrated.right)
        seed_3_sigma = stereo_range_error_m(sighted[0].range_m, scale, 1.0)
    return {
        "updates": len(run.stops),
        "lost_updates": len(run.stops) - len(sighted),
        "visual_odometry_updates": run.visual_odometry_updates,
        "autonav_updates": run.autonav_updates,
        **{
            column: float(reduce(figures[name])) if np.any(np.isfinite(figures[name])) else NAN
            for column, (name, reduce) in EXTREMES.items()
        },
        "roll_total_deg": float(np.nansum(figures["roll_change_deg"])),
        "azimuth_total_deg": float(np.nansum(figures["azimuth_change_deg"])),
        "target_motion_m": drift_m,
        "designation_error_m": seed_error,
        "designation_3_sigma_m": seed_3_sigma,
        "update_time_s": float(np.mean([one.track_time_s for one in run.stops])) if run.stops else NAN,
    }


def update_figures(run: Run) -> dict[str, Float64[np.ndarray, "stops"]]:
    """Figures of every update, one array each; NaN where a tracker reports no details, of a match also at the seed."""
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
        if details is not None and not details.seeded and stop.update.found:
            row["azimuth_change_deg"] = float(np.degrees(details.azimuth_change_rad))
        if details is not None and not details.seeded and details.match is not None:
            row["match_score"] = details.match.score
            if details.predicted_pixel is not None:
                row["correction_px"] = float(np.max(np.abs(details.match.pixel - details.predicted_pixel)))
        rows.append(row)
    return {name: np.array([row.get(name, NAN) for row in rows], dtype=np.float64) for name in FIGURES}


def stored_updates(run: Run, count: int) -> dict[str, Scalar]:
    """Figures of the first updates, a column each, NaN where there were fewer: for tables such as Table III."""
    return {
        f"update_{number + 1}_{name}": float(values[number]) if number < len(values) else NAN
        for number in range(count)
        for name, values in update_figures(run).items()
    }


def fixed_conditions(p: RoverScenarioParameters, run: Run) -> dict[str, Scalar]:
    """Conditions that do not depend on the tracker, read from the simulated objects."""
    target, rocks, number = run.target, run.world.rocks, run.world.target_number
    azimuth_error, elevation_error = np.degrees(run.rig.mast.zeros_rad)
    return {
        "site": p.world.site,
        "terrain": p.world.terrain,
        "camera": p.camera.name,
        "navcam": p.camera.name.endswith("navcam"),
        "pancam": p.camera.name.endswith("pancam"),
        "search_px": p.vtt.search_px,
        "rock_diameter_m": float(rocks.diameter_m[number]),
        "rock_height_m": float(rocks.height_m[number]),
        "rock_shape": int(rocks.shape[number]),
        "rock_yaw_deg": float(np.degrees(rocks.yaw_rad[number])),
        "point_across": p.target.across,
        "point_up": p.target.up,
        "point_on_edge": target.on_edge,
        "point_lit": target.lit,
        "selectable": target.lit and not target.on_edge,
        "incline": p.world.incline.name,
        "slope_deg": p.world.incline.slope_deg,
        "bearing_deg": float(np.degrees(p.bearing_rad)) % 360.0,
        "visual_odometry": any(leg.visual_odometry for leg in p.legs),
        "autonav": any(leg.autonav for leg in p.legs),
        "map_by": next((leg.map_by for leg in p.legs if leg.autonav), "none"),
        "roll_compensated": p.vtt.roll and p.algorithm != "pure-ncc",
        "roll_ignored": not p.vtt.roll or p.algorithm == "pure-ncc",
        "clear_sky": p.clouds is None or p.clouds.cover == 0.0,
        "disparity_error_start_px": run.rig.head.disparity_error_px(START_M),
        "disparity_error_goal_px": run.rig.head.disparity_error_px(GOAL_M),
        "mast_azimuth_error_deg": float(azimuth_error),
        "mast_elevation_error_deg": float(elevation_error),
    }


def run_conditions(p: RoverScenarioParameters, run: Run) -> dict[str, Scalar]:
    """Conditions along the run that the tracker led to, read from the simulated objects."""
    stops, world = run.stops, run.world
    drives = [drive for one in stops for drive in one.drives]
    lengths = np.array([drive.command.length_m for drive in drives])
    moving = lengths > 0.0
    slips = np.array([drive.slip for drive in drives])[moving]
    driven = float(lengths.sum())
    ranges, times, pose_error = (NAN, NAN), (0.0, 0.0), NAN
    if stops:
        ranges, times = (stops[0].range_m, stops[-1].range_m), (stops[0].time_s, stops[-1].time_s)
        position_error = stops[-1].estimated.translation - stops[-1].stance.world_from_rover.translation
        pose_error = float(np.linalg.norm(position_error))
    sun = [world.sun.direction(time_s) for time_s in times]
    exposures = np.array([one.pictures.exposure_s for one in stops], dtype=np.float64)
    shadowed = _is_rover_shadow_on_target(p, run)
    return {
        "rover_shadow_on_target": shadowed,
        "no_rover_shadow_on_target": not shadowed,
        "range_start_m": ranges[0],
        "range_end_m": ranges[1],
        "tilt_max_deg": float(np.degrees(_max(np.array([one.stance.tilt_rad for one in stops])))),
        "distance_driven_m": driven,
        "slip_mean": float(np.sum(slips * lengths[moving]) / driven) if driven > 0.0 else 0.0,
        "slip_max": _max(slips) if np.any(moving) else 0.0,
        "pose_error_m": pose_error,
        "pose_error_fraction": pose_error / driven if driven > 0.0 else NAN,
        "duration_min": times[1] / 60.0,
        **sun_columns(sun[0]),
        "sun_motion_deg": float(np.degrees(np.arccos(np.clip(sun[0] @ sun[1], -1.0, 1.0)))),
        "exposure_min_s": -_max(-exposures),
        "exposure_max_s": _max(exposures),
    }


def visibility_columns(p: RoverScenarioParameters, run: Run) -> dict[str, Scalar]:
    """Visibility of the designated point at the stops of a run."""
    if not run.stops:
        return {"point_in_view": False, "obliquity_start_deg": NAN, "obliquity_max_deg": NAN}
    heads = [stop.world_from_head for stop in run.stops]
    columns = asdict(evaluate_visibility(run.world, run.rig, run.target.point_world, heads, p.vtt))
    return {"point_in_view": columns.pop("in_view"), **columns}


def _is_rover_shadow_on_target(p: RoverScenarioParameters, run: Run) -> bool:
    """Whether the rover's shadow lay on the template up to the first stop at which the point was lost or mistracked.

    The path of the run after that is a consequence of the tracker's error.
    """
    reach, mast = 0.5 * p.vtt.template_px * run.rig.pixel_rad, run.rig.calibrated.geometry
    for stop, error in zip(run.stops, np.hypot(*errors_px(run).T), strict=True):
        eye = run.rig.eyes(stop.world_from_head)[0]
        patch = template_patch(eye, run.target.point_world, reach)
        sun = run.world.sun.direction(stop.time_s)
        if p.rover_shadow and rover_shades_patch(run.vehicle.rover, stop.stance, mast, stop.angles_rad, patch, sun):
            return True
        if not error <= p.score.tracked_px:
            return False
    return False


def products(p: RoverScenarioParameters, run: Run) -> dict[str, object]:
    """Collect the arrays for a run's figures (Figs. 15, 16b and 17 of the paper).

    ================== ================================================================================================
    stop_N_left        counts of the left subframe of stop N, from 1, and `stop_N_right` of the right one
    stop_N_corners     (u, v) of their upper left pixels in the full frames, (2, 2)
    stop_N_window      the search window in the left frame: (u, v) of its upper left pixel, columns, rows; NaN without
    stop_N_found       (u, v) found in the left and the right frame, (2, 2); NaN where not
    stop_N_point       (u, v) of the designated point's true projection in the left frame
    template_px        side of the template about `stop_N_found`
    figures            arrays over the stops by name, as `update_figures`
    states             the tracker's state at each stop
    rover_true_m       world positions of the rover's origin, (stops, 3); `rover_believed_m` as estimated
    heading_deg        true azimuth of the rover at each stop, clockwise from north
    target_m           designated point, world, (3,); `target_believed_m` as estimated at each stop in the world as
                       believed, (stops, 3), NaN where not found
    path_true_m        world positions of the rover's origin along its way, (points, 2)
    rocks_m            east, north and diameter of the target's rock and the obstacles, (rocks, 3)
    ================== ================================================================================================
    """
    stops, rocks, named = run.stops, run.world.rocks, list(run.world.rocks.names.values())
    arrays: dict[str, object] = {}
    for number, stop in enumerate(stops, start=1):
        left, right, details = stop.pictures.left, stop.pictures.right, stop.details
        window, matched_px = np.full(4, np.nan), np.full((2, 2), np.nan)
        if details is not None and details.window is not None and details.window_corner is not None:
            window = np.array([*details.window_corner, *details.window.shape[::-1]], dtype=np.float64)
        matched_px[0] = stop.found_px(run.rig.calibrated)
        if details is not None and details.stereo is not None and stop.update.found:
            matched_px[1] = details.stereo.pixel
        of_stop = {
            "left": left.counts,
            "right": right.counts,
            "corners": np.array([left.corner, right.corner], dtype=np.float64),
            "window": window,
            "found": matched_px,
            "point": stop.point_px,
        }
        arrays |= {f"stop_{number}_{name}": values for name, values in of_stop.items()}
    estimated = [
        np.full(3, np.nan) if stop.reported_rover is None else stop.estimated.apply(stop.reported_rover.copy())
        for stop in stops
    ]
    path = [
        stance.world_from_rover.translation[:2] for stop in stops for drive in stop.drives for stance in drive.stances
    ]
    arrays |= {
        "template_px": p.vtt.template_px,
        "figures": update_figures(run),
        "states": [stop.update.state.name for stop in stops],
        "rover_true_m": np.array([stop.stance.world_from_rover.translation for stop in stops]).reshape(-1, 3),
        "rover_believed_m": np.array([stop.estimated.translation for stop in stops]).reshape(-1, 3),
        "heading_deg": np.degrees(np.array([stop.stance.azimuth_rad for stop in stops])),
        "target_m": run.target.point_world,
        "target_believed_m": np.array(estimated).reshape(-1, 3),
        "path_true_m": np.array(path).reshape(-1, 2),
        "rocks_m": np.column_stack([rocks.position_m[named, :2], rocks.diameter_m[named]]),
    }
    return arrays


def scored_run(run: Run) -> ScoredRun:
    """The run as input of custom scores."""
    mast = run.rig.calibrated
    return ScoredRun(
        outcome=run.outcome.name,
        target_world=run.target.point_world.copy(),
        world_from_rover=tuple(stop.stance.world_from_rover for stop in run.stops),
        point_px=np.array([stop.point_px for stop in run.stops]).reshape(-1, 2),
        measurements=tuple(
            RoverMeasurements(stop.pictures.left, stop.pictures.right, mast, *stop.angles_rad, stop.estimated)
            for stop in run.stops
        ),
        answers=tuple(stop.update for stop in run.stops),
    )
