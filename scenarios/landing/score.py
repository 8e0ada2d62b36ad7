"""Result columns and products of a landing case: errors of motion, map, site and landing; conditions; figure data.

Sections, figures and tables are those of Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.hda import STAGES, HdaDetails, hda_products
from marsyard.algorithms.interface import SiteEstimate, SiteOutcome
from marsyard.scenarios.condition_columns import contrast_columns, sun_columns
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.landing.flight import LandingFlight
from marsyard.scenarios.landing.ground_truth import GroundTruth
from marsyard.scenarios.landing.images import Pair
from marsyard.scenarios.landing.map_errors import SampledMap, count_hazards, map_errors
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.rendered_flight import RenderedFlight
from marsyard.scenarios.landing.touchdown import Touchdown, horizontal_distance_m
from marsyard.scenarios.landing_site import motion_errors, stage_row
from marsyard.sim.camera import camera_pose
from marsyard.sim.measurements import LandingMeasurements
from marsyard.sim.sensor import height_above_ground

NAN = float("nan")
#: Maximum distance of a correct track from the true pixel, px.
MAX_TRACK_ERROR_PX = 1.0
#: Width of the border in which features need not be tracked, px.
BORDER_PX = 12.0
#: Minimum fraction of correct tracks, among the features in both images, of a well-tracked pair.
MIN_TRACKED_FRACTION = 0.9
#: Maximum changes between the images for tracking (section II.A): rotation about the optical axis and about each other
#: axis, and change of height as a fraction of the range along the optical axis.
MAX_ROLL_DEG, MAX_TILT_DEG, MAX_HEIGHT_CHANGE_FRACTION = 10.0, 20.0, 0.2
#: Minimum distance of a site from hazards, as a fraction of the distance of the farthest position.
MIN_CLEARANCE_FRACTION = 0.5
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
TOUCHDOWN_COLUMNS = (
    "touchdown_error_gps_m", "touchdown_error_estimated_m", "touchdown_error_m", "gps_sd_north_m",
    "gps_sd_east_m", "gps_solutions", "landing_iterations", "landing_path_change_m", "landing_after_s",
    "touchdown_sink_m_s", "touchdown_horizontal_speed_m_s",
)  # fmt: skip


def outcome_row(estimate: SiteEstimate) -> dict[str, Scalar]:
    """Compute the outcome columns that select requirement populations; a crashed algorithm has no such columns."""
    return {
        "converged": estimate.outcome.converged,
        "site_reported": estimate.outcome is SiteOutcome.SAFE_SITE,
        "no_site_reported": estimate.outcome is SiteOutcome.NO_SAFE_SITE,
    }


def site_populations(truth: GroundTruth) -> dict[str, Scalar]:
    """Classify the flight by its true ground: no safe site, only safe sites without margin, or safe sites with margin.

    The ground around a site with margin is safe up to a lander's radius. Exactly one of `no_safe_site_exists`,
    `narrow_site_exists` and `wide_site_exists` is true. `hazard_visible`: both images show an unsafe footprint, so that
    not every site is right.
    """
    has_safe_site, has_margin = bool(np.any(truth.safe)), bool(np.any(truth.safe_with_margin))
    return {
        "safe_site_exists": has_safe_site,
        "no_safe_site_exists": not has_safe_site,
        "narrow_site_exists": has_safe_site and not has_margin,
        "wide_site_exists": has_margin,
        "hazard_visible": bool(np.any(truth.visible_hazards)),
    }


def site_row(estimate: SiteEstimate, flight: LandingFlight, truth: GroundTruth) -> dict[str, Scalar]:
    """Compare the reported site with the ground truth.

    The true site is the reported site minus the navigation error at the first image. Only the outcome SAFE_SITE
    reports a site. If the algorithm did not converge, the helicopter descends to the a-priori site. The numbers of the
    site and `descent_target_safe` then describe the a-priori site, and `site_safe` is false.

    `answer_correct`: the site is safe, or no site is reported and no safe site with margin exists. Where only narrow
    sites exist, both answers are correct, because a narrow site leaves no margin for the errors of the algorithm.
    `site_clearance_fraction` is the distance of the reported site from the nearest hazard in both images, divided by
    that of the farthest position; NaN without a site or without hazards. `site_far_from_hazards`: it is at least
    `MIN_CLEARANCE_FRACTION`. The paper selects the safe site that is farthest from all hazards (section III).
    """
    position = _true_site(estimate, flight)
    row = _ground_row("site", position, truth)
    is_target_safe, reports_site = bool(row["site_safe"]), estimate.outcome is SiteOutcome.SAFE_SITE
    reports_safe_site, refuses = reports_site and is_target_safe, estimate.outcome is SiteOutcome.NO_SAFE_SITE
    clearance = truth.clearance_fraction(position) if reports_site and position is not None else NAN
    return {
        **row,
        "site_safe": reports_safe_site,
        "descent_target_safe": is_target_safe,
        "safe_or_no_site_reported": reports_safe_site or refuses,
        "answer_correct": reports_safe_site or (refuses and not np.any(truth.safe_with_margin)),
        "site_clearance_fraction": clearance,
        "site_far_from_hazards": clearance >= MIN_CLEARANCE_FRACTION,
    }


def _true_site(estimate: SiteEstimate, flight: LandingFlight) -> np.ndarray | None:
    """Compute the true x, y of the reported site; None without a site."""
    return None if estimate.site_world is None else (estimate.site_world - flight.position_error_m)[:2]


def _ground_row(name: str, position: np.ndarray | None, truth: GroundTruth) -> dict[str, Scalar]:
    """Compute the columns of the true ground under a lander at a position (x, y)."""
    columns = [f"{name}_{column}" for column in GROUND_COLUMNS]
    footprint = None if position is None else truth.footprint_at(position)
    if position is None or footprint is None:
        return {f"{name}_safe": False, **dict.fromkeys(columns, NAN)}
    slope_deg, roughness_m = float(np.degrees(footprint.slope_rad[0])), float(footprint.roughness_m[0])
    # smaller of the two relative margins: 0.2 if slope or roughness is at 80 % of its limit
    limits = truth.limits
    margin = 1.0 - max(float(footprint.slope_rad[0]) / limits.max_slope_rad, roughness_m / limits.max_roughness_m)
    values = (*map(float, position), slope_deg, roughness_m, truth.distance_to_hazard_m(position), margin)
    return {f"{name}_safe": bool(footprint.safe[0]), **dict(zip(columns, values, strict=True))}


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
    and the change of the path in the last iteration (`marsyard.scenarios.landing.touchdown`). Without a touchdown,
    numbers are NaN, and `touchdown_safe` is missing.
    """
    site = estimate.site_world
    if touchdown is None or site is None:
        columns = (*(f"touchdown_{column}" for column in GROUND_COLUMNS), *TOUCHDOWN_COLUMNS)
        return {"landed": False, **dict.fromkeys(columns, NAN)}
    position, velocity = touchdown.state.position_m, touchdown.state.velocity_m_s
    numbers = (
        horizontal_distance_m(touchdown.gps_m, site),
        horizontal_distance_m(touchdown.estimated_m, site),
        horizontal_distance_m(position, site - flight.position_error_m),
        float(touchdown.gps_deviation_m[1]),
        float(touchdown.gps_deviation_m[0]),
        touchdown.gps_solutions,
        touchdown.iterations,
        touchdown.path_change_m,
        touchdown.time_s - flight.states[1].time_s,
        -float(velocity[2]),
        float(np.hypot(*velocity[:2])),
    )
    ground_row = _ground_row("touchdown", position[:2], truth)
    return {"landed": True, **ground_row, **dict(zip(TOUCHDOWN_COLUMNS, numbers, strict=True))}


