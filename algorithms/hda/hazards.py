"""Slope and roughness of an elevation map, and where it is safe to land (section III)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from marsyard.algorithms.hda.elevation import ElevationMap
from marsyard.algorithms.hda.kernels import elevation as kernels
from marsyard.algorithms.hda.options import HdaOptions

#: Least side of the regions that planes are fitted to, cells: a median of squares needs more than a few points.
LEAST_SIDE = 3


class Safety(IntEnum):
    """What the safe landing map says of a cell: green, yellow and red in the paper's figures."""

    SAFE = 0
    UNKNOWN = 1
    HAZARD = 2


@dataclass(frozen=True)
class HazardMaps:
    """What is known of the ground for landing; all maps have the elevation map's cells.

    Attributes
    ----------
    planes
        Of each footprint: elevation at its middle (metres) and slopes per metre along columns and rows, shape
        (m, n, 3); NaN where too little is known.
    smooth_m
        The smooth underlying elevation, metres.
    roughness_m
        How far the elevation is off it, metres, upwards or downwards.
    slope_rad
        Angle between the ground's normal and the vertical.
    safety
        The safe landing map, values of `Safety`.
    """

    planes: Float[np.ndarray, "m n 3"]
    smooth_m: Float[np.ndarray, "rows columns"]
    roughness_m: Float[np.ndarray, "rows columns"]
    slope_rad: Float[np.ndarray, "rows columns"]
    safety: UInt8[np.ndarray, "rows columns"]


def hazard_maps(ground: ElevationMap, options: HdaOptions) -> HazardMaps:
    """The hazard maps of an elevation map."""
    planes, smooth, slope = smooth_surface(ground, options)
    roughness = np.abs(ground.elevation_m - smooth)
    return HazardMaps(planes, smooth, roughness, slope, safe_landing_map(slope, roughness, ground.cell_m, options))


