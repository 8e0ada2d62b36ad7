"""Columns in the rows of a descent with localisation on a map."""

from marsyard.scenarios import common_columns as common
from marsyard.scenarios.columns import ColumnKind, Columns, condition, error, flag, instrument_error, outcome

COLUMNS = Columns(
    (
        *common.SITE,
        *common.SUN,
        *common.FAULTS,
        *common.CONTRAST,
        *common.ALGORITHM,
        *common.IMAGES,
        condition("images", "number of delivered images"),
        condition(
            "altitude_last_m", "true height above the ground at the last delivered image", "altitude at the last image"
        ),
        common.OFF_NADIR_MAX,
        common.ATTITUDE_RATE_MAX,
        condition("sun_difference_deg", "angle between the suns of map and landing"),
        instrument_error("map_shift_m", "length of the map's registration error", "position error of the map"),
        instrument_error("initial_error_m", "horizontal error of the initial position, relative to the map"),
        instrument_error("initial_attitude_error_deg", "error of the initial attitude"),
        flag(
            "false_fix", "a reported position is more than 40 m from the true one", "with a false fix", ColumnKind.TRUTH
        ),
        flag("position_reported", "a position is reported", "with a reported position"),
        flag(
            "fixed_in_time",
            "the last answer within 10 s of the start is a position",
            "with a position as the last answer within 10 s of the start",
        ),
        outcome("fix_after_s", "time of the first reported position after the start"),
        outcome("valid_images", "images after which a position is reported"),
        outcome("inliers_median", "median number of landmarks of a position"),
        outcome("inliers_min", "smallest number of landmarks of a position"),
        outcome("image_time_median_s", "median processor time of an image"),
        outcome("image_time_max_s", "largest processor time of an image"),
        error("position_error_m", "horizontal distance between reported and true position on the map at the end"),
        error("position_error_east_m", "eastward error of the last position, relative to the map"),
        error("position_error_north_m", "northward error of the last position, relative to the map"),
        error("position_error_up_m", "vertical error of the last position"),
        error(
            "position_error_world_m", "horizontal distance between reported and true position in the world at the end"
        ),
        error(
            "position_error_at_10_s_m",
            "horizontal error of the last answer within 10 s of the start, at the time of this answer",
            "position error of the last answer within 10 s of the start",
        ),
        error(
            "position_error_max_m",
            "largest horizontal error of all reported positions",
            "largest error of all reported positions",
        ),
        error("coarse_error_m", "error of the first coarse position", "position error of the coarse stage"),
        outcome("position_sd_*_m", "reported standard deviation of a component of the last position"),
        error("position_nees", "squared horizontal error, normalised by the reported covariance; its mean is 2"),
        error("velocity_error_m_s", "magnitude of the error of the last velocity"),
        error("attitude_error_deg", "magnitude of the error of the last attitude"),
    )
)
