"""Columns of a landing case that do not depend on an algorithm: conditions and measurement errors.

Sections are those of Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

import numpy as np

from marsyard.scenarios.condition_columns import contrast_columns, sun_columns
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.landing.flight import LandingFlight
from marsyard.scenarios.landing.ground_truth import GroundTruth
from marsyard.scenarios.landing.simulation import RenderedFlight
from marsyard.sim.measurements import LandingMeasurements
from marsyard.sim.sensor import height_above_ground

#: Maximum rotations between the images for tracking (section II.A): about the optical axis, and about each other axis.
MAX_ROLL_DEG, MAX_TILT_DEG = 10.0, 20.0
#: Maximum change of height between the images for tracking, divided by the range along the first optical axis. Section
#: II.A limits the change of altitude to 20 % and does not name the divisor; the range determines the images' scale. The
#: column `height_change_fraction` is divided by the height above the ground.
MAX_HEIGHT_CHANGE_PER_RANGE = 0.2
#: Tolerances of these limits: flights that are exactly at a limit are within it.
_ANGLE_TOLERANCE_DEG, _FRACTION_TOLERANCE = 0.5, 0.01


def site_populations(truth: GroundTruth) -> dict[str, Scalar]:
    """Classify the flight by its true ground: no safe site, only safe sites without margin, or safe sites with margin.

    The ground around a site with margin is safe up to a lander's radius. Exactly one of `no_safe_site_exists`,
    `narrow_site_exists` and `wide_site_exists` is true.
    """
    has_safe_site, has_margin = bool(np.any(truth.safe)), bool(np.any(truth.safe_with_margin))
    return {
        "safe_site_exists": has_safe_site,
        "no_safe_site_exists": not has_safe_site,
        "narrow_site_exists": has_safe_site and not has_margin,
        "wide_site_exists": has_margin,
    }


def conditions(case: RenderedFlight, measurements: LandingMeasurements) -> dict[str, Scalar]:
    """Compute the columns of a case's conditions from the simulated objects."""
    p, pair, truth = case.p, case.pair, case.truth
    covered = truth.covered
    slopes = truth.footprints.slope_rad[covered]
    # for the limits of tracking: magnitudes of the rotations about the x, y and optical axes of the camera
    camera_rotation = case.flight.true_motion(pair.cameras).rotation
    camera_pitch_deg, camera_yaw_deg, camera_roll_deg = np.degrees(np.abs(camera_rotation.as_rotvec()))
    # height and vertical at the first image; motion and rotation to the second image
    first, second = case.flight.states
    motion = second.position_m - first.position_m
    east, north, climb = motion
    positions = np.stack([first.position_m, second.position_m])
    height = float(height_above_ground(case.world.ground.surface, positions)[0])
    up = first.attitude.inv().apply(np.array([0.0, 0.0, 1.0]))
    # for the columns: rotation vector in the body axes at the first image
    body_rotation_deg = (first.attitude.inv() * second.attitude).as_rotvec(degrees=True)
    body_pitch_deg, body_yaw_deg, body_roll_deg = body_rotation_deg
    apriori_site_m = (measurements.apriori_site_world - case.flight.position_error_m)[:2]
    within_limits = (
        camera_roll_deg < MAX_ROLL_DEG + _ANGLE_TOLERANCE_DEG
        and max(camera_pitch_deg, camera_yaw_deg) < MAX_TILT_DEG + _ANGLE_TOLERANCE_DEG
        and abs(float(climb)) < (MAX_HEIGHT_CHANGE_PER_RANGE + _FRACTION_TOLERANCE) * pair.axis_range_m
    )
    return {
        "site": p.site,
        "terrain": p.location.terrain,
        **p.faults.columns,
        **sun_columns(case.world.sun.direction),
        "height_m": height,
        "baseline_m": float(np.linalg.norm(motion)),
        "height_change_fraction": float(climb / height),
        "baseline_fraction": float(np.hypot(east, north) / height),
        "pair_rotation_deg": float(np.linalg.norm(body_rotation_deg)),
        "pitch_deg": float(body_pitch_deg),
        "yaw_deg": float(body_yaw_deg),
        "roll_deg": float(body_roll_deg),
        "off_nadir_deg": float(np.degrees(np.arccos(np.clip(up[2], -1.0, 1.0)))),
        "exposure_s": pair.images[0].calibration.exposure_s,
        "image_median_dn": float(np.median(pair.counts[0])),
        "range_m": pair.axis_range_m,
        "range_error_m": measurements.slant_range_m - pair.axis_range_m,
        **_navigation_errors(case.flight, measurements),
        "covered_m2": float(covered.sum() * truth.step_m**2),
        **site_populations(truth),
        "hazard_near_apriori_site": truth.has_hazard_near(apriori_site_m),
        "true_safe_fraction": float(truth.safe.sum() / max(int(covered.sum()), 1)),
        "within_limits": bool(within_limits),
        "true_slope_median_deg": float(np.degrees(np.median(slopes))) if slopes.size else np.nan,
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