def true_motion(flight: LandingFlight, pair: Pair) -> RigidTransform:
    """Compute the true motion from the first to the second camera's frame."""
    first, second = (
        state.world_from_body * camera_pose(image.camera)
        for state, image in zip(flight.states, pair.images, strict=True)
    )
    return second.inv() * first


def motion_row(details: object, flight: LandingFlight, pair: Pair) -> dict[str, Scalar]:
    """Compute the columns of tracks and motion errors; NaN for stages that were not reached."""
    row: dict[str, Scalar] = dict.fromkeys(MOTION_COLUMNS, NAN)
    row["tracked_well"] = False
    if not isinstance(details, HdaDetails):
        return row
    if details.tracks is not None and len(details.tracks.first) == 0:
        row["features"] = 0
    elif details.tracks is not None:
        tracks = details.tracks
        column, row_index = np.rint(tracks.first).astype(np.int64).T
        points = pair.frames[0].points_world((row_index * pair.images[0].calibration.rows_summed, column))
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
            "tracked_fraction": float(is_correct.sum() / in_view.sum()) if np.any(in_view) else NAN,
            "tracked_well": bool(np.any(in_view) and is_correct.sum() >= MIN_TRACKED_FRACTION * in_view.sum()),
            "tracks_outlier_fraction": float(np.mean(~is_correct[tracks.accepted])) if accepted else NAN,
        }
    if details.motion is not None:
        row |= motion_errors(details.motion.second_from_first, true_motion(flight, pair))
    return row | stage_row(details)


