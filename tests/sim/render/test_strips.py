"""Test of the shading kernels: evaluating the ground's spline for a strip of pixels equals evaluating each position."""

import numpy as np

from marsyard.sim.render.kernels.strips import ROW, STRIP, allocate_cells, fetch_levels, spline
from marsyard.sim.terrain import Surface
from marsyard.sim.terrain.kernels import sample

SIDE, SPACING_M = 64, 0.5
SAMPLES = np.random.default_rng(3).normal(size=(SIDE, SIDE, 2)).astype(np.float32)
SURFACE = Surface.from_samples(SAMPLES, SPACING_M)


def test_vectorised_spline_equals_single_evaluation() -> None:
    rng = np.random.default_rng(4)
    # Positions inside the terrain, on its border and in other periods.
    x, y = rng.uniform(-40.0, 40.0, (2, ROW))
    x[:4], y[:4] = [0.0, -0.25, 31.75, 32.0], [31.9, 0.0, -0.1, 16.0]
    level_of = rng.integers(0, len(SURFACE.levels), STRIP)
    indices = np.sort(rng.permutation(STRIP)[:100])
    cells = allocate_cells()
    fetch_levels(SURFACE.levels, 1.0 / SPACING_M, level_of, indices, indices.size, x, y, cells)
    for index in indices:
        scale = 1.0 / SPACING_M / 2.0 ** level_of[index]
        height, slope_x, slope_y, albedo = spline(cells[0], cells[1], int(index))
        expected = sample(SURFACE.levels[level_of[index]], scale, x[index], y[index])
        np.testing.assert_allclose((height, slope_x * scale, slope_y * scale, albedo), expected, rtol=0.0, atol=1e-14)
