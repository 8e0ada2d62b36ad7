"""Tests of the wind profile over height and of gust statistics."""

import numpy as np
import pytest
from scipy.integrate import quad

from marsyard.sim.dynamics import Wind, WindParameters
from marsyard.sim.dynamics.wind import LONGEST_WAVE_SCALES, SHORTEST_WAVE_M

#: Height of the ground, m; the wind depends on the height above it.
GROUND_M = -1900.0


def _make_wind(seed: int = 0, **parameters: float) -> Wind:
    return Wind.draw(WindParameters(**parameters), GROUND_M, np.random.default_rng(seed))


def test_mean_wind_is_logarithmic_in_layer_and_constant_above() -> None:
    wind = _make_wind(wind_east_m_s=20.0, wind_north_m_s=-5.0, gust_intensity_m_s=0.0)
    above_ground = np.array([0.0, 1.0, 100.0, 500.0, 2000.0])
    result = wind.velocities(GROUND_M + above_ground)
    # defaults: roughness length 0.03 m, boundary layer 500 m
    fraction = np.minimum(np.log1p(above_ground / 0.03) / np.log1p(500.0 / 0.03), 1.0)
    np.testing.assert_allclose(result, fraction[:, None] * [20.0, -5.0, 0.0], atol=1e-12)
    np.testing.assert_array_equal(wind.velocities(np.array([GROUND_M - 10.0])), 0.0)


def test_wind_without_gusts_is_the_mean_wind() -> None:
    wind = _make_wind(wind_east_m_s=20.0, gust_intensity_m_s=2.0)
    heights = GROUND_M + np.linspace(600.0, 2000.0, 50)
    assert np.ptp(wind.velocities(heights)[:, 0]) > 1.0
    np.testing.assert_allclose(wind.without_gusts.velocities(heights)[:, 0], 20.0)


def _compute_structure_function(spectrum: str, lag_m: float, length_m: float) -> float:
    """Compute the mean squared difference over a lag for unit variance, from the band-limited Dryden spectrum."""

    def density(k: float) -> float:
        """Compute the spectral density at wavenumber k, rad/m, with an arbitrary factor; x is length times k."""
        x2 = (length_m * k) ** 2
        return 2.0 / (1.0 + x2) if spectrum == "longitudinal" else (1.0 + 3.0 * x2) / (1.0 + x2) ** 2

    first, last = 2.0 * np.pi / (LONGEST_WAVE_SCALES * length_m), 2.0 * np.pi / SHORTEST_WAVE_M
    variance, _ = quad(density, first, last, limit=400)
    squared_difference, _ = quad(lambda k: density(k) * 2.0 * (1.0 - np.cos(k * lag_m)), first, last, limit=2000)
    return squared_difference / variance


@pytest.mark.slow
@pytest.mark.parametrize("lag_m", [50.0, 300.0])
def test_gusts_have_dryden_spectra(lag_m: float) -> None:
    n_draws = 3000
    heights = GROUND_M + np.array([1000.0, 1000.0 + lag_m])
    velocities_m_s = np.stack([_make_wind(seed, gust_intensity_m_s=2.0).velocities(heights) for seed in range(n_draws)])
    # The variance of n normal draws has a relative deviation of sqrt(2 / n) = 2.6 %; the tolerance is four times that.
    tolerance = 4.0 * np.sqrt(2.0 / n_draws)
    np.testing.assert_allclose(velocities_m_s[:, 0].var(axis=0), 4.0, rtol=tolerance)
    structure = np.mean((velocities_m_s[:, 1] - velocities_m_s[:, 0]) ** 2, axis=0) / 4.0
    # The default length scale is 533 m.
    np.testing.assert_allclose(structure[:2], _compute_structure_function("transverse", lag_m, 533.0), rtol=tolerance)
    np.testing.assert_allclose(structure[2], _compute_structure_function("longitudinal", lag_m, 533.0), rtol=tolerance)


def test_components_are_independent() -> None:
    gusts_m_s = np.stack([_make_wind(seed, gust_intensity_m_s=1.0).velocities(np.zeros(1))[0] for seed in range(2000)])
    correlation = np.corrcoef(gusts_m_s.T) - np.eye(3)
    assert np.abs(correlation).max() < 4.0 / np.sqrt(2000)
