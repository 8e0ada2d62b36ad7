"""Grids of height and albedo for terrain synthesis, and their refinement to finer grids."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from marsyard.sim.terrain.kernels import add_refined

SMALLEST_SIDE = 16  #: Minimum side of the grid of a landform, samples.
Grid = Float32[np.ndarray, "side side"]


@dataclass(frozen=True)
class TerrainGround:
    """Height and albedo of a terrain during synthesis; landforms change them in place.

    - height: control values of the spline, metres
    - log_albedo: natural logarithm of albedo divided by the mean albedo
    """

    height: Grid
    log_albedo: Grid
    spacing_m: float

    @property
    def side(self) -> int:
        """Samples along each side."""
        return int(self.height.shape[0])

    @property
    def period_m(self) -> float:
        """Period of the ground along x and y, metres."""
        return float(self.side * self.spacing_m)

    def coarser(self, feature_m: float) -> TerrainGround:
        """Return an empty grid of the same extent with a spacing of at most `feature_m`, but not finer than this grid.

        A landform without detail finer than `feature_m` is computed faster on this grid, and then added by `add`.
        """
        side = self.side
        while side > SMALLEST_SIDE and self.period_m / (side // 2) <= feature_m:
            side //= 2
        height, log_albedo = np.zeros((2, side, side), dtype=np.float32)
        return TerrainGround(height, log_albedo, self.period_m / side)

    def add(self, layer: TerrainGround, *, include_albedo: bool = True) -> None:
        """Add height and albedo of a coarser grid (`coarser`); the refinement of a B-spline is exact."""
        _add_grid(self.height, layer.height)
        if include_albedo:
            _add_grid(self.log_albedo, layer.log_albedo)


def _add_grid(total: Grid, coarse: Float32[np.ndarray, "coarse coarse"]) -> None:
    """Add a grid to one of the same extent that is as fine or finer."""
    if coarse.shape == total.shape:
        total += coarse
    else:
        add_refined(total, refine(coarse, total.shape[0] // 2))


def refine(coarse: Float32[np.ndarray, "coarse coarse"], side: int) -> Float32[np.ndarray, "side side"]:
    """Refine the control values of a surface to `side` samples per side: the coarse side times a power of two."""
    while coarse.shape[0] < side:
        doubled = np.zeros((2 * coarse.shape[0], 2 * coarse.shape[0]), dtype=np.float32)
        add_refined(doubled, np.ascontiguousarray(coarse))
        coarse = doubled
    return coarse


def resample(field: Float32[np.ndarray, "rows rows"], side: int) -> Float32[np.ndarray, "side side"]:
    """Refine or decimate a smooth field to a grid with `side` samples along each side."""
    step = max(field.shape[0] // side, 1)
    return refine(np.ascontiguousarray(field[::step, ::step]), side)
