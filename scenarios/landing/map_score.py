"""Result columns of an algorithm's hazard map: counts of hazards, and errors of elevation and slope."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt

from marsyard.algorithms.hda import HdaDetails, HdaOptions, MappedGround, Safety
from marsyard.algorithms.interface import SiteEstimate
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.landing.flight import LandingFlight
from marsyard.scenarios.landing.ground_truth import GroundTruth
from marsyard.scenarios.landing.parameters import LandingScenarioParameters

#: Bounds of the classes of slope or roughness divided by its limit, and the names of the classes.
CLASS_BOUNDS = (1.0, 1.5, 2.0, 3.0)
CLASS_NAMES = ("below_1", "1_to_1.5", "1.5_to_2", "2_to_3", "above_3")
#: Gross (large) hazards: minimum diameter in map cells, and minimum roughness divided by its limit.
MIN_GROSS_CELLS, MIN_GROSS_ROUGHNESS = 3.0, 2.0
#: Minimum distance of an outlier from the median or the fitted plane, in robust standard deviations.
OUTLIER_DEVIATIONS = 5.0


def map_row(
    p: LandingScenarioParameters, estimate: SiteEstimate, flight: LandingFlight, truth: GroundTruth
) -> dict[str, Scalar]:
    """Compute the columns of map errors and hazard counts; only the relief error, NaN, without a map."""
    row: dict[str, Scalar] = {"relief_error_fraction": np.nan}
    if not isinstance(estimate.details, HdaDetails) or estimate.details.ground is None:
        return row
    ground = estimate.details.ground
    sampled_map = SampledMap.sample(ground, flight, truth, p.hda)
    return {**row, **map_errors(ground, flight, sampled_map, truth), **count_hazards(ground, sampled_map, truth)}


@dataclass(frozen=True)
class SampledMap:
    """The algorithm's hazard map, sampled at the truth's grid positions."""

    #: fraction of the positions with their whole footprint in both images that have an elevation; 1 without positions
    mapped_fraction: float
    #: whether the map has slope and roughness at the position, and both images show the whole footprint
    valid: Bool[np.ndarray, "rows columns"]
    safe: Bool[np.ndarray, "rows columns"]  #: whether the map classifies the position as safe
    flagged: Bool[np.ndarray, "rows columns"]  #: whether a hazard cell, before dilation, is under the lander
    slope_rad: Float[np.ndarray, "rows columns"]

    @classmethod
    def sample(cls, ground: MappedGround, flight: LandingFlight, truth: GroundTruth, options: HdaOptions) -> SampledMap:
        """Sample the map at the truth's positions; `options` are those of the algorithm, with its limits."""
        offsets = truth.positions - flight.states[0].position_m[:2]
        local = np.asarray(offsets @ ground.world_from_surface.as_matrix()[:2, :2])
        cells = np.rint(ground.elevation.cells(local)).astype(np.int64)
        shape = np.array(ground.elevation.elevation_m.shape)
        is_inside = np.all((cells >= 0) & (cells < shape), axis=-1) & truth.covered
        rows, columns = np.moveaxis(np.clip(cells, 0, shape - 1), -1, 0)
        hazards = ground.hazards
        with np.errstate(invalid="ignore"):
            is_hazard = (hazards.slope_rad > options.max_slope_rad) | (hazards.roughness_m > options.max_roughness_m)
        radius = 0.5 * truth.limits.diameter_m / ground.elevation.cell_m
        flagged = distance_transform_edt(~is_hazard) <= radius if np.any(is_hazard) else np.zeros_like(is_hazard)
        has_elevation = is_inside & np.isfinite(ground.elevation.elevation_m[rows, columns])
        mapped_fraction = float(np.mean(has_elevation[truth.covered])) if np.any(truth.covered) else 1.0
        slope = hazards.slope_rad[rows, columns]
        valid = is_inside & np.isfinite(slope) & np.isfinite(hazards.roughness_m[rows, columns])
        safe = valid & (hazards.safety[rows, columns] == Safety.SAFE)
        return cls(mapped_fraction, valid, safe, valid & flagged[rows, columns], slope)


