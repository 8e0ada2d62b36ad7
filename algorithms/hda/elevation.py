"""The digital elevation map: points spread over a level grid (section II.D)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from marsyard.algorithms.hda.kernels import elevation as kernels

#: Minimum sum of bilinear weights of a known cell: a point less than 0.9 of a cell away along an axis.
MIN_WEIGHT = 0.1


@dataclass(frozen=True)
class ElevationMap:
    """Elevations on a level grid in the surface frame.

    - elevation_m: z of the middle of each cell; NaN without near points. Rows run along -y, columns along x, as in the
      image.
    - corner_m: (x, y) of the middle of the first cell
    - cell_m: Side of a cell
    """

    elevation_m: Float[np.ndarray, "rows columns"]
    corner_m: Float[np.ndarray, "2"]
    cell_m: float

    def places(self, cells: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """(x, y) of cells (row, column), whole or not."""
        return np.asarray(self.corner_m + self.cell_m * cells[..., ::-1] * np.array([1.0, -1.0]))

    def cells(self, places: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """(row, column), not whole, of places (x, y)."""
        offsets = (places - self.corner_m) / self.cell_m * np.array([1.0, -1.0])
        return np.asarray(offsets[..., ::-1])


def elevation_map(points: Float[np.ndarray, "n 3"]) -> ElevationMap | None:
    """The map of points in the surface frame; None if they cover no area.

    The cell side is sqrt(A / N) with A the area of the horizontal bounding box: about one point per cell. An elevation
    is the mean of the points about a cell by bilinear weights.
    """
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    extent = high - low
    cell = float(np.sqrt(extent[0] * extent[1] / len(points)))
    if not cell > 1e-6 * float(extent.max()):
        return None
    columns, rows = (int(count) for count in np.ceil(extent / cell))
    corner = 0.5 * (low + high) + 0.5 * cell * np.array([-(columns - 1.0), rows - 1.0])
    empty = ElevationMap(np.full((rows, columns), np.nan), corner, cell)
    row, column = empty.cells(points[:, :2]).T
    sums, weights = kernels.spread(row, column, points[:, 2], (rows, columns))
    values = np.divide(sums, weights, out=np.full_like(sums, np.nan), where=weights >= MIN_WEIGHT)
    return ElevationMap(values, corner, cell)
