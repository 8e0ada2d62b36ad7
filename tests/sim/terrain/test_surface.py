"""Tests of terrain surfaces against SciPy's B-spline, and of synthetic terrain: statistics, albedo and craters."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.ndimage import map_coordinates

from marsyard.sim.terrain import Surface, TerrainParameters, synthesise
from marsyard.sim.terrain.kernels import CEILING_BLOCK
from marsyard.sim.terrain.landforms.random_fields import FractalField, Spectrum


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
def test_height_matches_scipy_spline(surface: Surface, positions: tuple[np.ndarray, np.ndarray], level: int) -> None:
    x, y = positions
    spacing = surface.spacing_m * 2**level
    for channel, actual in ((0, surface.height(x, y, level)), (1, surface.albedo(x, y, level))):
        control = surface.levels[level][..., channel].astype(np.float64)
        expected = map_coordinates(control, [y / spacing, x / spacing], order=3, mode="grid-wrap", prefilter=False)
        assert_allclose(actual, expected, atol=1e-12)


def test_gradient_is_the_derivative_of_height(surface: Surface, positions: tuple[np.ndarray, np.ndarray]) -> None:
    x, y = positions
    # The error of central differences with the step h is h^2/6 times the third derivative of the cubic, about 1.
    step = 1e-4
    derivative_x = (surface.height(x + step, y) - surface.height(x - step, y)) / (2 * step)
    derivative_y = (surface.height(x, y + step) - surface.height(x, y - step)) / (2 * step)
    assert_allclose(surface.gradient(x, y), np.stack([derivative_x, derivative_y], axis=-1), atol=1e-7)


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


def test_random_fields_have_the_specified_mean_variance() -> None:
    # The standard error of the mean variance is about 3 % for 200 draws of about ten independent large-scale modes.
    spectrum = Spectrum.power_law(128, 1.0, 0.5, 60.0)
    variances = [spectrum.draw_field(np.random.default_rng(seed), 2.0).var() for seed in range(200)]
    assert np.mean(variances) == pytest.approx(4.0, rel=0.04)


@pytest.mark.parametrize("hurst", [0.5, 0.8])
def test_structure_function_has_specified_slope_and_exponent(hurst: float) -> None:
    """The structure function has the specified RMS slope at the baseline and grows with the Hurst exponent."""
    parameters = TerrainParameters(
        samples=1024, hurst=hurst, rms_slope_deg=3.0, slope_baseline_m=30.0, outer_scale_m=20000.0, craters_per_km2=0.0
    )
    lags = np.array([4, 8, 20])
    roughness = np.zeros(3)
    for seed in range(6):
        heights = synthesise(parameters, np.random.default_rng(seed)).levels[0][..., 0].astype(np.float64)
        roughness += [
            np.mean((np.roll(heights, -lag, axis=1) - heights) ** 2 + (np.roll(heights, -lag, axis=0) - heights) ** 2)
            for lag in lags
        ]
    # The sum has 12 terms: six terrains and two axes.
    rms = np.sqrt(roughness / 12.0)
    slope_deg = np.degrees(np.arctan(rms[2] / (lags[2] * parameters.spacing_m)))
    assert slope_deg == pytest.approx(3.0, rel=0.1)
    measured_hurst = np.polyfit(np.log(lags), np.log(rms), 1)[0]
    # The band limits of the grid change the exponent by a few hundredths.
    assert measured_hurst == pytest.approx(hurst, abs=0.05)


def test_albedo_has_the_specified_mean_and_contrast() -> None:
    parameters = TerrainParameters(samples=1024, albedo=0.25, albedo_contrast=0.1, outer_scale_m=200.0)
    albedo = synthesise(parameters, np.random.default_rng(1)).levels[0][..., 1]
    assert albedo.mean() == pytest.approx(0.25, rel=0.02)
    assert np.log(albedo).std() == pytest.approx(0.1, rel=0.1)


@pytest.mark.parametrize("hurst", [0.0, 0.75])
def test_white_noise_replaces_the_finest_octave(hurst: float) -> None:
    """The spectrum of the field's values is that of a power law at all samples, also where the octaves meet."""
    fields = (FractalField.power_law(512, 2.0, hurst, 200.0), Spectrum.power_law(512, 2.0, hurst, 200.0))
    power = []
    for field in fields:
        rng, total = np.random.default_rng(7), np.zeros((512, 257))
        for _ in range(6):
            control = field.draw_field(rng, 1.5).astype(np.float64)
            values = map_coordinates(control, np.mgrid[:512, :512], order=3, mode="grid-wrap", prefilter=False)
            total += np.abs(np.fft.rfft2(values)) ** 2
        power.append(total)
    frequency = np.hypot(np.fft.fftfreq(512)[:, None], np.fft.rfftfreq(512))
    for low, high in ((0.005, 0.02), (0.02, 0.06), (0.06, 0.12), (0.12, 0.18), (0.18, 0.25), (0.25, 0.33)):
        ring = (frequency > low) & (frequency < high)
        # beyond a quarter of the sampling frequency the spline attenuates both to a tenth of their power
        tolerance = 0.12 if high < 0.2 else 0.5
        assert power[0][ring].sum() == pytest.approx(power[1][ring].sum(), rel=tolerance)
    rms_slopes = [field.line_slope_rms(30.0) for field in fields]
    assert rms_slopes[0] == pytest.approx(rms_slopes[1], rel=0.02)
