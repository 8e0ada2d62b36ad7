"""Columns and products of a flight: motion, maps, site and landing against the truth; conditions; figure arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.hda import STAGES, Fate, HdaDetails, hda_products
from marsyard.algorithms.hda.motion import camera_pose
from marsyard.algorithms.interface import SiteEstimate, SiteOutcome
from marsyard.scenarios.conditions import sun_columns
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.landing.flight import Flight
from marsyard.scenarios.landing.helicopter import horizontal_distance_m, land
from marsyard.scenarios.landing.parameters import LandingScenarioParameters, stuck_range_m
from marsyard.scenarios.landing.pictures import GroundTruth, Pair, RenderedFlight, SampledMap, hazard_counts, map_errors
from marsyard.sim.dynamics.rotorcraft import GroundPatch
from marsyard.sim.measurements import LandingMeasurements
from marsyard.sim.sensor import height_above_ground
from marsyard.sim.sensor.ranging import RangingUnit
from marsyard.sim.streams import Streams

NAN = float("nan")
#: Maximum distance of a correct track from the true pixel.
CORRECT_PX = 1.0
#: Distance from the border within which features are not expected to be tracked.
BORDER_PX = 12.0
#: Minimum fraction of the features in both pictures to be tracked correctly.
WELL_TRACKED = 0.9
#: Reasons for dropped matches.
DROPPED = (Fate.DISSIMILAR, Fate.OUT_OF_BOUNDS, Fate.NOT_RETURNED)
#: Changes between pictures that tracking tolerates (section II.A): about the optical axis, about the others, of height.
MAX_ROLL_DEG, MAX_TILT_DEG, MAX_CLIMB = 10.0, 20.0, 0.2
#: Columns of tracks, motion, structure and map.
MOTION_COLUMNS = (
    "features", "tracks", "features_in_view", "tracks_correct", "tracked_fraction", "tracks_outlier_fraction",
    "inliers",
    "parallax_px", "rotation_error_deg", "direction_error_deg", "length_error_m", "baseline_error_fraction",
    "motion_residual_px", "points", "matched_fraction", "map_rows", "map_columns", "cell_m",
    "matches_dissimilar", "matches_out_of_bounds", "matches_not_returned",
)  # fmt: skip
#: Columns of the ground under a lander, after the name of the position.
PLACE_COLUMNS = ("east_m", "north_m", "slope_deg", "roughness_m", "hazard_distance_m")
TOUCHDOWN_COLUMNS = (
    "touchdown_error_gps_m", "touchdown_error_estimated_m", "touchdown_error_m", "gps_deviation_north_m",
    "gps_deviation_east_m", "gps_solutions", "landing_turns", "landing_moved_m", "landing_after_s",
    "touchdown_sink_m_s", "touchdown_drift_m_s",
)  # fmt: skip


def outcome_row(estimate: SiteEstimate) -> dict[str, Scalar]:
    """The outcome as populations of requirements; omitted for a crashed algorithm, whose case fails in each."""
    return {
        "converged": estimate.outcome.converged,
        "site_reported": estimate.outcome is SiteOutcome.SAFE_SITE,
        "no_site_reported": estimate.outcome is SiteOutcome.NO_SAFE_SITE,
    }


def site_populations(truth: GroundTruth) -> dict[str, Scalar]:
    """Populations by the true ground: no safe site, safe sites without margin only, or sites with a margin.

    A site with margin (`wide_site_exists`) has safe positions all around up to a lander's radius. Every flight is in
    one of `no_safe_site_exists`, `narrow_site_exists` and `wide_site_exists`.
    """
    safe, margin = bool(np.any(truth.safe)), bool(np.any(truth.safe_with_margin))
    return {
        "safe_site_exists": safe,
        "no_safe_site_exists": not safe,
        "narrow_site_exists": safe and not margin,
        "wide_site_exists": margin,
    }


def site_row(estimate: SiteEstimate, flight: Flight, truth: GroundTruth) -> dict[str, Scalar]:
    """The reported site against the truth.

    The true site is the reported one minus the navigation error at the first picture. Only SAFE_SITE reports a safe
    site: where the algorithm did not converge the a-priori site is scored.
    """
    row = _ground_row("site", _true_site(estimate, flight), truth)
    safe_reported = estimate.outcome is SiteOutcome.SAFE_SITE and bool(row["site_safe"])
    return {**row, "safe_or_no_site_reported": safe_reported or estimate.outcome is SiteOutcome.NO_SAFE_SITE}


def _true_site(estimate: SiteEstimate, flight: Flight) -> np.ndarray | None:
    """True x, y of the reported coordinates; None without a site."""
    return None if estimate.site_world is None else (estimate.site_world - flight.position_error_m)[:2]


def _ground_row(name: str, position: np.ndarray | None, truth: GroundTruth) -> dict[str, Scalar]:
    """The true ground under a lander at a position (x, y)."""
    columns = [f"{name}_{column}" for column in PLACE_COLUMNS]
    under = None if position is None else truth.under(position)
    if position is None or under is None:
        return {f"{name}_safe": False, **dict.fromkeys(columns, NAN)}
    slope_deg, roughness_m = float(np.degrees(under.slope_rad[0])), float(under.roughness_m[0])
    values = (*map(float, position), slope_deg, roughness_m, truth.distance_to_hazard_m(position))
    return {f"{name}_safe": bool(under.safe[0]), **dict(zip(columns, values, strict=True))}


def landing_row(
    p: LandingScenarioParameters, estimate: SiteEstimate, flight: Flight, truth: GroundTruth, streams: Streams
) -> dict[str, Scalar]:
    """The helicopter's touchdown, and the ground there.

    `touchdown_error_gps_m` is the distance of the receiver's averaged solutions from the site's coordinates, as the
    paper measured it; `touchdown_error_m` that of the true touchdown from the true site, with the navigation error at
    the first picture taken off; `touchdown_safe` whether it stands safely; `touchdown_sink_m_s` and
    `touchdown_drift_m_s` are its vertical and horizontal speed. Without a site or a helicopter there is no landing:
    numbers are NaN, and `touchdown_safe` is absent.
    """
    site, relief, landed = estimate.site_world, truth.relief, None
    if flight.transit is not None and site is not None:
        ground = GroundPatch(np.array([relief.west_m, relief.south_m]), relief.spacing_m, relief.heights_m)
        unit = RangingUnit.draw(p.laser, streams.generator("laser"))
        landed = land(flight.transit, site, ground, unit, streams, stuck_range_m(p.faults, p.height_m))
    if landed is None or site is None:
        columns = (*(f"touchdown_{column}" for column in PLACE_COLUMNS), *TOUCHDOWN_COLUMNS)
        return {"landed": False, **dict.fromkeys(columns, NAN)}
    position, velocity = landed.state.position_m, landed.state.velocity_m_s
    numbers = (
        horizontal_distance_m(landed.gps_m, site),
        horizontal_distance_m(landed.believed_m, site),
        horizontal_distance_m(position, site - flight.position_error_m),
        float(landed.gps_deviation_m[1]),
        float(landed.gps_deviation_m[0]),
        landed.gps_solutions,
        landed.iterations,
        landed.change_m,
        landed.time_s - flight.states[1].time_s,
        -float(velocity[2]),
        float(np.hypot(*velocity[:2])),
    )
    below = _ground_row("touchdown", position[:2], truth)
    return {"landed": True, **below, **dict(zip(TOUCHDOWN_COLUMNS, numbers, strict=True))}


def true_motion(flight: Flight, pair: Pair) -> RigidTransform:
    """The true motion from the first to the second camera's frame."""
    first, second = (
        state.world_from_body * camera_pose(image.camera)
        for state, image in zip(flight.states, pair.images, strict=True)
    )
    return second.inv() * first


