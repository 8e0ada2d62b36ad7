"""Columns of the motion that a landing algorithm solved for: errors and support."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.hda import Fate, HdaDetails
from marsyard.scenarios.interface import Scalar

NAN = float("nan")
#: Reasons for dropped matches.
DROPPED = (Fate.UNLIKE, Fate.OUT_OF_BOUNDS, Fate.NOT_RETURNED)


def motion_errors(found: RigidTransform, true: RigidTransform) -> dict[str, Scalar]:
    """A motion from the first to the second camera's frame against the true one."""
    length, true_length = (float(np.linalg.norm(one.translation)) for one in (found, true))
    turned = (found.rotation * true.rotation.inv()).magnitude()
    off = float(np.linalg.norm(found.translation - true.translation))
    return {
        "rotation_error_deg": float(np.degrees(turned)),
        "direction_error_deg": float(np.degrees(2.0 * np.arcsin(min(_direction_distance(found, true) / 2.0, 1.0)))),
        "length_error_m": length - true_length,
        "baseline_error_share": off / true_length if true_length > 0.0 else NAN,
    }


def solved_row(details: HdaDetails) -> dict[str, Scalar]:
    """Inliers, matches and map size; without columns of stages that were not reached."""
    row: dict[str, Scalar] = {}
    if details.motion is not None:
        row |= {
            "inliers": int(details.motion.inliers.sum()),
            "parallax_px": details.motion.parallax_px,
            "motion_residual_px": float(np.median(details.motion.residuals_px)),
        }
    if details.matches is not None:
        matches = details.matches
        row |= {"points": len(matches.points), "matched_share": float(matches.accepted.mean())}
        row |= {f"matches_{fate.name.lower()}": int(np.sum(matches.fates == fate)) for fate in DROPPED}
    if details.ground is not None:
        rows, columns = details.ground.elevation.elevation_m.shape
        row |= {"map_rows": rows, "map_columns": columns, "cell_m": details.ground.elevation.cell_m}
    return row


def _direction_distance(one: RigidTransform, other: RigidTransform) -> float:
    """Distance of the unit vectors of two translations."""
    a, b = (np.array(each.translation) for each in (one, other))
    if not (np.any(a) and np.any(b)):
        return NAN
    return float(np.linalg.norm(a / np.linalg.norm(a) - b / np.linalg.norm(b)))
