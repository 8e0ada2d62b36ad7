"""Result columns of a landing case: tracks and motion, reported site and touchdown, compared with the truth.

Table I and section III are those of Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

from __future__ import annotations

import numpy as np

from marsyard.algorithms.hda import STAGES, HdaDetails
from marsyard.algorithms.interface import SiteEstimate, SiteOutcome
from marsyard.scenarios.hda_stage_columns import motion_errors, stage_row
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.landing.flight import LandingFlight
from marsyard.scenarios.landing.ground_truth import MIN_CLEARANCE_FRACTION, GroundTruth
from marsyard.scenarios.landing.images import Pair
from marsyard.scenarios.landing.touchdown import Touchdown, horizontal_distance_m

#: Maximum distance of a correct track from the true pixel, px.
MAX_TRACK_ERROR_PX = 1.0
#: Width of the border in which features need not be tracked, px.
BORDER_PX = 12.0
#: Minimum fraction of correct tracks, among the features in both images, of a well-tracked pair.
MIN_TRACKED_FRACTION = 0.9
#: Columns of tracks, motion, structure and map.
MOTION_COLUMNS = (
    "features", "tracks", "features_in_view", "tracks_correct", "tracked_fraction", "tracks_outlier_fraction",
    "inliers",
    "parallax_px", "rotation_error_deg", "direction_error_deg", "length_error_m", "baseline_error_fraction",
    "motion_residual_px", "points", "matched_fraction", "map_rows", "map_columns", "cell_m",
    "matches_dissimilar", "matches_out_of_bounds", "matches_inconsistent", "empty_fraction", "unknown_fraction",
)  # fmt: skip
#: Columns of the true ground under a lander; their prefix is the name of the position (`site`, `touchdown`).
GROUND_COLUMNS = ("east_m", "north_m", "slope_deg", "roughness_m", "hazard_distance_m", "margin")
#: Columns of the touchdown, in addition to those of the ground under it.
TOUCHDOWN_COLUMNS = (
    "touchdown_error_gps_m", "touchdown_error_estimated_m", "touchdown_error_m", "gps_sd_north_m",
    "gps_sd_east_m", "gps_solutions", "landing_iterations", "landing_path_change_m", "landing_after_s",
    "touchdown_sink_m_s", "touchdown_horizontal_speed_m_s",
)  # fmt: skip


def motion_row(details: object, flight: LandingFlight, pair: Pair) -> dict[str, Scalar]:
    """Compute the columns of tracks and motion errors; NaN for stages that were not reached."""
    row: dict[str, Scalar] = dict.fromkeys(MOTION_COLUMNS, np.nan)
    row["tracked_well"] = False
    if not isinstance(details, HdaDetails):
        return row
    if details.tracks is not None and len(details.tracks.first) == 0:
        row["features"] = 0
    elif details.tracks is not None:
        tracks = details.tracks
        column, row_index = np.rint(tracks.first).astype(np.int64).T
        # a delivered row is the sum of rendered rows, the middle of which represents it (as in `select_middle_rows`)
        rows_summed = pair.images[0].calibration.rows_summed
        rendered_row = row_index * rows_summed + rows_summed // 2
        points = pair.frames[0].points_world((rendered_row, column))
        camera = pair.images[1].camera.transform(flight.states[1].world_from_body)
        pixels, in_front = camera.project(points)
        with np.errstate(invalid="ignore"):
            in_view = np.all((pixels >= BORDER_PX) & (pixels <= np.array(camera.size) - 1.0 - BORDER_PX), axis=1)
            in_view &= in_front
            is_correct = tracks.accepted & in_view & (np.hypot(*(tracks.second - pixels).T) <= MAX_TRACK_ERROR_PX)
        accepted = int(tracks.accepted.sum())
        row |= {
            "features": len(tracks.first),
            "tracks": accepted,
            "features_in_view": int(in_view.sum()),
            "tracks_correct": int(is_correct.sum()),
            "tracked_fraction": float(is_correct.sum() / in_view.sum()) if np.any(in_view) else np.nan,
            "tracked_well": bool(np.any(in_view) and is_correct.sum() >= MIN_TRACKED_FRACTION * in_view.sum()),
            "tracks_outlier_fraction": float(np.mean(~is_correct[tracks.accepted])) if accepted else np.nan,
        }
    if details.motion is not None:
        row |= motion_errors(details.motion.second_from_first, flight.true_motion(pair.cameras))
    return row | stage_row(details)


def times_row(details: object) -> dict[str, Scalar]:
    """Compute the columns of processor times of the stages in Table I; NaN for stages that were not reached."""
    stage_times_s = details.times_s if isinstance(details, HdaDetails) else {}
    return {f"{stage}_time_s": stage_times_s.get(stage, np.nan) for stage in STAGES}


def outcome_row(estimate: SiteEstimate) -> dict[str, Scalar]:
    """Compute the outcome columns that select requirement populations; a crashed algorithm has no such columns."""
    return {
        "converged": estimate.outcome.converged,
        "site_reported": estimate.outcome is SiteOutcome.SAFE_SITE,
        "no_site_reported": estimate.outcome is SiteOutcome.NO_SAFE_SITE,
    }


def site_row(estimate: SiteEstimate, flight: LandingFlight, truth: GroundTruth) -> dict[str, Scalar]:
    """Compare the reported site with the ground truth.

    The true site is the reported site minus the navigation error at the first image. Only the outcome SAFE_SITE
    reports a site. If the algorithm did not converge, the helicopter descends to the a-priori site. The numbers of the
    site and `descent_target_safe` then describe the a-priori site, and `site_safe` is false.

    `answer_correct`: the site is safe, or no site is reported and no safe site with margin exists. Where only narrow
    sites exist, both answers are correct, because a narrow site leaves no margin for the errors of the algorithm.
    `site_clearance_fraction` is the distance of the reported site from the nearest position that is unsafe or whose
    footprint is not in both images, divided by the largest such distance; NaN without a site.
    `site_far_from_hazards`: it is at least `MIN_CLEARANCE_FRACTION`. The paper selects the safe site that is farthest
    from all hazards, which include the border of the map (section III). `site_hazard_distance_m` is the distance to the
    nearest unsafe position of the grid, in both images or not. `site_height_error_m` is the height of the reported site
    minus that of the ground, the mean of a lander's width; NaN without a reported site.
    """
    position = true_site(estimate, flight)
    row = _ground_row("site", position, truth)
    is_target_safe, reports_site = bool(row["site_safe"]), estimate.outcome is SiteOutcome.SAFE_SITE
    reports_safe_site, refuses = reports_site and is_target_safe, estimate.outcome is SiteOutcome.NO_SAFE_SITE
    clearance = height_error_m = np.nan
    if reports_site and position is not None and estimate.site_world is not None:
        clearance = truth.clearance_fraction(position)
        ground_m = float(truth.relief.average(position[None, None], truth.limits.diameter_m)[0, 0])
        height_error_m = float((estimate.site_world - flight.position_error_m)[2]) - ground_m
    return {
        **row,
        "site_safe": reports_safe_site,
        "descent_target_safe": is_target_safe,
        "safe_or_no_site_reported": reports_safe_site or refuses,
        "answer_correct": reports_safe_site or (refuses and not np.any(truth.safe_with_margin)),
        "site_clearance_fraction": clearance,
        "site_far_from_hazards": clearance >= MIN_CLEARANCE_FRACTION,
        "site_height_error_m": height_error_m,
    }


def true_site(estimate: SiteEstimate, flight: LandingFlight) -> np.ndarray | None:
    """Compute the true x, y of the reported site; None without a site."""
    return None if estimate.site_world is None else (estimate.site_world - flight.position_error_m)[:2]


def _ground_row(name: str, position: np.ndarray | None, truth: GroundTruth) -> dict[str, Scalar]:
    """Compute the columns of the true ground under a lander at a position (x, y)."""
    footprint = None if position is None else truth.footprint_at(position)
    if position is None or footprint is None:
        return {f"{name}_safe": False, **dict.fromkeys([f"{name}_{column}" for column in GROUND_COLUMNS], np.nan)}
    slope_rad, roughness_m, limits = float(footprint.slope_rad[0]), float(footprint.roughness_m[0]), truth.limits
    return {
        f"{name}_safe": bool(footprint.safe[0]),
        f"{name}_east_m": float(position[0]),
        f"{name}_north_m": float(position[1]),
        f"{name}_slope_deg": float(np.degrees(slope_rad)),
        f"{name}_roughness_m": roughness_m,
        f"{name}_hazard_distance_m": truth.distance_to_hazard_m(position),
        # smaller of the two relative margins: 0.2 if slope or roughness is at 80 % of its limit
        f"{name}_margin": 1.0 - max(slope_rad / limits.max_slope_rad, roughness_m / limits.max_roughness_m),
    }


def landing_row(
    touchdown: Touchdown | None, estimate: SiteEstimate, flight: LandingFlight, truth: GroundTruth
) -> dict[str, Scalar]:
    """Compute the columns of the touchdown and of the ground under it.

    `touchdown_error_gps_m` is the distance from the receiver's averaged solutions to the site's coordinates, as
    measured in the paper. `touchdown_error_m` is the distance from the true touchdown to the true site, which
    excludes the navigation error at the first image. `touchdown_safe` is true if the ground under the helicopter is
    safe. `touchdown_sink_m_s` and `touchdown_horizontal_speed_m_s` are the vertical and horizontal speeds at
    touchdown. `gps_solutions` is the number of averaged solutions; `gps_sd_north_m` and `gps_sd_east_m` are the
    means of the standard deviations that the receiver reports. `landing_after_s` is the time from the second image
    to touchdown. `landing_iterations` and `landing_path_change_m` are the number of iterations of flight and filter
    and the change of the path in the last iteration (`marsyard.scenarios.landing.touchdown`).
    `descent_target_exists`: the helicopter flies to a site. Without a touchdown, numbers are NaN; `touchdown_safe` is
    false if the helicopter flies to a site but does not touch down in time, and missing without such a flight.
    """
    site = estimate.site_world
    if touchdown is None or site is None:
        columns = (*(f"touchdown_{column}" for column in GROUND_COLUMNS), *TOUCHDOWN_COLUMNS)
        has_target = flight.transit is not None and site is not None
        flags = {"descent_target_exists": has_target, "landed": False}
        return {**flags, **({"touchdown_safe": False} if has_target else {}), **dict.fromkeys(columns, np.nan)}
    position, velocity = touchdown.state.position_m, touchdown.state.velocity_m_s
    gps_sd_east_m, gps_sd_north_m, _ = touchdown.gps_deviation_m
    ground_row = _ground_row("touchdown", position[:2], truth)
    return {
        "descent_target_exists": True,
        "landed": True,
        **ground_row,
        "touchdown_error_gps_m": horizontal_distance_m(touchdown.gps_m, site),
        "touchdown_error_estimated_m": horizontal_distance_m(touchdown.estimated_m, site),
        "touchdown_error_m": horizontal_distance_m(position, site - flight.position_error_m),
        "gps_sd_north_m": float(gps_sd_north_m),
        "gps_sd_east_m": float(gps_sd_east_m),
        "gps_solutions": touchdown.gps_solutions,
        "landing_iterations": touchdown.iterations,
        "landing_path_change_m": touchdown.path_change_m,
        "landing_after_s": touchdown.time_s - flight.states[1].time_s,
        "touchdown_sink_m_s": -float(velocity[2]),
        "touchdown_horizontal_speed_m_s": float(np.hypot(*velocity[:2])),
    }
