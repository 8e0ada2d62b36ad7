"""Columns of a run: quantities of its updates, tracking success, and errors."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float64

from marsyard.algorithms.vtt import VttDetails
from marsyard.algorithms.vtt.accuracy import stereo_range_error_m
from marsyard.algorithms.vtt.stereo import disparity_px_m
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.parts.scores import ScoredRun
from marsyard.scenarios.rover.parameters import RoverScenarioParameters
from marsyard.scenarios.rover.run_state import RoverRun, RunOutcome, is_stuck

#: Quantities of each update, in the order of the columns of stored updates.
UPDATE_QUANTITIES = (
    "range_m", "azimuth_deg", "elevation_deg", "magnification", "roll_change_deg", "azimuth_change_deg",
    "match_score", "stereo_score", "correction_px", "error_px", "position_error_m", "leg", "time_s",
)  # fmt: skip


def errors_px(run: RoverRun) -> Float64[np.ndarray, "stops 2"]:
    """Compute reported minus true pixels (u, v) of the designated point at all stops, see `Stop.error_px`."""
    errors = [stop.error_px(run.setup.rig.calibrated) for stop in run.stops]
    return np.stack(errors) if errors else np.empty((0, 2))


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
        rows.append(row if stop.details is None else row | _match_quantities(stop.details, stop.update.tracked))
    return {name: np.array([row.get(name, np.nan) for row in rows], dtype=np.float64) for name in UPDATE_QUANTITIES}


def _match_quantities(details: VttDetails, tracked: bool) -> dict[str, float]:
    """Return the quantities of an update's matches: template changes, scores, and correction of the prediction."""
    row = {}
    if details.change is not None:
        row["magnification"] = details.change.magnification
        row["roll_change_deg"] = float(np.degrees(details.change.roll_rad))
    if details.stereo is not None:
        row["stereo_score"] = details.stereo.score
    if details.seeded:  # the first update has no earlier template
        return row
    if tracked:
        row["azimuth_change_deg"] = float(np.degrees(details.azimuth_change_rad))
    if details.match is not None:
        row["match_score"] = details.match.score
        if details.predicted_pixel is not None:
            row["correction_px"] = float(np.max(np.abs(details.match.pixel - details.predicted_pixel)))
    return row


def update_columns(run: RoverRun, count: int) -> dict[str, Scalar]:
    """Compute the columns of the first updates (as in Table III), NaN for missing updates."""
    quantities = update_quantities(run)
    return {
        f"update_{number + 1}_{name}": float(values[number]) if number < len(values) else np.nan
        for number in range(count)
        for name, values in quantities.items()
    }


def known_max(values: Float64[np.ndarray, "n"]) -> float:
    """Return the maximum of the values that are not NaN; NaN without such values."""
    return float(np.nanmax(values)) if not np.isnan(values).all() else np.nan


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


def score_run(p: RoverScenarioParameters, run: RoverRun) -> dict[str, Scalar]:
    """Compute the columns of tracking success and errors at the goal.

    - `tracked`: whether the run is completed and the last reported position, projected into the left image, is within
      `tracked_px` of the true projection of the designated point
    - `target_held`: the same at the last stop of a run with any outcome, for example of a stuck rover
    - `handed_off`: whether a tracked target was handed off to the arm
    - `stuck`, `mobile`: whether the true slip was above its limit (see `is_stuck`), with any outcome, and the opposite
    - `position_error_m`: distance of the last reported position from the designated point; NaN if the run was not
      completed
    - `false_updates`: number of updates that report the target farther than `false_track_px` from the true projection,
      or behind the camera
    """
    errors = errors_px(run)
    error_sizes_px = np.hypot(*errors.T)
    is_completed = run.outcome is RunOutcome.COMPLETED
    last_error_px, error_m, range_error, cross_error = np.full(2, np.nan), np.full(3, np.nan), np.nan, np.nan
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
    is_tracked, has_stuck_rover = is_completed and is_held, is_stuck(run.steps, p.mobility)
    loss_reasons = next((stop.update.losses for stop in run.stops if stop.update.losses), ())
    return {
        "tracked": is_tracked,
        "not_tracked": not is_tracked,
        "target_held": is_held,
        "stuck": has_stuck_rover,
        "mobile": not has_stuck_rover,
        "no_false_track": false_updates == 0,
        "false_updates": false_updates,
        "position_error_m": float(np.linalg.norm(error_m)),
        "range_error_m": range_error,
        "cross_error_m": cross_error,
        "drift_px": drift,
        "drift_u_px": float(last_error_px[0]),
        "drift_v_px": float(last_error_px[1]),
        "max_error_px": known_max(error_sizes_px),
        "track_margin_px": p.score.false_track_px - known_max(error_sizes_px),
        "losses": ", ".join(loss.name for loss in loss_reasons) or "none",
        "lost_range_m": next((stop.range_m for stop in run.stops if not stop.update.tracked), np.nan),
        "handed_off": run.handed_off and is_held,
    }


def tracking_row(run: RoverRun) -> dict[str, Scalar]:
    """Compute the columns of tracking: extremes of Table III's quantities, drift, and designation errors."""
    quantities = update_quantities(run)
    tracked_stops = [stop for stop in run.stops if stop.update.tracked]
    drift_m = designation_error = designation_3_sigma = np.nan
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
            column: float(reduce(quantities[name])) if np.any(np.isfinite(quantities[name])) else np.nan
            for column, (name, reduce) in REDUCTIONS.items()
        },
        "roll_total_deg": float(np.nansum(quantities["roll_change_deg"])),
        "azimuth_total_deg": float(np.nansum(quantities["azimuth_change_deg"])),
        "target_motion_m": drift_m,
        "designation_error_m": designation_error,
        "designation_3_sigma_m": designation_3_sigma,
        "update_time_s": float(np.mean([stop.track_time_s for stop in run.stops])) if run.stops else np.nan,
    }


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
