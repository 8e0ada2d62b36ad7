"""Tests of outcrops: area of the slabs, and their relief and albedo relative to the sand."""

import numpy as np
import pytest
from jaxtyping import Float32

from marsyard.sim.terrain.landforms import Outcrop, TerrainGround
from marsyard.sim.terrain.landforms.bedrock import locate_points
from marsyard.sim.terrain.landforms.kernels.bedrock import DOME, LOOSENESS, Slabs, add_slabs


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
