"""Hazard maps, safe landing map and selection of the landing site (section III).

With the option `check_footprints`, the estimator replaces section III's safe landing map by a check of each footprint
against limits that include the map's resolution and errors (`classify_footprints`).

Sections are those of Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Float, Int, UInt8

from marsyard.algorithms.arrays import Raster, Vector2
from marsyard.algorithms.hda.elevation import ElevationMap, dilate, grassfire
from marsyard.algorithms.hda.kernels import elevation as kernels
from marsyard.algorithms.hda.motion import CameraMotion
from marsyard.algorithms.hda.options import HdaOptions

#: Minimum side of the squares for plane fits, cells; a least-median-of-squares fit requires more than a few points.
MIN_SIDE_CELLS = 3
#: Number of points for the plane fit per footprint diameter.
POINTS_PER_DIAMETER = 16


class Safety(IntEnum):
    """Values of the safe landing map; in the paper's figures they are green, yellow and red."""

    SAFE = 0
    UNKNOWN = 1
    HAZARD = 2


@dataclass(frozen=True)
class HazardMaps:
    """Hazard maps on the cells of the elevation map.

    - smooth_m: Elevation of the smooth underlying surface
    - roughness_m: Absolute distance of the elevation from the smooth surface
    - slope_rad: Angle between the ground's normal and the vertical
    - safety: The safe landing map, values of `Safety`
    """

    smooth_m: Raster
    roughness_m: Raster
    slope_rad: Raster
    safety: UInt8[np.ndarray, "rows columns"]


def hazard_maps(ground: ElevationMap, options: HdaOptions) -> HazardMaps:
    """Compute the hazard maps of an elevation map."""
    smooth, slope = smooth_surface(ground, options)
    roughness = np.abs(ground.elevation_m - smooth)
    return HazardMaps(smooth, roughness, slope, safe_landing_map(slope, roughness, ground.cell_m, options))


