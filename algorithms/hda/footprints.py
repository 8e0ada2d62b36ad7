"""Safe landing map by a check of each footprint against limits that include the map's resolution and errors.

The estimator uses it with the option `check_footprints`; without it, the safe landing map of section III
(`marsyard.algorithms.hda.hazards`), as published.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int, UInt8

from marsyard.algorithms.hda.elevation import ElevationMap
from marsyard.algorithms.hda.hazards import Safety
from marsyard.algorithms.hda.kernels import elevation as kernels
from marsyard.algorithms.hda.morphology import dilate
from marsyard.algorithms.hda.motion import CameraMotion
from marsyard.algorithms.hda.options import HdaOptions

#: Number of points for the plane fit per footprint diameter.
POINTS_PER_DIAMETER = 16


@dataclass(frozen=True)
class Resolution:
    """Map resolution: side of the matching windows on the ground, and standard deviations of elevation and position.

    The position is that of the map in the surface frame: an error of the vertical displaces it horizontally.
    """

    window_m: float
    noise_m: float
    position_m: float


def map_resolution(motion: CameraMotion, focal_px: float, options: HdaOptions) -> Resolution:
    """Estimate the resolution of a map at the features' median depth.

    The match error perpendicular to epipolar lines is estimated from the tracks' residuals. The same error is assumed
    along the lines, where it causes a depth error.
    """
    depth = float(np.median(motion.depths[motion.inliers]))
    error_px = kernels.SIGMA_PER_MEDIAN * float(np.median(motion.residuals_px[motion.inliers]))
    error_px = float(np.hypot(error_px, options.match_error_px))
    window_m = depth * (2 * options.search_half_px + 1) / focal_px
    return Resolution(window_m, depth * error_px / motion.parallax_px, depth * options.level_error_rad)


def roughness_limit_m(resolution: Resolution, cell_m: float, options: HdaOptions) -> float:
    """Maximum roughness of a safe footprint in the map; zero or negative if the map cannot resolve hazards.

    A map shows reduced heights. A match averages over a window of side w, a cell of side s averages over points up to a
    distance s, and its centre is up to s / 2 from the top of a hazard along each axis. A paraboloid of base width D
    therefore has the fraction ``1 - 4 r2 / D**2`` of its height in the map. r2 is the mean square distance of the
    averaged points from its top: w**2 / 6 (window) + s**2 / 3 (bilinear weights) + s**2 / 2 (position). The limit is
    the reduced height of the narrowest hazard at the lander's limit, minus the margin for the map's noise.
    """
    mean_square_m2 = resolution.window_m**2 / 6.0 + 5.0 / 6.0 * cell_m**2
    width = options.narrowest_hazard * options.max_roughness_m
    height_fraction = max(1.0 - 4.0 * mean_square_m2 / width**2, 0.0)
    return height_fraction * options.max_roughness_m - options.margin_deviations * resolution.noise_m


def classify_footprints(
    ground: ElevationMap, resolution: Resolution, options: HdaOptions
) -> UInt8[np.ndarray, "rows columns"]:
    """Classify the footprint centred at each cell by a robust plane of its own: values of `Safety`.

    A footprint is safe if the slope of its plane and the largest distance of a cell from the plane are within the
    limits. The plane is fitted to a disc of the lander's diameter; the distances are also checked one cell farther out,
    because positions between cell centres belong to the nearest cell. A footprint with an empty cell, or beyond the
    border of the map, is unknown. Hazards and unknown positions are dilated by the error of the map's position, with
    the margin `margin_deviations`. The maps of section III have planes of fixed squares only, and their hazards are
    enlarged by the lander's diameter.
    """
    shape = ground.elevation_m.shape
    max_roughness_m = roughness_limit_m(resolution, ground.cell_m, options)
    if max_roughness_m <= 0.0:
        return np.full(shape, Safety.HAZARD, dtype=np.uint8)
    radius_cells = 0.5 * options.lander_diameter_m / ground.cell_m
    step = max(int(2.0 * radius_cells / POINTS_PER_DIAMETER), 1)
    fit_offsets = disc_cells(radius_cells)
    fit_offsets = fit_offsets[np.all(fit_offsets % step == 0, axis=1)].copy()
    empty = np.pad(np.isnan(ground.elevation_m), 1, constant_values=True)
    known = ~dilate(empty, radius_cells)[1:-1, 1:-1]
    rows, columns = np.nonzero(known)
    triples = np.random.default_rng(options.seed).uniform(size=(options.plane_trials, 3))
    slopes, roughness = kernels.evaluate_footprints(
        ground.elevation_m, rows, columns, disc_cells(radius_cells + 1.0), fit_offsets, triples, options.refine_planes
    )
    max_slope_rad = options.max_slope_rad - options.margin_deviations * options.level_error_rad
    safe = (np.arctan(slopes / ground.cell_m) <= max_slope_rad) & (roughness <= max_roughness_m)
    hazard = np.zeros(shape, dtype=bool)
    hazard[rows[~safe], columns[~safe]] = True
    margin_cells = options.margin_deviations * resolution.position_m / ground.cell_m
    unknown = dilate(np.pad(~known, 1, constant_values=True), margin_cells)[1:-1, 1:-1]
    hazard = dilate(hazard, margin_cells)
    safety = np.where(hazard, Safety.HAZARD, np.where(unknown, Safety.UNKNOWN, Safety.SAFE))
    return np.asarray(safety.astype(np.uint8))


def disc_cells(radius_cells: float) -> Int[np.ndarray, "n 2"]:
    """List the cells of a disc as offsets (row, column) from its centre."""
    radius = int(radius_cells)
    offsets = np.arange(-radius, radius + 1)
    cells = np.stack(np.meshgrid(offsets, offsets, indexing="ij"), axis=-1).reshape(-1, 2)
    return np.asarray(cells[np.hypot(*cells.T) <= radius_cells])
