"""The last word on a place: the plane of its own footprint, with a margin for what the map does not see.

Section III's maps know planes of fixed squares and what lies between them. Before a place is called safe the lander's
footprint about it is looked at by itself, by the same definitions: the slope of its robust plane, and the farthest that
a cell is off that plane.

A map sees less than there is. A match is one elevation for a window of side w, and a cell of side s the mean of points
up to s away, its middle up to s / 2 beside the top of what stands there. Of a hazard as a paraboloid of width D this
leaves the share ``1 - 4 r2 / D**2``, with r2 the mean square of the distances from its top: w**2 / 6 by the window,
s**2 / 3 by the weights, s**2 / 2 by the place. The limit of roughness is what is left of the narrowest hazard that is
as high as the lander's limit, less the map's noise. Where nothing would be left, nothing can be called safe.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int, UInt8

from marsyard.algorithms.hda.elevation import ElevationMap
from marsyard.algorithms.hda.hazards import Safety
from marsyard.algorithms.hda.kernels import elevation as kernels
from marsyard.algorithms.hda.motion import Motion
from marsyard.algorithms.hda.options import HdaOptions

#: Points across a footprint through which planes are laid, and places across it that are looked at.
ACROSS = 16
#: What makes the median of absolute values the standard deviation of a normal distribution.
DEVIATION_OF_MEDIAN = 1.4826


@dataclass(frozen=True)
class Resolution:
    """What a map can see.

    Attributes
    ----------
    window_m
        Side of the matched windows on the ground.
    noise_m
        Standard deviation of a point's elevation.
    """

    window_m: float
    noise_m: float


def map_resolution(motion: Motion, focal_px: float, options: HdaOptions) -> Resolution:
    """The resolution that a motion gives at the features' median depth.

    The tracks' residuals are their errors across the epipolar lines; the same along them is an error of depth.
    """
    depth = float(np.median(motion.depths[motion.inliers]))
    error_px = DEVIATION_OF_MEDIAN * float(np.median(motion.residuals_px[motion.inliers]))
    error_px = float(np.hypot(error_px, options.match_error_px))
    return Resolution(depth * (2 * options.search_half_px + 1) / focal_px, depth * error_px / motion.parallax_px)


def roughness_limit_m(resolution: Resolution, cell_m: float, options: HdaOptions) -> float:
    """How rough a footprint of the map may be for the lander to stand on it; not above 0 where the map cannot tell."""
    spread = resolution.window_m**2 / 6.0 + 5.0 / 6.0 * cell_m**2
    width = options.narrowest_hazard * options.max_roughness_m
    seen = max(1.0 - 4.0 * spread / width**2, 0.0)
    return seen * options.max_roughness_m - options.margin_deviations * resolution.noise_m


def checked(
    safety: UInt8[np.ndarray, "rows columns"], ground: ElevationMap, resolution: Resolution, options: HdaOptions
) -> UInt8[np.ndarray, "rows columns"]:
    """The safe landing map without the places whose own footprints are not safe; those become hazards.

    Footprints are looked at on a lattice of `ACROSS` places to the diameter; a cell takes the word of the nearest that
    was looked at.
    """
    cells_across = options.lander_diameter_m / ground.cell_m
    step = max(int(cells_across / ACROSS), 1)
    lattice = np.zeros(safety.shape, dtype=bool)
    lattice[::step, ::step] = True
    # beside the lattice a safe cell needs a neighbour on it that is looked at, safe by the map or not
    wanted = np.zeros_like(lattice)
    safe_rows, safe_columns = np.nonzero(safety == Safety.SAFE)
    wanted[_nearest(safe_rows, step, safety.shape[0]), _nearest(safe_columns, step, safety.shape[1])] = True
    rows, columns = np.nonzero(wanted & lattice)
    offsets = disc(0.5 * cells_across)
    fitted = offsets[np.all(offsets % step == 0, axis=1)].copy()
    triples = np.random.default_rng(options.seed).uniform(size=(options.plane_trials, 3))
    slopes, roughness = kernels.under_lander(
        ground.elevation_m, rows, columns, offsets, fitted, max(len(fitted) // 2, 4), triples, options.refine_planes
    )
    steepest = options.max_slope_rad - options.margin_deviations * options.level_error_rad
    roughest = roughness_limit_m(resolution, ground.cell_m, options)
    with np.errstate(invalid="ignore"):
        good = (np.arctan(slopes / ground.cell_m) <= steepest) & (roughness <= roughest) & (roughest > 0.0)
    fails = np.zeros_like(lattice)
    fails[rows[~good], columns[~good]] = True
    result = safety.copy()
    told = fails[_nearest(safe_rows, step, safety.shape[0]), _nearest(safe_columns, step, safety.shape[1])]
    result[safe_rows[told], safe_columns[told]] = Safety.HAZARD
    return result


def disc(radius_cells: float) -> Int[np.ndarray, "n 2"]:
    """Cells (row, column) from the middle of a disc."""
    reach = int(radius_cells)
    across = np.arange(-reach, reach + 1)
    cells = np.stack(np.meshgrid(across, across, indexing="ij"), axis=-1).reshape(-1, 2)
    return np.asarray(cells[np.hypot(*cells.T) <= radius_cells])


def _nearest(cells: Int[np.ndarray, "n"], step: int, extent: int) -> Int[np.ndarray, "n"]:
    """The lattice's cell nearest to each along an axis."""
    return np.asarray(np.minimum((cells + step // 2) // step * step, (extent - 1) // step * step))
