"""Tests of terrain surfaces: height, gradient and resolution levels against SciPy's cubic B-spline; height bounds."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from marsyard.sim.terrain import Surface
from marsyard.sim.terrain.kernels import CEILING_BLOCK


@pytest.fixture(scope="module")
def surface() -> Surface:
    samples = np.random.default_rng(5).normal(size=(64, 64, 2)).astype(np.float32)
    return Surface.from_samples(samples, spacing_m=3.0)


@pytest.fixture(scope="module")
def positions() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(6)
    # The positions cover several periods on each side.
    return rng.uniform(-500.0, 500.0, 400), rng.uniform(-500.0, 500.0, 400)


@pytest.mark.parametrize("level", [0, 1, 2])
def test_height_matches_scipy_cubic_b_spline(
    surface: Surface, positions: tuple[np.ndarray, np.ndarray], level: int
) -> None:
    x, y = positions
    spacing = surface.spacing_m * 2**level
    for channel, actual in ((0, surface.height(x, y, level)), (1, surface.albedo(x, y, level))):
        control = surface.levels[level][..., channel].astype(np.float64)
        expected = map_coordinates(control, [y / spacing, x / spacing], order=3, mode="grid-wrap", prefilter=False)
        np.testing.assert_allclose(actual, expected, atol=1e-12)


def test_gradient_is_the_derivative_of_height(surface: Surface, positions: tuple[np.ndarray, np.ndarray]) -> None:
    x, y = positions
    # The error of central differences with the step h is h^2/6 times the third derivative of the cubic, about 1.
    step = 1e-4
    derivative_x = (surface.height(x + step, y) - surface.height(x - step, y)) / (2 * step)
    derivative_y = (surface.height(x, y + step) - surface.height(x, y - step)) / (2 * step)
    np.testing.assert_allclose(surface.gradient(x, y), np.stack([derivative_x, derivative_y], axis=-1), atol=1e-7)


@pytest.mark.parametrize("level", [0, 2])
def test_ceilings_bound_the_height(surface: Surface, level: int) -> None:
    """The ceiling of a block is the maximum control value in and next to it; no height in the block exceeds it."""
    ceiling, spacing = surface.ceilings[level], surface.spacing_m * 2.0**level
    block = CEILING_BLOCK * spacing
    x, y = np.random.default_rng(7).uniform(-surface.period_m, 2.0 * surface.period_m, (2, 40000))
    block_row, block_column = (np.floor(coordinate / block).astype(int) % len(ceiling) for coordinate in (y, x))
    assert np.all(surface.height(x, y, level) <= ceiling[block_row, block_column])
    samples = surface.levels[level][..., 0]
    for row, column in ((0, 0), (3, 1), (len(ceiling) - 1, 2)):
        indices = [
            np.arange(CEILING_BLOCK * index - 1, CEILING_BLOCK * (index + 1) + 2) % len(samples)
            for index in (row, column)
        ]
        assert ceiling[row, column] == samples[np.ix_(*indices)].max()


def test_surface_is_periodic(surface: Surface, positions: tuple[np.ndarray, np.ndarray]) -> None:
    x, y = positions
    np.testing.assert_allclose(
        surface.height(x + surface.period_m, y - 2 * surface.period_m), surface.height(x, y), atol=1e-11
    )


def test_resolution_levels_are_aligned() -> None:
    """A long wave has the same phase on each level."""
    side, spacing = 256, 2.0
    period = side * spacing
    x = np.arange(side) * spacing
    samples = np.zeros((side, side, 2), dtype=np.float32)
    samples[..., 0] = np.sin(2 * np.pi * x / period)[None, :] + np.cos(2 * np.pi * x / period)[:, None]
    surface = Surface.from_samples(samples, spacing)
    positions_m = np.linspace(0.0, period, 512, endpoint=False)
    for level in range(len(surface.levels) - 1):
        wave = surface.height(positions_m, np.zeros_like(positions_m), level)
        phase = np.angle(np.sum(wave * np.exp(-2j * np.pi * positions_m / period))) + np.pi / 2
        assert abs(phase) < 1e-5, f"level {level}"


@pytest.mark.parametrize("shape", [(8, 8, 2), (48, 48, 2), (64, 32, 2)])
def test_shapes_that_cannot_be_halved_are_rejected(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="power of two"):
        Surface.from_samples(np.zeros(shape, dtype=np.float32), 1.0)
