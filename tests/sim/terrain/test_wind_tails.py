"""Tests of wind tails, the sand ridges downwind of rocks: shape of one ridge, and terrains with tails in the bank."""

from pathlib import Path

import numpy as np
import pytest

from marsyard.sim.terrain import PlacedRock, RockField, RockParameters, Surface, TerrainBank, TerrainParameters
from marsyard.sim.terrain.rocks.tails import WindTails

#: Spacing (m), samples per side and albedo of the ground; diameter, height and coordinates of the rock's centre, m.
SPACING_M, SIDE, ALBEDO = 0.02, 256, 0.25
DIAMETER_M, HEIGHT_M, CENTRE_M = 0.4, 0.2, 2.5


def _make_flat_surface() -> Surface:
    samples = np.zeros((SIDE, SIDE, 2), dtype=np.float32)
    samples[..., 1] = ALBEDO
    return Surface.from_samples(samples, SPACING_M)


def _make_surface_with_tail(tails: WindTails, diameter_m: float = DIAMETER_M) -> Surface:
    rock = PlacedRock(name="rock", east_m=CENTRE_M, north_m=CENTRE_M, diameter_m=diameter_m, height_m=HEIGHT_M)
    rocks = RockField.draw(
        _make_flat_surface(), RockParameters(abundance=0.0, placed=(rock,)), np.random.default_rng(1)
    )
    return tails.apply(_make_flat_surface(), rocks, np.random.default_rng(2))


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


def test_sides_are_not_steeper_than_the_cross_section_allows() -> None:
    surface = _make_surface_with_tail(WindTails(wind_from_deg=45.0, repose_deg=20.0, height_fraction=1.0))
    x, y = np.meshgrid(np.arange(0.0, SIDE * SPACING_M, 0.01), np.arange(0.0, SIDE * SPACING_M, 0.01))
    steepest = np.linalg.norm(surface.gradient(x, y), axis=-1).max()
    # The cross section is 1.54 times as steep as a triangle. The slope along the narrowing ridge adds in quadrature.
    assert np.tan(np.radians(20.0)) < steepest < 1.7 * np.tan(np.radians(20.0))


def test_rocks_narrower_than_four_samples_have_no_tail() -> None:
    assert not _make_surface_with_tail(WindTails(), diameter_m=3.9 * SPACING_M).levels[0][..., 0].any()
    assert _make_surface_with_tail(WindTails(), diameter_m=4.1 * SPACING_M).levels[0][..., 0].any()


def test_tails_in_the_bank_do_not_change_the_positions_of_rocks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MARSYARD_CACHE", str(tmp_path))
    without_tails = TerrainParameters(samples=256, spacing_m=0.05, rocks=RockParameters(abundance=0.05, smallest_m=0.2))
    with_tails = without_tails.with_changes({"rocks": {"tails": {}}})
    plain_bank, tail_bank = TerrainBank(without_tails, 3), TerrainBank(with_tails, 3)
    tail_heights = tail_bank.terrain(0).levels[0][..., 0] - plain_bank.terrain(0).levels[0][..., 0]
    assert tail_heights.min() == 0.0
    assert tail_heights.max() > 0.02
    rocks, rocks_of_plain = (bank.rocks(0, bank.terrain(0)) for bank in (tail_bank, plain_bank))
    assert rocks is not None
    assert rocks_of_plain is not None
    np.testing.assert_array_equal(rocks.position_m[:, :2], rocks_of_plain.position_m[:, :2])
    # Rocks stand on the surface with ridges.
    x, y, z = rocks.position_m.T
    np.testing.assert_array_equal(z, tail_bank.terrain(0).height(x, y))


def test_rock_abundance_changes_the_cached_terrain_only_with_tails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MARSYARD_CACHE", str(tmp_path))
    rocks = RockParameters(abundance=0.05, smallest_m=0.2)
    parameters = TerrainParameters(samples=64, spacing_m=0.05, rocks=rocks)
    for tails in (None, WindTails()):
        for abundance in (0.05, 0.1):
            TerrainBank(parameters.with_changes({"rocks": {"abundance": abundance, "tails": tails}}), 1).store(0)
    terrains = [path for path in (tmp_path / "terrain").glob("*.npy") if not path.name.startswith("rocks-")]
    assert len(terrains) == 3  # one without tails, two with tails
