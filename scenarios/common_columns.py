"""Declarations of columns that several scenarios compute.

They describe the world, faults, images, algorithms, the motion of the vehicle, velocities, and hazard detection.
"""

from marsyard.scenarios.columns import Column, ColumnKind, condition, error, flag, instrument_error, outcome, text

SITE = (
    text("site", "site of the terrain"),
    Column("terrain", ColumnKind.PROVENANCE, "number of the terrain in the bank"),
)

SUN = (
    condition("sun_azimuth_deg", "azimuth of the sun, clockwise from north"),
    condition("sun_elevation_deg", "elevation of the sun above the horizon"),
)

FAULTS = (
    text("fault", "name of the injected fault", ColumnKind.CONFIGURED),
    Column("fault_size", ColumnKind.CONFIGURED, "size of the injected fault, in its unit"),
    flag("fault_free", "no fault is injected", "without a fault", ColumnKind.TRUTH),
)

CONTRAST = (
    condition(
        "image_contrast",
        "median of the first image's local contrast: standard deviation of the brightness divided by its mean, in "
        "blocks of 16 x 16 pixels of the image binned to 256 x 256 pixels",
        "image contrast (median of local standard deviation / local mean)",
    ),
    condition(
        "image_patchiness",
        "90 % quantile of the local contrast divided by its 10 % quantile",
        "patchiness of the image (90 % quantile of local contrast divided by its 10 % quantile)",
    ),
)

IMAGES = (
    text("image_hash", "hash of the counts of all images", ColumnKind.PROVENANCE),
    text("gl_backend", "OpenGL backend of the renderer", ColumnKind.PROVENANCE),
    text("gl_version", "OpenGL implementation and compiler of the renderer", ColumnKind.PROVENANCE),
    text("processor_features", "hash of the processor's features that compiled code uses", ColumnKind.PROVENANCE),
)

ALGORITHM = (
    text("algorithm", "label of the algorithm under test", ColumnKind.PROVENANCE),
    text("stderr", "standard error of an external program", ColumnKind.PROVENANCE),
    outcome(
        "estimation_time_s",
        "processor time of the algorithm; wall-clock time of an external program; missing after a failure",
    ),
)

OFF_NADIR_MAX = condition("off_nadir_max_deg", "maximum off-nadir angle at the images", "maximum off-nadir angle")
ATTITUDE_RATE_MAX = condition("attitude_rate_max_deg_s", "maximum attitude rate at the images", "maximum attitude rate")

MOTION = (
    condition("horizontal_speed_m_s", "true horizontal speed at the last image"),
    condition("altitude_*_m", "true height above the ground at an image", "altitude at image *"),
    condition("off_nadir_*_deg", "angle between the camera's axis and nadir at an image", "off-nadir angle at image *"),
    condition("attitude_rate_*_deg_s", "magnitude of the angular velocity at an image", "attitude rate at image *"),
    OFF_NADIR_MAX,
    ATTITUDE_RATE_MAX,
)

MOTION_ERRORS = (
    instrument_error("attitude_error_*_deg", "magnitude of the measured attitude's error", "attitude error at image *"),
    instrument_error("altitude_error_*_m", "error of the measured altitude", "altitude error at image *"),
)

VELOCITY = (
    error("velocity_error_m_s", "magnitude of the difference of reported and true mean horizontal velocity"),
    error("velocity_error_x_m_s", "eastward error of the velocity", "east velocity error"),
    error("velocity_error_y_m_s", "northward error of the velocity", "north velocity error"),
    outcome("velocity_estimated_*_m_s", "component of the reported velocity, x east and y north"),
    outcome(
        "velocity_true_*_m_s",
        "component of the true velocity of the same interval, x east and y north; in the field test from GPS positions",
    ),
    outcome("velocity_sd_*_m_s", "reported standard deviation of a component of the velocity"),
    outcome("velocity_correlation", "reported correlation of the errors of both components"),
    error("velocity_normalised_*", "error of a component divided by its reported standard deviation"),
    error("velocity_nees", "squared error of the velocity, normalised by the reported covariance; its mean is 2"),
)

#: Stages of hazard detection: matching of both images, estimated motion, elevation map, and landing site.
HAZARD_DETECTION = (
    outcome("inliers", "tracks that agree with the estimated motion"),
    outcome("parallax_px", "median displacement of tracks by the translation"),
    error("rotation_error_deg", "error of the estimated rotation between both images"),
    error("direction_error_deg", "angle between the estimated and the true direction of the translation"),
    error("length_error_m", "error of the length of the estimated translation"),
    error("baseline_error_fraction", "error of the translation, divided by its length", "baseline error / baseline"),
    outcome("motion_residual_px", "median residual of the tracks after the motion was estimated"),
    outcome("points", "triangulated points"),
    outcome("matched_fraction", "accepted fraction of the matches"),
    outcome("map_rows", "rows of the elevation map", "rows of the elevation map"),
    outcome("map_columns", "columns of the elevation map", "columns of the elevation map"),
    outcome("cell_m", "side of a cell of the elevation map"),
    outcome("matches_dissimilar", "matches rejected because the image windows differ"),
    outcome("matches_out_of_bounds", "matches rejected at the border of the search"),
    outcome("matches_inconsistent", "matches rejected by the reverse match"),
    outcome("empty_fraction", "fraction of the map's cells without an elevation"),
    outcome("unknown_fraction", "fraction of the map's cells without a classification"),
    flag("converged", "the algorithm converges", "with a converged algorithm"),
    flag("site_reported", "a site is reported", "with a reported site"),
    outcome("site_east_m", "east position of the site", "east position of the site"),
    outcome("site_north_m", "north position of the site", "north position of the site"),
)
