"""Columns in the rows of a landing: motion, map, site and touchdown."""

from marsyard.scenarios import common_columns as common
from marsyard.scenarios.columns import ColumnKind, Columns, condition, error, flag, instrument_error, outcome

COLUMNS = Columns(
    (
        *common.SITE,
        *common.SUN,
        *common.FAULTS,
        *common.CONTRAST,
        *common.HAZARD_DETECTION,
        *common.ALGORITHM,
        *common.IMAGES,
        condition("height_m", "true height above the ground at the first image"),
        condition("baseline_m", "true distance between both camera positions"),
        condition("baseline_fraction", "horizontal part of the baseline, divided by the height", "baseline / height"),
        condition(
            "height_change_fraction",
            "change of the height between both images, divided by the height",
            "change of height / height",
        ),
        condition("pair_rotation_deg", "true rotation between both images", "rotation between the two images"),
        condition("pitch_deg", "component of the true rotation between both images about the body's x axis"),
        condition("yaw_deg", "component of the true rotation between both images about the body's y axis"),
        condition("roll_deg", "component of the true rotation between both images about the body's z axis"),
        condition("off_nadir_deg", "angle between the camera's axis and nadir at the first image", "off-nadir angle"),
        condition("exposure_s", "exposure time of the first image"),
        condition("image_median_dn", "median of the counts of the first image", "median of the image"),
        condition("range_m", "true distance to the ground along the optical axis at the first image"),
        condition("covered_m2", "area of the ground in both images", "ground in both images"),
        condition(
            "true_safe_fraction",
            "fraction of the positions in both images at which a lander is safe",
            "fraction of the ground that is truly safe",
        ),
        condition("true_slope_median_deg", "median slope of the footprints in both images", "median of the true slope"),
        condition("max_slope_deg", "largest slope of a site that the algorithm accepts", "limit of the slope"),
        condition("max_roughness_m", "largest roughness that the algorithm accepts", "limit of the roughness"),
        instrument_error("range_error_m", "error of the range that the algorithm receives"),
        instrument_error("level_error_deg", "error of the measured vertical", "tilt error of the vertical"),
        instrument_error("pose_position_error_m", "error of the first pose's position", "position error of the pose"),
        instrument_error(
            "pose_motion_error_m", "error of the motion between both poses", "error of the motion between the poses"
        ),
        instrument_error("pose_tilt_error_deg", "tilt error of the first pose", "tilt error of the pose"),
        instrument_error("pose_azimuth_error_deg", "azimuth error of the first pose", "azimuth error of the pose"),
        instrument_error(
            "pose_rotation_error_deg",
            "error of the rotation between both poses",
            "error of the rotation between the poses",
        ),
        instrument_error(
            "gps_sd_east_m",
            "mean standard deviation that the receiver reports after touchdown, east",
            "east error of averaged GPS",
        ),
        instrument_error(
            "gps_sd_north_m",
            "mean standard deviation that the receiver reports after touchdown, north",
            "north error of averaged GPS",
        ),
        flag("safe_site_exists", "a safe site is visible in both images", "with a safe site", ColumnKind.TRUTH),
        flag("no_safe_site_exists", "no safe site is visible in both images", "without a safe site", ColumnKind.TRUTH),
        flag(
            "narrow_site_exists", "safe sites exist, but none is wide", "with only narrow safe sites", ColumnKind.TRUTH
        ),
        flag(
            "wide_site_exists",
            "around a safe site all positions within one lander radius are safe",
            "with a wide safe site",
            ColumnKind.TRUTH,
        ),
        flag(
            "hazard_near_apriori_site",
            "both images show a footprint that is not safe, and the a-priori site is less than half as far from "
            "hazards and border as the position that is farthest from them",
            "with hazards near the a-priori site",
            ColumnKind.TRUTH,
        ),
        flag(
            "within_limits",
            "the change between the images is within the paper's limits",
            "within the tracking limits",
            ColumnKind.TRUTH,
        ),
        flag(
            "strict_threshold",
            "the algorithm's limit of the roughness is at most that of the lander",
            "with a threshold within the lander's limit",
            ColumnKind.CONFIGURED,
        ),
        outcome("features", "selected features"),
        outcome("tracks", "accepted tracks"),
        outcome(
            "features_in_view", "features whose true position is in both images", "features visible in both images"
        ),
        error("tracks_correct", "accepted tracks within 1 px of the true position"),
        error("tracked_fraction", "correct tracks, divided by the features in view"),
        error("tracks_outlier_fraction", "fraction of the accepted tracks that are not correct"),
        flag("tracked_well", "90 % of the features are tracked"),
        outcome("tracking_time_s", "processor time of the tracking"),
        outcome("motion_time_s", "processor time of the motion estimation"),
        outcome("structure_time_s", "processor time of the dense matching"),
        outcome("hazards_time_s", "processor time of the hazard detection"),
        error(
            "relief_error_fraction",
            "RMS elevation error about a plane, divided by that of a plane; ground without elevation counts as a plane",
            "elevation error of the map relative to that of a plane",
        ),
        error("elevation_bias_m", "mean error of the map's elevations"),
        error("elevation_rms_m", "root mean square of the map's elevation errors"),
        error("elevation_noise_m", "robust standard deviation of the map's elevation errors about a plane"),
        error("elevation_median_error_m", "median magnitude of the map's elevation errors"),
        error("elevation_outliers", "fraction of the cells with a gross elevation error"),
        error("slope_error_bias_deg", "mean error of the footprints' slopes"),
        error("slope_error_rms_deg", "root mean square of the footprints' slope errors"),
        error("false_alarms", "safe footprints that contain a hazard in the map"),
        error("missed", "unsafe footprints that contain no hazard in the map"),
        error("gross_hazards", "footprints with at least twice the roughness limit, at least three cells wide"),
        error("gross_hazards_unflagged", "gross hazards that contain no hazard in the map"),
        error("gross_hazards_called_safe", "gross hazards that the safe landing map calls safe"),
        outcome("footprints", "lander footprints compared with the truth", "evaluated lander footprints"),
        outcome("footprints_called_safe", "footprints that are safe in the map", "footprints that are safe in the map"),
        outcome("footprints_truly_safe", "footprints that are truly safe", "footprints that are truly safe"),
        outcome(
            "footprints_slope_below_1",
            "footprints with a true slope within the limit",
            "footprints with a slope within the limit",
        ),
        outcome(
            "footprints_roughness_below_1",
            "footprints with a true roughness within the limit",
            "footprints with a roughness within the limit",
        ),
        outcome("footprints_*", "footprints of a class of true slope, roughness or safety"),
        flag("no_site_reported", "the answer is 'no safe site'"),
        flag("site_safe", "the reported site is safe", "with a safe reported site"),
        flag("descent_target_safe", "the target of the descent, the reported or the a-priori site, is safe"),
        flag("safe_or_no_site_reported", "the answer is a safe site or 'no safe site'"),
        flag("answer_correct", "the answer is correct (a safe site, or 'no safe site' where no safe site is wide)"),
        flag("site_far_from_hazards", "the site is far from all hazards"),
        error(
            "site_clearance_fraction",
            "distance of the site from hazards and from the border of the ground in both images, divided by the "
            "largest one",
            "distance from hazards and border / largest distance",
        ),
        error(
            "site_height_error_m", "height of the reported site minus that of the ground", "height error of the site"
        ),
        outcome("site_slope_deg", "true slope at the site", "true slope at the site"),
        outcome("site_roughness_m", "true roughness at the site", "true roughness at the site"),
        error(
            "site_hazard_distance_m",
            "distance from the site to the nearest unsafe position of the ground around the first image",
            "distance from the site to the nearest unsafe position",
        ),
        error("site_margin", "distance of slope and roughness from their limits, relative to them; the smaller one"),
        flag(
            "descent_target_exists",
            "the helicopter flies to a site, the reported or the a-priori site, to land",
            "with a flight to a site",
        ),
        flag("landed", "the helicopter lands", "that land"),
        flag("touchdown_safe", "the helicopter lands on safe ground"),
        error("touchdown_error_m", "distance between true touchdown and true site", "touchdown error"),
        error(
            "touchdown_error_gps_m",
            "distance between the averaged solutions of the receiver and the site",
            "distance from touchdown to site, by averaged GPS",
        ),
        error(
            "touchdown_error_estimated_m",
            "distance between the navigation filter's position at touchdown and the site",
            "touchdown error, navigation filter",
        ),
        outcome("touchdown_east_m", "east position of the touchdown"),
        outcome("touchdown_north_m", "north position of the touchdown"),
        outcome("touchdown_slope_deg", "true slope at the touchdown"),
        outcome("touchdown_roughness_m", "true roughness at the touchdown"),
        error(
            "touchdown_hazard_distance_m",
            "distance from the touchdown to the nearest unsafe position of the ground around the first image",
            "distance from the touchdown to the nearest unsafe position",
        ),
        error(
            "touchdown_margin", "distance of slope and roughness at the touchdown from their limits; the smaller one"
        ),
        outcome("touchdown_sink_m_s", "vertical speed at touchdown"),
        outcome("touchdown_horizontal_speed_m_s", "horizontal speed at touchdown"),
        outcome("gps_solutions", "averaged solutions of the receiver after touchdown"),
        outcome("landing_iterations", "iterations of flight and filter", "iterations of flight and filter"),
        outcome(
            "landing_path_change_m", "change of the path in the last iteration", "path change in the last iteration"
        ),
        outcome("landing_after_s", "time from the second image to touchdown", "time from the images to the landing"),
    )
)
