"""What is stored of a run: errors, conditions as read back from the simulated objects, what figures need."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from marsyard.algorithms.vtt.accuracy import stereo_range_error_m
from marsyard.algorithms.vtt.stereo import disparity_px_m
from marsyard.scenarios.conditions import rendered_as
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.parts.scores import ScoredRun
from marsyard.scenarios.rover.own_shadow import shades, template_patch
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.run import Run
from marsyard.scenarios.rover.stops import RunOutcome, Stop
from marsyard.scenarios.rover.target import sightings
from marsyard.sim.measurements import RoverMeasurements

_FULL_TURN_DEG = 360.0


def errors_px(run: Run) -> Float64[np.ndarray, "stops 2"]:
    """Place found less true projection of the designated point at every stop, (u, v) pixels; NaN where not found."""
    found = [stop.found_px(run.rig.calibrated) - stop.point_px for stop in run.stops]
    return np.stack(found) if found else np.empty((0, 2))


def score(p: RoverScenarioParameters, run: Run) -> dict[str, Scalar]:
    """How well the target was tracked, and how well it is known at the goal.

    `tracked`: the run is completed and the place found in the last picture is within `tracked_px` of the true
    projection of the designated point. `position_error_m`: the last reported position less the designated point, in the
    rover frame; NaN where the run was not completed. `false_track`: an update reported the target further than
    `tracked_px` from the true projection.
    """
    errors = errors_px(run)
    sizes = np.hypot(*errors.T)
    completed = run.outcome is RunOutcome.COMPLETED
    last = errors[-1] if completed else np.full(2, np.nan)
    stop = run.stops[-1] if run.stops else None
    error = stop.error_m() if completed and stop is not None else np.full(3, np.nan)
    false = int(np.count_nonzero(sizes > p.score.tracked_px))
    along, across = _along_sight(run, stop, error)
    drift = float(np.hypot(*last))
    return {
        "tracked": bool(completed and drift <= p.score.tracked_px),
        "not_tracked": not (completed and drift <= p.score.tracked_px),
        "true_track": false == 0,
        "false_updates": false,
        "position_error_m": float(np.linalg.norm(error)),
        "range_error_m": along,
        "cross_error_m": across,
        "drift_px": drift,
        "drift_u_px": float(last[0]),
        "drift_v_px": float(last[1]),
        "worst_error_px": _most(sizes),
        "losses": ", ".join(_losses(run.stops)) or "none",
        "lost_range_m": next((one.range_m for one in run.stops if not one.update.found), float("nan")),
        "handed_over": run.handed_over,
    }


def _along_sight(run: Run, stop: Stop | None, error: Float64[np.ndarray, "3"]) -> tuple[float, float]:
    """An error's parts along the line of sight (positive: too far) and across it."""
    if stop is None:
        return float("nan"), float("nan")
    eye = stop.stance.world_from_rover.inv().apply(stop.world_from_head.apply(run.rig.left.c.copy()))
    sight = stop.point_rover - eye
    along = float(error @ sight / np.linalg.norm(sight))
    return along, float(np.sqrt(max(float(error @ error) - along * along, 0.0))) if np.isfinite(along) else float("nan")


def _losses(stops: Sequence[Stop]) -> list[str]:
    """Names of what lost the target at the first stop that did."""
    for stop in stops:
        if stop.update.losses:
            return [loss.name for loss in stop.update.losses]
    return []


def _most(values: Float64[np.ndarray, "n"]) -> float:
    """The largest number; NaN where there is none."""
    return float(np.nanmax(values)) if np.any(np.isfinite(values)) else float("nan")


def _least(values: Float64[np.ndarray, "n"]) -> float:
    return -_most(-values)