def smooth_surface(ground: ElevationMap, options: HdaOptions) -> tuple[Raster, Raster]:
    """Fit robust planes to footprints; interpolate elevation (metres) and slope (radians) between their centres.

    The footprints are squares with the lander's diameter as side, distributed evenly over the map. Outside the
    outermost centres the extrapolation is linear, with slopes clipped at zero. The plane of a square is NaN if fewer
    than half of its cells are valid.
    """
    side = max(round(options.lander_diameter_m / ground.cell_m), MIN_SIDE_CELLS)
    shape = ground.elevation_m.shape
    starts = [_square_starts(extent, side) for extent in shape]
    # random numbers from which the kernel selects three cells in each trial
    triples = np.random.default_rng(options.seed).uniform(size=(options.plane_trials, 3))
    min_cells = max(side * side // 2, 4)  # a plane through three cells has no residuals
    planes = kernels.footprint_planes(ground.elevation_m, *starts, side, min_cells, triples, options.refine_planes)
    if planes.size == 0:
        return np.full(shape, np.nan), np.full(shape, np.nan)
    heights, column_slopes, row_slopes = np.moveaxis(planes, -1, 0)
    column_slopes, row_slopes = column_slopes / ground.cell_m, row_slopes / ground.cell_m
    centres = [start + 0.5 * (side - 1) for start in starts]
    rows, columns = (_interpolation_weights(centre, extent) for centre, extent in zip(centres, shape, strict=True))
    smooth = _interpolate(heights, rows, columns)
    # Along an axis with a single footprint, extrapolate with the slope of its plane.
    for axis, axis_slopes in enumerate((row_slopes, column_slopes)):
        if len(centres[axis]) == 1:
            offsets = np.expand_dims(np.arange(shape[axis]) - centres[axis][0], 1 - axis)
            smooth = smooth + _interpolate(axis_slopes, rows, columns) * ground.cell_m * offsets
    slopes = np.arctan(np.hypot(column_slopes, row_slopes))
    return smooth, np.maximum(_interpolate(slopes, rows, columns), 0.0)


def _square_starts(extent: int, side: int) -> Int[np.ndarray, "n"]:
    """Indices of the first cells of evenly distributed squares along an axis; empty if the axis is too short."""
    if extent < side:
        return np.zeros(0, dtype=np.int64)
    count = round(extent / side)
    if count < 2:
        return np.array([(extent - side) // 2], dtype=np.int64)
    return np.rint(np.linspace(0.0, extent - side, count)).astype(np.int64)


def _interpolation_weights(centres: Float[np.ndarray, "n"], extent: int) -> Float[np.ndarray, "extent n"]:
    """Linear interpolation weights of the square centres for every cell along an axis, extrapolated at the ends."""
    if len(centres) == 1:
        return np.ones((extent, 1))
    weights = np.zeros((extent, len(centres)))
    cells = np.arange(extent)
    left = np.clip(np.searchsorted(centres, cells, side="right") - 1, 0, len(centres) - 2)
    fraction = (cells - centres[left]) / (centres[left + 1] - centres[left])
    weights[cells, left] = 1.0 - fraction
    weights[cells, left + 1] = fraction
    return weights


def _interpolate(
    values: Float[np.ndarray, "m n"], rows: Float[np.ndarray, "r m"], columns: Float[np.ndarray, "c n"]
) -> Float[np.ndarray, "r c"]:
    """Interpolate footprint values to cells by row and column weights; NaN if a value with nonzero weight is NaN."""
    unknown = np.isnan(values)
    unknown_counts = (rows != 0.0).astype(np.float64) @ unknown @ (columns != 0.0).T
    return np.where(unknown_counts > 0.0, np.nan, rows @ np.where(unknown, 0.0, values) @ columns.T)


def safe_landing_map(
    slope_rad: Raster, roughness_m: Raster, cell_m: float, options: HdaOptions
) -> UInt8[np.ndarray, "rows columns"]:
    """Classify cells by slope and roughness: values of `Safety`.

    Hazards are dilated by `hazard_growth` lander diameters. Cells within `unknown_growth` lander diameters of the map's
    border or of an unknown cell are unknown. Hazard has precedence over unknown.
    """
    with np.errstate(invalid="ignore"):
        hazards = [slope_rad > options.max_slope_rad, roughness_m > options.max_roughness_m]
    growth_cells = options.hazard_growth * options.lander_diameter_m / cell_m
    hazard = np.logical_or(*(dilate(hazard_mask, growth_cells) for hazard_mask in hazards))
    # Cells outside the map are unknown.
    holes = np.pad(np.isnan(slope_rad) | np.isnan(roughness_m), 1, constant_values=True)
    unknown = dilate(holes, options.unknown_growth * options.lander_diameter_m / cell_m)[1:-1, 1:-1]
    safety = np.where(hazard, Safety.HAZARD, np.where(unknown, Safety.UNKNOWN, Safety.SAFE))
    return np.asarray(safety.astype(np.uint8))


def safe_site(safety: UInt8[np.ndarray, "rows columns"], apriori_cell: Vector2) -> tuple[int, int] | None:
    """Select the safe cell (row, column) farthest from all unsafe cells; None if no cell is safe.

    Of several such cells, the cell nearest to the a-priori site is selected. Cells outside the map are unsafe.
    """
    distances = grassfire(np.pad(safety != Safety.SAFE, 1, constant_values=True))[1:-1, 1:-1]
    farthest = float(distances.max(initial=0.0))
    if farthest == 0.0:
        return None
    # equal distances can differ by float32 rounding
    best_cells = np.argwhere(distances >= farthest - 1e-4)
    nearest = np.argmin(np.hypot(*(best_cells - apriori_cell).T))
    return int(best_cells[nearest, 0]), int(best_cells[nearest, 1])


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
    # at least the four neighbours of the centre: a plane needs more than three cells
    radius_cells = max(0.5 * options.lander_diameter_m / ground.cell_m, 1.0)
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
