"""Columns of the stages of hazard detection: motion, matches and map, in simulated flights and real images."""

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.hda import HdaDetails, MatchStatus, Safety
from marsyard.scenarios.interface import Scalar

#: Match statuses whose matches are dropped and counted.
DROP_STATUSES = (MatchStatus.DISSIMILAR, MatchStatus.OUT_OF_BOUNDS, MatchStatus.INCONSISTENT)


def motion_errors(estimated: RigidTransform, true: RigidTransform) -> dict[str, Scalar]:
    """Compute the errors of an estimated motion from the first to the second camera's frame."""
    translation, true_translation = np.array(estimated.translation), np.array(true.translation)
    length, true_length = float(np.linalg.norm(translation)), float(np.linalg.norm(true_translation))
    chord = np.nan  # between the unit vectors of both directions, which a motion without translation lacks
    if length > 0.0 and true_length > 0.0:
        chord = float(np.linalg.norm(translation / length - true_translation / true_length))
    error = float(np.linalg.norm(translation - true_translation))
    return {
        "rotation_error_deg": float(np.degrees((estimated.rotation * true.rotation.inv()).magnitude())),
        "direction_error_deg": float(np.degrees(2.0 * np.arcsin(min(chord / 2.0, 1.0)))),
        "length_error_m": length - true_length,
        "baseline_error_fraction": error / true_length if true_length > 0.0 else np.nan,
    }


def stage_row(details: HdaDetails) -> dict[str, Scalar]:
    """Compute the columns of inliers, matches and map; only for stages that were reached.

    `empty_fraction` is the fraction of the map's cells without an elevation, after small holes were filled;
    `unknown_fraction` is the fraction of cells that the safe landing map classifies as unknown.
    """
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
        row |= {f"matches_{status.name.lower()}": int(np.sum(matches.statuses == status)) for status in DROP_STATUSES}
    if details.ground is not None:
        rows, columns = details.ground.elevation.elevation_m.shape
        row |= {"map_rows": rows, "map_columns": columns, "cell_m": details.ground.elevation.cell_m}
        row["empty_fraction"] = float(np.mean(np.isnan(details.ground.elevation.elevation_m)))
        row["unknown_fraction"] = float(np.mean(details.ground.hazards.safety == Safety.UNKNOWN))
    return row
