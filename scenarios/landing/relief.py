"""Exact heights of ground and rocks, and true slope and roughness of lander footprints.

Slope is the angle of the plane of least absolute deviations over the footprint, roughness the maximum distance from it,
upwards or downwards. Like the algorithm's plane of least median of squares (paper, section III), it is robust against
rocks on the ground; but it is unique, needs no random trials, and is continuous in the heights (docs/adr/0028). Heights
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

#: Spacing of the exact heights, in footprints' diameters: 80 points across a footprint, 2.5 cm for one of 2 m.
SPACING_DIAMETERS = 1.0 / 80.0
#: Every fourth point fits the planes: 20 points across, some 310 in all.
FITTED_EVERY = 4


@dataclass(frozen=True)
class Limits:
    """Limits of a lander: diameter of its footprint, a disc, maximum slope of the plane and distance from it."""

    diameter_m: float
    max_slope_rad: float
    max_roughness_m: float


@dataclass(frozen=True)
class Footprints:
    """The true ground under landers."""

    slope_rad: Float[np.ndarray, "*places"]
    roughness_m: Float[np.ndarray, "*places"]
    exceeding_m2: Float[np.ndarray, "*places"]  #: area of the footprint that is farther from the plane than the limit
    safe: Bool[np.ndarray, "*places"]  #: whether slope and roughness are within the limits


@dataclass(frozen=True)
class Relief:
    """Exact heights of ground and rocks on a grid: row i at y = south + i spacing, column j at x = west + j spacing."""

    heights_m: Float[np.ndarray, "rows columns"]
    west_m: float
    south_m: float
    spacing_m: float

    @classmethod
    def of(
        cls,
        ground: SiteGround,
        low_m: Float[np.ndarray, "2"],
        high_m: Float[np.ndarray, "2"],
        spacing_m: float,
        meshes: Sequence[MeshParameters] = (),
    ) -> Relief:
        """The ground between two corners (x, y) with custom meshes; rocks have more detail than the grid resolves."""
        columns, rows = (int(n) for n in np.ceil((high_m - low_m) / spacing_m) + 1)
        west, south = float(low_m[0]), float(low_m[1])
        x, y = np.meshgrid(west + spacing_m * np.arange(columns), south + spacing_m * np.arange(rows))
        heights = np.array(ground.surface.height(x, y))
        middle = 0.5 * (low_m + high_m)
        if ground.rocks is not None:
            reach = 0.5 * float(np.hypot(*(high_m - low_m))) + float(ground.rocks.diameter_m.max(initial=0.0))
            # detail as from far above with pixels of the grid's spacing
            mesh = ground.rocks.near(
                float(middle[0]), float(middle[1]), reach, above_m=1e3 * reach, pixel_rad=spacing_m / (1e3 * reach)
            )
            kernels.raise_by_triangles(heights, west, south, spacing_m, mesh.vertices, mesh.faces)
        for one in meshes:
            own = one.standing(ground.surface, (float(middle[0]), float(middle[1])))
            corners = own.triangles.reshape(-1, 3)
            faces = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
            kernels.raise_by_triangles(heights, west, south, spacing_m, corners, faces)
        return cls(heights, west, south, spacing_m)

    def cells(self, places: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Fractional row and column of positions (x, y)."""
        return np.asarray((places - np.array([self.west_m, self.south_m]))[..., ::-1] / self.spacing_m)

    def average(self, places: Float[np.ndarray, "rows columns 2"], side_m: float) -> Float[np.ndarray, "rows columns"]:
        """Mean height over squares of this side about positions (x, y); NaN outside the grid."""
        width = max(round(side_m / self.spacing_m), 1)
        means = cv2.blur(self.heights_m, (width, width)) if width > 1 else self.heights_m
        rows, columns = np.moveaxis(self.cells(places).astype(np.float32), -1, 0)
        return np.asarray(
            cv2.remap(means, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan)
        )

    def footprints(self, places: Float[np.ndarray, "*places 2"], limits: Limits) -> Footprints:
        """The ground under landers at places (x, y).

        Raises ValueError if a footprint does not lie within the grid.
        """
        disc = _disc(round(0.5 * limits.diameter_m / self.spacing_m))
        middles = np.rint(self.cells(places)).astype(np.int64).reshape(-1, 2)
        reach = int(disc.offsets.max())
        if np.any(middles < reach) or np.any(middles >= np.array(self.heights_m.shape) - reach):
            raise ValueError("a footprint reaches beyond the ground whose heights are known")
        slopes, roughness, exceeding = (
            values.reshape(places.shape[:-1])
            for values in kernels.footprints(self.heights_m, self.spacing_m, middles, disc, limits.max_roughness_m)
        )
        safe = (slopes <= limits.max_slope_rad) & (roughness <= limits.max_roughness_m)
        return Footprints(slopes, roughness, exceeding, safe)


@lru_cache(maxsize=4)
def _disc(radius: int) -> kernels.Disc:
    """Points of a disc about its middle (row, column): all, and those that fit planes."""
    across = np.arange(-radius, radius + 1)
    points = np.stack(np.meshgrid(across, across, indexing="ij"), axis=-1).reshape(-1, 2)
    points = points[np.hypot(*points.T) <= radius]
    return kernels.Disc(points, points[np.all(points % FITTED_EVERY == 0, axis=1)].copy())
