"""Tests of craters: sizes, ages, outlines, relief, ejecta, sand, and how the albedo wears with the relief."""

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from marsyard.sim.terrain import TerrainParameters, synthesise
from marsyard.sim.terrain.landforms.craters import (
    CLUSTER_RADIUS_M,
    CRATER,
    DARK_EJECTA,
    DEGRADED_DEPTH,
    EJECTA_EXTENT_RADII,
    EJECTA_OPACITY,
    FILL_MARGIN,
    FRESH_DEPTH,
    FULL_CONTRAST_M,
    LARGEST_SECONDARY_M,
    OUTLINE_EXPONENT,
    OUTLINE_RMS,
    SECONDARY_FRACTION,
    WIND_ASYMMETRY,
    add_craters,
    crater_rows,
    draw_craters,
    outline_tables,
)
from marsyard.sim.terrain.landforms.ground import TerrainGround
from marsyard.sim.terrain.landforms.kernels.shapes import (
    CORE_LEE,
    CORE_RADIUS,
    RAY_CONTRAST,
    RIDGE_HEIGHT_M,
    scale_roughness,
    stamp_craters,
    stamp_streaks,
)
from marsyard.sim.terrain.landforms.units import SurfaceUnits
from marsyard.sim.terrain.surface import TEXTURE

#: Values of a bare bowl whose albedo does not wear; those of the other columns are 0.
BOWL = {
    "x": 64.0, "y": 64.0, "radius": 30.0, "depth": 3.0, "rim": 0.3, "rounding": 1.0, "fill_radius": 1.0,
    "extent": EJECTA_EXTENT_RADII, "opacity": EJECTA_OPACITY, "margin": FILL_MARGIN,
}  # fmt: skip
#: Tables of a round outline without rays.
ROUND = (np.zeros((1, 4)), np.zeros((1, 4)))
WORN = TerrainParameters(
    samples=2048,
    craters_per_km2=400.0,
    craters_wear_albedo=True,
    crater_sand_fraction=1.0,
    crater_sand_log_albedo=-0.8,
    crater_floor_contrast=0.0,
)


def _crater(**columns: float) -> np.ndarray:
    """Return a table of one crater."""
    crater = np.zeros(1, dtype=CRATER)
    for name, value in (BOWL | columns).items():
        crater[name] = value
    return crater


