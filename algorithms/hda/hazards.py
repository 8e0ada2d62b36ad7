"""Hazard maps, safe landing map and selection of the landing site (section III).

With the option `check_footprints`, the estimator replaces section III's safe landing map by that of `footprints`.

Sections are those of Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Float, Int, UInt8

from marsyard.algorithms.arrays import Raster, Vector2
from marsyard.algorithms.hda.elevation import ElevationMap
from marsyard.algorithms.hda.kernels import elevation as kernels
from marsyard.algorithms.hda.morphology import dilate, grassfire
from marsyard.algorithms.hda.options import HdaOptions

#: Minimum side of the squares for plane fits, cells; a least-median-of-squares fit requires more than a few points.
MIN_SIDE_CELLS = 3


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
    planes = kernels.footprint_planes(
        ground.elevation_m, starts[0], starts[1], side, max(side * side // 2, 4), triples, options.refine_planes
    )
    planes[..., 1:] /= ground.cell_m
    if planes.size == 0:
        return np.full(shape, np.nan), np.full(shape, np.nan)
    centres = [start + 0.5 * (side - 1) for start in starts]
    rows, columns = (_interpolation_weights(centre, extent) for centre, extent in zip(centres, shape, strict=True))
    smooth = _interpolate(planes[..., 0], rows, columns)
    # Along an axis with a single footprint, extrapolate with the slope of its plane.
    for axis, centre in enumerate(centres):
        if len(centre) == 1:
            offsets = np.expand_dims(np.arange(shape[axis]) - centre[0], 1 - axis)
            smooth = smooth + _interpolate(planes[..., 2 - axis], rows, columns) * ground.cell_m * offsets
    slopes = np.arctan(np.hypot(planes[..., 1], planes[..., 2]))
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
