"""Minimum cost of a `dimes-gusev` case: core-seconds of the necessary operations, measured separately, and their sum.

A case has three images of 1024 x 1024 pixels. Each pixel needs one spline evaluation for its intersection, one for its
radiance, a Poisson number of electrons and a normally distributed number for readout noise. The shadow sweep reads
every height once. The costs of OpenGL drawing and of DIMES' transforms are those of the library calls in profiled
cases.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from benchmarks.images import descent_scene
from benchmarks.stages import Stages, profile_stages
from benchmarks.timing import Measurement, core_seconds
from marsyard.sim.render.kernels.ground import height_range
from marsyard.sim.render.kernels.strips import STRIP, CellBuffers, allocate_cells, fetch_cells, spline
from marsyard.sim.terrain.kernels import Array, Level

#: Images of a case, and their side in pixels.
IMAGES, SIDE_PX = 3, 1024
#: Spline evaluations per pixel: intersection and radiance.
SPLINES_PER_PIXEL = 2
#: Mean number of electrons of a pixel; above about ten, the cost of a Poisson number does not depend on the mean.
ELECTRONS = 3e4
#: Library calls whose cost is taken from profiled cases.
CALLS: Stages = {
    "OpenGL: drawing triangles and reading them back": (("render/backend.py", "draw"),),
    "DIMES: transforms of the correlations": (("image/correlation.py", "cross_sums"),),
}


def measure_minimum_costs(run_case: Callable[[], object], repeats: int) -> list[Measurement]:
    """Measure the minimum cost of each necessary operation of a case and their sum, in core-seconds."""
    calls = profile_stages(run_case, repeats, CALLS)
    operations = {
        "splines for ray intersection and shading": core_seconds(_prepare_splines(), repeats),
        "random numbers of the detector": core_seconds(_prepare_random_numbers(), repeats),
        "one pass over the terrain's heights": core_seconds(_prepare_height_pass(), repeats),
    } | {name: calls[name] for name in CALLS}
    costs = [Measurement(f"dimes-gusev case, minimum cost: {name}", values) for name, values in operations.items()]
    total = sum(statistics.median(values) for values in operations.values())
    return [*costs, Measurement("dimes-gusev case, minimum cost: sum", [total])]


def _prepare_splines() -> Callable[[], object]:
    """Return a function that evaluates splines at neighbouring positions, one per pixel, as the kernels do."""
    surface = descent_scene()[1]
    axis_m = np.linspace(0.0, 1000.0, SIDE_PX)
    x, y = (grid.ravel() for grid in np.meshgrid(axis_m, axis_m))
    scale, passes = 1.0 / surface.spacing_m, IMAGES * SPLINES_PER_PIXEL
    return lambda: [_sum_fields(surface.levels[0], scale, x, y) for _ in range(passes)]


@njit(cache=True)
def _sum_fields(field: Level, scale: float, x: Array, y: Array) -> float:
    """Sum of heights, slopes and albedos at positions, in strips of `STRIP` positions for vector instructions."""
    cells: CellBuffers = allocate_cells()
    lanes = np.arange(STRIP)
    total = 0.0
    for first in range(0, x.size, STRIP):
        fetch_cells(field, scale, x[first : first + STRIP], y[first : first + STRIP], lanes, STRIP, cells[0], cells[1])
        total += _sum_strip(cells)
    return total


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _sum_strip(cells: CellBuffers) -> float:
    """Evaluate the splines of one strip."""
    total = 0.0
    for k in range(STRIP):
        height, slope_x, slope_y, albedo = spline(cells[0], cells[1], k)
        total += height + slope_x + slope_y + albedo
    return total


def _prepare_random_numbers() -> Callable[[], object]:
    """Return a function that draws one Poisson and one normally distributed number per pixel."""
    rng = np.random.default_rng(0)
    mean: NDArray[np.float32] = np.full((SIDE_PX, SIDE_PX), ELECTRONS, dtype=np.float32)

    def run() -> None:
        for _ in range(IMAGES):
            rng.poisson(mean)
            rng.standard_normal(mean.shape, dtype=np.float32)

    return run


def _prepare_height_pass() -> Callable[[], object]:
    """Return a function that reads all heights of a terrain once."""
    surface = descent_scene()[1]
    return lambda: height_range(surface.levels[0])