def tracking(run: Run) -> dict[str, Scalar]:
    """What the tracker made of the run: Table III's figures at their extremes, and its corrections."""
    figures = update_figures(run)
    seed = next((one for one in run.stops if one.update.found), None)
    last = next((one for one in reversed(run.stops) if one.update.found), None)
    moved = float("nan")
    if seed is not None and last is not None:
        places = [one.estimated.apply(np.asarray(one.update.position_rover).copy()) for one in (seed, last)]
        moved = float(np.linalg.norm(places[1] - places[0]))
    seed_error = float("nan") if seed is None else float(np.linalg.norm(seed.error_m()))
    scale = disparity_px_m(run.rig.calibrated.left, run.rig.calibrated.right)
    return {
        "updates": len(run.stops),
        "lost_updates": sum(not one.update.found for one in run.stops),
        "visual_odometry_updates": run.visual_odometry_updates,
        "autonav_updates": run.autonav_updates,
        "match_score_min": _least(figures["match_score"]),
        "stereo_score_min": _least(figures["stereo_score"]),
        "magnification_min": _least(figures["magnification"]),
        "magnification_max": _most(figures["magnification"]),
        "roll_change_max_deg": _most(np.abs(figures["roll_change_deg"])),
        "roll_total_deg": float(np.nansum(figures["roll_change_deg"])),
        "azimuth_change_max_deg": _most(np.abs(figures["azimuth_change_deg"])),
        "azimuth_total_deg": float(np.nansum(figures["azimuth_change_deg"])),
        "correction_max_px": _most(figures["correction_px"]),
        "target_moved_m": moved,
        "designation_error_m": seed_error,
        "designation_3_sigma_m": float("nan") if seed is None else stereo_range_error_m(seed.range_m, scale, 1.0),
        "update_time_s": float(np.mean([one.track_time_s for one in run.stops])) if run.stops else float("nan"),
    }


def update_figures(run: Run) -> dict[str, Float64[np.ndarray, "stops"]]:
    """Figures of every update, one array each; NaN where a tracker keeps no details or has nothing to say."""
    errors = errors_px(run)
    rows = [_figures(stop, error) for stop, error in zip(run.stops, errors, strict=True)]
    names = (
        "range_m", "azimuth_deg", "elevation_deg", "magnification", "roll_change_deg", "azimuth_change_deg",
        "match_score", "stereo_score", "correction_px", "error_px", "position_error_m", "leg", "time_s",
    )  # fmt: skip
    return {name: np.array([row[name] for row in rows], dtype=np.float64) for name in names}


def _figures(stop: Stop, error_px: Float64[np.ndarray, "2"]) -> dict[str, float]:
    nan = float("nan")
    figures = {
        "range_m": stop.range_m,
        "azimuth_deg": float(np.degrees(stop.angles_rad[0])),
        "elevation_deg": float(np.degrees(stop.angles_rad[1])),
        "error_px": float(np.hypot(*error_px)),
        "position_error_m": float(np.linalg.norm(stop.error_m())),
        "leg": float(stop.leg),
        "time_s": stop.time_s,
    }
    details = stop.details
    match, change = (None, None) if details is None else (details.match, details.change)
    seeded = details is None or details.seeded
    figures["magnification"] = nan if change is None else change.magnification
    figures["roll_change_deg"] = nan if change is None else float(np.degrees(change.roll_rad))
    figures["azimuth_change_deg"] = (
        nan if details is None or seeded or not stop.update.found else float(np.degrees(details.azimuth_change_rad))
    )
    figures["match_score"] = nan if match is None or seeded else match.score
    figures["stereo_score"] = nan if details is None or details.stereo is None else details.stereo.score
    corrected = match is not None and not seeded and details is not None and details.predicted_pixel is not None
    figures["correction_px"] = (
        float(np.max(np.abs(match.pixel - details.predicted_pixel))) if corrected else nan  # type: ignore[union-attr]
    )
    return figures


def stored_updates(run: Run, count: int) -> dict[str, Scalar]:
    """Figures of the first updates, a column each, NaN where there were fewer: for tables such as Table III."""
    figures = update_figures(run)
    row: dict[str, Scalar] = {}
    for number in range(count):
        for name, values in figures.items():
            row[f"update_{number + 1}_{name}"] = float(values[number]) if number < len(values) else float("nan")
    return row


