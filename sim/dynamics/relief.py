"""Height map of ground and rocks under a rover's wheels, from the terrain and the rocks' triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64
from scipy.ndimage import map_coordinates

from marsyard.sim.dynamics.rover import Ground

#: Side of the grid's cells, metres: a tenth of a wheel's radius.
CELL_M = 0.0125
#: Largest distance between sample points on a triangle, in cells.
_SAMPLE_SPACING = 0.7


@dataclass(frozen=True)
class RockyGround:
    """Ground with bodies on it within a square; the ground alone outside.

    Heights are interpolated bilinearly between cell centres. A cell is as high as the highest body point in it, so
    that steep sides extend up to one cell outwards. Overhangs are filled.

    - corner_m: world x, y of the centre of cell (0, 0)
    - above_m: height of each cell above the ground, 0 without a body; row i lies at y = corner + i cells
    """

    ground: Ground
    corner_m: tuple[float, float]
    above_m: Float64[np.ndarray, "rows columns"]

    @classmethod
    def of(
        cls,
        ground: Ground,
        triangles: Float64[np.ndarray, "triangles 3 3"],
        centre_m: tuple[float, float],
        half_m: float,
    ) -> RockyGround:
        """Rasterize bodies (triangles in world axes, metres) within `half_m` of a centre along x and y.

        A `marsyard.sim.terrain.RockMesh` gives the triangles of a rock field as ``mesh.vertices[mesh.faces]``.
        """
        cells = 2 * int(np.ceil(half_m / CELL_M)) + 1
        corner = np.array(centre_m) - 0.5 * (cells - 1) * CELL_M
        points = _sample_triangles(triangles)
        cell = np.rint((points[:, :2] - corner) / CELL_M).astype(np.int64)
        inside = np.all((cell >= 0) & (cell < cells), axis=1)
        column, row = cell[inside].T
        top = np.full((cells, cells), -np.inf)
        np.maximum.at(top, (row, column), points[inside, 2])
        y, x = np.nonzero(np.isfinite(top))
        above = np.zeros((cells, cells))
        below = ground.height(corner[0] + CELL_M * x, corner[1] + CELL_M * y)
        above[y, x] = np.maximum(top[y, x] - below, 0.0)
        above.setflags(write=False)
        return cls(ground, (float(corner[0]), float(corner[1])), above)

    def height(self, x: Float[np.ndarray, "*batch"], y: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """Height of ground or rocks at world positions, metres."""
        cells = [(y - self.corner_m[1]) / CELL_M, (x - self.corner_m[0]) / CELL_M]
        above = map_coordinates(self.above_m, cells, order=1, mode="constant", prefilter=False)
        return np.asarray(self.ground.height(x, y) + above)


def _sample_triangles(triangles: Float64[np.ndarray, "triangles 3 3"]) -> Float64[np.ndarray, "points 3"]:
    """Points on triangles, at most `_SAMPLE_SPACING` cells apart."""
    edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
    steps = np.ceil(edges / (_SAMPLE_SPACING * CELL_M)).astype(np.int64)
    parts = [np.empty((0, 3))]
    for count in np.unique(steps):
        i, j = np.meshgrid(np.arange(count + 1), np.arange(count + 1))
        first, second = i[i + j <= count] / count, j[i + j <= count] / count
        weights = np.stack([1.0 - first - second, first, second], axis=1)
        parts.append(np.einsum("pk,tki->tpi", weights, triangles[steps == count]).reshape(-1, 3))
    return np.concatenate(parts)
