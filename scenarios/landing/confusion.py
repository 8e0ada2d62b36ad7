"""The algorithm's maps against the truth: elevation, slope, missed hazards and false alarms.

Everything is counted at the places of the truth's lattice that the map covers and whose ground both pictures show, and
at the map's cell nearest to each. Places in the map's coordinates are held against the truth at the same horizontal
distance from the camera: the navigation's error of position, which the landing shares, is left out, those of its
azimuth and of the vertical are in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt

from marsyard.algorithms.hda import Ground, Safety
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.landing.flight import Flight
from marsyard.scenarios.landing.truth import GroundTruth

#: Bounds of the classes of hazards, in units of the limit: below, up to half above, up to twice, thrice, and beyond.
CLASSES = (1.0, 1.5, 2.0, 3.0)
#: Names of the classes between these bounds.
CLASS_NAMES = ("below_1", "1_to_1.5", "1.5_to_2", "2_to_3", "above_3")
#: Cells that a hazard must be across for it to be asked for.
CELLS_ACROSS = 3.0
#: Hazards of this many limits are the ones that bar 2 of the validation asks for.
GROSS = 2.0


@dataclass(frozen=True)
class MapAtPlaces:
    """The algorithm's map at places of the truth."""

    #: Whether the map has slope and roughness there, and both pictures show the footprint
    known: Bool[np.ndarray, "rows columns"]
    safe: Bool[np.ndarray, "rows columns"]  #: Whether the map calls the place safe
    #: Whether a cell that is itself a hazard, before growth, lies under the lander
    flagged: Bool[np.ndarray, "rows columns"]
    slope_rad: Float[np.ndarray, "rows columns"]  #: The map's slope

    @classmethod
    def of(cls, ground: Ground, flight: Flight, truth: GroundTruth, limits_rad_m: tuple[float, float]) -> MapAtPlaces:
        """The map at the truth's places; `limits_rad_m` are the algorithm's own limits of slope and roughness."""
        cells = _cells_at(ground, flight, truth)
        shape = np.array(ground.elevation.elevation_m.shape)
        inside = np.all((cells >= 0) & (cells < shape), axis=-1) & truth.covered
        rows, columns = np.moveaxis(np.clip(cells, 0, shape - 1), -1, 0)
        hazards = ground.hazards
        with np.errstate(invalid="ignore"):
            raw = (hazards.slope_rad > limits_rad_m[0]) | (hazards.roughness_m > limits_rad_m[1])
        reach = 0.5 * truth.limits.diameter_m / ground.elevation.cell_m
        near = distance_transform_edt(~raw) <= reach if np.any(raw) else np.zeros_like(raw)
        slope = hazards.slope_rad[rows, columns]
        known = inside & np.isfinite(slope) & np.isfinite(hazards.roughness_m[rows, columns])
        safe = known & (hazards.safety[rows, columns] == Safety.SAFE)
        return cls(known, safe, known & near[rows, columns], slope)


def _cells_at(ground: Ground, flight: Flight, truth: GroundTruth) -> Int[np.ndarray, "rows columns 2"]:
    """The map's cells (row, column) at the truth's places."""
    away = truth.places - flight.states[0].position_m[:2]
    world_from_surface = ground.world_from_surface.as_matrix()[:2, :2]
    return np.asarray(np.rint(ground.elevation.cells(np.asarray(away @ world_from_surface))).astype(np.int64))


def hazard_counts(ground: Ground, at: MapAtPlaces, truth: GroundTruth) -> dict[str, Scalar]:
    """Counts of footprints by what is true of them and what the map says: sums over cases make rates.

    For each class of roughness and of slope over the limit: `footprints_*` in all, `footprints_*_safe` that the map
    calls safe, `footprints_*_unflagged` under which it has no hazard before growth. `gross_*` are hazards of twice the
    limit of roughness that are at least three cells across; `false_alarms` truly safe footprints with a hazard of the
    map under them.
    """
    under = truth.footprints
    across = 2.0 * np.sqrt(under.exceeding_m2 / np.pi) / ground.elevation.cell_m
    gross = (under.roughness_m >= GROSS * truth.limits.max_roughness_m) & (across >= CELLS_ACROSS)
    row: dict[str, Scalar] = {
        "footprints": _count(at.known),
        "footprints_called_safe": _count(at.safe),
        "footprints_called_safe_unsafe": _count(at.safe & ~under.safe),
        "footprints_truly_safe": _count(at.known & under.safe),
        "false_alarms": _count(at.known & under.safe & at.flagged),
        "missed": _count(at.known & ~under.safe & ~at.flagged),
        "gross": _count(at.known & gross),
        "gross_called_safe": _count(at.safe & gross),
        "gross_unflagged": _count(at.known & gross & ~at.flagged),
    }
    for kind, over in (
        ("roughness", under.roughness_m / truth.limits.max_roughness_m),
        ("slope", under.slope_rad / truth.limits.max_slope_rad),
    ):
        members = np.digitize(over, CLASSES)
        for number, name in enumerate(CLASS_NAMES):
            of_class = at.known & (members == number)
            row[f"footprints_{kind}_{name}"] = _count(of_class)
            row[f"footprints_{kind}_{name}_safe"] = _count(of_class & at.safe)
            row[f"footprints_{kind}_{name}_unflagged"] = _count(of_class & ~at.flagged)
    return row


def map_errors(ground: Ground, flight: Flight, at: MapAtPlaces, truth: GroundTruth) -> dict[str, Scalar]:
    """Errors of the map's elevation and slope.

    The elevation is held against the mean of the exact heights over each cell, relative to the camera. `bias` is the
    error's mean, `rms` its RMS about zero, `noise` what a robust standard deviation makes of it after its plane is
    taken off: what roughness sees; `outliers` the share beyond five of these.
    """
    rows, columns = np.indices(ground.elevation.elevation_m.shape)
    local = ground.elevation.places(np.stack([rows, columns], axis=-1).astype(np.float64))
    start = flight.states[0].position_m
    places = start[:2] + local @ ground.world_from_surface.as_matrix()[:2, :2].T
    exact = truth.relief.averaged(places, ground.elevation.cell_m) - start[2]
    error = ground.elevation.elevation_m - exact
    known = np.isfinite(error)
    values = error[known]
    if values.size < 4:
        return {}
    design = np.column_stack([local[known], np.ones(values.size)])
    near = np.abs(values - np.median(values)) <= 5.0 * _deviation(values)
    level = values - design @ np.linalg.lstsq(design[near], values[near], rcond=None)[0]
    noise = _deviation(level)
    slope_errors = (at.slope_rad - truth.footprints.slope_rad)[at.known]
    return {
        "elevation_bias_m": float(values.mean()),
        "elevation_rms_m": float(np.sqrt(np.mean(values**2))),
        "elevation_median_error_m": float(np.median(np.abs(values))),
        "elevation_noise_m": noise,
        "elevation_outliers": float(np.mean(np.abs(level) > 5.0 * noise)),
        "slope_error_bias_deg": float(np.degrees(slope_errors.mean())) if slope_errors.size else float("nan"),
        "slope_error_rms_deg": float(np.degrees(np.sqrt(np.mean(slope_errors**2))))
        if slope_errors.size
        else float("nan"),
    }


def _deviation(values: Float[np.ndarray, "n"]) -> float:
    """A robust standard deviation; the least positive number where more than half of the values are the same."""
    return max(1.4826 * float(np.median(np.abs(values - np.median(values)))), 1e-12)


def _count(chosen: Bool[np.ndarray, "rows columns"]) -> int:
    return int(np.count_nonzero(chosen))
