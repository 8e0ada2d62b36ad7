"""Tests of slope, roughness and safe landing maps on grounds with analytic solutions."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marsyard.algorithms.hda import HdaOptions, Safety, hazard_maps, safe_site
from marsyard.algorithms.hda.elevation import ElevationMap, elevation_map, fill_small_holes, grassfire
from marsyard.algorithms.hda.hazards import (
    Resolution,
    classify_footprints,
    roughness_limit_m,
    safe_landing_map,
    smooth_surface,
)
from marsyard.algorithms.hda.kernels.elevation import robust_plane

CELL_M = 0.1
OPTIONS = HdaOptions(
    refine_planes=True, lander_diameter_m=1.0, max_roughness_m=0.2, max_slope_rad=float(np.deg2rad(15.0))
)


def make_ground(rows: int = 80, columns: int = 100, slope_x: float = 0.0, slope_y: float = 0.0) -> ElevationMap:
    """Create the elevation map of a plane."""
    empty = ElevationMap(np.zeros((rows, columns)), np.array([-2.0, 5.0]), CELL_M)
    x, y = np.moveaxis(empty.positions(np.moveaxis(np.indices((rows, columns)).astype(np.float64), 0, -1)), -1, 0)
    return replace(empty, elevation_m=slope_x * x + slope_y * y)


def add_bump(flat: ElevationMap, row: int, column: int, radius: float, height: float) -> ElevationMap:
    """Add a cylinder; its radius is in cells, its height in metres."""
    rows, columns = np.indices(flat.elevation_m.shape)
    is_inside = np.hypot(rows - row, columns - column) <= radius
    return replace(flat, elevation_m=flat.elevation_m + height * is_inside)


@pytest.mark.parametrize("refine", [False, True])
@pytest.mark.parametrize("slopes", [(0.0, 0.0), (0.2, 0.0), (0.1, -0.25)])
def test_plane_has_exact_slope_and_no_roughness(slopes: tuple[float, float], refine: bool) -> None:
    maps = hazard_maps(make_ground(slope_x=slopes[0], slope_y=slopes[1]), replace(OPTIONS, refine_planes=refine))
    np.testing.assert_allclose(maps.roughness_m, 0.0, atol=1e-10)
    np.testing.assert_allclose(maps.slope_rad, np.arctan(np.hypot(*slopes)), atol=1e-10)


@pytest.mark.parametrize("slopes", [(0.0, 0.0), (0.15, -0.1)])
@pytest.mark.parametrize("height", [0.3, -0.3])
def test_roughness_equals_boulder_height_on_a_slope(slopes: tuple[float, float], height: float) -> None:
    # A radius of 2.5 cells covers 21 of the 100 cells of a footprint: no effect on a least-median plane.
    flat = make_ground(slope_x=slopes[0], slope_y=slopes[1])
    for row, column in ((40, 50), (45, 55), (12, 33)):
        maps = hazard_maps(add_bump(flat, row, column, 2.5, height), OPTIONS)
        assert maps.roughness_m[row, column] == pytest.approx(abs(height), abs=1e-9)
        np.testing.assert_allclose(maps.slope_rad, np.arctan(np.hypot(*slopes)), atol=1e-9)
        assert maps.safety[row, column] == Safety.HAZARD


def test_robust_fit_tolerates_almost_half_outliers() -> None:
    # Close to the breakdown point of 50 %: 45 of 100 points are outliers. The probability that 300 trials contain no
    # inlier triple is 1e-24.
    rng = np.random.default_rng(1)
    x, y = (grid.astype(np.float64).ravel() for grid in np.meshgrid(np.arange(10), np.arange(10)))
    z = 3.0 + 0.2 * x - 0.1 * y + rng.normal(0.0, 0.01, 100)
    z[rng.permutation(100)[:45]] += rng.uniform(1.0, 5.0, 45)
    triples = rng.uniform(size=(300, 3))
    value, slope_x, slope_y = robust_plane(x, y, z, triples, True)
    # The slope error of 55 points with 0.01 of noise is 0.01 / (sqrt(55) 2.9) = 5e-4; the tolerance is four times that.
    assert slope_x == pytest.approx(0.2, abs=2e-3)
    assert slope_y == pytest.approx(-0.1, abs=2e-3)
    assert value == pytest.approx(3.0, abs=0.02)
    # The constant of the ordinary least-squares plane is wrong by several tenths.
    least_squares = np.linalg.lstsq(np.column_stack([np.ones(100), x, y]), z, rcond=None)[0]
    assert abs(least_squares[0] - 3.0) > 0.3


def test_robust_fit_has_least_median_of_tested_triples() -> None:
    rng = np.random.default_rng(2)
    x, y = (grid.astype(np.float64).ravel() for grid in np.meshgrid(np.arange(5), np.arange(5)))
    z = rng.normal(size=25)
    triples = rng.uniform(size=(40, 3))
    result = robust_plane(x, y, z, triples, False)
    best = np.inf
    expected = None
    for uniform_numbers in triples:
        # Sampling without replacement: the first of 25 indices, the second of the other 24, then the third of 23.
        remaining = list(range(25))
        indices = [remaining.pop(int(number * (25 - n))) for n, number in enumerate(uniform_numbers)]
        design = np.array([[1.0, x[index], y[index]] for index in indices])
        # The determinant of whole coordinates is a whole number: 0 if the points are collinear.
        if abs(np.linalg.det(design)) < 0.5:
            continue
        plane = np.linalg.solve(design, z[indices])
        # The median of n values with three unknowns is the (n // 2 + 2)-th smallest (Rousseeuw & Leroy 1987).
        median = np.sort(np.abs(z - plane[0] - plane[1] * x - plane[2] * y))[25 // 2 + 1]
        if median < best:
            best, expected = median, plane
    assert expected is not None
    np.testing.assert_allclose(result, expected, atol=1e-9)


def test_refinement_reduces_noise() -> None:
    rng = np.random.default_rng(3)
    x, y = (grid.astype(np.float64).ravel() for grid in np.meshgrid(np.arange(10), np.arange(10)))
    errors = []
    for _ in range(200):
        z = rng.normal(0.0, 1.0, 100)
        triples = rng.uniform(size=(30, 3))
        errors.append([robust_plane(x, y, z, triples, refine)[1] for refine in (False, True)])
    raw, refined = np.std(errors, axis=0)
    # Slope error of least squares with all 100 points: 1 / (sqrt(100) 2.87) = 0.035; almost all points are inliers.
    assert refined < 0.045 < raw


def test_smooth_surface_is_bilinear_between_footprints() -> None:
    # The elevation is bilinear in row and column: interpolation between footprint centres is exact.
    flat = make_ground(60, 60)
    rows, columns = np.indices((60, 60))
    saddle = replace(flat, elevation_m=1e-4 * (rows - 29.5) * (columns - 29.5))
    smooth, _ = smooth_surface(saddle, replace(OPTIONS, refine_planes=True, plane_trials=200))
    # The robust plane of a footprint is closer to the saddle centre than the saddle deviates from a plane.
    assert np.max(np.abs(smooth - saddle.elevation_m)) < 1e-4 * 5.0 * 5.0


@pytest.mark.parametrize("shape", [(80, 14), (14, 80), (12, 13)])
def test_strip_of_one_footprint_width_is_a_plane(shape: tuple[int, int]) -> None:
    maps = hazard_maps(make_ground(*shape, slope_x=0.1, slope_y=0.2), OPTIONS)
    np.testing.assert_allclose(maps.roughness_m, 0.0, atol=1e-10)


def test_map_smaller_than_the_lander_is_unknown() -> None:
    maps = hazard_maps(make_ground(8, 40), OPTIONS)
    assert np.all(maps.safety == Safety.UNKNOWN)
    assert safe_site(maps.safety, np.zeros(2)) is None


@given(st.integers(5, 74), st.integers(5, 94), st.floats(0.5, 2.0))
def test_hazards_are_dilated_by_lander_disc(row: int, column: int, growth: float) -> None:
    rough = np.zeros((80, 100))
    rough[row, column] = 1.0
    options = replace(OPTIONS, hazard_growth=growth, unknown_growth=0.0)
    safety = safe_landing_map(np.zeros((80, 100)), rough, CELL_M, options)
    rows, columns = np.indices((80, 100))
    distance = CELL_M * np.hypot(rows - row, columns - column)
    expected = distance <= growth * OPTIONS.lander_diameter_m
    unambiguous = np.abs(distance - growth * OPTIONS.lander_diameter_m) > 1e-5
    np.testing.assert_array_equal((safety == Safety.HAZARD)[unambiguous], expected[unambiguous])


@pytest.mark.parametrize(("diameter_m", "growth"), [(1.0, 0.5), (1.5, 0.61)])
def test_cells_near_borders_and_holes_are_unknown(diameter_m: float, growth: float) -> None:
    slope = np.zeros((80, 100))
    slope[40, 50] = np.nan
    options = replace(OPTIONS, lander_diameter_m=diameter_m, unknown_growth=growth)
    safety = safe_landing_map(slope, np.zeros((80, 100)), CELL_M, options)
    rows, columns = np.indices((80, 100))
    # half a diameter is 5 cells, or 0.61 of 1.5 m are 9.15 cells; the cells around the map are unknown
    near_cells = 10.0 * growth * diameter_m
    from_border = np.minimum.reduce([rows + 1, columns + 1, 80 - rows, 100 - columns])
    unknown = (from_border <= near_cells) | (np.hypot(rows - 40, columns - 50) <= near_cells)
    np.testing.assert_array_equal(safety, np.where(unknown, Safety.UNKNOWN, Safety.SAFE))


def test_hazard_takes_precedence_over_unknown() -> None:
    slope = np.zeros((80, 100))
    slope[:, 0] = 1.0
    safety = safe_landing_map(slope, np.zeros((80, 100)), CELL_M, OPTIONS)
    assert np.all(safety[:, :11] == Safety.HAZARD)
    assert np.all(safety[10:70, 11:90] == Safety.SAFE)


def test_site_has_maximum_distance_to_unsafe_cells() -> None:
    safety = np.full((60, 60), Safety.SAFE, dtype=np.uint8)
    safety[10, 10] = Safety.HAZARD
    safety[50, 20] = Safety.UNKNOWN
    site = safe_site(safety, np.array([0.0, 0.0]))
    is_unsafe = np.pad(safety != Safety.SAFE, 1, constant_values=True)
    unsafe_cells = np.argwhere(is_unsafe) - 1
    cells = np.moveaxis(np.indices(safety.shape), 0, -1).reshape(-1, 1, 2)
    distances = np.linalg.norm(cells - unsafe_cells, axis=-1).min(axis=1).reshape(safety.shape)
    assert distances[site] == pytest.approx(distances.max())


@pytest.mark.parametrize("apriori", [(0.0, 0.0), (29.0, 8.0), (5.0, 90.0)])
def test_ties_are_resolved_by_distance_to_apriori_site(apriori: tuple[float, float]) -> None:
    # A strip of 11 rows: each cell of the middle row is 6 cells from both sides.
    safety = np.full((11, 60), Safety.SAFE, dtype=np.uint8)
    site = safe_site(safety, np.array(apriori))
    assert site == (5, int(np.clip(apriori[1], 5, 54)))


def test_map_without_safe_cells_has_no_site() -> None:
    assert safe_site(np.full((20, 20), Safety.HAZARD, dtype=np.uint8), np.zeros(2)) is None
    rough = make_ground()
    noise = np.random.default_rng(5).normal(0.0, 1.0, rough.elevation_m.shape)
    assert safe_site(hazard_maps(replace(rough, elevation_m=noise), OPTIONS).safety, np.zeros(2)) is None


def test_small_holes_are_interpolated_and_wide_holes_are_not() -> None:
    """On a plane the interpolation is exact. A hole of 3 cells contains no disc of 4 cells, a hole of 5 cells does."""
    rows, columns = np.mgrid[0.0:40.0, 0.0:60.0]
    plane = 2.0 + 0.03 * rows - 0.05 * columns
    elevation = plane.copy()
    elevation[5:8, 5:8] = elevation[20, 10:40] = elevation[30, 30] = np.nan
    elevation[10:15, 45:50] = np.nan
    elevation[:3] = np.nan
    filled = fill_small_holes(ElevationMap(elevation, np.zeros(2), CELL_M), 4.0 * CELL_M).elevation_m
    is_wide = np.zeros((40, 60), dtype=bool)
    is_wide[11:14, 46:49] = True
    assert np.all(np.isnan(filled[is_wide]))
    assert np.all(np.isnan(filled[:3]))
    outside = np.ones((40, 60), dtype=bool)
    outside[10:15, 45:50] = outside[:3] = False
    np.testing.assert_allclose(filled[outside], plane[outside], rtol=0, atol=1e-12)


def test_out_of_range_options_are_reported() -> None:
    with pytest.raises(ValueError, match="template_half_px is 1; it must be at least 2"):
        HdaOptions(template_half_px=1)
    with pytest.raises(ValueError, match="lander_diameter_m is 0"):
        HdaOptions(lander_diameter_m=0.0)
    with pytest.raises(ValueError, match="max_slope_rad"):
        HdaOptions(max_slope_rad=2.0)
    with pytest.raises(ValueError, match="max_forward_backward_px is 0"):
        HdaOptions(max_forward_backward_px=0.0)


# ----- footprints -----


#: Resolution of an exact map: matching windows without extent, no noise, and an exact position.
SHARP = Resolution(window_m=0.0, noise_m=0.0, position_m=0.0)


def test_curvature_limit_follows_window_mean_of_paraboloid() -> None:
    """The limit uses the mean of the paraboloid 1 - 4 r^2 / D^2 over a centred square window of side w.

    The base width D is narrowest_hazard x max_roughness_m = 0.4 m, and w is 0.1 m.
    """
    options = HdaOptions(refine_planes=True, max_roughness_m=0.2, narrowest_hazard=2.0)
    x = np.linspace(-0.05, 0.05, 401)
    mean = float(np.mean(1.0 - 4.0 * (x[:, None] ** 2 + x**2) / 0.4**2))
    assert roughness_limit_m(Resolution(0.1, 0.0, 0.0), 1e-9, options) == pytest.approx(0.2 * mean, rel=1e-2)
    noisy = roughness_limit_m(Resolution(0.0, 0.01, 0.0), 1e-9, options)
    assert noisy == pytest.approx(0.2 - options.margin_deviations * 0.01)


def test_curved_ground_is_a_hazard_despite_smooth_planes() -> None:
    """A ridge with a slope of 0.3 on both sides: no plane under a footprint on its crest fits within 0.1 m."""
    x = 0.05 * (np.arange(121) - 60)
    ground = ElevationMap(np.tile(-0.3 * np.abs(x), (121, 1)), np.zeros(2), 0.05)
    options = HdaOptions(
        refine_planes=True, max_roughness_m=0.1, narrowest_hazard=100.0, max_slope_rad=float(np.radians(20.0))
    )
    result = classify_footprints(ground, SHARP, options)
    assert np.all(result[40:80, 58:63] == Safety.HAZARD)
    # A footprint that lies on one flank is plane.
    assert np.all(result[40:80, 85:95] == Safety.SAFE)


def test_coarse_map_has_no_safe_cells() -> None:
    ground = ElevationMap(np.zeros((60, 60)), np.zeros(2), 0.1)
    options = HdaOptions(refine_planes=True, max_roughness_m=0.2, narrowest_hazard=2.0)
    coarse = Resolution(window_m=1.0, noise_m=0.0, position_m=0.0)
    # Footprints at the border are not within the map.
    inner = (slice(10, 50), slice(10, 50))
    assert np.all(classify_footprints(ground, SHARP, options)[inner] == Safety.SAFE)
    assert np.all(classify_footprints(ground, coarse, options) == Safety.HAZARD)


@pytest.mark.parametrize("diameter_m", [0.05, 0.1, 0.19])
def test_footprint_of_a_cell_or_less_has_the_plane_of_its_neighbours(diameter_m: float) -> None:
    options = replace(OPTIONS, lander_diameter_m=diameter_m, narrowest_hazard=100.0, level_error_rad=0.0)
    expected = np.full((80, 100), Safety.UNKNOWN)
    expected[1:-1, 1:-1] = Safety.SAFE
    np.testing.assert_array_equal(classify_footprints(make_ground(slope_x=0.1), SHARP, options), expected)
    steep = classify_footprints(make_ground(slope_x=0.4), SHARP, options)
    assert np.all(steep[1:-1, 1:-1] == Safety.HAZARD)


@pytest.mark.parametrize(("row", "column"), [(40, 50), (41, 53), (37, 60)])
def test_each_position_is_checked_with_its_own_footprint(row: int, column: int) -> None:
    """A boulder of one cell is a hazard for footprints within a lander radius and one cell, 5 + 1 cells, and no other.

    Footprints within 5 cells of the border, or of an empty cell, are unknown.
    """
    ground = add_bump(make_ground(slope_x=0.1, slope_y=-0.05), row, column, 0.5, 0.3)
    ground.elevation_m[20, 20] = np.nan
    options = replace(OPTIONS, narrowest_hazard=100.0, level_error_rad=0.0)
    safety = classify_footprints(ground, SHARP, options)
    rows, columns = np.indices(safety.shape)
    hazard = np.hypot(rows - row, columns - column) <= 6.0
    unknown = np.hypot(rows - 20, columns - 20) <= 5.0
    unknown |= np.minimum.reduce([rows + 1, columns + 1, 80 - rows, 100 - columns]) <= 5
    expected = np.where(hazard, Safety.HAZARD, np.where(unknown, Safety.UNKNOWN, Safety.SAFE))
    np.testing.assert_array_equal(safety, expected)


def test_unsafe_positions_grow_by_the_error_of_the_position() -> None:
    """Two standard deviations of 0.16 m are 3.2 cells: the hazard grows from 6 to 9 cells, the border from 5 to 8."""
    ground = add_bump(make_ground(), 40, 50, 0.5, 0.3)
    options = replace(OPTIONS, narrowest_hazard=100.0, margin_deviations=2.0, level_error_rad=0.0)
    safety = classify_footprints(ground, replace(SHARP, position_m=0.16), options)
    distances = np.hypot(*(np.indices(safety.shape) - np.array([40, 50])[:, None, None]))
    assert np.all(safety[distances <= 8.5] == Safety.HAZARD)
    assert np.all(safety[8:-8, 8:-8][distances[8:-8, 8:-8] > 9.7] == Safety.SAFE)
    assert np.all(safety[:8] == Safety.UNKNOWN)


def test_steep_footprints_are_hazards() -> None:
    """The limit of slope, 15 deg, is reduced by two standard deviations of the vertical, here to 13 deg."""
    options = replace(OPTIONS, narrowest_hazard=100.0, level_error_rad=float(np.radians(1.0)))
    for slope_deg, expected in ((12.9, Safety.SAFE), (13.1, Safety.HAZARD)):
        ground = make_ground(slope_y=float(np.tan(np.radians(slope_deg))))
        assert np.all(classify_footprints(ground, SHARP, options)[10:70, 10:90] == expected)


def test_elevation_map_is_centred_on_its_points() -> None:
    x, y = np.meshgrid(np.arange(10.0), np.arange(6.0))
    ground = elevation_map(np.stack([x.ravel(), y.ravel(), np.zeros(60)], axis=-1))
    rows, columns = ground.elevation_m.shape
    corners = ground.positions(np.array([[0.0, 0.0], [rows - 1.0, columns - 1.0]]))
    np.testing.assert_allclose(corners.mean(axis=0), [4.5, 2.5], atol=1e-9)


def test_grassfire_transform_equals_distance_to_nearest_seed() -> None:
    rng = np.random.default_rng(4)
    is_seed = rng.random((40, 50)) < 0.01
    seeds = np.argwhere(is_seed)
    cells = np.moveaxis(np.indices(is_seed.shape), 0, -1).reshape(-1, 1, 2)
    expected = np.linalg.norm(cells - seeds, axis=-1).min(axis=1).reshape(is_seed.shape)
    np.testing.assert_allclose(grassfire(is_seed), expected, rtol=1e-5)
    assert np.all(np.isinf(grassfire(np.zeros((3, 3), dtype=bool))))


def test_map_holes_are_not_interpolated() -> None:
    flat = make_ground(100, 100)
    elevation = flat.elevation_m.copy()
    elevation[30:70, 30:70] = np.nan
    maps = hazard_maps(replace(flat, elevation_m=elevation), OPTIONS)
    assert np.all(maps.safety[30:70, 30:70] == Safety.UNKNOWN)
    assert np.any(maps.safety == Safety.SAFE)


def test_single_empty_cells_do_not_hide_the_ground() -> None:
    """Every fifth cell of level ground is empty: a lander's radius around each of them would be the whole map."""
    flat = make_ground(60, 60)
    elevation = flat.elevation_m.copy()
    elevation[::5, ::5] = np.nan
    holed = replace(flat, elevation_m=elevation)
    assert not np.any(hazard_maps(holed, OPTIONS).safety == Safety.SAFE)
    filled = fill_small_holes(holed, 2.0 * CELL_M)
    assert np.mean(hazard_maps(filled, OPTIONS).safety == Safety.SAFE) > 0.5


def test_slope_and_roughness_hazards_are_combined() -> None:
    zero = np.zeros((80, 100))
    rough, steep = zero.copy(), zero.copy()
    rough[40, 30], steep[40, 70] = 1.0, 1.0
    safety = safe_landing_map(steep, rough, CELL_M, OPTIONS)
    assert safety[40, 30] == safety[40, 70] == Safety.HAZARD
    assert safety[40, 50] == Safety.SAFE


def test_steep_ground_is_a_hazard_next_to_level_ground() -> None:
    flat = make_ground(80, 100)
    ramp = np.maximum(np.arange(100) - 50, 0) * CELL_M * np.tan(np.deg2rad(20.0))
    maps = hazard_maps(replace(flat, elevation_m=flat.elevation_m + ramp), OPTIONS)
    assert np.rad2deg(maps.slope_rad[40, 85]) == pytest.approx(20.0, abs=0.01)
    assert np.rad2deg(maps.slope_rad[40, 15]) == pytest.approx(0.0, abs=0.01)
    assert maps.safety[40, 75] == Safety.HAZARD
    assert maps.safety[40, 20] == Safety.SAFE
    site = safe_site(maps.safety, np.array([40.0, 50.0]))
    assert site is not None
    assert site[1] < 40