def _stamp(side: int, tables: tuple[np.ndarray, np.ndarray] = ROUND, **columns: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the height and the log albedo of level ground with one crater, on samples 1 m apart."""
    height, log_albedo = np.zeros((2, side, side), dtype=np.float32)
    stamp_craters(height, log_albedo, 1.0, crater_rows(_crater(**columns)), *tables)
    return height, log_albedo


def test_crater_depths_range_from_degraded_to_fresh() -> None:
    craters = draw_craters(TerrainParameters(craters_per_km2=100.0), np.random.default_rng(3))
    depth_ratio = (craters["depth"] + craters["rim"]) / (2.0 * craters["radius"])
    assert depth_ratio.min() == pytest.approx(DEGRADED_DEPTH, rel=0.02)
    assert depth_ratio.max() == pytest.approx(FRESH_DEPTH, rel=0.02)


def test_large_craters_are_fresher_than_those_in_saturation() -> None:
    """Diffusion time in units of the squared diameter: uniform below the knee, up to a quarter at twice the knee."""
    p = TerrainParameters(craters_per_km2=300.0, crater_knee_m=40.0, crater_exponent=1.83)
    craters = draw_craters(p, np.random.default_rng(3))
    diameter = 2.0 * craters["radius"]
    ratio = (craters["depth"] + craters["rim"]) / diameter
    oldest = FRESH_DEPTH / DEGRADED_DEPTH - 1.0
    assert np.median(ratio[diameter < 40.0]) == pytest.approx(FRESH_DEPTH / (1.0 + 0.5 * oldest), rel=0.05)
    assert ratio[diameter > 80.0].min() >= FRESH_DEPTH / (1.0 + 0.25 * oldest)


def test_crater_sizes_follow_saturation_and_production() -> None:
    """Cumulative numbers vary as D**-1.83 below the knee (saturation) and as D**-3.2 above it (production)."""
    sizes: dict[str, Any] = {"crater_diameter_min_m": 8.0, "crater_diameter_max_m": 2000.0, "crater_exponent": 1.83}
    parameters = TerrainParameters(samples=4096, spacing_m=3.0, craters_per_km2=600.0, crater_knee_m=60.0, **sizes)
    diameters = 2.0 * draw_craters(parameters, np.random.default_rng(5))["radius"]
    expected = 600.0 * (4096 * 0.003) ** 2
    assert diameters.size == pytest.approx(expected, abs=4 * np.sqrt(expected))
    assert np.all(np.diff(diameters) <= 0.0)
    assert diameters.min() >= 8.0
    assert diameters.max() <= 2000.0
    counts = {size: np.count_nonzero(diameters > size) for size in (8.0, 16.0, 32.0, 64.0, 128.0)}
    assert np.log2(counts[8.0] / counts[16.0]) == pytest.approx(1.83, abs=0.15)
    assert np.log2(counts[16.0] / counts[32.0]) == pytest.approx(1.83, abs=0.15)
    assert np.log2(counts[64.0] / counts[128.0]) == pytest.approx(3.2, abs=0.25)


def test_unordered_crater_sizes_are_rejected() -> None:
    parameters = TerrainParameters(samples=64, crater_diameter_min_m=50.0, crater_diameter_max_m=20.0)
    with pytest.raises(ValueError, match="must be larger than crater_diameter_min_m"):
        synthesise(parameters, np.random.default_rng(0))


def test_large_craters_are_equal_on_a_coarser_grid() -> None:
    """A crater with a radius of 150 samples, on a grid of every fourth sample: equal within 2 % of its depth."""
    columns = {"x": 200.0, "y": 260.0, "radius": 150.0, "depth": 24.0, "rim": 6.0, "rounding": 2.4}
    columns |= {"ejecta_log_albedo": 0.1, "fill_log_albedo": -0.3, "fill_radius": 0.8}
    height, log_albedo = _stamp(512, outline_tables(), **columns)
    ground = TerrainGround(np.zeros_like(height), np.zeros_like(height), 1.0)
    add_craters(ground, _crater(**columns))
    # the B-spline of the coarser grid smooths the crest over a sample
    assert np.sqrt(np.mean((ground.height - height) ** 2)) < 0.01 * 24.0
    assert np.abs(ground.height - height).max() < 0.05 * 24.0
    assert np.sqrt(np.mean((ground.log_albedo - log_albedo) ** 2)) < 0.01


def test_outlines_have_a_power_law_of_waves() -> None:
    """Large craters are scalloped, not polygons: the power of the waves follows the law, and no wave is the shape."""
    azimuth, powers = 2.0 * np.pi * np.arange(256) / 256, []
    columns = {"x": 256.0, "y": 256.0, "radius": 80.0, "depth": 16.0, "rim": 0.0, "rounding": 1e-6, "rotation": 0.1}
    for number in range(32):
        height, _ = _stamp(512, outline_tables(), **columns, outline=number)
        # without a rim, the bowl ends at the outline: it is at half its depth at 0.5**(1 / 2.2) of the local radius
        radii = np.arange(20.0, 80.0, 0.25)
        rays = [256.0 + radii[:, None] * shape(azimuth) for shape in (np.sin, np.cos)]
        profile = map_coordinates(height, rays, order=1)
        outline = radii[np.argmax(profile > -8.0, axis=0)] / (80.0 * 0.5 ** (1.0 / 2.2))
        powers.append(np.abs(np.fft.rfft(outline - 1.0) / 256) ** 2)
    power = np.mean(powers, axis=0)
    assert np.sqrt(2.0 * power[1:].sum()) == pytest.approx(OUTLINE_RMS, rel=0.1)
    waves = np.arange(2, 10)
    exponent = np.polyfit(np.log(waves), np.log(power[waves]), 1)[0]
    assert exponent == pytest.approx(2.0 * OUTLINE_EXPONENT, abs=0.4)
    # five lobes alone, a pentagon, have a small fraction of the variance
    assert power[5] < 0.1 * power[1:].sum()


def test_fresh_crater_has_depth_rim_and_position_across_border() -> None:
    # a crater with a sharp rim, centred on the corner of the grid
    grids = _stamp(256, x=0.0, y=0.0, radius=20.0, depth=6.4, rim=1.6, rounding=0.0, ejecta_log_albedo=0.1)
    height, log_albedo = (np.roll(grid, (128, 128), axis=(0, 1)) for grid in grids)
    assert height[128, 128] == height.min() == pytest.approx(-6.4)
    assert height[128, 128 + 20] == pytest.approx(1.6)
    assert height[128 - 20, 128] == pytest.approx(1.6)
    assert np.count_nonzero(height[:, :60]) == 0
    # the ejecta cover 95 % of the ground at the rim; debris hides them towards the middle
    assert log_albedo[128, 128] == 0.0
    assert log_albedo[128, 138] == pytest.approx(0.25 * 0.1, rel=1e-4)
    assert log_albedo[128, 148] == pytest.approx(0.1 * (1.0 - np.exp(-EJECTA_OPACITY)), rel=0.02)


def test_filled_crater_has_a_flat_floor_at_its_depth() -> None:
    height, log_albedo = _stamp(128, fill=0.4)
    assert height[64, 64] == pytest.approx(-3.0, abs=0.05)
    assert np.ptp(height[64, 56:73]) < 0.15
    assert not log_albedo.any()


def test_ejecta_have_rays() -> None:
    """Outside the rim the ejecta height decreases with the cube of the distance. Rays modulate it in azimuth."""
    radius, rim, extent = 12.0, 0.8, 4.0
    # one ray: its strength is linear along the square |x| + |y| = 1, and 1 where x = 1; a quarter of a turn from x
    tables = np.zeros((1, 4)), np.array([[1.0, 0.0, -1.0, 0.0]])
    ejecta = {"ejecta_log_albedo": 0.2, "rotation": 0.25, "extent": extent, "opacity": 2.0}
    height, log_albedo = _stamp(128, tables, radius=radius, rim=rim, rounding=0.1, fill=0.3, **ejecta)
    y, x = np.mgrid[:128, :128] - 64.0
    r = np.hypot(x, y) / radius
    is_ejecta = (r > 1.1) & (r < extent)
    fade = (extent - r) / (extent - 1.0)
    ray = -y / np.maximum(np.abs(x) + np.abs(y), 1e-9)
    strength = 1.0 + RAY_CONTRAST * ray * np.minimum(2.0 * (r - 1.0), 1.0)
    blanket = rim / np.maximum(r, 0.6) ** 3 * fade * strength
    assert_allclose(height[is_ejecta], blanket[is_ejecta], atol=1e-6)
    coverage = 1.0 - np.exp(-2.0 / np.maximum(r, 0.6) ** 3 * strength)
    assert_allclose(log_albedo[is_ejecta], 0.2 * (coverage * fade)[is_ejecta], atol=1e-6)


def test_sand_in_a_crater_has_the_specified_albedo_and_margin() -> None:
    """The sand ends at its radius, and is thicker downwind, which is along x."""
    _, log_albedo = _stamp(128, fill_log_albedo=-0.5, fill_radius=0.8, lee_x=0.3)
    assert log_albedo[64, 64] == pytest.approx(-0.5)
    assert log_albedo[64, 64 + 12] == pytest.approx(-0.5 * (1.0 + 0.3 * 0.4))
    assert log_albedo[64, 64 - 12] == pytest.approx(-0.5 * (1.0 - 0.3 * 0.4))
    assert log_albedo[64 + 21, 64] == pytest.approx(-0.5 * (0.8 - 0.7) / 0.4, rel=1e-5)
    assert not log_albedo[np.hypot(*(np.mgrid[:128, :128] - 64.0)) >= 24.0].any()


def test_crater_floors_are_smoother_and_ejecta_rougher() -> None:
    factors = np.ones((64, 64), dtype=np.float32)
    # x, y, radius, factor on the floor, factor on the ejecta
    scale_roughness(factors, 1.0, np.array([[32.0, 32.0, 10.0, 0.4, 1.8]]), 2.0)
    assert factors[32, 32] == pytest.approx(0.4)
    assert factors[32, 43] > 1.6
    assert factors[32, 54] == 1.0


def test_wind_tails_lie_downwind_of_their_craters() -> None:
    log_albedo = np.zeros((128, 128), dtype=np.float32)
    # x, y, half width, length, cosine and sine of the downwind direction (east), log_albedo
    stamp_streaks(log_albedo, 1.0, np.array([[30.0, 64.0, 6.0, 50.0, 1.0, 0.0, -0.2]]))
    rows, columns = np.nonzero(log_albedo)
    assert columns.min() >= 30
    assert columns.max() <= 80
    assert abs(rows - 64).max() < 12
    assert log_albedo.min() == pytest.approx(-0.2, abs=0.05)


def test_small_craters_have_less_sand_and_fainter_ejecta() -> None:
    p = TerrainParameters(crater_sand_fraction=0.8, crater_sand_log_albedo=-0.6, craters_per_km2=400.0)
    craters = draw_craters(p, np.random.default_rng(5))
    diameter, ejecta, sand = 2.0 * craters["radius"], craters["ejecta_log_albedo"], craters["fill_log_albedo"]
    large, small = diameter > FULL_CONTRAST_M, diameter < 0.25 * FULL_CONTRAST_M
    assert np.mean(sand[large] < -0.25) == pytest.approx(0.8, abs=0.06)
    assert np.mean(sand[small] < -0.25) == pytest.approx(0.8 * np.mean(diameter[small]) / FULL_CONTRAST_M, abs=0.02)
    assert np.mean(ejecta[large] < 0.0) == pytest.approx(DARK_EJECTA, abs=0.05)
    assert np.abs(ejecta[large]).mean() == pytest.approx(p.crater_ejecta_contrast, rel=0.1)
    assert np.abs(ejecta[small]).mean() < 0.3 * p.crater_ejecta_contrast


def test_sand_and_ejecta_fade_as_craters_wear() -> None:
    """Columns of `stamp_craters`; the depth below the rim is 0.4 radii for a fresh crater."""
    craters = draw_craters(WORN, np.random.default_rng(1))
    diameter, freshness = 2.0 * craters["radius"], (craters["depth"] + craters["rim"]) / craters["radius"] / 0.4
    assert (craters["ejecta_log_albedo"] >= 0.0).all()
    # without the random factor of 0.7 to 1.3, at the size with the full contrast
    middle = (diameter > FULL_CONTRAST_M) & (diameter < 2.0 * FULL_CONTRAST_M)
    ratio = craters["fill_log_albedo"][middle] / freshness[middle] / -0.8
    assert ratio.min() >= 0.7 - 1e-9
    assert ratio.max() <= 1.3 + 1e-9
    # optical depth 3 of fresh ejecta
    assert_allclose(craters["opacity"], 3.0 * freshness**1.5, rtol=1e-6)
    assert craters["extent"].min() >= 1.6
    # the fill's border is 1.5 m wide in fresh craters, and up to 12 m wider in worn ones
    margin_m, worn = craters["margin"][middle] * craters["radius"][middle], 1.0 - freshness[middle]
    assert (margin_m >= 1.5 + 12.0 * 0.3 * worn - 1e-9).all()
    assert (margin_m <= 1.5 + 12.0 * worn + 1e-9).all()


@pytest.mark.parametrize(("wind_from_deg", "direction"), [(0.0, (0.0, 1.0)), (90.0, (1.0, 0.0))])
def test_sand_is_thicker_on_the_side_from_which_the_wind_blows(
    wind_from_deg: float, direction: tuple[float, float]
) -> None:
    """x is east, y is north. Behind the upwind rim, the crater is sheltered."""
    units = {"kinds": [{"name": "plain", "fraction": 1.0}], "wind_from_deg": wind_from_deg}
    craters = draw_craters(WORN.with_changes({"units": units}), np.random.default_rng(1))
    mean = craters["lee_x"].mean(), craters["lee_y"].mean()
    assert mean == pytest.approx(WIND_ASYMMETRY * np.array(direction), abs=0.02)


def test_small_craters_gather_in_clusters() -> None:
    """Near a small crater are more small craters than near a large one."""
    craters = draw_craters(WORN, np.random.default_rng(1))
    period = WORN.samples * WORN.spacing_m
    positions, is_small = (
        np.stack([craters["x"], craters["y"]], axis=1) % period,
        2.0 * craters["radius"] < LARGEST_SECONDARY_M,
    )
    small, large = positions[is_small], positions[~is_small]
    tree = cKDTree(small, boxsize=np.full(2, period))
    radius = 2.0 * CLUSTER_RADIUS_M
    near_small = np.mean(tree.query_ball_point(small, radius, return_length=True)) - 1.0
    near_large = np.mean(tree.query_ball_point(large, radius, return_length=True))
    # secondaries have 0.63 of the about 9 others of their cluster within twice its radius, which is a convolution of
    # two Gaussians: 1 - exp(-1)
    assert near_small - near_large > 0.5 * SECONDARY_FRACTION * 0.63 * 9.0


def test_deposit_in_the_middle_has_ridges_and_less_sand() -> None:
    columns: dict[str, Any] = {
        "x": 128.0,
        "y": 128.0,
        "radius": 60.0,
        "depth": 6.0,
        "rim": 1.0,
        "fill": 0.4,
        "fill_log_albedo": -0.5,
    }
    columns |= {"lee_x": 0.05, "margin": 0.1}
    (height, bright), (flat, dark) = (_stamp(256, **columns, core=core) for core in (0.8, 1e-9))
    # the lee, 0.05, increases the sand on its side, here at 0.1 radii, where the border of the deposit is nearer
    assert bright[128, 134] == pytest.approx(-0.5 * (1.0 + 0.05 * 0.1) * (1.0 - 0.8), rel=1e-3)
    ridges = height - flat
    assert np.abs(ridges).max() == pytest.approx(0.8 * RIDGE_HEIGHT_M, rel=0.05)
    x = np.flatnonzero(bright[128] != dark[128]) - 128.0
    for side in (-1.0, 1.0):
        border = CORE_RADIUS / (1.0 + side * CORE_RADIUS * CORE_LEE * 0.05) * 60.0
        assert np.max(side * x) == pytest.approx(border, abs=1.0)


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
    craters = np.zeros(16, dtype=CRATER)
    craters["x"], craters["y"] = 512.0 * np.mgrid[:4, :4].reshape(2, -1) + 256.0
    craters["radius"], craters["depth"], craters["rim"], craters["rounding"] = 40.0, 14.0, 2.0, 1.0
    factors = units.apply(ground, craters, np.random.default_rng(2))
    dust = (factors[..., TEXTURE] < 0.5).reshape(4, 64, 4, 64).mean(axis=(0, 2))
    # within 32 m of the axis, 64 to 160 m downwind, which is along x; far: 224 m and more to the sides
    excess = dust[28:37, 40:52].mean() - dust[:4].mean()
    if preference:
        assert excess > 0.15
    else:
        assert abs(excess) < 0.1
