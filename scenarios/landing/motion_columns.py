"""Columns of tracks and motion of an algorithm, compared with the true motion."""

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.hda import STAGES, HdaDetails
from marsyard.scenarios.hda_stage_columns import motion_errors, stage_row
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.landing.flight import LandingFlight
from marsyard.scenarios.landing.images import Pair
from marsyard.sim.camera import camera_pose

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

NAN = float("nan")


def true_motion(flight: LandingFlight, pair: Pair) -> RigidTransform:
    """Compute the true motion from the first to the second camera's frame."""
    first, second = (
        state.world_from_body * camera_pose(image.camera)
        for state, image in zip(flight.states, pair.images, strict=True)
    )
    return second.inv() * first


def motion_row(details: object, flight: LandingFlight, pair: Pair) -> dict[str, Scalar]:
    """Compute the columns of tracks and motion errors; NaN for stages that were not reached."""
    row: dict[str, Scalar] = dict.fromkeys(MOTION_COLUMNS, NAN)
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
            "tracked_fraction": float(is_correct.sum() / in_view.sum()) if np.any(in_view) else NAN,
            "tracked_well": bool(np.any(in_view) and is_correct.sum() >= MIN_TRACKED_FRACTION * in_view.sum()),
            "tracks_outlier_fraction": float(np.mean(~is_correct[tracks.accepted])) if accepted else NAN,
        }
    if details.motion is not None:
        row |= motion_errors(details.motion.second_from_first, true_motion(flight, pair))
    return row | stage_row(details)


def times_row(details: object) -> dict[str, Scalar]:
    """Compute the columns of processor times of the stages in Table I; NaN for stages that were not reached."""
    stage_times_s = details.times_s if isinstance(details, HdaDetails) else {}
    return {f"{stage}_time_s": stage_times_s.get(stage, NAN) for stage in STAGES}
