"""Tests of surface units (patches with different albedo, roughness and rocks), craters, wind marks and wind tails."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from marsyard.sim.terrain import (
    PlacedRock,
    RockField,
    RockParameters,
    Surface,
    TerrainBank,
    TerrainParameters,
    synthesise,
)
from marsyard.sim.terrain.landforms.craters import CRATER
from marsyard.sim.terrain.landforms.ground import TerrainGround
from marsyard.sim.terrain.landforms.random_fields import Spectrum
from marsyard.sim.terrain.landforms.units import SurfaceUnits
from marsyard.sim.terrain.rocks.field import RockForms
from marsyard.sim.terrain.rocks.shapes import SHAPES_OF_FORM
from marsyard.sim.terrain.rocks.tails import WindTails
from marsyard.sim.terrain.surface import ROCKS, ROUGHNESS, TEXTURE
from tests.sim.scenes import flat_ground

#: Types of units: fraction of the area, albedo, and factors of roughness, texture amplitude and rock density.
KINDS: list[dict[str, Any]] = [
    {"name": "plain", "fraction": 0.5},
    {"name": "dust", "fraction": 0.3, "log_albedo": 0.2, "roughness": 0.3, "texture": 0.2, "rocks": 0.1},
    {"name": "rubble", "fraction": 0.2, "log_albedo": -0.2, "roughness": 2.0, "texture": 1.5, "rocks": 3.0},
]
PLAIN = [{"name": "plain", "fraction": 1.0}]
NO_CRATERS = np.empty(0, dtype=CRATER)


def _make_units(**changes: Any) -> SurfaceUnits:
    return SurfaceUnits.model_validate({"kinds": KINDS, "boundary": 0.02, **changes})


def _apply_units(units: SurfaceUnits, seed: int = 1, side: int = 1024) -> tuple[TerrainGround, np.ndarray]:
    """Apply units to level ground without craters; return the ground, and the factors of the units at each cell."""
    ground = TerrainGround(np.zeros((side, side), dtype=np.float32), np.zeros((side, side), dtype=np.float32), 2.0)
    return ground, units.apply(ground, NO_CRATERS, np.random.default_rng(seed))


def _make_parameters(**changes: Any) -> TerrainParameters:
    values = {"samples": 512, "spacing_m": 2.0, "albedo_contrast": 0.1, "albedo_hurst": 0.3, "craters_per_km2": 0.0}
    return TerrainParameters.model_validate({**values, **changes})


def test_units_have_the_specified_areas_factors_and_albedos() -> None:
    """With sharp boundaries and fixed areas, each unit has its area, its factors and its albedo."""
    ground, factors = _apply_units(_make_units(concentration=1e6))
    for kind in KINDS:
        is_inside = np.isclose(factors[..., TEXTURE], kind.get("texture", 1.0), rtol=0.05)
        assert is_inside.mean() == pytest.approx(kind["fraction"], abs=0.05)
        assert np.median(factors[is_inside, ROUGHNESS]) == pytest.approx(kind.get("roughness", 1.0), rel=0.05)
        assert np.median(ground.log_albedo[::4, ::4][is_inside]) == pytest.approx(kind.get("log_albedo", 0.0), abs=0.02)
    assert factors[..., ROCKS].mean() == pytest.approx(1.0, rel=1e-4)


def test_unit_areas_vary_between_terrains() -> None:
    dust_fractions = [np.mean(_apply_units(_make_units(), seed, 256)[1][..., TEXTURE] < 0.4) for seed in range(40)]
    # The areas have a Dirichlet distribution: variance a (1 - a) / (concentration + 1), with the default
    # concentration of 8.
    assert np.std(dust_fractions) == pytest.approx(np.sqrt(0.3 * 0.7 / 9.0), rel=0.35)
    assert np.mean(dust_fractions) == pytest.approx(0.3, abs=0.08)


def test_patches_are_longer_along_the_wind() -> None:
    units = _make_units(wind_from_deg=270.0, wind_spread_deg=0.0, elongation=4.0, largest_m=300.0)
    texture = np.log(_apply_units(units)[1][..., TEXTURE])
    texture -= texture.mean()
    correlation_x, correlation_y = (np.mean(texture * np.roll(texture, 10, axis=axis)) for axis in (1, 0))
    assert correlation_x > 1.2 * correlation_y


def test_sand_lies_in_valleys_and_not_on_the_lower_half_of_the_terrain() -> None:
    """Units follow relief of the size of their patches; a slope of kilometres does not separate them."""
    kinds = [{"name": "sand", "fraction": 0.3, "texture": 0.5, "elevation": -4.0}, {"name": "rock", "fraction": 0.7}]
    units = _make_units(kinds=kinds, largest_m=400.0, concentration=1e6)
    phase = 2.0 * np.pi * np.arange(1024) / 1024
    # one wave of 40 m along y, and ten valleys of 10 m along x
    height = (20.0 * np.sin(phase)[:, None] + 5.0 * np.sin(10.0 * phase)).astype(np.float32)
    ground = TerrainGround(height, np.zeros_like(height), 2.0)
    is_sand = units.apply(ground, NO_CRATERS, np.random.default_rng(1))[..., TEXTURE] < 0.7
    in_valley = np.broadcast_to(np.sin(10.0 * phase)[::4] < 0.0, is_sand.shape)
    assert in_valley[is_sand].mean() > 0.8
    low_half = is_sand[np.sin(phase)[::4] < 0.0].mean()
    assert low_half == pytest.approx(is_sand.mean(), abs=0.1)


def test_units_follow_the_landforms() -> None:
    """Outcrop lies on lobes, which are added to the ground before its units."""
    kinds = [{"name": "rock", "fraction": 0.3, "texture": 0.5, "elevation": 4.0}, {"name": "sand", "fraction": 0.7}]
    lava = {"layers": 0.3, "lobe_length_m": 400.0, "lobe_thickness_m": 30.0, "aa_fraction": 0.0}
    p = _make_parameters(units=_make_units(kinds=kinds, largest_m=600.0, concentration=1e6), lava=lava)
    surface = synthesise(p, np.random.default_rng(2))
    is_rock = surface.factors[..., TEXTURE] < 0.7
    height = surface.levels[0][::4, ::4, 0]
    is_lobe = height - gaussian_filter(height, 40.0, mode="wrap") > 5.0
    assert is_rock[is_lobe].mean() > 2.0 * is_rock.mean()


@pytest.mark.parametrize("follows", [False, True])
def test_albedo_follows_relief_at_all_scales(follows: bool) -> None:
    """Hollows are dark and crests bright, at wavelengths of 8 to 16 and of 64 to 128 samples."""
    p = _make_parameters(albedo_follows_relief=follows, albedo_hurst=0.0, hurst=0.8)
    channels = synthesise(p, np.random.default_rng(3)).levels[0]
    for size in (2.0, 16.0):
        height, log_albedo = (
            gaussian_filter(field, size, mode="wrap") - gaussian_filter(field, 2.0 * size, mode="wrap")
            for field in (channels[..., 0], np.log(channels[..., 1]))
        )
        correlation = np.corrcoef(height.ravel(), log_albedo.ravel())[0, 1]
        assert correlation > 0.8 if follows else abs(correlation) < 0.4


def test_sum_of_split_field_equals_the_field() -> None:
    spectrum = Spectrum.power_law(128, 1.0, 0.4, 60.0)
    coarse, fine = spectrum.draw_split_field(np.random.default_rng(2), 1.5, 20.0)
    np.testing.assert_allclose(coarse + fine, spectrum.draw_field(np.random.default_rng(2), 1.5), atol=1e-5)
    waves = np.abs(np.fft.rfft2(coarse)).sum(axis=0)
    assert waves[40:].max() < 1e-3 * waves[:5].max()


def test_dust_devil_tracks_are_darker() -> None:
    ground, _ = _apply_units(_make_units(kinds=PLAIN, tracks_per_km2=20.0, track_log_albedo=-0.12))
    assert -0.3 < ground.log_albedo.min() < -0.08
    assert ground.log_albedo.max() < 1e-6
    assert 0.02 < np.mean(ground.log_albedo < -0.02) < 0.9


def test_rocks_follow_the_density_of_units_with_the_same_total() -> None:
    surface = synthesise(_make_parameters(samples=256, spacing_m=0.5, units=_make_units()), np.random.default_rng(4))
    parameters = RockParameters(abundance=0.005, smallest_m=0.02)  # few rocks, so that overlaps are rare
    rocks = RockField.draw(surface, parameters, np.random.default_rng(2))
    uniform_rocks = RockField.draw(Surface(surface.samples, surface.spacing_m), parameters, np.random.default_rng(2))
    assert len(rocks) == len(uniform_rocks)
    side = len(surface.factors)
    cell = (rocks.position_m[:, :2] / surface.period_m * side).astype(int) % side
    density = surface.factors[..., ROCKS]
    is_dense = density[cell[:, 1], cell[:, 0]] > 1.0
    expected = float(density[density > 1.0].sum() / density.sum())
    assert is_dense.mean() == pytest.approx(expected, abs=4.0 * np.sqrt(expected * (1.0 - expected) / len(rocks)))


def test_rock_forms_have_the_specified_fractions() -> None:
    surface = synthesise(_make_parameters(samples=128, spacing_m=0.5), np.random.default_rng(4))
    parameters = RockParameters(abundance=0.1, smallest_m=0.05, forms=RockForms(block=3.0, slab=1.0), albedo_spread=0.3)
    rocks = RockField.draw(surface, parameters, np.random.default_rng(2))
    # Shapes are numbered by form: blocks are form 0, slabs form 3.
    is_slab = rocks.shape // SHAPES_OF_FORM == 3
    assert set(np.unique(rocks.shape // SHAPES_OF_FORM)) == {0, 3}
    assert is_slab.mean() == pytest.approx(0.25, abs=0.02)
    ratio = rocks.height_m / rocks.diameter_m
    assert ratio[is_slab].mean() == pytest.approx(0.35 * ratio[~is_slab].mean(), rel=0.05)
    assert rocks.albedo.mean() == pytest.approx(1.0, abs=0.02)
    assert np.log(rocks.albedo).std() == pytest.approx(0.3, rel=0.05)


#: Spacing (m), samples per side and albedo of the ground; diameter, height and coordinates of the rock's centre, m.
SPACING_M, SIDE, ALBEDO = 0.02, 256, 0.25
DIAMETER_M, HEIGHT_M, CENTRE_M = 0.4, 0.2, 2.5


def _make_surface_with_tail(tails: WindTails, diameter_m: float = DIAMETER_M) -> Surface:
    rock = PlacedRock(name="rock", east_m=CENTRE_M, north_m=CENTRE_M, diameter_m=diameter_m, height_m=HEIGHT_M)
    rocks = RockField.draw(
        flat_ground(SIDE, SPACING_M, ALBEDO), RockParameters(abundance=0.0, placed=(rock,)), np.random.default_rng(1)
    )
    return tails.apply(flat_ground(SIDE, SPACING_M, ALBEDO), rocks, np.random.default_rng(2))


def test_ridge_has_the_height_length_and_direction_of_its_parameters() -> None:
    tails = WindTails(wind_from_deg=270.0, length_heights=4.0, length_spread=0.0, log_albedo=0.2)
    surface = _make_surface_with_tail(tails)
    # The angle of repose limits the height: half width times tan(20 deg) = 7.3 cm < 0.4 * 20 cm.
    height_m = 0.5 * DIAMETER_M * np.tan(np.radians(20.0))
    edge_m = CENTRE_M + 0.5 * DIAMETER_M
    # The spline smooths the kink at the rock's edge, which lowers it by less than a tenth.
    assert float(surface.height(edge_m, CENTRE_M)) == pytest.approx(height_m, rel=0.1)
    # The wind comes from the west. The ridge extends to the east and ends 4 rock heights from the edge.
    half_way = float(surface.height(edge_m + 2.0 * HEIGHT_M, CENTRE_M))
    assert half_way == pytest.approx(0.5 * height_m, rel=0.1)
    assert float(surface.height(edge_m + 4.0 * HEIGHT_M + 2 * SPACING_M, CENTRE_M)) == 0.0
    assert float(surface.height(CENTRE_M - 2 * SPACING_M, CENTRE_M)) == 0.0
    assert float(surface.height(edge_m, CENTRE_M + 0.5 * DIAMETER_M + 2 * SPACING_M)) == 0.0
    # The cross section is (1 - t**2)**2, with t relative to the half width: 0.5625 at t = 0.5.
    assert float(surface.height(edge_m, CENTRE_M + 0.25 * DIAMETER_M)) == pytest.approx(0.5625 * height_m, rel=0.1)
    assert float(surface.albedo(edge_m, CENTRE_M)) == pytest.approx(ALBEDO * np.exp(0.2), rel=0.02)


def test_wind_digs_a_moat_in_front_of_a_rock() -> None:
    tails = WindTails(wind_from_deg=270.0, moat_fraction=0.15)
    surface, flat = _make_surface_with_tail(tails), _make_surface_with_tail(WindTails(moat_fraction=0.0))
    radius = 0.5 * DIAMETER_M
    # the deepest point is 1.15 half widths to the west, where the wind comes from
    assert float(surface.height(CENTRE_M - 1.15 * radius, CENTRE_M)) == pytest.approx(-0.15 * HEIGHT_M, rel=0.05)
    diagonal = 1.15 * radius * np.sqrt(0.5)
    assert float(surface.height(CENTRE_M - diagonal, CENTRE_M + diagonal)) == pytest.approx(
        -0.15 * HEIGHT_M * np.sqrt(0.5), rel=0.05
    )
    assert float(surface.height(CENTRE_M - 2.0 * radius, CENTRE_M)) == 0.0
    assert flat.levels[0][..., 0].min() == 0.0


def test_sides_are_not_steeper_than_the_cross_section_allows() -> None:
    surface = _make_surface_with_tail(WindTails(wind_from_deg=45.0, repose_deg=20.0, height_fraction=1.0))
    x, y = np.meshgrid(np.arange(0.0, SIDE * SPACING_M, 0.01), np.arange(0.0, SIDE * SPACING_M, 0.01))
    steepest = np.linalg.norm(surface.gradient(x, y), axis=-1).max()
    # The cross section is 1.54 times as steep as a triangle. The slope along the narrowing ridge adds in quadrature.
    assert np.tan(np.radians(20.0)) < steepest < 1.7 * np.tan(np.radians(20.0))


def test_rocks_narrower_than_two_and_a_half_samples_have_no_tail() -> None:
    assert not _make_surface_with_tail(WindTails(), diameter_m=2.4 * SPACING_M).levels[0][..., 0].any()
    assert _make_surface_with_tail(WindTails(), diameter_m=2.6 * SPACING_M).levels[0][..., 0].any()


def test_tails_in_the_bank_do_not_move_rocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MARSYARD_CACHE", str(tmp_path))
    without_tails = TerrainParameters(samples=256, spacing_m=0.05, rocks=RockParameters(abundance=0.05, smallest_m=0.2))
    with_tails = without_tails.with_changes({"rocks": {"tails": {}}})
    plain_bank, tail_bank = TerrainBank(without_tails, 3), TerrainBank(with_tails, 3)
    tail_heights = tail_bank.terrain(0).levels[0][..., 0] - plain_bank.terrain(0).levels[0][..., 0]
    # moats are 12 % of the rocks' heights deep
    assert -0.2 * 0.5 * 3.0 < tail_heights.min() < -0.005
    assert tail_heights.max() > 0.02
    rocks, rocks_of_plain = (bank.rocks(0, bank.terrain(0)) for bank in (tail_bank, plain_bank))
    np.testing.assert_array_equal(rocks.position_m[:, :2], rocks_of_plain.position_m[:, :2])
    # Rocks stand on the surface with ridges.
    x, y, z = rocks.position_m.T
    np.testing.assert_array_equal(z, tail_bank.terrain(0).height(x, y))


def test_abundance_changes_the_cached_terrain_only_with_tails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MARSYARD_CACHE", str(tmp_path))
    rocks = RockParameters(abundance=0.05, smallest_m=0.2)
    parameters = TerrainParameters(samples=64, spacing_m=0.05, rocks=rocks)
    for tails in (None, WindTails()):
        for abundance in (0.05, 0.1):
            TerrainBank(parameters.with_changes({"rocks": {"abundance": abundance, "tails": tails}}), 1).store(0)
    terrains = [path for path in (tmp_path / "terrain").glob("*.npy") if not path.name.startswith("rocks-")]
    assert len(terrains) == 3  # one without tails, two with tails


def test_hollows_of_fine_relief_are_level_and_its_rises_bright() -> None:
    parameters = _make_parameters(
        albedo_contrast=0.0, units={"kinds": PLAIN}, relief_log_albedo=0.1, fine_below_m=1e6, rms_slope_deg=3.0
    )
    samples = synthesise(parameters, np.random.default_rng(3)).levels[0].astype(np.float64)
    height, log_albedo = samples[..., 0], np.log(samples[..., 1])
    above = height - height.min()
    # a Gaussian field z is below its mean on half the ground, and the mean of max(z, 0) is half that of abs(z)
    assert np.mean(above < 1e-3 * above.max()) == pytest.approx(0.5, abs=0.08)
    slope = np.polyfit(above.ravel(), log_albedo.ravel(), 1)[0]
    assert slope == pytest.approx(0.1 / (2.0 * above.mean()), rel=0.05)
    assert np.corrcoef(above.ravel(), log_albedo.ravel())[0, 1] > 0.99
