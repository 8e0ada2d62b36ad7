"""Columns in the rows of tracked targets: runs of a rover, and targets on the images of a shared drive."""

from marsyard.scenarios import common_columns as common
from marsyard.scenarios.columns import (
    Column,
    ColumnKind,
    Columns,
    condition,
    error,
    flag,
    instrument_error,
    outcome,
    text,
)

_TARGET = (
    *common.SITE,
    *common.SUN,
    *common.ALGORITHM,
    *common.IMAGES,
    text("camera", "preset of the cameras"),
    text("incline", "kind of the incline"),
    text("map_by", "cameras of the terrain map: body, mast, or none without one"),
    text("losses", "criteria that lost the target, or none", ColumnKind.OUTCOME),
    flag("navcam", "the cameras are navcams", "with the navcam", ColumnKind.CONFIGURED),
    flag("pancam", "the cameras are pancams", "with the pancam", ColumnKind.CONFIGURED),
    flag("visual_odometry", "the rover corrects its pose by visual odometry", "", ColumnKind.CONFIGURED),
    flag("autonav", "the rover avoids hazards by itself", "with autonomous navigation", ColumnKind.CONFIGURED),
    flag("roll_compensated", "the tracker rotates its template", "with roll compensation", ColumnKind.CONFIGURED),
    flag(
        "roll_ignored", "the tracker does not rotate its template", "without roll compensation", ColumnKind.CONFIGURED
    ),
    Column("search_px", ColumnKind.CONFIGURED, "side of the search window"),
    condition("rock_diameter_m", "diameter of the target's rock", "rock diameter"),
    condition("rock_height_m", "height of the target's rock"),
    flag(
        "selectable",
        "at its designation the point is sunlit, unoccluded and away from the edge of the rock",
        "with a selectable target",
        ColumnKind.TRUTH,
    ),
    flag("point_lit", "at its designation neither its rock nor a cloud shades the point", kind=ColumnKind.CONDITION),
    flag("point_on_edge", "the designated point is near the occluding edge of its rock", kind=ColumnKind.CONDITION),
    flag("clear_sky", "no cloud shadow moves over the ground", "without clouds", ColumnKind.TRUTH),
    instrument_error("disparity_error_start_px", "disparity error at 10 m", "disparity error at the start"),
    instrument_error("disparity_error_goal_px", "disparity error at 2 m", "disparity error at the goal"),
    instrument_error("mast_azimuth_error_deg", "zero error of the mast's azimuth"),
    instrument_error("mast_elevation_error_deg", "zero error of the mast's elevation"),
    condition("range_start_m", "range of the target at the first stop", "range at the start"),
    outcome("range_end_m", "range of the target at the last stop"),
    condition("max_tilt_deg", "maximum tilt of the rover", "maximum rover tilt"),
    condition("distance_driven_m", "commanded length of the path"),
    condition("slip_mean", "mean slip of the wheels, weighted with the lengths", "mean wheel slip"),
    condition("slip_max", "maximum slip of the wheels", "maximum wheel slip"),
    instrument_error("pose_error_m", "position error of the rover's estimated pose at the last stop"),
    instrument_error(
        "pose_error_fraction", "pose error, divided by the distance", "rover pose error / distance driven"
    ),
    outcome("duration_min", "time from the start of the run to the last stop, minutes"),
    condition("sun_motion_deg", "angle between the sun's directions at the first and the last stop"),
    condition("min_exposure_s", "shortest exposure", "shortest exposure"),
    condition("max_exposure_s", "longest exposure", "longest exposure"),
    condition(
        "obliquity_start_deg",
        "angle between the target's normal and the line of sight at the start",
        "obliquity of the target's surface at the start",
    ),
    condition("obliquity_max_deg", "maximum obliquity", "maximum obliquity of the target's surface"),
    flag("rover_shadow_on_target", "the rover's shadow lies on the target", "", ColumnKind.TRUTH),
    flag(
        "no_rover_shadow_on_target",
        "the rover's shadow never lies on the target",
        "whose target is never in the rover's shadow",
        ColumnKind.TRUTH,
    ),
    condition(
        "azimuth_change_max_deg",
        "largest change of the target's azimuth between two updates",
        "largest change of azimuth between two updates",
    ),
    condition("azimuth_total_deg", "sum of the changes of the target's azimuth", "sum of the changes of azimuth"),
    condition(
        "roll_change_max_deg",
        "largest change of roll between two updates",
        "largest change of roll between two updates",
    ),
    condition("roll_total_deg", "sum of the changes of roll", "sum of the changes of roll"),
    flag("tracked", "the target is tracked", "with a tracked target"),
    flag("not_tracked", "the target is not tracked", "without a tracked target"),
    flag("target_held", "the target is tracked at the last stop, with any outcome"),
    flag("stuck", "the true slip over several steps is above its limit", "with a stuck rover", ColumnKind.TRUTH),
    flag("mobile", "the rover is not stuck", "with a rover that is not stuck", ColumnKind.TRUTH),
    flag("no_false_track", "there is no false track"),
    flag("handed_off", "a tracked target is handed off to the arm"),
    outcome("updates", "updates of the tracker"),
    outcome("lost_updates", "updates without a tracked target"),
    error("false_updates", "updates more than 10 px from the true projection, or behind the camera"),
    outcome("lost_range_m", "range at which the target was lost"),
    outcome("visual_odometry_updates", "poses corrected by visual odometry"),
    outcome("visual_odometry_failures", "attempts of visual odometry that failed"),
    outcome("autonav_updates", "updates during autonomous navigation"),
    error("position_error_m", "distance between reported and designated point in the rover frame, at the goal"),
    error("range_error_m", "component of the position error along the line of sight; positive: too far"),
    error("cross_error_m", "component of the position error across the line of sight"),
    error("drift_px", "distance of the reported from the true pixel in the last image", "drift of the tracked point"),
    error("drift_u_px", "drift along the columns"),
    error("drift_v_px", "drift along the rows"),
    error("max_error_px", "largest distance of the reported from the true pixel"),
    error("track_margin_px", "limit of a false track minus the worst error"),
    error("target_motion_m", "distance between the first and the last reported target in the world"),
    error(
        "designation_error_m", "target position error at its designation", "target position error at its designation"
    ),
    outcome(
        "designation_3_sigma_m",
        "3-sigma error of the target at its designation for a 3-sigma disparity error of 1 px",
        "predicted 3-sigma error at designation",
    ),
    outcome("match_score_min", "smallest correlation of a match"),
    outcome("stereo_score_min", "smallest correlation of a stereo match"),
    outcome("magnification_min", "smallest change of the template's scale"),
    outcome("magnification_max", "largest change of the template's scale"),
    outcome(
        "correction_max_px", "largest distance from prediction to match", "maximum distance from prediction to match"
    ),
    outcome("update_time_s", "mean processor time of an update"),
)