def motion_row(details: object, flight: Flight, pair: Pair) -> dict[str, Scalar]:
    """Tracks, and the motion against the true one; NaN for stages that were not reached."""
    row: dict[str, Scalar] = dict.fromkeys(MOTION_COLUMNS, NAN)
    row["tracked_well"] = False
    if not isinstance(details, HdaDetails):
        return row
    if details.tracks is not None and len(details.tracks.first) == 0:
        row["features"] = 0
    elif details.tracks is not None:
        tracks = details.tracks
        column, line = np.rint(tracks.first).astype(np.int64).T
        points = pair.frames[0].points_world()[line * pair.images[0].calibration.rows_summed, column]
        camera = pair.images[1].camera.transform(flight.states[1].world_from_body)
        pixels, ahead = camera.project(points)
        with np.errstate(invalid="ignore"):
            inside = np.all((pixels >= BORDER_PX) & (pixels <= np.array(camera.size) - 1.0 - BORDER_PX), axis=1) & ahead
            right = tracks.accepted & inside & (np.hypot(*(tracks.second - pixels).T) <= CORRECT_PX)
        accepted = int(tracks.accepted.sum())
        row |= {
            "features": len(tracks.first),
            "tracks": accepted,
            "features_in_view": int(inside.sum()),
            "tracks_correct": int(right.sum()),
            "tracked_fraction": float(right.sum() / inside.sum()) if np.any(inside) else NAN,
            "tracked_well": bool(np.any(inside) and right.sum() >= WELL_TRACKED * inside.sum()),
            "tracks_outlier_fraction": float(np.mean(~right[tracks.accepted])) if accepted else NAN,
        }
    if details.motion is not None:
        row |= motion_errors(details.motion.second_from_first, true_motion(flight, pair))
    return row | solved_row(details)


