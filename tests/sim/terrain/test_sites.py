"""Tests of sites: terrain statistics against the field test paper (section III.A), environment and parameters."""

from itertools import pairwise

import numpy as np
import pytest

from marsyard.sim.terrain import Environment, Surface, site, sites, synthesise
from marsyard.sim.terrain.rocks import RockField
from marsyard.sim.terrain.statistics import (
    PUBLISHED_SITES,
    TerrainStatistics,
    image_contrast,
    mean_slope_deg,
    terrain_statistics,
)
from tests.sim.scenes import make_ground

FIELD_SITES = ("pisgah", "kelso", "ivanpah")
MARS_SITES = ("gusev", "meridiani")
NAMES = (*FIELD_SITES, *MARS_SITES, "mars-yard", "heli-benign", "heli-hazardous")


@pytest.fixture(scope="module")
def site_statistics() -> dict[str, TerrainStatistics]:
    """Compute statistics of the full extent of 6 km, at four times the sample spacing to reduce the run time."""
    result = {}
    for name in (*FIELD_SITES, *MARS_SITES):
        parameters = site(name).terrain("descent")
        coarse_parameters = parameters.model_copy(
            update={"samples": parameters.samples // 4, "spacing_m": 4 * parameters.spacing_m}
        )
        result[name] = terrain_statistics(synthesise(coarse_parameters, np.random.default_rng(1)))
    return result


def test_all_sites_exist() -> None:
    assert tuple(sites()) == NAMES
    with pytest.raises(ValueError, match="no site is called 'jezero'; allowed: pisgah"):
        site("jezero")


@pytest.mark.parametrize("name", FIELD_SITES + MARS_SITES)
def test_albedo_and_slopes_match_the_paper(name: str, site_statistics: dict[str, TerrainStatistics]) -> None:
    paper, statistics = PUBLISHED_SITES[name], site_statistics[name]
    assert paper.albedo[0] - 1e-6 <= statistics.albedo <= paper.albedo[1] + 1e-6
    min_value, max_value = paper.mean_slope_deg
    assert min_value <= statistics.mean_slope_30_m_deg <= max_value
    assert min_value <= statistics.mean_slope_90_m_deg <= max_value


def test_kelso_rises_over_200_m_and_ivanpah_is_the_flattest(site_statistics: dict[str, TerrainStatistics]) -> None:
    assert site_statistics["kelso"].relief_m > 200.0
    for other_site in ("pisgah", "kelso"):
        assert site_statistics["ivanpah"].mean_slope_30_m_deg < site_statistics[other_site].mean_slope_30_m_deg
        assert site_statistics["ivanpah"].mean_slope_90_m_deg < site_statistics[other_site].mean_slope_90_m_deg


def _compute_median_contrast(name: str) -> float:
    parameters = site(name).terrain("descent")
    coarse = parameters.model_copy(update={"samples": 1024, "spacing_m": 4 * parameters.spacing_m})
    return float(
        np.median([terrain_statistics(synthesise(coarse, np.random.default_rng(seed))).contrast for seed in range(5)])
    )


@pytest.mark.slow
def test_contrast_of_pisgah_is_below_that_of_the_mars_sites() -> None:
    """The paper states that the contrast is "similar to contrast measured on descent images synthesized" from MOC.

    The contrast of these images is a lower limit of the contrast on Mars.
    """
    pisgah = _compute_median_contrast("pisgah")
    assert pisgah < 0.1
    for name in MARS_SITES:
        assert 0.5 < pisgah / _compute_median_contrast(name) < 1.0


def test_sites_have_complete_parameters() -> None:
    for parameters in sites().values():
        assert parameters.descent is not None or parameters.ground is not None
        assert parameters.ground_texture.amplitudes
        assert parameters.rock_texture.amplitudes
        finest_m = parameters.ground_texture.coarsest_m / 2 ** (len(parameters.ground_texture.amplitudes) - 1)
        assert finest_m < 0.002, "texture has details of a millimetre"
    for name in FIELD_SITES + MARS_SITES:
        assert site(name).terrain().spacing_m == 1.5
        assert site(name).terrain("ground").spacing_m == 0.025
    with pytest.raises(ValueError, match="mars-yard has no terrain at the scale 'descent'"):
        site("mars-yard").terrain("descent")
    with pytest.raises(ValueError, match="allowed: descent, ground"):
        site("gusev").terrain("orbit")


@pytest.mark.parametrize("name", NAMES)
def test_site_grounds_can_be_built_with_rocks(name: str) -> None:
    """A smaller extent with the same rocks reduces the run time."""
    parameters = site(name).terrain("ground")
    scale = {"samples": 512} if name != "kelso" else {"samples": 1024, "spacing_m": 0.1}
    surface = synthesise(parameters.model_copy(update=scale), np.random.default_rng(1))
    assert np.isfinite(surface.levels[0]).all()
    if parameters.rocks is not None:
        field = RockField.draw(surface, parameters.rocks, np.random.default_rng(1))
        assert len(field) > 0


def test_mean_slope_of_a_sine_wave_equals_its_closed_form() -> None:
    side, spacing = 256, 2.0
    surface = make_ground(np.tile(10.0 * np.sin(4 * np.pi * np.arange(side) / side), (side, 1)), spacing)
    # The mean absolute slope of a sine is 2 / pi of its maximum. The mean over both axes is half of that, because the
    # slope along the crests is zero.
    steepest = 10.0 * 2 * 2 * np.pi / 512
    assert mean_slope_deg(surface, 16.0) == pytest.approx(np.degrees(steepest * 2 / np.pi) / 2, rel=0.02)
    # The included part is near the zero crossing at x = 256 m, where the slope has its maximum.
    is_included = np.zeros((side, side), dtype=np.bool_)
    is_included[:251, 123:134] = True
    part_slope_deg = mean_slope_deg(surface, 4.0, is_included)
    assert part_slope_deg == pytest.approx(np.degrees(np.arctan(steepest)) / 2, rel=0.02)
    assert np.isnan(mean_slope_deg(surface, 300.0))


def test_contrast_of_level_ground_with_two_albedos_equals_their_contrast() -> None:
    samples = np.zeros((64, 64, 2), dtype=np.float32)
    samples[..., 1] = 0.2
    samples[:, :32, 1] = 0.1
    assert image_contrast(Surface.from_samples(samples, 6.5), 6.5) == pytest.approx(1 / 3, rel=1e-6)


def test_sky_light_increases_with_dust() -> None:
    sun_elevation = np.radians(45.0)
    fractions = [Environment(optical_depth=tau).sky_fraction(sun_elevation) for tau in (0.0, 0.2, 0.5, 0.9)]
    assert fractions[0] == 0.0
    assert all(less < more for less, more in pairwise(fractions))
    assert Environment(optical_depth=0.0).direct_fraction(sun_elevation) == 1.0
    # Without absorption and with isotropic scattering Eddington's approximation has a closed form. Over ground with the
    # albedo A the fraction of sunlight that arrives is (2 + 3 mu + (2 - 3 mu) exp(-tau / mu)) / (4 + 3 (1 - A) tau)
    # (Shettle & Weinman 1970).
    conservative = Environment(optical_depth=1.0, single_scattering_albedo=0.9999999, asymmetry=0.0)
    for mu in (1.0, 0.5):
        sun = np.arcsin(mu)
        for ground_albedo in (0.0, 0.3):
            total = conservative.direct_fraction(sun) * (mu + conservative.sky_fraction(sun, ground_albedo)) / mu
            expected = (2 + 3 * mu + (2 - 3 * mu) * np.exp(-1.0 / mu)) / (4 + 3 * (1.0 - ground_albedo))
            assert total == pytest.approx(expected, abs=1e-4)


def test_site_terrain_can_be_partly_changed() -> None:
    default = site("gusev").terrain("ground")
    custom = site("gusev").terrain("ground", {"samples": 512, "rocks": {"abundance": 0.2}, "ripples": None})
    assert (custom.samples, custom.rocks.abundance, custom.ripples) == (512, 0.2, None)
    assert custom.rocks.model_copy(update={"abundance": default.rocks.abundance}) == default.rocks
    assert custom.albedo == default.albedo
    with_dunes = site("gusev").terrain("descent", {"dunes": {"wavelength_m": 40.0}})
    assert with_dunes.dunes.wavelength_m == 40.0
    assert site("gusev").terrain("descent", {}) == site("gusev").descent


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sample": 512}, r"terrain has no parameter 'sample'; allowed: samples, spacing_m"),
        ({"rocks": {"density": 1}}, r"terrain\.rocks has no parameter 'density'; allowed: abundance, smallest_m"),
        ({"source": {"dem": "x"}}, r"terrain\.source has no parameter 'dem'; allowed: dtm"),
        ({"samples": 500}, r"terrain\.samples: .*500 is not a power of two; given: 500"),
        ({"rocks": {"abundance": 0.9}}, r"terrain\.rocks\.abundance: .*less than or equal to 0.4; given: 0.9"),
        ({"dunes": 3.0}, r"terrain\.dunes: .*; given: 3.0"),
    ],
)
def test_change_errors_are_reported(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        site("gusev").terrain("descent", changes)


def test_relief_is_that_of_the_spline_surface() -> None:
    """Alternating control values of +1 and -1 m give heights of +1/9 and -1/9 m at the knots: (4 - 2)**2 / 36."""
    rows, columns = np.indices((32, 32))
    surface = make_ground(np.where((rows + columns) % 2 == 0, 1.0, -1.0), 2.0)
    relief = terrain_statistics(surface).relief_m
    assert relief == pytest.approx(2.0 / 9.0, rel=1e-5)
    knots = surface.height(2.0 * columns, 2.0 * rows)
    assert relief == pytest.approx(float(np.ptp(knots)), rel=1e-5)
