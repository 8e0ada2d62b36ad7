"""Exact heights of ground and rocks, and true slope and roughness of footprints; confusion matrices.

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
from scipy.ndimage import distance_transform_edt

from marsyard.algorithms.hda import Ground, Safety
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.landing import kernels
from marsyard.scenarios.landing.flight import Flight
from marsyard.scenarios.landing.pictures import GroundTruth
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

    def averaged(self, places: Float[np.ndarray, "rows columns 2"], side_m: float) -> Float[np.ndarray, "rows columns"]:
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


#: Bounds of the hazard classes over the limit, and names of the classes between them.
CLASSES = (1.0, 1.5, 2.0, 3.0)
CLASS_NAMES = ("below_1", "1_to_1.5", "1.5_to_2", "2_to_3", "above_3")
#: Gross hazards (bar 2 of the validation): minimum diameter in cells, and minimum roughness over the limit.
GROSS_CELLS, GROSS = 3.0, 2.0


@dataclass(frozen=True)
class SampledMap:
    """The algorithm's map at the truth's positions."""

    #: whether the map has slope and roughness there, and both pictures show the footprint
    known: Bool[np.ndarray, "rows columns"]
    safe: Bool[np.ndarray, "rows columns"]  #: whether the map calls the position safe
    flagged: Bool[np.ndarray, "rows columns"]  #: whether a hazard cell, before growth, lies under the lander
    slope_rad: Float[np.ndarray, "rows columns"]

    @classmethod
    def of(cls, ground: Ground, flight: Flight, truth: GroundTruth, limits_rad_m: tuple[float, float]) -> SampledMap:
        """The map at the truth's positions; `limits_rad_m`: the algorithm's own limits of slope and roughness."""
        away = truth.places - flight.states[0].position_m[:2]
        local = np.asarray(away @ ground.world_from_surface.as_matrix()[:2, :2])
        cells = np.rint(ground.elevation.cells(local)).astype(np.int64)
        shape = np.array(ground.elevation.elevation_m.shape)
        inside = np.all((cells >= 0) & (cells < shape), axis=-1) & truth.covered
        rows, columns = np.moveaxis(np.clip(cells, 0, shape - 1), -1, 0)
        hazards = ground.hazards
        with np.errstate(invalid="ignore"):
            raw = (hazards.slope_rad > limits_rad_m[0]) | (hazards.roughness_m > limits_rad_m[1])
        reach = 0.5 * truth.limits.diameter_m / ground.elevation.cell_m
        near = distance_transform_edt(~raw) <= reach if np.any(raw) else np.zeros_like(raw)
        slope = hazards.slope_rad[rows, columns]
        known = inside & np.isfinite(slope) & np.isfinite(hazards.roughness_m[rows, columns])
        safe = known & (hazards.safety[rows, columns] == Safety.SAFE)
        return cls(known, safe, known & near[rows, columns], slope)


def hazard_counts(ground: Ground, at: SampledMap, truth: GroundTruth) -> dict[str, Scalar]:
    """Confusion counts of footprints, truth against map; sums over cases give rates.

    For each class of roughness and of slope over the limit: `footprints_*` in all, `footprints_*_safe` that the map
    calls safe, `footprints_*_unflagged` without a map hazard before growth. `gross_*` are hazards of twice the limit of
    roughness with a diameter of at least three cells; `false_alarms` are truly safe footprints with a map hazard.
    """
    under, known, safe = truth.footprints, at.known, at.safe
    over = {
        "roughness": under.roughness_m / truth.limits.max_roughness_m,
        "slope": under.slope_rad / truth.limits.max_slope_rad,
    }
    diameter_cells = 2.0 * np.sqrt(under.exceeding_m2 / np.pi) / ground.elevation.cell_m
    gross = (under.roughness_m >= GROSS * truth.limits.max_roughness_m) & (diameter_cells >= GROSS_CELLS)
    counted = {
        "footprints": known,
        "footprints_called_safe": safe,
        "footprints_called_safe_unsafe": safe & ~under.safe,
        "footprints_truly_safe": known & under.safe,
        "false_alarms": known & under.safe & at.flagged,
        "missed": known & ~under.safe & ~at.flagged,
        "gross_hazards": known & gross,
        "gross_hazards_called_safe": safe & gross,
        "gross_hazards_unflagged": known & gross & ~at.flagged,
    }
    for kind, ratio in over.items():
        classes = np.digitize(ratio, CLASSES)
        for number, name in enumerate(CLASS_NAMES):
            members = known & (classes == number)
            column = f"footprints_{kind}_{name}"
            counted |= {column: members, f"{column}_safe": members & safe, f"{column}_unflagged": members & ~at.flagged}
    return {column: int(np.count_nonzero(chosen)) for column, chosen in counted.items()}


def map_errors(ground: Ground, flight: Flight, at: SampledMap, truth: GroundTruth) -> dict[str, Scalar]:
    """Errors of the map's elevation and slope.

    The elevation is compared with the mean of the exact heights over each cell, relative to the camera. `bias` is the
    mean error, `rms` its RMS about zero, `noise` the robust standard deviation about the error's plane, which affects
    roughness; `outliers` is the fraction beyond five of these.
    """
    rows, columns = np.indices(ground.elevation.elevation_m.shape)
    local = ground.elevation.places(np.stack([rows, columns], axis=-1).astype(np.float64))
    start = flight.states[0].position_m
    places = start[:2] + local @ ground.world_from_surface.as_matrix()[:2, :2].T
    exact = truth.relief.averaged(places, ground.elevation.cell_m) - start[2]
    error = ground.elevation.elevation_m - exact
    known = np.isfinite(error)
    values = error[known]
    if values.size < 4:
        return {}
    design = np.column_stack([local[known], np.ones(values.size)])
    near = np.abs(values - np.median(values)) <= 5.0 * _deviation(values)
    level = values - design @ np.linalg.lstsq(design[near], values[near], rcond=None)[0]
    noise = _deviation(level)
    slope_errors = (at.slope_rad - truth.footprints.slope_rad)[at.known]
    some = slope_errors.size > 0
    return {
        "elevation_bias_m": float(values.mean()),
        "elevation_rms_m": float(np.sqrt(np.mean(values**2))),
        "elevation_median_error_m": float(np.median(np.abs(values))),
        "elevation_noise_m": noise,
        "elevation_outliers": float(np.mean(np.abs(level) > 5.0 * noise)),
        "slope_error_bias_deg": float(np.degrees(slope_errors.mean())) if some else float("nan"),
        "slope_error_rms_deg": float(np.degrees(np.sqrt(np.mean(slope_errors**2)))) if some else float("nan"),
    }


def _deviation(values: Float[np.ndarray, "n"]) -> float:
    """Robust standard deviation, at least 1e-12: positive also where more than half of the values are equal."""
    return max(1.4826 * float(np.median(np.abs(values - np.median(values)))), 1e-12)