def count_hazards(ground: MappedGround, sampled: SampledMap, truth: GroundTruth) -> dict[str, Scalar]:
    """Count footprints by truth and map; sums over cases give rates.

    Footprints are classified by roughness / limit and slope / limit. For each class:

    - `footprints_*`: number of footprints
    - `footprints_*_safe`: number that the map classifies as safe
    - `footprints_*_unflagged`: number without a hazard cell, before the algorithm dilates the hazard cells

    `footprints_called_safe` is the number of all footprints that the map classifies as safe, and
    `footprints_called_safe_unsafe` the number of these footprints that are truly unsafe.

    `gross_*` hazards have at least twice the roughness limit and a diameter of at least three cells. `false_alarms` are
    safe footprints with a hazard cell; `missed` are unsafe footprints without one.
    """
    footprints, valid, safe = truth.footprints, sampled.valid, sampled.safe
    ratios = {
        "roughness": footprints.roughness_m / truth.limits.max_roughness_m,
        "slope": footprints.slope_rad / truth.limits.max_slope_rad,
    }
    diameter_cells = 2.0 * np.sqrt(footprints.exceeding_m2 / np.pi) / ground.elevation.cell_m
    is_gross = footprints.roughness_m >= MIN_GROSS_ROUGHNESS * truth.limits.max_roughness_m
    is_gross &= diameter_cells >= MIN_GROSS_CELLS
    masks = {
        "footprints": valid,
        "footprints_called_safe": safe,
        "footprints_called_safe_unsafe": safe & ~footprints.safe,
        "footprints_truly_safe": valid & footprints.safe,
        "false_alarms": valid & footprints.safe & sampled.flagged,
        "missed": valid & ~footprints.safe & ~sampled.flagged,
        "gross_hazards": valid & is_gross,
        "gross_hazards_called_safe": safe & is_gross,
        "gross_hazards_unflagged": valid & is_gross & ~sampled.flagged,
    }
    for kind, ratio in ratios.items():
        classes = np.digitize(ratio, CLASS_BOUNDS)
        for number, name in enumerate(CLASS_NAMES):
            members = valid & (classes == number)
            column = f"footprints_{kind}_{name}"
            unflagged = members & ~sampled.flagged
            masks |= {column: members, f"{column}_safe": members & safe, f"{column}_unflagged": unflagged}
    return {column: int(np.count_nonzero(mask)) for column, mask in masks.items()}


def map_errors(
    ground: MappedGround, flight: LandingFlight, sampled: SampledMap, truth: GroundTruth
) -> dict[str, Scalar]:
    """Compute the errors of the map's elevation and slope.

    The reference elevation is the mean of the exact heights in a cell, relative to the camera. `bias` is the mean
    error, `rms` the RMS error, `median_error` the median absolute error. `noise` is the robust standard deviation of
    the errors about a fitted plane; `outliers` is the fraction of errors about this plane beyond `OUTLIER_DEVIATIONS`
    times `noise`. The result is empty for fewer than four cells with an elevation.

    `relief_error_fraction` is the RMS of the errors about their plane of least squares, divided by that of the exact
    heights. Rocks that the map lacks and gross errors count, unlike in robust deviations. Ground in both images without
    an elevation has the error of a plane. The result is 1 for a plane, which needs no images, and 0 for an exact map.
    """
    rows, columns = np.indices(ground.elevation.elevation_m.shape)
    local = ground.elevation.positions(np.stack([rows, columns], axis=-1).astype(np.float64))
    start = flight.states[0].position_m
    positions = start[:2] + local @ ground.world_from_surface.as_matrix()[:2, :2].T
    exact = truth.relief.average(positions, ground.elevation.cell_m) - start[2]
    error = ground.elevation.elevation_m - exact
    is_finite = np.isfinite(error)
    values = error[is_finite]
    if values.size < 4:  # the fitted plane has three parameters
        return {}
    design = np.column_stack([local[is_finite], np.ones(values.size)])
    residuals = _subtract_plane(design, values)
    noise = _robust_deviation(residuals)
    pair = np.column_stack([values, exact[is_finite]])
    error, relief = np.std(pair - design @ np.linalg.lstsq(design, pair, rcond=None)[0], axis=0)
    mapped = sampled.mapped_fraction
    slope_errors = (sampled.slope_rad - truth.footprints.slope_rad)[sampled.valid]
    has_slopes = slope_errors.size > 0
    return {
        "elevation_bias_m": float(values.mean()),
        "elevation_rms_m": float(np.sqrt(np.mean(values**2))),
        "elevation_median_error_m": float(np.median(np.abs(values))),
        "elevation_noise_m": noise,
        "relief_error_fraction": float(np.sqrt(mapped * (error / relief) ** 2 + 1.0 - mapped)),
        "elevation_outliers": float(np.mean(np.abs(residuals) > OUTLIER_DEVIATIONS * noise)),
        "slope_error_bias_deg": float(np.degrees(slope_errors.mean())) if has_slopes else np.nan,
        "slope_error_rms_deg": float(np.degrees(np.sqrt(np.mean(slope_errors**2)))) if has_slopes else np.nan,
    }


def _subtract_plane(design: Float[np.ndarray, "n 3"], values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Subtract the plane that is fitted to the values without their outliers, which are found about a first plane.

    An additional plane in the values does not change the result.
    """
    residuals = values - design @ np.linalg.lstsq(design, values, rcond=None)[0]
    is_inlier = np.abs(residuals - np.median(residuals)) <= OUTLIER_DEVIATIONS * _robust_deviation(residuals)
    return np.asarray(values - design @ np.linalg.lstsq(design[is_inlier], values[is_inlier], rcond=None)[0])


def _robust_deviation(values: Float[np.ndarray, "n"]) -> float:
    """Compute a robust standard deviation; at least 1e-12, so that ratios are finite.

    It is 1.4826 times the median absolute deviation: the ratio of the two for a normal distribution.
    """
    return max(1.4826 * float(np.median(np.abs(values - np.median(values)))), 1e-12)