#: Quantities of single updates, and their meaning.
_UPDATES = {
    "range_m": "range of the target", "azimuth_deg": "azimuth of the mast", "elevation_deg": "elevation of the mast",
    "magnification": "change of the template's scale", "roll_change_deg": "change of the template's roll",
    "azimuth_change_deg": "change of the target's azimuth", "match_score": "correlation of the match",
    "stereo_score": "correlation of the stereo match", "correction_px": "distance from prediction to match",
    "error_px": "distance of the reported from the true pixel", "position_error_m": "error of the reported position",
    "leg": "index of the leg", "time_s": "time from the start",
}  # fmt: skip

COLUMNS = Columns(
    (
        *_TARGET,
        flag(
            "point_in_view",
            "the designated point stays visible to the end of a commanded path, or else of the run",
            "whose point stays in view",
            ColumnKind.TRUTH,
        ),
        flag(
            "placeable",
            "a position within 8 mm of the designated point is free of collisions",
            "whose target permits a placement",
            ColumnKind.TRUTH,
        ),
        flag("placed", "the instrument is placed", "with a placed instrument"),
        flag("placement_safe", "the instrument is placed within 3 cm of the designated point without a collision"),
        error("placement_error_m", "distance of the placed instrument from the designated point"),
        outcome("reselection_m", "distance of the selected position from the tracked target"),
        error("tool_overlap_m", "largest depth of a tool in the true rock"),
        outcome("run_time_s", "processor time of the run"),
        *(outcome(f"update_*_{name}", f"{meaning} at an update") for name, meaning in _UPDATES.items()),
    )
)

DRIVE_COLUMNS = Columns(
    (
        *_TARGET,
        condition("step", "step between two updates: degrees of a turn, fixed length (m), or fraction of the distance"),
        flag("in_view", "the designated point stays visible", "whose point stays in view", ColumnKind.TRUTH),
        flag(
            "on_face",
            "the point is on the face seen from both ends",
            "whose point is on the face seen from both ends",
            ColumnKind.TRUTH,
        ),
        flag(
            "with_scale", "the tracker changes the scale of its template", "with template scale", ColumnKind.CONFIGURED
        ),
        flag("pure_ncc", "the tracker is pure-ncc", "without template scale", ColumnKind.CONFIGURED),
        # ranges of steps, which the campaign names
        flag("at_*", "the step is in the range", "with steps of *", ColumnKind.CONFIGURED),
        flag("to_*", "the step is in the range", "with steps of up to *", ColumnKind.CONFIGURED),
    ),
    named_flags="step_ranges",
)
