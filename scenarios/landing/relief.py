"""Exact heights of ground and rocks, and true slope and roughness of lander footprints.

Slope is the angle of the plane of least absolute deviations over the footprint. Roughness is the maximum distance from
this plane, upwards or downwards. Like the algorithm's plane of least median of squares (paper, section III), the plane
is robust against rocks. It is unique, needs no random trials, and is continuous in the heights (docs/adr/0028). Heights
are those of the terrain and of the rocks' triangles within each footprint, without interpolation between footprints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float

from marsyard.scenarios.landing import kernels
from marsyard.scenarios.meshes import MeshParameters
from marsyard.scenarios.views import SiteGround

#: Spacing of the exact heights in footprint diameters: 80 points per diameter, 2.5 cm for a diameter of 2 m.
SPACING_DIAMETERS = 1.0 / 80.0
#: Planes are fitted to every fourth point: 20 points per diameter, about 310 points in all.
FIT_STRIDE = 4


@dataclass(frozen=True)
class Limits:
    """Limits of a lander: diameter of its disc-shaped footprint, maximum slope, and maximum roughness."""

    diameter_m: float
    max_slope_rad: float
    max_roughness_m: float


@dataclass(frozen=True)
class Footprints:
    """True ground under landers at several positions."""

    slope_rad: Float[np.ndarray, "*positions"]
    roughness_m: Float[np.ndarray, "*positions"]
    exceeding_m2: Float[np.ndarray, "*positions"]  #: footprint area farther from the plane than the limit
    safe: Bool[np.ndarray, "*positions"]  #: whether slope and roughness are within the limits


@dataclass(frozen=True)
class Relief:
    """Exact heights of ground and rocks on a grid: row i at y = south + i spacing, column j at x = west + j spacing."""

    heights_m: Float[np.ndarray, "rows columns"]
    west_m: float
    south_m: float
    spacing_m: float

    @classmethod
    def from_ground(
        cls,
        ground: SiteGround,
        low_m: Float[np.ndarray, "2"],
        high_m: Float[np.ndarray, "2"],
        spacing_m: float,
        meshes: Sequence[MeshParameters] = (),
    ) -> Relief:
        """Compute heights of ground, rocks and custom meshes on a grid between two corners (x, y)."""
        columns, rows = (int(n) for n in np.ceil((high_m - low_m) / spacing_m) + 1)
        west, south = float(low_m[0]), float(low_m[1])
        x, y = np.meshgrid(west + spacing_m * np.arange(columns), south + spacing_m * np.arange(rows))
        heights = np.array(ground.surface.height(x, y))
        centre = 0.5 * (low_m + high_m)
        if ground.rocks is not None:
            radius = 0.5 * float(np.hypot(*(high_m - low_m))) + float(ground.rocks.diameter_m.max(initial=0.0))
            # rocks with the level of detail of a distant view from above, with pixels of the grid's spacing
            mesh = ground.rocks.near(
                float(centre[0]), float(centre[1]), radius, above_m=1e3 * radius, pixel_rad=spacing_m / (1e3 * radius)
            )
            kernels.raise_by_triangles(heights, west, south, spacing_m, mesh.vertices, mesh.faces)
        for parameters in meshes:
            body = parameters.place_on_ground(ground.surface, (float(centre[0]), float(centre[1])))
            corners = body.triangles.reshape(-1, 3)
            faces = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
            kernels.raise_by_triangles(heights, west, south, spacing_m, corners, faces)
        return cls(heights, west, south, spacing_m)

    def cells(self, positions_m: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Convert positions (x, y) to fractional rows and columns."""
        return np.asarray((positions_m - np.array([self.west_m, self.south_m]))[..., ::-1] / self.spacing_m)

    def average(self, points: Float[np.ndarray, "rows columns 2"], side_m: float) -> Float[np.ndarray, "rows columns"]:
        """Compute mean heights of squares of side `side_m` around positions (x, y); NaN outside the grid."""
        width = max(round(side_m / self.spacing_m), 1)
        means = cv2.blur(self.heights_m, (width, width)) if width > 1 else self.heights_m
        # the mean of an even number of points is centred half a point before the position at which cv2 stores it
        cells = self.cells(points) + 0.5 * (1 - width % 2)
        rows, columns = np.moveaxis(cells.astype(np.float32), -1, 0)
        return np.asarray(
            cv2.remap(means, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan)
        )

    def footprints(self, positions_m: Float[np.ndarray, "*positions 2"], limits: Limits) -> Footprints:
        """Compute slope and roughness under landers at positions (x, y).

        Raises ValueError if a footprint does not lie within the grid.
        """
        disc, limit_m = _create_disc(round(0.5 * limits.diameter_m / self.spacing_m)), limits.max_roughness_m
        cells = np.rint(self.cells(positions_m)).astype(np.int64).reshape(-1, 2)
        radius = int(disc.offsets.max())
        if np.any(cells < radius) or np.any(cells >= np.array(self.heights_m.shape) - radius):
            raise ValueError("a footprint extends beyond the grid of exact heights")
        slopes, roughness, areas = (
            values.reshape(positions_m.shape[:-1])
            for values in kernels.measure_footprints(self.heights_m, self.spacing_m, cells, disc, limit_m)
        )
        is_safe = (slopes <= limits.max_slope_rad) & (roughness <= limit_m)
        return Footprints(slopes, roughness, areas, is_safe)


@lru_cache(maxsize=4)
def _create_disc(radius: int) -> kernels.Disc:
    """Create a disc with a radius in grid points, centred at the origin."""
    offsets = np.arange(-radius, radius + 1)
    points = np.stack(np.meshgrid(offsets, offsets, indexing="ij"), axis=-1).reshape(-1, 2)
    points = points[np.hypot(*points.T) <= radius]
    return kernels.Disc(points, points[np.all(points % FIT_STRIDE == 0, axis=1)].copy())
