"""Quantities of the tracker's updates at the stops of a run.

Table III is that of Kim et al., "Targeted Driving Using Visual Tracking".
"""

import numpy as np
from jaxtyping import Float64

from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.rover.run_state import RoverRun

NAN = float("nan")

#: Quantities of each update, in the order of the columns of stored updates.
UPDATE_QUANTITIES = (
    "range_m", "azimuth_deg", "elevation_deg", "magnification", "roll_change_deg", "azimuth_change_deg",
    "match_score", "stereo_score", "correction_px", "error_px", "position_error_m", "leg", "time_s",
)  # fmt: skip


def errors_px(run: RoverRun) -> Float64[np.ndarray, "stops 2"]:
    """Compute tracked minus true pixels (u, v) of the designated point at all stops; NaN if it was not tracked."""
    errors = [stop.reported_px(run.setup.rig.calibrated) - stop.point_px for stop in run.stops]
    return np.stack(errors) if errors else np.empty((0, 2))


def update_quantities(run: RoverRun) -> dict[str, Float64[np.ndarray, "stops"]]:
    """Collect the quantities of all updates in arrays; NaN if missing: for a tracker without details, for example."""
    rows = []
    for stop, error in zip(run.stops, errors_px(run), strict=True):
        azimuth, elevation = np.degrees(stop.angles_rad)
        row = {
            "range_m": stop.range_m,
            "azimuth_deg": float(azimuth),
            "elevation_deg": float(elevation),
            "error_px": float(np.hypot(*error)),
            "position_error_m": float(np.linalg.norm(stop.error_m())),
            "leg": float(stop.leg),
            "time_s": stop.time_s,
        }
        details = stop.details
        if details is not None and details.change is not None:
            row["magnification"] = details.change.magnification
            row["roll_change_deg"] = float(np.degrees(details.change.roll_rad))
        if details is not None and details.stereo is not None:
            row["stereo_score"] = details.stereo.score
        if details is not None and not details.seeded and stop.update.tracked:
            row["azimuth_change_deg"] = float(np.degrees(details.azimuth_change_rad))
        if details is not None and not details.seeded and details.match is not None:
            row["match_score"] = details.match.score
            if details.predicted_pixel is not None:
                row["correction_px"] = float(np.max(np.abs(details.match.pixel - details.predicted_pixel)))
        rows.append(row)
    return {name: np.array([row.get(name, NAN) for row in rows], dtype=np.float64) for name in UPDATE_QUANTITIES}


def update_columns(run: RoverRun, count: int) -> dict[str, Scalar]:
    """Compute the columns of the first updates (as in Table III), NaN for missing updates."""
    return {
        f"update_{number + 1}_{name}": float(values[number]) if number < len(values) else NAN
        for number in range(count)
        for name, values in update_quantities(run).items()
    }


def finite_max(values: Float64[np.ndarray, "n"]) -> float:
    """Return the maximum; NaN without finite values."""
    return float(np.nanmax(values)) if np.any(np.isfinite(values)) else NAN
