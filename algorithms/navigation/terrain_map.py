"""Terrain map of the navigator: heights of stereo points on a grid, and goodness of the ground for the rover.

As in GESTALT (Goldberg, Maimone & Matthies 2002), a plane is fitted to the ground under a disc that contains the
rover's footprint at any heading. Tilt of the plane, height of points above and below it, and roughness determine the
goodness of the disc, from 0 (hazard) to 1. Ground that no image shows has no goodness: images do not show occluded
ground, and have no stereo match without texture. All positions are in the estimated world frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Float64

from marsyard.algorithms.arrays import Mask, Points3, Raster, Vector, Vector2

#: Side of a cell (GESTALT: 0.2 m) and half the side of the map (assumed), metres.
CELL_M, HALF_SIDE_M = 0.2, 20.0
#: Minimum number of points in a cell, and quantiles of their heights that give a cell's lower and upper height: single
#: false matches have no effect.
_MIN_POINTS, _QUANTILES = 4, (0.2, 0.8)
#: Minimum fraction of a disc's cells that must be mapped for a plane fit.
_MIN_MAPPED_FRACTION = 0.8


@dataclass(frozen=True)
class GroundLimits:
    """Limits of the ground that the rover may drive over; those of MER's flight parameters are not published (assumed).

    - radius_m: radius of the disc around the rover's footprint, at least a cell
    - climb_m: maximum height above, or depth below, the fitted plane
    - tilt_rad: maximum tilt of the plane
    - roughness_m: maximum standard deviation of the heights from the plane
    """

    radius_m: float
    climb_m: float
    tilt_rad: float
    roughness_m: float


@dataclass(frozen=True)
class Goodness:
    """Goodness of the ground at each cell of a map.

    - corner_m: east and north of the centre of cell (0, 0)
    - values: goodness of the disc around the cell, 0 to 1; NaN if less than 80 % of the disc is mapped
    - hazard_m: distance to the nearest cell that is too high or too low
    """

    corner_m: Vector2
    values: Raster
    hazard_m: Raster

    def at(self, positions_m: Float[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n"]:
        """Return the goodness at positions (east, north); NaN outside of the map."""
        return _look_up(self.values, self.corner_m, positions_m)

    def hazard_distances_m(self, positions_m: Float[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n"]:
        """Return the distances of positions (east, north) to the nearest hazard; NaN outside of the map."""
        return _look_up(self.hazard_m, self.corner_m, positions_m)


@dataclass(frozen=True)
class TerrainMap:
    """Heights on a square grid; row i is north, column j east of the corner's cell. NaN: not mapped.

    - corner_m: east and north of the centre of cell (0, 0)
    - lower_m, median_m, upper_m: heights of the points in a cell: 20 % quantile, median and 80 % quantile
    """

    corner_m: Vector2
    lower_m: Raster
    median_m: Raster
    upper_m: Raster

    @classmethod
    def empty(cls, centre_m: Vector2) -> TerrainMap:
        """Create a map without data around a position (east, north)."""
        count = 2 * int(HALF_SIDE_M / CELL_M) + 1
        blank = np.full((count, count), np.nan)
        return cls(np.asarray(centre_m - HALF_SIDE_M, dtype=np.float64), blank, blank, blank)

    def add_points(self, points: Points3) -> TerrainMap:
        """Return the map with new points (east, north, up); cells with enough new points are replaced."""
        columns, rows = np.rint((points[:, :2] - self.corner_m) / CELL_M).astype(int).T
        count = len(self.median_m)
        inside = (columns >= 0) & (columns < count) & (rows >= 0) & (rows < count)
        cells, heights = (rows * count + columns)[inside], points[inside, 2]
        order = np.lexsort((heights, cells))
        cells, heights = cells[order], heights[order]
        numbers, first, counts = np.unique(cells, return_index=True, return_counts=True)
        has_enough_points = counts >= _MIN_POINTS
        numbers, first, counts = numbers[has_enough_points], first[has_enough_points], counts[has_enough_points]
        low, middle, high = (
            first + np.rint(quantile * (counts - 1)).astype(int) for quantile in (_QUANTILES[0], 0.5, _QUANTILES[1])
        )
        values = heights[low], heights[middle], heights[high]
        layers = [self.lower_m.copy(), self.median_m.copy(), self.upper_m.copy()]
        for layer, heights_of_cells in zip(layers, values, strict=True):
            layer.ravel()[numbers] = heights_of_cells
        return replace(self, lower_m=layers[0], median_m=layers[1], upper_m=layers[2])

    def add_plane(
        self, centre_m: Float[np.ndarray, "3"], normal: Float[np.ndarray, "3"], radius_m: float
    ) -> TerrainMap:
        """Return the map with a plane in the unmapped cells of a disc, for the ground that the rover stands on."""
        axis = self.corner_m[:, None] + CELL_M * np.arange(len(self.median_m))
        east, north = np.meshgrid(axis[0] - centre_m[0], axis[1] - centre_m[1])
        heights = centre_m[2] - (normal[0] * east + normal[1] * north) / normal[2]
        is_new = (np.hypot(east, north) <= radius_m) & np.isnan(self.median_m)
        layers = (np.where(is_new, heights, layer) for layer in (self.lower_m, self.median_m, self.upper_m))
        return TerrainMap(self.corner_m, *layers)

    def without_hazards(self, centre_m: Vector2, radius_m: float) -> TerrainMap:
        """Return the map with level ground in a disc, so that the target's rock is not a hazard.

        The level is the median of the ground around the disc; the disc is unmapped if that ground is unmapped.
        """
        axis = self.corner_m[:, None] + CELL_M * np.arange(len(self.median_m))
        east, north = np.meshgrid(axis[0] - centre_m[0], axis[1] - centre_m[1])
        inside = np.hypot(east, north) <= radius_m
        ring = (np.hypot(east, north) <= radius_m + 2.0 * CELL_M) & ~inside & np.isfinite(self.median_m)
        level = float(np.median(self.median_m[ring])) if ring.any() else float("nan")
        layers = (np.where(inside, level, layer) for layer in (self.lower_m, self.median_m, self.upper_m))
        return TerrainMap(self.corner_m, *layers)

    @cached_property
    def mapped_cells(self) -> Mask:
        """Cells with heights."""
        return np.asarray(np.isfinite(self.median_m))

    def goodness(self, limits: GroundLimits) -> Goodness:
        """Evaluate the ground under a disc at each cell."""
        planes, disc = _fit_planes(self.median_m, limits.radius_m), _disc(limits.radius_m)[0]
        is_known = planes.is_known
        centre = np.full(is_known.shape, np.nan)
        centre[is_known] = planes.heights_m
        hazard = is_known & self.mapped_cells
        with np.errstate(invalid="ignore"):
            step = np.maximum(self.upper_m - centre, centre - self.lower_m)
            hazard &= step > limits.climb_m
        distance = cv2.distanceTransform((~hazard).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * CELL_M
        # largest step of any cell in the disc
        steps = np.where(is_known & self.mapped_cells, np.nan_to_num(step), 0.0)
        max_steps = cv2.dilate(steps, (disc > 0.0).astype(np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0.0)
        margins = [
            1.0 - planes.tilts_rad / limits.tilt_rad,
            1.0 - planes.roughness_m / limits.roughness_m,
            1.0 - max_steps[is_known] / limits.climb_m,
        ]
        values = np.full(is_known.shape, np.nan)
        values[is_known] = np.maximum(np.min(margins, axis=0), 0.0)
        return Goodness(self.corner_m, values, np.asarray(distance, dtype=np.float64))


class _Planes(NamedTuple):
    """Planes fitted to the discs around the cells of a map.

    - is_known: cells whose disc is mapped well enough; the other fields have one value for each of them
    - heights_m: height of the plane at the cell
    - tilts_rad, roughness_m: tilt of the plane, and standard deviation of the heights from it
    """

    is_known: Mask
    heights_m: Vector
    tilts_rad: Vector
    roughness_m: Vector


def _fit_planes(heights_m: Raster, radius_m: float) -> _Planes:
    """Fit a plane to the mapped cells of the disc around each cell by least squares."""
    is_mapped = np.isfinite(heights_m)
    # heights relative to their mean, to reduce rounding errors
    reference = float(np.nanmean(heights_m)) if is_mapped.any() else 0.0
    z = np.where(is_mapped, heights_m - reference, 0.0)
    weight = is_mapped.astype(np.float64)
    disc, x, y = _disc(radius_m)

    def sum_over_disc(values: Raster, kernel: Float[np.ndarray, "_ _"]) -> Raster:
        return np.asarray(cv2.filter2D(values, cv2.CV_64F, kernel, borderType=cv2.BORDER_CONSTANT))

    # normal equations of z = a + b x + c y over the mapped cells of the disc; x and y contain its weights, 0 or 1
    count, sx, sy = sum_over_disc(weight, disc), sum_over_disc(weight, x), sum_over_disc(weight, y)
    sxx, sxy, syy = sum_over_disc(weight, x * x), sum_over_disc(weight, x * y), sum_over_disc(weight, y * y)
    sz, sxz, syz, szz = sum_over_disc(z, disc), sum_over_disc(z, x), sum_over_disc(z, y), sum_over_disc(z * z, disc)
    is_known = count >= _MIN_MAPPED_FRACTION * disc.sum()
    matrices = np.stack([count, sx, sy, sx, sxx, sxy, sy, sxy, syy], axis=-1).reshape(*z.shape, 3, 3)[is_known]
    right_hand_sides = np.stack([sz, sxz, syz], axis=-1)[is_known]
    planes = np.linalg.solve(matrices, right_hand_sides[..., None])[..., 0]
    squared_residuals = szz[is_known] - np.sum(planes * right_hand_sides, axis=-1)
    height, slope_x, slope_y = planes.T
    roughness = np.sqrt(np.maximum(squared_residuals, 0.0) / count[is_known])
    return _Planes(is_known, height + reference, np.arctan(np.hypot(slope_x, slope_y)), roughness)


@lru_cache(maxsize=8)
def _disc(radius_m: float) -> tuple[Raster, Raster, Raster]:
    """Compute a disc's weights, and its weights times the offsets x (east) and y (north) from its centre, metres."""
    half = int(np.ceil(radius_m / CELL_M))
    offsets = CELL_M * np.arange(-half, half + 1)
    x, y = np.meshgrid(offsets, offsets)
    disc = (np.hypot(x, y) <= radius_m).astype(np.float64)
    return disc, disc * x, disc * y


def _look_up(values: Raster, corner_m: Vector2, positions_m: Float[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n"]:
    """Return the value of the cell that contains each position (east, north); NaN outside of the map."""
    columns, rows = np.rint((positions_m - corner_m) / CELL_M).astype(int).T
    count = len(values)
    inside = (columns >= 0) & (columns < count) & (rows >= 0) & (rows < count)
    result = np.full(len(columns), np.nan)
    result[inside] = values[rows[inside], columns[inside]]
    return result