def smooth_surface(
    ground: ElevationMap, options: HdaOptions
) -> tuple[Float[np.ndarray, "m n 3"], Float[np.ndarray, "rows columns"], Float[np.ndarray, "rows columns"]]:
    """Robust planes of the footprints, and elevation (metres) and slope (radians) interpolated between their middles.

    The map is partitioned into squares of the footprint's side, spread evenly where it is not a whole number of them.
    Beyond the outermost middles the interpolation goes on in a straight line, for slopes not below zero; what is not
    known comes out as NaN. A square is known if half of its cells are.
    """
    side = max(round(options.lander_diameter_m / ground.cell_m), LEAST_SIDE)
    shape = ground.elevation_m.shape
    starts = [_starts(extent, side) for extent in shape]
    triples = np.random.default_rng(options.seed).uniform(size=(options.plane_trials, 3))
    planes = kernels.footprint_planes(
        ground.elevation_m, starts[0], starts[1], side, max(side * side // 2, 4), triples, options.refine_planes
    )
    planes[..., 1:] /= ground.cell_m
    if planes.size == 0:
        return planes, np.full(shape, np.nan), np.full(shape, np.nan)
    middles = [start + 0.5 * (side - 1) for start in starts]
    rows, columns = (_interpolation(middle, extent) for middle, extent in zip(middles, shape, strict=True))
    smooth = _between(planes[..., 0], rows, columns)
    # Along an axis with a single footprint nothing can be interpolated: the planes' own slope is taken.
    for axis, middle in enumerate(middles):
        if len(middle) == 1:
            offsets = np.expand_dims(np.arange(shape[axis]) - middle[0], 1 - axis)
            smooth = smooth + _between(planes[..., 2 - axis], rows, columns) * ground.cell_m * offsets
    slopes = np.arctan(np.hypot(planes[..., 1], planes[..., 2]))
    return planes, smooth, np.maximum(_between(slopes, rows, columns), 0.0)


def _starts(extent: int, side: int) -> Int[np.ndarray, "n"]:
    """First cells of the squares along an axis, spread evenly from end to end; none where not even one has room."""
    if extent < side:
        return np.zeros(0, dtype=np.int64)
    count = round(extent / side)
    if count < 2:
        return np.array([(extent - side) // 2], dtype=np.int64)
    return np.rint(np.linspace(0.0, extent - side, count)).astype(np.int64)


def _interpolation(middles: Float[np.ndarray, "n"], extent: int) -> Float[np.ndarray, "extent n"]:
    """Weights of the middles for every cell along an axis: linear between neighbours and beyond the last ones."""
    weights = np.zeros((extent, len(middles)))
    cells = np.arange(extent)
    if len(middles) == 1:
        weights[:] = 1.0
        return weights
    left = np.clip(np.searchsorted(middles, cells, side="right") - 1, 0, len(middles) - 2)
    fraction = (cells - middles[left]) / (middles[left + 1] - middles[left])
    weights[cells, left] = 1.0 - fraction
    weights[cells, left + 1] = fraction
    return weights


def _between(
    values: Float[np.ndarray, "m n"], rows: Float[np.ndarray, "r m"], columns: Float[np.ndarray, "c n"]
) -> Float[np.ndarray, "r c"]:
    """Values of footprints interpolated to cells by the weights of rows and columns; NaN where one that counts is."""
    unknown = np.isnan(values)
    touched = (rows != 0.0).astype(np.float64) @ unknown @ (columns != 0.0).T
    return np.where(touched > 0.0, np.nan, rows @ np.where(unknown, 0.0, values) @ columns.T)


def safe_landing_map(
    slope_rad: Float[np.ndarray, "rows columns"],
    roughness_m: Float[np.ndarray, "rows columns"],
    cell_m: float,
    options: HdaOptions,
) -> UInt8[np.ndarray, "rows columns"]:
    """Which cells are safe: values of `Safety`.

    Slope and roughness above what the lander can stand on are hazards, each grown by the lander's diameter; what is
    near the map's border or a cell where either is not known is unknown. A cell that is both is a hazard.
    """
    with np.errstate(invalid="ignore"):
        hazards = [slope_rad > options.max_slope_rad, roughness_m > options.max_roughness_m]
    reach = options.hazard_growth * options.lander_diameter_m / cell_m
    hazard = np.logical_or(*(_grown(one, reach) for one in hazards))
    # The cells around the map are as unknown as its holes.
    holes = np.pad(np.isnan(slope_rad) | np.isnan(roughness_m), 1, constant_values=True)
    unknown = _grown(holes, options.unknown_growth * options.lander_diameter_m / cell_m)[1:-1, 1:-1]
    safety = np.where(hazard, Safety.HAZARD, np.where(unknown, Safety.UNKNOWN, Safety.SAFE))
    return np.asarray(safety.astype(np.uint8))


def grassfire(burning: Bool[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows columns"]:
    """Distance of every cell from the nearest that burns, cells; infinite where none does (Blum 1973)."""
    if not np.any(burning):
        return np.full(burning.shape, np.inf)
    distances = cv2.distanceTransform((~burning).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(distances.astype(np.float64))


def _grown(burning: Bool[np.ndarray, "rows columns"], reach: float) -> Bool[np.ndarray, "rows columns"]:
    return np.asarray(burning | (grassfire(burning) <= reach))


def safe_site(
    safety: UInt8[np.ndarray, "rows columns"], apriori_cell: Float[np.ndarray, "2"]
) -> tuple[int, int] | None:
    """The safe cell (row, column) farthest from all that are not, of equals the nearest to the a-priori site.

    None if no cell is safe. Those around the map are not.
    """
    distances = grassfire(np.pad(safety != Safety.SAFE, 1, constant_values=True))[1:-1, 1:-1]
    farthest = float(distances.max(initial=0.0))
    if farthest == 0.0:
        return None
    equals = np.argwhere(distances >= farthest - 1e-4)
    nearest = np.argmin(np.hypot(*(equals - apriori_cell).T))
    return int(equals[nearest, 0]), int(equals[nearest, 1])