def fixed_conditions(p: RoverScenarioParameters, run: Run) -> dict[str, Scalar]:
    """What is known of a run before its tracker is asked, read from the simulated objects."""
    chosen, rocks, number = run.target, run.world.rocks, run.world.target_number
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
        "point_on_edge": chosen.on_edge,
        "point_lit": chosen.lit,
        "selectable": chosen.lit and not chosen.on_edge,
        "incline": p.world.incline.name,
        "slope_deg": p.world.incline.slope_deg,
        "bearing_deg": float(np.degrees(p.bearing_rad)) % _FULL_TURN_DEG,
        "visual_odometry": any(leg.visual_odometry for leg in p.legs),
        "autonav": any(leg.autonav for leg in p.legs),
        "map_by": next((leg.map_by for leg in p.legs if leg.autonav), "none"),
        "roll_compensated": p.vtt.roll and p.algorithm != "pure-ncc",
        "roll_ignored": not p.vtt.roll or p.algorithm == "pure-ncc",
        "clear_sky": p.clouds is None or p.clouds.cover == 0.0,
        **run.rig.applied(),
    }


def run_conditions(p: RoverScenarioParameters, run: Run) -> dict[str, Scalar]:
    """What the run was like where its tracker led it, read from the simulated objects."""
    stops, world = run.stops, run.world
    first, last = stops[0] if stops else None, stops[-1] if stops else None
    tilts = np.array([one.stance.tilt_rad for one in stops])
    drives = [drive for one in stops for drive in one.drives]
    lengths = np.array([drive.command.length_m for drive in drives])
    slips = np.array([drive.slip for drive in drives])
    moving = lengths > 0.0
    driven = float(lengths.sum())
    pose_error = (
        float("nan")
        if last is None
        else float(np.linalg.norm(last.estimated.translation - last.stance.world_from_rover.translation))
    )
    sun = [world.sun.direction(0.0 if one is None else one.time_s) for one in (first, last)]
    shadowed = _own_shadow(p, run)
    return {
        "own_shadow": shadowed,
        "no_own_shadow": not shadowed,
        "range_start_m": float("nan") if first is None else first.range_m,
        "range_end_m": float("nan") if last is None else last.range_m,
        "tilt_max_deg": float(np.degrees(_most(tilts))),
        "driven_m": driven,
        "slip_mean": float(np.sum(slips[moving] * lengths[moving]) / driven) if driven > 0.0 else 0.0,
        "slip_max": _most(slips[moving]) if np.any(moving) else 0.0,
        "pose_error_m": pose_error,
        "pose_error_share": pose_error / driven if driven > 0.0 else float("nan"),
        "duration_min": 0.0 if last is None else last.time_s / 60.0,
        "sun_azimuth_deg": float(np.degrees(np.arctan2(sun[0][0], sun[0][1])) % _FULL_TURN_DEG),
        "sun_elevation_deg": float(np.degrees(np.arcsin(sun[0][2]))),
        "sun_moved_deg": float(np.degrees(np.arccos(np.clip(sun[0] @ sun[1], -1.0, 1.0)))),
        "exposure_min_s": _least(np.array([one.pictures.exposure_s for one in stops], dtype=np.float64)),
        "exposure_max_s": _most(np.array([one.pictures.exposure_s for one in stops], dtype=np.float64)),
    }


def sighted(p: RoverScenarioParameters, run: Run) -> dict[str, Scalar]:
    """How the designated point showed itself at the stops of a run (`Sightings`)."""
    eyes = [run.rig.eyes(one.world_from_head) for one in run.stops]
    if not eyes:
        return {"point_in_view": False, "obliquity_start_deg": float("nan"), "obliquity_max_deg": float("nan")}
    seen = sightings(run.world, run.target.point_world, eyes, run.rig.pixel_rad, p.vtt)
    return {
        "point_in_view": seen.in_view,
        "obliquity_start_deg": seen.obliquity_start_deg,
        "obliquity_max_deg": seen.obliquity_max_deg,
    }


