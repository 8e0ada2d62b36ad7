"""Result columns of a landing case: answer, map, site and touchdown, compared with the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.hda import STAGES, HdaDetails, MappedGround, Safety
from marsyard.algorithms.interface import SiteEstimate, SiteOutcome
from marsyard.scenarios.hda_stage_columns import motion_errors, stage_row
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.landing.flight import LandingFlight
from marsyard.scenarios.landing.ground_truth import GroundTruth
from marsyard.scenarios.landing.images import Pair
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.touchdown import Touchdown, horizontal_distance_m
from marsyard.sim.camera import camera_pose

#: Bounds of the classes of slope or roughness divided by its limit, and the names of the classes.
CLASS_BOUNDS = (1.0, 1.5, 2.0, 3.0)
CLASS_NAMES = ("below_1", "1_to_1.5", "1.5_to_2", "2_to_3", "above_3")
#: Gross (large) hazards: minimum diameter in map cells, and minimum roughness divided by its limit.
MIN_GROSS_CELLS, MIN_GROSS_ROUGHNESS = 3.0, 2.0
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
#: Minimum distance of a site from hazards, as a fraction of the distance of the farthest position.
MIN_CLEARANCE_FRACTION = 0.5
#: Columns of the true ground under a lander; their prefix is the name of the position (`site`, `touchdown`).
GROUND_COLUMNS = ("east_m", "north_m", "slope_deg", "roughness_m", "hazard_distance_m", "margin")
TOUCHDOWN_COLUMNS = (
    "touchdown_error_gps_m", "touchdown_error_estimated_m", "touchdown_error_m", "gps_sd_north_m",
    "gps_sd_east_m", "gps_solutions", "landing_iterations", "landing_path_change_m", "landing_after_s",
    "touchdown_sink_m_s", "touchdown_horizontal_speed_m_s",
)  # fmt: skip


@dataclass(frozen=True)
class SampledMap:
    """The algorithm's hazard map, sampled at the truth's grid positions."""

    #: whether the map has slope and roughness at the position, and both images show the whole footprint
    valid: Bool[np.ndarray, "rows columns"]
    safe: Bool[np.ndarray, "rows columns"]  #: whether the map classifies the position as safe
    flagged: Bool[np.ndarray, "rows columns"]  #: whether a hazard cell, before dilation, is under the lander
    slope_rad: Float[np.ndarray, "rows columns"]

    @classmethod
    def sample(
        cls, ground: MappedGround, flight: LandingFlight, truth: GroundTruth, limits: tuple[float, float]
    ) -> SampledMap:
        """Sample the map at the truth's positions; `limits`: the algorithm's slope (rad) and roughness (m) limits."""
        offsets = truth.positions - flight.states[0].position_m[:2]
        local = np.asarray(offsets @ ground.world_from_surface.as_matrix()[:2, :2])
        cells = np.rint(ground.elevation.cells(local)).astype(np.int64)
        shape = np.array(ground.elevation.elevation_m.shape)
        is_inside = np.all((cells >= 0) & (cells < shape), axis=-1) & truth.covered
        rows, columns = np.moveaxis(np.clip(cells, 0, shape - 1), -1, 0)
        hazards = ground.hazards
        with np.errstate(invalid="ignore"):
            is_hazard = (hazards.slope_rad > limits[0]) | (hazards.roughness_m > limits[1])
        radius = 0.5 * truth.limits.diameter_m / ground.elevation.cell_m
        flagged = distance_transform_edt(~is_hazard) <= radius if np.any(is_hazard) else np.zeros_like(is_hazard)
        slope = hazards.slope_rad[rows, columns]
        valid = is_inside & np.isfinite(slope) & np.isfinite(hazards.roughness_m[rows, columns])
        safe = valid & (hazards.safety[rows, columns] == Safety.SAFE)
        return cls(valid, safe, valid & flagged[rows, columns], slope)


def count_hazards(ground: MappedGround, sampled: SampledMap, truth: GroundTruth) -> dict[str, Scalar]:
    """Count footprints by truth and map; sums over cases give rates.

    Footprints are classified by roughness / limit and slope / limit. For each class:

    - `footprints_*`: number of footprints
    - `footprints_*_safe`: number that the map classifies as safe
    - `footprints_*_unflagged`: number without a hazard cell, before the algorithm dilates the hazard cells

    `footprints_called_safe` is the number of all footprints that the map classifies as safe, and
    `footprints_called_safe_unsafe` the number of these footprints that are truly unsafe.

    `gross_*` hazards have at least twice the roughness limit and a diameter of at least three cells. `false_alarms` are
    safe footprints with a hazard cell; `missed` are unsafe footprints without one.
    """
    footprints, valid, safe = truth.footprints, sampled.valid, sampled.safe
    ratios = {
        "roughness": footprints.roughness_m / truth.limits.max_roughness_m,
        "slope": footprints.slope_rad / truth.limits.max_slope_rad,
    }
    diameter_cells = 2.0 * np.sqrt(footprints.exceeding_m2 / np.pi) / ground.elevation.cell_m
    is_gross = footprints.roughness_m >= MIN_GROSS_ROUGHNESS * truth.limits.max_roughness_m
    is_gross &= diameter_cells >= MIN_GROSS_CELLS
    masks = {
        "footprints": valid,
        "footprints_called_safe": safe,
        "footprints_called_safe_unsafe": safe & ~footprints.safe,
        "footprints_truly_safe": valid & footprints.safe,
        "false_alarms": valid & footprints.safe & sampled.flagged,
        "missed": valid & ~footprints.safe & ~sampled.flagged,
        "gross_hazards": valid & is_gross,
        "gross_hazards_called_safe": safe & is_gross,
        "gross_hazards_unflagged": valid & is_gross & ~sampled.flagged,
    }
    for kind, ratio in ratios.items():
        classes = np.digitize(ratio, CLASS_BOUNDS)
        for number, name in enumerate(CLASS_NAMES):
            members = valid & (classes == number)
            column = f"footprints_{kind}_{name}"
            unflagged = members & ~sampled.flagged
            masks |= {column: members, f"{column}_safe": members & safe, f"{column}_unflagged": unflagged}
    return {column: int(np.count_nonzero(mask)) for column, mask in masks.items()}


def map_errors(
    ground: MappedGround, flight: LandingFlight, sampled: SampledMap, truth: GroundTruth
) -> dict[str, Scalar]:
    """Compute the errors of the map's elevation and slope.

    The reference elevation is the mean of the exact heights in a cell, relative to the camera. `bias` is the mean
    error, `rms` the RMS error, `median_error` the median absolute error. `noise` is the robust standard deviation of
    the errors about a fitted plane; it affects roughness. `relief_error_fraction` is `noise` divided by the same
    deviation of the exact heights: it is 1 for a plane, which needs no images, and 0 for an exact map. `outliers` is
    the fraction of errors about the plane beyond five times `noise`. The result is empty for fewer than four cells with
    an elevation.
    """
    rows, columns = np.indices(ground.elevation.elevation_m.shape)
    local = ground.elevation.positions(np.stack([rows, columns], axis=-1).astype(np.float64))
    start = flight.states[0].position_m
    positions = start[:2] + local @ ground.world_from_surface.as_matrix()[:2, :2].T
    exact = truth.relief.average(positions, ground.elevation.cell_m) - start[2]
    error = ground.elevation.elevation_m - exact
    is_finite = np.isfinite(error)
    values = error[is_finite]
    if values.size < 4:  # the fitted plane has three parameters
        return {}
    design = np.column_stack([local[is_finite], np.ones(values.size)])
    residuals = _subtract_plane(design, values)
    noise, relief = _robust_deviation(residuals), _robust_deviation(_subtract_plane(design, exact[is_finite]))
    slope_errors = (sampled.slope_rad - truth.footprints.slope_rad)[sampled.valid]
    has_slopes = slope_errors.size > 0
    return {
        "elevation_bias_m": float(values.mean()),
        "elevation_rms_m": float(np.sqrt(np.mean(values**2))),
        "elevation_median_error_m": float(np.median(np.abs(values))),
        "elevation_noise_m": noise,
        "relief_error_fraction": noise / relief,
        "elevation_outliers": float(np.mean(np.abs(residuals) > 5.0 * noise)),
        "slope_error_bias_deg": float(np.degrees(slope_errors.mean())) if has_slopes else np.nan,
        "slope_error_rms_deg": float(np.degrees(np.sqrt(np.mean(slope_errors**2)))) if has_slopes else np.nan,
    }


def _subtract_plane(design: Float[np.ndarray, "n 3"], values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Subtract the plane that is fitted to the values without their outliers, which are found about a first plane.

    An additional plane in the values does not change the result.
    """
    residuals = values - design @ np.linalg.lstsq(design, values, rcond=None)[0]
    is_inlier = np.abs(residuals - np.median(residuals)) <= 5.0 * _robust_deviation(residuals)
    return np.asarray(values - design @ np.linalg.lstsq(design[is_inlier], values[is_inlier], rcond=None)[0])