def times_row(details: object) -> dict[str, Scalar]:
    """Compute the columns of processor times of the stages in Table I; NaN for stages that were not reached."""
    stage_times_s = details.times_s if isinstance(details, HdaDetails) else {}
    return {f"{stage}_time_s": stage_times_s.get(stage, NAN) for stage in STAGES}


def map_row(
    p: LandingScenarioParameters, estimate: SiteEstimate, flight: LandingFlight, truth: GroundTruth
) -> dict[str, Scalar]:
    """Compute the columns of map errors and hazard counts; only the relief error, NaN, without a map."""
    row: dict[str, Scalar] = {"relief_error_fraction": NAN}
    if not isinstance(estimate.details, HdaDetails) or estimate.details.ground is None:
        return row
    ground = estimate.details.ground
    sampled_map = SampledMap.sample(ground, flight, truth, (p.hda.max_slope_rad, p.hda.max_roughness_m))
    return {**row, **map_errors(ground, flight, sampled_map, truth), **count_hazards(ground, sampled_map, truth)}


def conditions(case: RenderedFlight, measurements: LandingMeasurements) -> dict[str, Scalar]:
    """Compute the columns of a case's conditions from the simulated objects."""
    p, pair, truth = case.p, case.pair, case.truth
    covered = truth.covered
    slopes = truth.footprints.slope_rad[covered]
    # the paper's limits of tracking (section II.A); pitch, yaw and roll are the components of the rotation vector about
    # the x, y and optical axes of the camera
    pitch, yaw, roll = np.degrees(np.abs(true_motion(case.flight, pair).rotation.as_rotvec()))
    # height and vertical at the first image; motion and rotation vector, body axes, to the second image
    first, second = case.flight.states
    motion = second.position_m - first.position_m
    positions = np.stack([first.position_m, second.position_m])
    height = float(height_above_ground(case.world.ground.surface, positions)[0])
    up = first.attitude.inv().apply(np.array([0.0, 0.0, 1.0]))
    rotation_deg = (first.attitude.inv() * second.attitude).as_rotvec(degrees=True)
    # the tolerances include flights that are exactly at the limits
    within_limits = (
        roll < MAX_ROLL_DEG + 0.5
        and max(pitch, yaw) < MAX_TILT_DEG + 0.5
        and abs(float(motion[2])) < (MAX_HEIGHT_CHANGE_FRACTION + 0.01) * pair.axis_range_m
    )
    return {
        "site": p.site,
        "terrain": p.location.terrain,
        **p.faults.columns,
        **sun_columns(case.world.sun.direction),
        "height_m": height,
        "baseline_m": float(np.linalg.norm(motion)),
        "height_change_fraction": float(motion[2] / height),
        "baseline_fraction": float(np.hypot(*motion[:2]) / height),
        "pair_rotation_deg": float(np.linalg.norm(rotation_deg)),
        **{f"{axis}_deg": float(angle) for axis, angle in zip(("pitch", "yaw", "roll"), rotation_deg, strict=True)},
        "off_nadir_deg": float(np.degrees(np.arccos(np.clip(up[2], -1.0, 1.0)))),
        "exposure_s": pair.images[0].calibration.exposure_s,
        "image_median_dn": float(np.median(pair.counts[0])),
        "range_m": pair.axis_range_m,
        "range_error_m": measurements.slant_range_m - pair.axis_range_m,
        **_navigation_errors(case.flight, measurements),
        "covered_m2": float(covered.sum() * truth.step_m**2),
        **site_populations(truth),
        "true_safe_fraction": float(truth.safe.sum() / max(int(covered.sum()), 1)),
        "within_limits": bool(within_limits),
        "true_slope_median_deg": float(np.degrees(np.median(slopes))) if slopes.size else NAN,
        "max_slope_deg": float(np.degrees(p.hda.max_slope_rad)),
        "max_roughness_m": p.hda.max_roughness_m,
        "strict_threshold": p.hda.max_roughness_m <= truth.limits.max_roughness_m,
        **contrast_columns(pair.counts[0], p.detector),
    }


