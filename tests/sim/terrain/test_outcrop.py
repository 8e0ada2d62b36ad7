"""Tests of outcrops, strata and sand: areas, relief, and albedo that follows the ground."""

import numpy as np
import pytest
from jaxtyping import Float32

from marsyard.sim.terrain.landforms import Drifts, Dunes, Outcrop, Strata, TerrainGround
from marsyard.sim.terrain.landforms.bedrock import locate_points
from marsyard.sim.terrain.landforms.kernels.bedrock import DOME, LOOSENESS, Slabs, add_slabs
from marsyard.sim.terrain.landforms.wind import compute_lee


def _apply(**changes: float) -> TerrainGround:
    height, log_albedo = np.zeros((2, 512, 512), dtype=np.float32)
    ground = TerrainGround(height, log_albedo, 0.05)
    Outcrop(**{"patch_m": 4.0, "slab_m": 1.0, "joint_m": 0.05, **changes}).apply(ground, np.random.default_rng(3))
    return ground


@pytest.mark.parametrize("fraction", [0.2, 0.6])
def test_slabs_cover_the_specified_fraction_and_rise_above_the_sand(fraction: float) -> None:
    ground = _apply(fraction=fraction, height_m=0.1, tilt_deg=0.0, log_albedo=0.3, log_albedo_sd=0.0)
    is_slab = ground.height > 0.005
    # 26 x 26 large slabs with patches of 4 m: the area is known to a tenth; about a third is joints and low slabs
    assert np.mean(is_slab) == pytest.approx(0.67 * fraction, abs=0.08)
    # the bedrock is 0 to 1 height above the sand, on average over patches about 0.8 with slabs of 0 in the mean
    assert np.median(ground.height[is_slab]) == pytest.approx(0.08, rel=0.35)
    assert np.median(ground.log_albedo[ground.height > 0.05]) == pytest.approx(0.3, rel=0.1)
    assert np.all(ground.height[~is_slab] >= 0.0)


def test_slabs_go_below_the_sand_at_the_boundary_of_a_patch() -> None:
    """Heights vary continuously from the sand to the middle of a patch, and slabs differ in height."""
    ground = _apply(fraction=0.4, patch_m=12.0, height_m=0.1, tilt_deg=0.0)
    heights = ground.height[ground.height > 0.0]
    quantiles = np.percentile(heights, [5, 25, 50, 75, 95])
    # not a plateau: the interquartile range exceeds a third of the median
    assert quantiles[3] - quantiles[1] > 0.33 * quantiles[2]
    assert quantiles[0] < 0.2 * quantiles[2]


def test_sand_between_slabs_is_dark_or_bright() -> None:
    ground = _apply(fraction=0.6, patch_m=1.0, log_albedo=0.0, log_albedo_sd=0.0, sand_log_albedo_sd=0.2)
    sand = ground.log_albedo[ground.height == 0.0]
    assert sand.min() < -0.1
    assert sand.max() > 0.1


def test_ground_without_bedrock_is_unchanged() -> None:
    ground = _apply(fraction=0.0)
    # the quantile that bounds the patches is the maximum of the field
    assert np.mean(ground.height > 0.0) < 0.01


def _add_one_slab(slope_x: float, joint_m: float = 0.1) -> Float32[np.ndarray, "64 64"]:
    """Add one slab above sand, among deep cells: four cells of 1.6 m with points in their middles, equal joints."""
    height, log_albedo = np.zeros((2, 64, 64), dtype=np.float32)
    positions, slabs = locate_points(np.full((2, 2, 2), 0.5)), np.zeros((2, 2, 5))
    slabs[..., 0], slabs[..., 4] = -0.5, 0.25
    slabs[0, 0, :2] = (0.2, slope_x)
    coarse = Slabs(positions, np.pad(slabs, ((1, 1), (1, 1), (0, 0)), mode="wrap"), 1.6, joint_m, 0.5, 0.5)
    fine = Slabs(positions, np.zeros((4, 4, 5)), 1.6, joint_m, 0.0, 0.0)
    add_slabs(height, log_albedo, 0.05, np.zeros((16, 16, 4), dtype=np.float32), coarse, fine, 1.0, 0.02)
    return height


def test_slab_is_a_tilted_dome_between_level_joints() -> None:
    level, tilted = _add_one_slab(0.0), _add_one_slab(0.1)
    # The cell is the square from 0 to 1.6 m. At the boundary of the bedrock joints are wider by `LOOSENESS`; numbers of
    # 0.25 give 3/4 of the mean half width: 0.19 m. From 0.4 m on the slab is level.
    half_width = 0.75 * 0.1 * (1.0 + LOOSENESS)
    assert level[8:25, 8:25] == pytest.approx(0.2)
    # 0.3 m from the border, a quarter of the fall remains
    assert level[16, 6] == pytest.approx(0.2 - DOME * 0.5 * 0.25**2, abs=1e-6)
    # a sample at 0.2 m is joint in this part of its width
    filled = (half_width - 0.175) / 0.05
    assert level[16, 4] == pytest.approx(0.2 - 0.75 * 0.5 * filled, abs=1e-6)
    # the floor of the joint is below the sand
    assert np.all(level[16, :4] == 0.0)
    assert np.all(level[34:, :] == 0.0)
    assert np.all(level[:, 34:] == 0.0)
    # along x, columns are 0.05 m apart
    assert np.diff(tilted[16, 8:25]) == pytest.approx(0.1 * 0.05, abs=1e-6)
    assert tilted[16, 16] == pytest.approx(0.2, abs=1e-6)


def test_joints_are_sand_also_where_their_floor_is_above_the_surroundings() -> None:
    ground = _apply(fraction=1.0, height_m=0.1, tilt_deg=0.0, log_albedo=0.4, log_albedo_sd=0.0, sand_log_albedo_sd=0.0)
    high = ground.log_albedo[ground.height > 0.035]
    # the remaining samples contain the margin of a joint
    assert np.mean(high > 0.39) > 0.6
    assert np.mean(high < 0.0) > 0.02


def test_joints_differ_in_width() -> None:
    """Widths of the gaps between exposed slabs along lines: their standard deviation is over half of their mean."""
    ground = _apply(fraction=1.0, height_m=0.1, tilt_deg=0.0, log_albedo_sd=0.0, sand_log_albedo_sd=0.0)
    is_sand = ground.height == 0.0
    widths = []
    for line in is_sand:
        edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(int), [0]])))
        widths += (edges[1::2] - edges[::2]).tolist()
    assert np.std(widths) > 0.5 * np.mean(widths)


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
