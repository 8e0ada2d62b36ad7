"""Ground under the wheels of a rover: terrain with rocks, rasterised to a grid of heights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float64
from scipy.ndimage import map_coordinates

from marsyard.sim.dynamics.kernels.rock_heights import rasterize_heights

#: Cell size of the rocks' height grid: a tenth of a wheel's radius.
CELL_M = 0.0125
#: Largest distance between sample points on a triangle, in cells.
_SAMPLE_SPACING = 0.7


@runtime_checkable
class DrivenGround(Protocol):
    """Ground under the wheels: `marsyard.sim.terrain.Surface`, or `RockyGround`."""

    def height(self, x: Float[np.ndarray, "*batch"], y: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """Compute the height of the ground at world positions, metres."""


@dataclass(frozen=True)
class RockyGround:
    """Ground with rocks on it within a square grid; outside the grid the ground without rocks.

    Heights are interpolated bilinearly between cell centres. A cell has the height of the highest rock point in it;
    steep sides therefore extend up to one cell outwards. Overhangs are filled.

    - corner_m: world x, y of the centre of cell (0, 0)
    - above_m: height of each cell above the ground, 0 without a rock; row i is at y = corner + i cells
    """

    ground: DrivenGround
    corner_m: tuple[float, float]
    above_m: Float64[np.ndarray, "rows columns"]

    @classmethod
    def from_triangles(
        cls,
        ground: DrivenGround,
        triangles: Float64[np.ndarray, "triangles 3 3"],
        centre_m: tuple[float, float],
        half_m: float,
    ) -> RockyGround:
        """Rasterize rocks (triangles in world axes, metres) within `half_m` of a centre along x and y.

        For a `marsyard.sim.terrain.RockMesh` the triangles are ``mesh.vertices[mesh.faces]``.
        """
        cells = 2 * int(np.ceil(half_m / CELL_M)) + 1
        corner = np.array(centre_m) - 0.5 * (cells - 1) * CELL_M
        top = np.full((cells, cells), -np.inf)
        rasterize_heights(np.ascontiguousarray(triangles), *corner, CELL_M, _SAMPLE_SPACING * CELL_M, top)
        y, x = np.nonzero(np.isfinite(top))
        above = np.zeros((cells, cells))
        ground_height = ground.height(corner[0] + CELL_M * x, corner[1] + CELL_M * y)
        above[y, x] = np.maximum(top[y, x] - ground_height, 0.0)
        above.setflags(write=False)
        return cls(ground, (float(corner[0]), float(corner[1])), above)

    def height(self, x: Float[np.ndarray, "*batch"], y: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """Compute the height of ground or rocks at world positions, metres."""
        cells = [(y - self.corner_m[1]) / CELL_M, (x - self.corner_m[0]) / CELL_M]
        above = map_coordinates(self.above_m, cells, order=1, mode="constant", prefilter=False)
        return np.asarray(self.ground.height(x, y) + above)