def _robust_deviation(values: Float[np.ndarray, "n"]) -> float:
    """Compute a robust standard deviation of at least 1e-12.

    It is 1.4826 times the median absolute deviation: the ratio of the two for a normal distribution.
    """
    return max(1.4826 * float(np.median(np.abs(values - np.median(values)))), 1e-12)


def true_motion(flight: LandingFlight, pair: Pair) -> RigidTransform:
    """Compute the true motion from the first to the second camera's frame."""
    first, second = (
        state.world_from_body * camera_pose(image.camera)
        for state, image in zip(flight.states, pair.images, strict=True)
    )
    return second.inv() * first


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
            "tracked_fraction": float(is_correct.sum() / in_view.sum()) if np.any(in_view) else np.nan,
            "tracked_well": bool(np.any(in_view) and is_correct.sum() >= MIN_TRACKED_FRACTION * in_view.sum()),
            "tracks_outlier_fraction": float(np.mean(~is_correct[tracks.accepted])) if accepted else np.nan,
        }
    if details.motion is not None:
        row |= motion_errors(details.motion.second_from_first, true_motion(flight, pair))
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
    `site_clearance_fraction` is the distance of the reported site from the nearest hazard in both images, divided by
    that of the farthest position; NaN without a site or without hazards. `site_far_from_hazards`: it is at least
    `MIN_CLEARANCE_FRACTION`. The paper selects the safe site that is farthest from all hazards (section III).
    """
    position = true_site(estimate, flight)
    row = _ground_row("site", position, truth)
    is_target_safe, reports_site = bool(row["site_safe"]), estimate.outcome is SiteOutcome.SAFE_SITE
    reports_safe_site, refuses = reports_site and is_target_safe, estimate.outcome is SiteOutcome.NO_SAFE_SITE
    clearance = truth.clearance_fraction(position) if reports_site and position is not None else np.nan
    return {
        **row,
        "site_safe": reports_safe_site,
        "descent_target_safe": is_target_safe,
        "safe_or_no_site_reported": reports_safe_site or refuses,
        "answer_correct": reports_safe_site or (refuses and not np.any(truth.safe_with_margin)),
        "site_clearance_fraction": clearance,
        "site_far_from_hazards": clearance >= MIN_CLEARANCE_FRACTION,
    }


def true_site(estimate: SiteEstimate, flight: LandingFlight) -> np.ndarray | None:
    """Compute the true x, y of the reported site; None without a site."""
    return None if estimate.site_world is None else (estimate.site_world - flight.position_error_m)[:2]


def _ground_row(name: str, position: np.ndarray | None, truth: GroundTruth) -> dict[str, Scalar]:
    """Compute the columns of the true ground under a lander at a position (x, y)."""
    columns = [f"{name}_{column}" for column in GROUND_COLUMNS]
    footprint = None if position is None else truth.footprint_at(position)
    if position is None or footprint is None:
        return {f"{name}_safe": False, **dict.fromkeys(columns, np.nan)}
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
        return {"landed": False, **dict.fromkeys(columns, np.nan)}
    position, velocity = touchdown.state.position_m, touchdown.state.velocity_m_s
    ground_row = _ground_row("touchdown", position[:2], truth)
    return {
        "landed": True,
        **ground_row,
        "touchdown_error_gps_m": horizontal_distance_m(touchdown.gps_m, site),
        "touchdown_error_estimated_m": horizontal_distance_m(touchdown.estimated_m, site),
        "touchdown_error_m": horizontal_distance_m(position, site - flight.position_error_m),
        "gps_sd_north_m": float(touchdown.gps_deviation_m[1]),
        "gps_sd_east_m": float(touchdown.gps_deviation_m[0]),
        "gps_solutions": touchdown.gps_solutions,
        "landing_iterations": touchdown.iterations,
        "landing_path_change_m": touchdown.path_change_m,
        "landing_after_s": touchdown.time_s - flight.states[1].time_s,
        "touchdown_sink_m_s": -float(velocity[2]),
        "touchdown_horizontal_speed_m_s": float(np.hypot(*velocity[:2])),
    }


def map_row(
    p: LandingScenarioParameters, estimate: SiteEstimate, flight: LandingFlight, truth: GroundTruth
) -> dict[str, Scalar]:
    """Compute the columns of map errors and hazard counts; only the relief error, NaN, without a map."""
    row: dict[str, Scalar] = {"relief_error_fraction": np.nan}
    if not isinstance(estimate.details, HdaDetails) or estimate.details.ground is None:
        return row
    ground = estimate.details.ground
    sampled_map = SampledMap.sample(ground, flight, truth, (p.hda.max_slope_rad, p.hda.max_roughness_m))
    return {**row, **map_errors(ground, flight, sampled_map, truth), **count_hazards(ground, sampled_map, truth)}