def _own_shadow(p: RoverScenarioParameters, run: Run) -> bool:
    """Whether the rover's shadow lay on the template about the designated point before the tracker had gone wrong.

    Looked at are the stops up to the first at which the point was lost or reported elsewhere: where a run goes after
    that is the tracker's doing.
    """
    reach, mast = 0.5 * p.vtt.template_px * run.rig.pixel_rad, run.rig.calibrated.geometry
    for stop, error in zip(run.stops, np.hypot(*errors_px(run).T), strict=True):
        eye = run.rig.eyes(stop.world_from_head)[0]
        patch = template_patch(eye, run.target.point_world, reach)
        sun = run.world.sun.direction(stop.time_s)
        if p.rover_shadow and shades(run.vehicle.rover, stop.stance, mast, stop.angles_rad, patch, sun):
            return True
        if not error <= p.score.tracked_px:
            return False
    return False


def provenance(p: RoverScenarioParameters, run: Run) -> dict[str, Scalar]:
    """Hash of the pictures, and what their last bits depend on."""
    digest = hashlib.sha256(b"".join(stop.pictures.digest for stop in run.stops))
    return rendered_as(p.backend, digest.hexdigest())


def products(p: RoverScenarioParameters, run: Run) -> dict[str, object]:
    """Arrays from which a run's figures are drawn (Figs. 15, 16b and 17 of the paper).

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
    stops = run.stops
    kept: dict[str, object] = {}
    for number, stop in enumerate(stops, start=1):
        left, right, details = stop.pictures.left, stop.pictures.right, stop.details
        kept[f"stop_{number}_left"] = left.counts
        kept[f"stop_{number}_right"] = right.counts
        kept[f"stop_{number}_corners"] = np.array([left.corner, right.corner], dtype=np.float64)
        window = np.full(4, np.nan)
        if details is not None and details.window is not None and details.window_corner is not None:
            window = np.array([*details.window_corner, *details.window.shape[::-1]], dtype=np.float64)
        kept[f"stop_{number}_window"] = window
        found = np.full((2, 2), np.nan)
        found[0] = stop.found_px(run.rig.calibrated)
        if details is not None and details.stereo is not None and stop.update.found:
            found[1] = details.stereo.pixel
        kept[f"stop_{number}_found"] = found
        kept[f"stop_{number}_point"] = stop.point_px
    believed = [
        stop.estimated.apply(np.asarray(stop.update.position_rover).copy())
        if stop.update.found and stop.update.position_rover is not None
        else np.full(3, np.nan)
        for stop in stops
    ]
    path = [
        stance.world_from_rover.translation[:2] for stop in stops for drive in stop.drives for stance in drive.stances
    ]
    kept |= {
        "template_px": p.vtt.template_px,
        "figures": update_figures(run),
        "states": [stop.update.state.name for stop in stops],
        "rover_true_m": np.array([stop.stance.world_from_rover.translation for stop in stops]).reshape(-1, 3),
        "rover_believed_m": np.array([stop.estimated.translation for stop in stops]).reshape(-1, 3),
        "heading_deg": np.degrees(np.array([stop.stance.azimuth_rad for stop in stops])),
        "target_m": run.target.point_world,
        "target_believed_m": np.array(believed).reshape(-1, 3),
        "path_true_m": np.array(path).reshape(-1, 2),
        "rocks_m": run.world.placed_m,
    }
    return kept


def scored_run(run: Run) -> ScoredRun:
    """The run as a user's own scores are handed it."""
    known = run.rig.calibrated
    return ScoredRun(
        outcome=run.outcome.name,
        target_world=run.target.point_world.copy(),
        world_from_rover=tuple(stop.stance.world_from_rover for stop in run.stops),
        point_px=np.array([stop.point_px for stop in run.stops]).reshape(-1, 2),
        measurements=tuple(
            RoverMeasurements(stop.pictures.left, stop.pictures.right, known, *stop.angles_rad, stop.estimated)
            for stop in run.stops
        ),
        answers=tuple(stop.update for stop in run.stops),
    )
