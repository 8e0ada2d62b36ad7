"""Tests of craters whose albedo wears with their relief: sand, ejecta, secondaries, deposits, and dust around them."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial import cKDTree

from marsyard.sim.terrain import TerrainParameters
from marsyard.sim.terrain.landforms.craters import (
    CLUSTER_RADIUS_M,
    FULL_CONTRAST_M,
    LARGEST_SECONDARY_M,
    SECONDARY_FRACTION,
    draw_craters,
)
from marsyard.sim.terrain.landforms.ground import TerrainGround
from marsyard.sim.terrain.landforms.kernels.shapes import CORE_RADIUS, RIDGE_HEIGHT_M, stamp_craters
from marsyard.sim.terrain.landforms.units import SurfaceUnits
from marsyard.sim.terrain.surface import TEXTURE

PARAMETERS = TerrainParameters(
    samples=2048,
    craters_per_km2=400.0,
    craters_wear_albedo=True,
    crater_sand_fraction=1.0,
    crater_sand_log_albedo=-0.8,
    crater_floor_contrast=0.0,
)


def test_sand_and_ejecta_fade_as_craters_wear() -> None:
    """Columns of `stamp_craters`; the depth below the rim is 0.4 radii for a fresh crater."""
    craters = draw_craters(PARAMETERS, np.random.default_rng(1))
    diameter, freshness = 2.0 * craters[:, 2], (craters[:, 3] + craters[:, 4]) / craters[:, 2] / 0.4
    assert (craters[:, 7] >= 0.0).all()
    # without the random factor of 0.7 to 1.3, at the size with the full contrast
    middle = (diameter > FULL_CONTRAST_M) & (diameter < 2.0 * FULL_CONTRAST_M)
    ratio = craters[middle, 8] / freshness[middle] / -0.8
    assert ratio.min() >= 0.7 - 1e-9
    assert ratio.max() <= 1.3 + 1e-9
    # optical depth 3 of fresh ejecta
    assert_allclose(craters[:, 15], 3.0 * freshness**1.5, rtol=1e-6)
    assert craters[:, 14].min() >= 1.6
    # the fill's border is 1.5 m wide in fresh craters, and up to 12 m wider in worn ones
    margin_m, worn = craters[middle, 16] * craters[middle, 2], 1.0 - freshness[middle]
    assert (margin_m >= 1.5 + 12.0 * 0.3 * worn - 1e-9).all()
    assert (margin_m <= 1.5 + 12.0 * worn + 1e-9).all()


def test_small_craters_gather_in_clusters() -> None:
    """Near a small crater are more small craters than near a large one."""
    craters = draw_craters(PARAMETERS, np.random.default_rng(1))
    period = PARAMETERS.samples * PARAMETERS.spacing_m
    small = craters[2.0 * craters[:, 2] < LARGEST_SECONDARY_M, :2] % period
    large = craters[2.0 * craters[:, 2] >= LARGEST_SECONDARY_M, :2] % period
    tree = cKDTree(small, boxsize=np.full(2, period))
    radius = 2.0 * CLUSTER_RADIUS_M
    near_small = np.mean(tree.query_ball_point(small, radius, return_length=True)) - 1.0
    near_large = np.mean(tree.query_ball_point(large, radius, return_length=True))
    # secondaries have 0.63 of the about 9 others of their cluster within twice its radius, which is a convolution of
    # two Gaussians: 1 - exp(-1)
    assert near_small - near_large > 0.5 * SECONDARY_FRACTION * 0.63 * 9.0


def test_deposit_in_the_middle_has_ridges_and_less_sand() -> None:
    bright, dark = (np.zeros((256, 256), dtype=np.float32) for _ in range(2))
    height, flat = (np.zeros((256, 256), dtype=np.float32) for _ in range(2))
    round_outline = (np.zeros((1, 4)), np.zeros((1, 4)))
    for heights, log_albedo, core in ((height, bright, 0.8), (flat, dark, 1e-9)):
        crater = [128.0, 128.0, 60.0, 6.0, 1.0, 1.0, 0.4, 0.0, -0.5, 1.0, 0.05, 0.0, 0.0, 0.0, 3.0, 3.0, 0.1, core]
        stamp_craters(heights, log_albedo, 1.0, np.array([crater]), *round_outline)
    # the deposit is displaced by 0.05 radii; the lee increases the sand by a factor of 1.0025 there
    assert bright[128, 131] == pytest.approx(-0.5 * 1.0025 * (1.0 - 0.8), rel=1e-3)
    assert bright[128, 128 + 50] == dark[128, 128 + 50]
    ridges = height - flat
    assert np.abs(ridges).max() == pytest.approx(0.8 * RIDGE_HEIGHT_M, rel=0.05)
    y, x = np.nonzero(np.abs(ridges) > 1e-6)
    assert np.hypot(x - 131.0, y - 128.0).max() <= CORE_RADIUS * 60.0 + 1.0


@pytest.mark.parametrize("preference", [0.0, 3.0])
def test_unit_surrounds_craters_and_lies_downwind(preference: float) -> None:
    kinds = [
        {"name": "dust", "fraction": 0.3, "texture": 0.2, "craters": preference},
        {"name": "plain", "fraction": 0.7},
    ]
    units = SurfaceUnits.model_validate(
        {"kinds": kinds, "boundary": 0.05, "largest_m": 100.0, "wind_from_deg": 270.0, "wind_spread_deg": 0.0}
    )
    height, log_albedo = np.zeros((2, 1024, 1024), dtype=np.float32)
    ground = TerrainGround(height, log_albedo, 2.0)
    # 16 craters of 40 m radius, every 512 m: 64 samples of the factors
    crater = np.zeros((16, 18))
    crater[:, :2] = np.stack(np.meshgrid(np.arange(4), np.arange(4)), axis=-1).reshape(-1, 2) * 512.0 + 256.0
    crater[:, 2:7] = 40.0, 14.0, 2.0, 1.0, 0.0
    factors = units.apply(ground, crater, np.random.default_rng(2))
    dust = (factors[..., TEXTURE] < 0.5).reshape(4, 64, 4, 64).mean(axis=(0, 2))
    # within 32 m of the axis, 64 to 160 m downwind, which is along x; far: 224 m and more to the sides
    excess = dust[28:37, 40:52].mean() - dust[:4].mean()
    if preference:
        assert excess > 0.15
    else:
        assert abs(excess) < 0.1
