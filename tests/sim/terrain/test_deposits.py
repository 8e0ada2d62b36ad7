"""Tests of albedo that follows the ground: strata and their scarps, sand in the lee of relief."""

import numpy as np
import pytest

from marsyard.sim.terrain.landforms import Drifts, Dunes, Strata, TerrainGround
from marsyard.sim.terrain.landforms.wind import compute_lee

SIDE, SPACING_M = 256, 2.0


def _make_ground(height: np.ndarray) -> TerrainGround:
    return TerrainGround(height.astype(np.float32), np.zeros((SIDE, SIDE), dtype=np.float32), SPACING_M)


def test_strata_are_level_and_end_in_scarps() -> None:
    """On a plane slope the albedo depends only on the height, and there are two slopes: of treads and of scarps."""
    slope = 0.05
    ground = _make_ground(np.broadcast_to(slope * SPACING_M * np.arange(SIDE), (SIDE, SIDE)))
    before = ground.height.copy()
    strata = Strata(thickness_m=5.0, scarp_height=0.6, scarp_width=0.2, log_albedo_rms=0.1)
    strata.apply(ground, np.random.default_rng(1))
    assert np.array_equal(ground.height, np.broadcast_to(ground.height[0], (SIDE, SIDE)))
    assert np.abs(ground.height - before).max() < 5.0 * 3.0
    slopes = np.diff(ground.height[0].astype(np.float64)) / SPACING_M
    assert slopes.min() > 0.0
    # treads: 0.4 of the height in 0.8 of the outcrop; scarps: 0.6 in 0.2; a few samples are on both
    is_tread, is_scarp = (np.isclose(slopes, ratio * slope, rtol=0.1) for ratio in (0.4 / 0.8, 0.6 / 0.2))
    assert is_tread.mean() == pytest.approx(0.8, abs=0.12)
    assert is_scarp.mean() == pytest.approx(0.2, abs=0.12)
    # 25.6 m of height contain about five strata; the albedo is constant in each
    steps = np.abs(np.diff(ground.log_albedo[0]))
    assert 2 <= np.count_nonzero(steps > 0.02) <= 15
    assert np.median(steps) == 0.0


@pytest.mark.parametrize("downwind_deg", [0.0, 90.0, 180.0, 270.0, 30.0, 250.0])
def test_lee_lies_downwind_of_a_hill_and_falls_with_its_slope(downwind_deg: float) -> None:
    """Behind a hill the lee begins at its height; it falls with the slope, and faster as it spreads to its sides."""
    y, x = (np.mgrid[:SIDE, :SIDE] - SIDE / 2) * SPACING_M
    height = (20.0 * np.exp(-0.5 * (x**2 + y**2) / 15.0**2)).astype(np.float32)
    lee = compute_lee(height, SPACING_M, np.radians(downwind_deg), 0.1)
    assert (lee >= height).all()
    along = x * np.cos(np.radians(downwind_deg)) + y * np.sin(np.radians(downwind_deg))
    depth = lee - height
    assert depth[along < -20.0].max() < 0.01
    assert depth.max() > 5.0
    centre = np.unravel_index(depth.argmax(), depth.shape)
    assert 20.0 < along[centre] < 100.0
    # a straight crest has no sides: the lee is a plane
    ridge = np.zeros((SIDE, SIDE), dtype=np.float32)
    ridge[:, 40] = 10.0
    plane = compute_lee(ridge, SPACING_M, 0.0, 0.1)
    np.testing.assert_allclose(plane[:, 40:90], np.broadcast_to(10.0 - 0.2 * np.arange(50), (SIDE, 50)), atol=1e-4)
    assert not plane[:, :40].any()


def test_sand_lies_in_craters_and_behind_rims() -> None:
    """The bowl of a crater is dark and partly filled; its bedforms end at the border of the sand."""
    radius = np.hypot(*(np.mgrid[:SIDE, :SIDE] - SIDE / 2)) * SPACING_M
    height = np.where(radius < 60.0, 20.0 * (radius / 60.0) ** 2 - 16.0, 4.0 * np.exp(-(radius - 60.0) / 20.0))
    drifts = Drifts(wind_from_deg=270.0, wind_spread_deg=0.0, log_albedo=-0.3, depth_m=2.0, filled=0.2)
    ground = _make_ground(height)
    drifts.apply(ground, np.random.default_rng(1))
    middle = SIDE // 2
    assert ground.log_albedo[middle, middle] == pytest.approx(-0.3, abs=0.03)
    assert 1.0 < ground.height[middle, middle] - height[middle, middle] < 0.2 * 20.0
    # the outer slope of the rim, 4 m / 20 m, is steeper than the lee: sand lies behind the downwind rim only
    assert ground.log_albedo[middle, middle + 36] < -0.001
    assert ground.log_albedo[middle, middle - 36] == 0.0
    rippled = _make_ground(height)
    bedforms = Dunes(wavelength_m=20.0, height_m=0.8, repose_deg=15.0, albedo_contrast=0.0)
    drifts.model_copy(update={"bedforms": bedforms}).apply(rippled, np.random.default_rng(1))
    change = np.abs(rippled.height - ground.height)
    assert change[radius < 40.0].max() > 0.4
    assert change[radius > 200.0].max() < 0.02
