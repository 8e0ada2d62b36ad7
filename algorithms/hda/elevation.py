"""Elevation map of a landing site from points of the ground (section II.D), its small holes, and distances in a map."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Num

from marsyard.algorithms.arrays import Mask, Points2, Points3, Raster, Vector, Vector2

#: Minimum sum of bilinear weights of a valid cell: the weight of a single point 0.9 cells away along an axis.
MIN_WEIGHT = 0.1
#: Minimum side of a cell, as a fraction of the points' extent: the points of smaller cells lie on a line.
_MIN_CELL_FRACTION = 1e-6


def grassfire(mask: Mask) -> Raster:
    """Grassfire transform (Blum 1973): distance of every cell to the nearest true cell of a mask, in cells.

    Infinite if no cell is true.
    """
    if not np.any(mask):
        return np.full(mask.shape, np.inf)
    distances = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(distances.astype(np.float64))


def dilate(mask: Mask, radius_cells: float) -> Mask:
    """Dilate a mask by a disc: a cell becomes true within `radius_cells` of a true cell."""
    return np.asarray(mask | (grassfire(mask) <= radius_cells))


@dataclass(frozen=True)
class ElevationMap:
    """Elevations on a level grid in the surface frame.

    - elevation_m: z at the centre of each cell; NaN if no point is near it. Rows run along -y, columns along x, as in
      the image.
    - corner_m: (x, y) of the centre of the first cell (row 0, column 0)
    - cell_m: Side of a cell
    """

    elevation_m: Raster
    corner_m: Vector2
    cell_m: float

    def positions(self, cells: Num[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Convert cells (row, column; may be fractional) to positions (x, y), metres."""
        return np.asarray(self.corner_m + self.cell_m * cells[..., ::-1] * np.array([1.0, -1.0]))

    def cells(self, positions: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Convert positions (x, y), metres, to fractional cells (row, column)."""
        offsets = (positions - self.corner_m) / self.cell_m * np.array([1.0, -1.0])
        return np.asarray(offsets[..., ::-1])


def elevation_map(points: Points3) -> ElevationMap | None:
    """Compute the elevation map of points in the surface frame; None if they cover no area.

    The cell side is sqrt(A / N), where A is the area of the horizontal bounding box and N the number of points: about
    one point per cell. The elevation of a cell is the bilinearly weighted mean of the points around its centre.
    """
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    extent = high - low
    cell = float(np.sqrt(extent[0] * extent[1] / len(points)))
    if not cell > _MIN_CELL_FRACTION * float(extent.max()):
        return None
    columns, rows = (int(count) for count in np.ceil(extent / cell))
    corner = 0.5 * (low + high) + 0.5 * cell * np.array([-(columns - 1.0), rows - 1.0])
    empty = ElevationMap(np.full((rows, columns), np.nan), corner, cell)
    sums, weights = _accumulate_bilinear(empty.cells(points[:, :2]), points[:, 2], (rows, columns))
    values = np.divide(sums, weights, out=np.full_like(sums, np.nan), where=weights >= MIN_WEIGHT)
    return ElevationMap(values, corner, cell)


def _accumulate_bilinear(cells: Points2, values: Vector, shape: tuple[int, int]) -> tuple[Raster, Raster]:
    """Distribute values at fractional cells (row, column) to the four nearest cells with bilinear weights.

    Returns the sums of weighted values and of weights per cell.
    """
    low = np.floor(cells).astype(np.int64)
    fractions = cells - low
    corners = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
    near = low[:, np.newaxis] + corners
    weights = np.where(corners == 1, fractions[:, np.newaxis], 1.0 - fractions[:, np.newaxis]).prod(axis=2)
    inside = np.all((near >= 0) & (near < shape), axis=2)
    rows, columns = near[inside].T
    sums = np.zeros((2, *shape))
    np.add.at(sums[0], (rows, columns), (weights * values[:, np.newaxis])[inside])
    np.add.at(sums[1], (rows, columns), weights[inside])
    return sums[0], sums[1]


def fill_small_holes(ground: ElevationMap, width_m: float) -> ElevationMap:
    """Fill the holes of an elevation map that are too small for a disc of the diameter `width_m`; return the new map.

    The elevation of a cell is interpolated along its row and its column between the nearest known cells, and the two
    values are averaged with the inverse distances between these cells as weights (section II.D: "bilinear interpolation
    of point elevation is used to deal with the uneven sampling"). Ground outside the map is unknown: cells with known
    cells on one side only are not filled.
    """
    holes = np.isnan(ground.elevation_m)
    # a hole of n cells contains a cell at the distance (n + 1) / 2 from the nearest known cell
    radius_cells = 0.5 * (width_m / ground.cell_m + 1.0)
    margin = int(np.ceil(2.0 * radius_cells)) + 1
    padded = np.pad(holes, margin, constant_values=True)
    # morphological opening: the parts of holes that a disc of this diameter covers
    wide = dilate(grassfire(~padded) >= radius_cells, radius_cells - 0.5)[margin:-margin, margin:-margin]
    along_rows = _interpolate_rows(ground.elevation_m)
    along_columns = [array.T for array in _interpolate_rows(ground.elevation_m.T)]
    sums, weights = np.zeros(holes.shape), np.zeros(holes.shape)
    for value, gap in (along_rows, along_columns):
        is_known = np.isfinite(value)
        sums += np.where(is_known, value, 0.0) / gap
        weights += is_known / gap
    filled = np.divide(sums, weights, out=np.full_like(sums, np.nan), where=weights > 0.0)
    return replace(ground, elevation_m=np.where(holes & ~wide, filled, ground.elevation_m))


def _interpolate_rows(values: Raster) -> tuple[Raster, Raster]:
    """Interpolate the NaN values of each row linearly; also return the distance between the cells used, at least 1.

    The result is NaN if a row has no known cell on one side.
    """
    columns = np.broadcast_to(np.arange(values.shape[1]), values.shape)
    known = np.isfinite(values)
    left = np.maximum.accumulate(np.where(known, columns, -1), axis=1)
    right = np.minimum.accumulate(np.where(known, columns, values.shape[1])[:, ::-1], axis=1)[:, ::-1]
    inside = (left >= 0) & (right < values.shape[1])
    low, high = (np.take_along_axis(values, np.where(inside, index, 0), axis=1) for index in (left, right))
    gap = np.maximum(right - left, 1).astype(np.float64)
    return np.where(inside, low + (high - low) * (columns - left) / gap, np.nan), gap
