"""Columns in the rows of a parachute descent."""

from marsyard.scenarios import common_columns as common
from marsyard.scenarios.columns import Column, ColumnKind, Columns, condition, error, flag, instrument_error, outcome

#: Columns of custom motions, altimeters and attitude sources, which the user's code names. A declaration has one type;
#: the values can be numbers, flags or texts, so that each pattern is declared once for each type.
_CUSTOM = tuple(
    Column(f"{part}_*", ColumnKind.CONDITION, f"quantity of a custom {noun}", type=value_type)
    for part, noun in (("flight", "motion"), ("altimeter", "altimeter"), ("attitude_source", "source of attitudes"))
    for value_type in (float, bool, str)
)

COLUMNS = Columns(
    (
        *common.SITE,
        *common.SUN,
        *common.FAULTS,
        *common.CONTRAST,
        *common.MOTION,
        *common.MOTION_ERRORS,
        *common.VELOCITY,
        *common.ALGORITHM,
        *common.IMAGES,
        condition("descent_rate_m_s", "mean true descent rate between first and last image"),
        # without a label, axes would show the words of the name
        condition(
            "firing_after_s", "time from the last image to ignition", label="time from the last image to ignition"
        ),
        condition(
            "overlap_width_first_pair_m",
            "diameter of the largest circle of level ground in both images of the first pair, taken above one point",
            label="width of the ground in both images of the first pair",
        ),
        condition(
            "overlap_width_second_pair_m",
            "diameter of the largest circle of level ground in both images of the second pair, taken above one point",
            label="width of the ground in both images of the second pair",
        ),
        Column(
            "feasible_overlap",
            ColumnKind.TRUTH,
            "in both image pairs, the ground that both images show without horizontal motion, outside of the bright "
            "spot opposite the sun, is at least 110 m across",
            population="with feasible overlap",
            type=bool,
            enables_answer=True,
        ),
        instrument_error(
            "attitude_error_common_deg",
            "magnitude of the mean error of all attitudes",
            label="attitude error common to all images",
        ),
        instrument_error(
            "attitude_error_independent_deg",
            "root mean square of the attitude errors around their mean",
            label="attitude error, independent part",
        ),
        instrument_error(
            "altitude_error_common", "mean relative error of all altitudes", label="altitude error common to all images"
        ),
        instrument_error(
            "altitude_error_independent",
            "root mean square of the relative altitude errors around their mean",
            label="altitude error, independent part",
        ),
        instrument_error("tag_error_*_s", "error of an image's time tag", label="error of the time tag of image *"),
        instrument_error(
            "velocity_change_error_m_s",
            "error of the velocity change between both image pairs, measured by the inertial unit",
            label="error of the velocity change measured by the IMU",
        ),
        outcome("stream_images", "number of images that a stream received"),
        outcome("images_before_answer", "number of images before the first velocity of a stream; 0 without a velocity"),
        error(
            "velocity_error_after_*_m_s",
            "velocity error after an image of a stream",
            label="velocity error after image *",
        ),
        error(
            "firing_velocity_error_m_s", "velocity error, propagated to ignition", label="velocity error at ignition"
        ),
        error("firing_velocity_error_x_m_s", "eastward error at ignition", label="east velocity error at ignition"),
        error("firing_velocity_error_y_m_s", "northward error at ignition", label="north velocity error at ignition"),
        outcome("firing_velocity_estimated_*_m_s", "component of the velocity propagated to ignition"),
        outcome("firing_velocity_true_*_m_s", "component of the true velocity at ignition"),
        flag("in_time_assumed", "the answer is available before ignition, with the assumed computation time"),
        error("touchdown_speed_corrected_m_s", "horizontal speed at touchdown, steered with the answer"),
        error("touchdown_speed_uncorrected_m_s", "horizontal speed at touchdown without steering"),
        *_CUSTOM,
    )
)
