"""Columns in the rows of recorded images: agreement of images and poses, and answers of algorithms."""

from dataclasses import replace

from marsyard.scenarios import common_columns as common
from marsyard.scenarios.columns import Column, ColumnKind, Columns, condition, error, flag, outcome, text

_IDENTITY = (
    text("measured_case", "name of the case"),
    text("image_hash", "hash of the counts of all images", ColumnKind.PROVENANCE),
)
#: Columns of a case of two or more images.
_CASE = (
    *_IDENTITY,
    condition("images", "number of images"),
    condition("duration_s", "time from the first to the last image"),
    condition("max_rotation_deg", "largest rotation between two images", "largest rotation between two images"),
    condition("max_translation_m", "largest distance between two images", "largest distance between two images"),
    outcome("matches", "matched points of all image pairs"),
    outcome("pairs_matched", "pairs of images with enough matches"),
    error("outlier_fraction", "fraction of the matches that disagree with the essential matrix"),
    error("residual_median_px", "median distance of the matches from the poses' epipolar curves"),
    error("residual_90_percent_px", "90 % quantile of the distance from the epipolar curves"),
    error("residual_worst_pair_px", "median distance of the worst pair"),
)

MATCHING_COLUMNS = Columns(_CASE)

_MATCHERS = {"template": "templates", "sift": "SIFT features", "orb": "ORB features", "lvs": "landmarks"}


def _map_columns(prefix: str, whose: str) -> tuple[Column, ...]:
    """Return the columns of an image over a map."""
    words = prefix.replace(".", " ")
    columns = [
        outcome("registration_inliers", "number of features that agree with the pose, found on the whole map"),
        condition("height_m", "height above the ground"),
        condition("off_nadir_deg", "angle between optical axis and nadir", f"{words}off-nadir angle"),
        condition("ground_pixel_m", "size of a pixel on the ground at the nadir"),
    ]
    for name, items in _MATCHERS.items():
        columns += [
            outcome(f"{name}_searched", f"number of {items} of the image that were searched on the map"),
            outcome(f"{name}_inliers", f"number of {items} that were found at the right position"),
            outcome(f"{name}_yield", f"fraction of {items} that were found at the right position"),
            outcome(f"{name}_rank", "rank of this yield among the four matchers; 1 is the largest yield"),
        ]
    columns += [
        outcome(f"{name}_inlier_fraction", f"fraction of the matched {_MATCHERS[name]} at the right position")
        for name in ("sift", "orb")
    ]
    columns += [
        outcome("template_correlation", "median of the highest correlations of all templates"),
        outcome("template_strong_correlation", "the same for the quarter of the templates with the most contrast"),
        outcome("lvs_found_fraction", "fraction of landmarks that were found, before the check of the common pose"),
        outcome("lvs_correlation", "median correlation of the landmarks that agree on the pose"),
        outcome("lvs_residual_px", "median distance of these landmarks from the common pose, pixels of their search"),
    ]
    return tuple(replace(column, name=prefix + column.name, meaning=f"{whose}: {column.meaning}") for column in columns)


MAP_COLUMNS = Columns(
    (
        *_IDENTITY,
        *_map_columns("", "recorded image"),
        text("rendered.outcome", "outcome of the rendered image", ColumnKind.OUTCOME),
        *_map_columns("rendered.", "rendered image"),
        error("rendered.pose_error_px", "median distance between the pixels of the landmarks by found and true pose"),
    )
)

VELOCITY_COLUMNS = Columns(
    (
        *_CASE,
        *common.ALGORITHM,
        *common.VELOCITY,
        condition("altitude_*_m", "measured altitude at an image", "altitude at image *"),
        common.OFF_NADIR_MAX,
        condition("sun_elevation_deg", "elevation of the sun above the horizon"),
        flag("truth_known", "the truth is known"),
        error("inertial_difference_m_s", "difference from the inertial velocity, which has an unknown constant error"),
        error(
            "pair_discrepancy_m_s", "difference of the velocity changes between both pairs: estimated minus inertial"
        ),
        error("difference_m_s", "difference from the answer of the algorithm under test"),
    )
)

LANDING_COLUMNS = Columns(
    (
        *_CASE,
        *common.ALGORITHM,
        *common.HAZARD_DETECTION,
        condition("slant_range_m", "measured distance to the ground along the optical axis"),
        flag("truth_known", "the truth is known"),
        outcome("site_up_m", "height of the site"),
        error("difference_m", "distance from the site of the algorithm under test"),
        error("rotation_pose_difference_deg", "difference of the estimated rotation from that of the measured poses"),
        error("direction_pose_difference_deg", "difference of the estimated direction from that of the measured poses"),
        error("length_pose_difference_m", "difference of the estimated length from that of the measured poses"),
        error("baseline_pose_difference_fraction", "difference of the estimated translation, divided by its length"),
    )
)
