"""Lower bounds of the run time of a `dimes-gusev` case: necessary operations, measured separately, and their sum.

Three pictures of 1024 x 1024 pixels. Each pixel needs one spline evaluation for its intersection and one for its
radiance, a Poisson number of electrons and normal readout noise; shadows read every height once. OpenGL drawing and
DIMES' transforms are the library calls of profiled cases.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from benchmarks.pictures import descent_scene
from benchmarks.stages import Stages, profile_stages
from benchmarks.timing import Figure, core_seconds
from marsyard.sim.render.kernels.ground import height_range
from marsyard.sim.render.kernels.strips import STRIP, FetchedCells, fetch_cells, no_cells, spline
from marsyard.sim.terrain.kernels import Array, Level

PICTURES, SIDE_PX = 3, 1024
#: Spline evaluations per pixel: intersection and radiance.
SPLINES = 2
#: Mean electrons of a pixel; above about ten, the cost of a Poisson number does not depend on the mean.
ELECTRONS = 3e4
#: Library calls in cases.
CALLS: Stages = {
    "triangles drawn and read back by OpenGL": (("render/backend.py", "draw"),),
    "transforms of DIMES' correlations": (("image/correlation.py", "cross_sums"),),
}


def bounds(run_case: Callable[[], object], repeats: int) -> list[Figure]:
    """Lower bounds of the parts of a case and their sum, in core-seconds."""
    calls = profile_stages(run_case, repeats, CALLS)
    parts = {
        "splines where rays meet the ground and are shaded": core_seconds(_splines(), repeats),
        "random numbers of the detector": core_seconds(_random_numbers(), repeats),
        "heights of the ground read once": core_seconds(_heights(), repeats),
    } | {name: calls[name] for name in CALLS}
    figures = [Figure(f"  bound of a case: {name}", values) for name, values in parts.items()]
    total = sum(statistics.median(values) for values in parts.values())
    return [*figures, Figure("  bounds of a case, their sum", [total])]


def _splines() -> Callable[[], object]:
    """Evaluate splines at neighbouring positions, one per pixel, as the kernels do."""
    surface = descent_scene()[1]
    places = np.linspace(0.0, 1000.0, SIDE_PX)
    x, y = (side.ravel() for side in np.meshgrid(places, places))
    return lambda: [_sum_fields(surface.levels[0], 1.0 / surface.spacing_m, x, y) for _ in range(PICTURES * SPLINES)]


@njit(cache=True)
def _sum_fields(field: Level, scale: float, x: Array, y: Array) -> float:
    """Sum of heights, slopes and albedos at positions."""
    near: FetchedCells = no_cells()
    which = np.arange(STRIP)
    total = 0.0
    for first in range(0, x.size, STRIP):
        fetch_cells(field, scale, x[first : first + STRIP], y[first : first + STRIP], which, STRIP, near[0], near[1])
        total += _strip(near)
    return total


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _strip(near: FetchedCells) -> float:
    total = 0.0
    for k in range(STRIP):
        height, slope_x, slope_y, albedo = spline(near[0], near[1], k)
        total += height + slope_x + slope_y + albedo
    return total


def _random_numbers() -> Callable[[], object]:
    """Draw one Poisson and one normal number per pixel."""
    rng = np.random.default_rng(0)
    mean: NDArray[np.float32] = np.full((SIDE_PX, SIDE_PX), ELECTRONS, dtype=np.float32)

    def run() -> None:
        for _ in range(PICTURES):
            rng.poisson(mean)
            rng.standard_normal(mean.shape, dtype=np.float32)

    return run


def _heights() -> Callable[[], object]:
    """One pass over the heights of a terrain."""
    surface = descent_scene()[1]
    return lambda: height_range(surface.levels[0])