def _navigation_errors(flight: LandingFlight, measurements: LandingMeasurements) -> dict[str, Scalar]:
    """Compute the columns of the errors of inclinometers and poses."""
    states, poses = flight.states, flight.poses
    first, second = (
        (pose.world_from_body.rotation * state.attitude.inv()).as_rotvec()
        for pose, state in zip(poses, states, strict=True)
    )
    up = states[0].attitude.inv().apply(np.array([0.0, 0.0, 1.0]))
    level_error = float(np.arccos(np.clip(up @ measurements.up_body, -1.0, 1.0)))
    motion_error = np.array(poses[1].world_from_body.translation) - states[1].position_m - flight.position_error_m
    return {
        "level_error_deg": float(np.degrees(level_error)),
        "pose_position_error_m": float(np.linalg.norm(flight.position_error_m)),
        "pose_motion_error_m": float(np.linalg.norm(motion_error)),
        "pose_tilt_error_deg": float(np.degrees(np.hypot(*first[:2]))),
        "pose_azimuth_error_deg": float(np.degrees(first[2])),
        "pose_rotation_error_deg": float(np.degrees(np.linalg.norm(second - first))),
    }


def products(case: RenderedFlight, estimate: SiteEstimate) -> dict[str, Any]:
    """Return the arrays for the case's figures.

    The arrays are those of `marsyard.algorithms.hda.hda_products` (Figs. 1-5 and 7), and:

    - `image_1`, `image_2`: the images;
    - `true_rotation`, `true_translation`: true motion from the first to the second camera's frame;
    - `true_positions`, `true_slope`, `true_roughness`, `true_safe`, `true_covered`: sampling grid of the truth,
      world axes;
    - `true_heights`, `true_corner`, `true_spacing`: exact heights, world axes (row i at y = corner[1] + i spacing);
    - `camera_true`, `camera_estimated`: body poses at the first image (4 x 4), true and estimated on board;
    - `limits`: the algorithm's limits of slope (radians) and roughness (metres), and the lander's diameter;
    - `site_true`: true x, y of the reported site (see `site_row`).
    """
    p, flight, pair, truth = case.p, case.flight, case.pair, case.truth
    arrays: dict[str, Any] = {"image_1": pair.counts[0], "image_2": pair.counts[1]}
    if isinstance(estimate.details, HdaDetails):
        arrays |= hda_products(estimate.details)
    second_from_first = true_motion(flight, pair)
    arrays |= {
        "true_rotation": second_from_first.rotation.as_matrix(),
        "true_translation": np.array(second_from_first.translation),
        "true_positions": truth.positions,
        "true_slope": truth.footprints.slope_rad,
        "true_roughness": truth.footprints.roughness_m,
        "true_safe": truth.footprints.safe,
        "true_covered": truth.covered,
        "true_heights": truth.relief.heights_m,
        "true_corner": np.array([truth.relief.west_m, truth.relief.south_m]),
        "true_spacing": np.array([truth.relief.spacing_m]),
        "camera_true": flight.states[0].world_from_body.as_matrix(),
        "camera_estimated": flight.poses[0].world_from_body.as_matrix(),
        "limits": np.array([p.hda.max_slope_rad, p.hda.max_roughness_m, truth.limits.diameter_m]),
    }
    site = _true_site(estimate, flight)
    return arrays if site is None else {**arrays, "site_true": site}