def motion_errors(found: RigidTransform, true: RigidTransform) -> dict[str, Scalar]:
    """Errors of a motion from the first to the second camera's frame."""
    (a, length), (b, true_length) = (
        (np.array(motion.translation), float(np.linalg.norm(motion.translation))) for motion in (found, true)
    )
    direction = float(np.linalg.norm(a / length - b / true_length)) if length and true_length else NAN
    return {
        "rotation_error_deg": float(np.degrees((found.rotation * true.rotation.inv()).magnitude())),
        "direction_error_deg": float(np.degrees(2.0 * np.arcsin(min(direction / 2.0, 1.0)))),
        "length_error_m": length - true_length,
        "baseline_error_fraction": float(np.linalg.norm(a - b)) / true_length if true_length > 0.0 else NAN,
    }


def solved_row(details: HdaDetails) -> dict[str, Scalar]:
    """Inliers, matches and map size; without columns of stages that were not reached."""
    row: dict[str, Scalar] = {}
    if details.motion is not None:
        row |= {
            "inliers": int(details.motion.inliers.sum()),
            "parallax_px": details.motion.parallax_px,
            "motion_residual_px": float(np.median(details.motion.residuals_px)),
        }
    if details.matches is not None:
        matches = details.matches
        row |= {"points": len(matches.points), "matched_fraction": float(matches.accepted.mean())}
        row |= {f"matches_{fate.name.lower()}": int(np.sum(matches.fates == fate)) for fate in DROPPED}
    if details.ground is not None:
        rows, columns = details.ground.elevation.elevation_m.shape
        row |= {"map_rows": rows, "map_columns": columns, "cell_m": details.ground.elevation.cell_m}
    return row


def times_row(details: object) -> dict[str, Scalar]:
    """Processor time of the stages of Table I; NaN for stages that were not reached."""
    stage_times_s = details.times_s if isinstance(details, HdaDetails) else {}
    return {f"{stage}_time_s": stage_times_s.get(stage, NAN) for stage in STAGES}


def map_row(
    p: LandingScenarioParameters, estimate: SiteEstimate, flight: Flight, truth: GroundTruth
) -> dict[str, Scalar]:
    """The maps against the truth; empty without a map."""
    if not isinstance(estimate.details, HdaDetails) or estimate.details.ground is None:
        return {}
    ground = estimate.details.ground
    at = SampledMap.of(ground, flight, truth, (p.hda.max_slope_rad, p.hda.max_roughness_m))
    return {**map_errors(ground, flight, at, truth), **hazard_counts(ground, at, truth)}


def conditions(case: RenderedFlight, measurements: LandingMeasurements) -> dict[str, Scalar]:
    """Conditions of the case, read from the simulated objects."""
    p, pair, truth = case.p, case.pair, case.truth
    covered = truth.covered
    slopes = truth.footprints.slope_rad[covered]
    # the paper's limits of tracking (section II.A)
    pitch, yaw, roll = np.degrees(np.abs(true_motion(case.flight, pair).rotation.as_rotvec()))
    # height and attitude at the first picture, motion and rotation to the second
    first, second = case.flight.states
    motion = second.position_m - first.position_m
    positions = np.stack([first.position_m, second.position_m])
    height = float(height_above_ground(case.world.ground.surface, positions)[0])
    upright = first.attitude.inv().apply(np.array([0.0, 0.0, 1.0]))
    rotation_deg = (first.attitude.inv() * second.attitude).as_rotvec(degrees=True)
    within_limits = (
        roll < MAX_ROLL_DEG + 0.5
        and max(pitch, yaw) < MAX_TILT_DEG + 0.5
        and abs(float(motion[2])) < (MAX_CLIMB + 0.01) * pair.axis_range_m
    )
    return {
        "site": p.site,
        "terrain": p.location.terrain,
        **p.faults.columns,
        "location_east_m": p.location.east_m,
        "location_north_m": p.location.north_m,
        **sun_columns(case.world.sun.direction),
        "height_m": height,
        "baseline_m": float(np.linalg.norm(motion)),
        "height_change_fraction": float(motion[2] / height),
        "baseline_fraction": float(np.hypot(*motion[:2]) / height),
        "pair_rotation_deg": float(np.linalg.norm(rotation_deg)),
        **{f"{axis}_deg": float(angle) for axis, angle in zip(("pitch", "yaw", "roll"), rotation_deg, strict=True)},
        "off_nadir_deg": float(np.degrees(np.arccos(np.clip(upright[2], -1.0, 1.0)))),
        "exposure_s": pair.images[0].calibration.exposure_s,
        "picture_median_dn": float(np.median(pair.counts[0])),
        "range_m": pair.axis_range_m,
        "range_error_m": measurements.slant_range_m - pair.axis_range_m,
        **_navigation_errors(case.flight, measurements),
        "covered_m2": float(covered.sum() * truth.step_m**2),
        **site_populations(truth),
        "true_safe_fraction": float(truth.safe.sum() / max(int(covered.sum()), 1)),
        "within_limits": bool(within_limits),
        "true_slope_median_deg": float(np.degrees(np.median(slopes))) if slopes.size else NAN,
        "texture": p.texture,
        "grid_px": p.hda.grid_px,
        "max_slope_deg": float(np.degrees(p.hda.max_slope_rad)),
        "max_roughness_m": p.hda.max_roughness_m,
        "rocks_abundance": 0.0 if p.terrain.rocks is None else p.terrain.rocks.abundance,
    }


