"""Columns in the rows of a field test: one triple of images of a helicopter flight."""

from marsyard.scenarios import common_columns as common
from marsyard.scenarios.columns import Column, ColumnKind, Columns, condition, flag, instrument_error, text

COLUMNS = Columns(
    (
        *common.SITE,
        *common.SUN,
        *common.MOTION,
        *common.MOTION_ERRORS,
        *common.VELOCITY,
        *common.ALGORITHM,
        *common.IMAGES,
        text("run", "name of the run"),
        text("category", "category of the triple: short time, same direction, opposite direction"),
        flag("one_direction", "all images show one flight direction", "with one direction of flight", ColumnKind.TRUTH),
        flag("clear_sky", "no cloud shadow moves over the ground", "without clouds", ColumnKind.TRUTH),
        flag("intact_cable", "the cable causes no noise", "with an intact cable", ColumnKind.CONFIGURED),
        flag("noisy_cable", "the cable causes noise", "with noise from the cable", ColumnKind.CONFIGURED),
        condition("location_east_m", "east position at the second image", "east position on the terrain"),
        condition("location_north_m", "north position at the second image", "north position on the terrain"),
        condition("interval_*_s", "true time between the images of a pair"),
        instrument_error("attitude_change_*_deg", "change of the attitude error between the images of a pair"),
        instrument_error(
            "attitude_velocity_error_m_s",
            "velocity error at the nadir that the attitude errors of the last pair cause",
            label="velocity error by attitudes",
        ),
        condition("cloud_transmittance_*", "mean fraction of direct sunlight that clouds transmit at an image"),
        condition("cloud_change_*", "mean change of the transmitted fraction between the images of a pair"),
        Column("image_time_*_s", ColumnKind.PROVENANCE, "true time of an image from the start of the run"),
        Column("pass_*", ColumnKind.PROVENANCE, "number of the pass over the target at an image"),
    )
)