def _navigation_errors(flight: Flight, measurements: LandingMeasurements) -> dict[str, Scalar]:
    states, poses = flight.states, flight.poses
    first, second = (
        (pose.world_from_body.rotation * state.attitude.inv()).as_rotvec()
        for pose, state in zip(poses, states, strict=True)
    )
    upright = states[0].attitude.inv().apply(np.array([0.0, 0.0, 1.0]))
    level = float(np.arccos(np.clip(upright @ measurements.up_body, -1.0, 1.0)))
    motion_error = np.array(poses[1].world_from_body.translation) - states[1].position_m - flight.position_error_m
    return {
        "level_error_deg": float(np.degrees(level)),
        "pose_position_error_m": float(np.linalg.norm(flight.position_error_m)),
        "pose_motion_error_m": float(np.linalg.norm(motion_error)),
        "pose_tilt_error_deg": float(np.degrees(np.hypot(*first[:2]))),
        "pose_azimuth_error_deg": float(np.degrees(first[2])),
        "pose_turn_error_deg": float(np.degrees(np.linalg.norm(second - first))),
    }


def products(case: RenderedFlight, estimate: SiteEstimate) -> dict[str, Any]:
    """Arrays for the case's figures.

    Those of `marsyard.algorithms.hda.hda_products` (Figs. 1-5 and 7), and

    - `image_1`, `image_2`: the pictures;
    - `true_rotation`, `true_translation`: of the second from the first camera;
    - `true_places`, `true_slope`, `true_roughness`, `true_safe`, `true_covered`: the truth's lattice, world axes;
    - `true_heights`, `true_corner`, `true_spacing`: exact heights, world axes (row i at y = corner[1] + i spacing);
    - `camera_true`, `camera_believed`: poses of the body at the first picture (4 x 4), true and on board;
    - `limits`: the algorithm's limits of slope (radians) and roughness (metres), and the lander's diameter;
    - `site_true`: true x, y of the reported site (see `site_row`).
    """
    p, flight, pair, truth = case.p, case.flight, case.pair, case.truth
    kept: dict[str, Any] = {"image_1": pair.counts[0], "image_2": pair.counts[1]}
    if isinstance(estimate.details, HdaDetails):
        kept |= hda_products(estimate.details)
    true = true_motion(flight, pair)
    kept |= {
        "true_rotation": true.rotation.as_matrix(),
        "true_translation": np.array(true.translation),
        "true_places": truth.places,
        "true_slope": truth.footprints.slope_rad,
        "true_roughness": truth.footprints.roughness_m,
        "true_safe": truth.footprints.safe,
        "true_covered": truth.covered,
        "true_heights": truth.relief.heights_m,
        "true_corner": np.array([truth.relief.west_m, truth.relief.south_m]),
        "true_spacing": np.array([truth.relief.spacing_m]),
        "camera_true": flight.states[0].world_from_body.as_matrix(),
        "camera_believed": flight.poses[0].world_from_body.as_matrix(),
        "limits": np.array([p.hda.max_slope_rad, p.hda.max_roughness_m, truth.limits.diameter_m]),
    }
    site = _true_site(estimate, flight)
    return kept if site is None else {**kept, "site_true": site}
