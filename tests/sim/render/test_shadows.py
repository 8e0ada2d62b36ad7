"""Tests of cast shadows against an independent ray cast: SciPy's B-spline for the ground, brute force for triangles."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.validation.raycast import Ground, cast_triangles
from marsyard.sim.camera import Cahv
from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import Frame, Objects, Photometry, PixelRays, Renderer, Scene, Sun, ground_shadow
from marsyard.sim.render.arrays import to_host, vectors_to_device
from marsyard.sim.render.casters import are_occluded, casters_towards
from marsyard.sim.render.cones import Bounds, ground_in_cones
from marsyard.sim.render.device import Array3f64, Bool, UInt32
from marsyard.sim.render.ground_shadow import (
    GroundShadow,
    compute_ground_shadow,
    is_sun_above_slopes,
    periodic_window,
    slope_bounds,
)
from marsyard.sim.terrain import Surface, TerrainParameters, synthesise
from marsyard.sim.terrain.rocks import RockField, RockParameters
from tests.sim.scenes import DOWN, LAMBERT, NEAR_MESH, descent_camera, level_plate, look_down, make_ground, rocks_near

ALBEDO = 0.2
#: Required fraction of equal pixels, from docs/validation.md.
MIN_AGREEMENT = 0.995


def _with_uniform_albedo(surface: Surface) -> Surface:
    """Return the same ground with uniform albedo."""
    return make_ground(surface.levels[0][..., 0], surface.spacing_m, ALBEDO)


def _compare_with_ray_cast(frame: Frame, scene: Scene, count: int, step: float) -> tuple[float, float]:
    """Compute the fraction of random pixels where image and ray cast agree, and the fraction in cast shadow."""
    pixels = np.random.default_rng(6).integers(0, frame.radiance.size, count)
    points = frame.points_world().reshape(-1, 3)[pixels]
    to_sun = scene.sun.direction
    cos_incidence = frame.normal.reshape(-1, 3)[pixels].astype(np.float64) @ to_sun
    sun_fraction = frame.radiance.ravel()[pixels] / (ALBEDO * np.maximum(cos_incidence, 1e-6))
    is_shaded = Ground(scene.surface).is_occluded(points, to_sun, step)
    rays = np.broadcast_to(to_sun, points.shape)
    is_shaded |= np.isfinite(cast_triangles(scene.objects, points, rays, nearest=2e-3))
    actual, expected = (cos_incidence > 0.0) & (sun_fraction > 0.5), (cos_incidence > 0.0) & ~is_shaded
    return float(np.mean(actual == expected)), float(np.mean((cos_incidence > 0.0) & is_shaded))


@pytest.mark.parametrize("azimuth_deg", [110.0, 200.0])
def test_low_sun_shadows_of_rough_ground_match_ray_cast(
    renderer: Renderer, terrain: Surface, azimuth_deg: float
) -> None:
    sun = Sun(direction(np.radians(azimuth_deg), np.radians(12.0)))
    scene = Scene(_with_uniform_albedo(terrain), (380.0, 200.0), sun, LAMBERT, edge_rays=1)
    pose = rigid(Rotation.from_euler("zxy", [30.0, 12.0, 5.0], degrees=True), np.array([380.0, 200.0, 1500.0]))
    frame = renderer.render(scene, PixelRays.from_camera(descent_camera(512)), pose)
    agreement, shaded_fraction = _compare_with_ray_cast(frame, scene, 4000, 0.3)
    assert shaded_fraction > 0.02
    assert agreement >= MIN_AGREEMENT


def test_rock_shadows_match_ray_cast(renderer: Renderer) -> None:
    parameters = TerrainParameters(
        samples=256, spacing_m=0.1, rms_slope_deg=2.0, slope_baseline_m=2.0, outer_scale_m=15.0, craters_per_km2=0.0
    )
    surface = _with_uniform_albedo(synthesise(parameters, np.random.default_rng(5)))
    field = RockField.draw(surface, RockParameters(abundance=0.1, smallest_m=0.15), np.random.default_rng(1))
    rocks = rocks_near(field, 10.0, 10.0, 7.0, 8.0, albedo=ALBEDO)
    camera = Cahv.from_field_of_view(0.3, (256, 256), **DOWN)
    sun = Sun(direction(np.radians(200.0), np.radians(35.0)))
    scene = Scene(surface, (10.0, 10.0), sun, LAMBERT, rocks, mesh_finest_m=0.1, mesh_half_width_m=100.0, edge_rays=1)
    eye = np.array([10.0, 10.0, float(surface.height(10.0, 10.0)) + 8.0])
    pose = rigid(Rotation.from_euler("x", 15.0, degrees=True), eye)
    frame = renderer.render(scene, PixelRays.from_camera(camera), pose)
    agreement, shaded_fraction = _compare_with_ray_cast(frame, scene, 3000, 0.02)
    assert shaded_fraction > 0.02
    assert agreement >= MIN_AGREEMENT


def test_ridge_penumbra_matches_visible_sun_fraction(renderer: Renderer) -> None:
    """The penumbra 55 m from the ridge equals the visible fraction of the solar disc."""
    spacing, elevation = 0.5, np.radians(20.0)
    heights = np.zeros((256, 256)) + np.maximum(20.0 - spacing * np.abs(np.arange(256.0) - 60.0), 0.0)
    surface = make_ground(heights, spacing, ALBEDO)
    sun = Sun(direction(np.radians(270.0), elevation))
    # Elevation of the ridge at x = 30 m, seen from ground positions in the east.
    profile = np.arange(28.0, 32.0, 0.01)
    crest = surface.height(profile, 0.0)
    ground = np.linspace(75.0, 95.0, 2001)
    skyline = np.arctan2(crest, ground[:, None] - profile).max(axis=1)
    edge = float(np.interp(elevation, skyline[::-1], ground[::-1]))
    pose = rigid(Rotation.identity(), np.array([edge, 64.0, 8.0]))
    scene = Scene(surface, (edge, 64.0), sun, LAMBERT)
    frame = renderer.render(scene, PixelRays.from_camera(descent_camera(256)), pose)
    x_m = frame.points_world()[..., 0].ravel()
    offset = np.clip((elevation - np.interp(x_m, ground, skyline)) / sun.angular_radius_rad, -1.0, 1.0)
    expected = 0.5 + (offset * np.sqrt(1.0 - offset**2) + np.arcsin(offset)) / np.pi
    sun_fraction = frame.radiance.ravel() / (ALBEDO * np.sin(elevation))
    # The penumbra is 1 m wide; a pixel covers 3 cm.
    assert 0.1 < np.mean((expected > 0.0) & (expected < 1.0)) < 0.3
    np.testing.assert_allclose(sun_fraction, expected, atol=0.01)


def _random_bodies(rng: np.random.Generator, centres: np.ndarray, sizes: np.ndarray) -> Objects:
    """Create one body of seven random triangles at each centre."""
    offsets = sizes[:, None, None, None] * rng.normal(size=(len(centres), 7, 3, 3))
    triangles = (centres[:, None, None] + offsets).reshape(-1, 3)
    faces = np.arange(len(triangles), dtype=np.int32).reshape(-1, 3)
    body_ids = np.repeat(np.arange(len(centres), dtype=np.int32), 7)
    return Objects.of_mesh(triangles, np.zeros_like(triangles), faces, body_ids, ALBEDO)


@pytest.mark.parametrize("distant_m", [0.0, 40.0, 20_000.0])
@pytest.mark.parametrize("elevation", [-0.2, 0.15, 1.0, np.pi / 2])
def test_shaded_positions_equal_an_exhaustive_search(elevation: float, distant_m: float) -> None:
    """The bodies overlap and consist of random triangles of many sizes and orientations; two may be distant."""
    rng = np.random.default_rng(8)
    centres = rng.uniform(-5.0, 5.0, (60, 3))
    centres[-2:, :2] += ([distant_m, 0.3 * distant_m], [-distant_m, distant_m])
    objects = _random_bodies(rng, centres, 10.0 ** rng.uniform(-1.5, 0.3, 60))
    sun = Sun(direction(0.7, elevation))
    positions = rng.uniform(-9.0, 9.0, (3000, 3))
    positions[:100] += centres[-1]
    casters = casters_towards(objects, sun)
    assert casters is not None
    result = to_host(are_occluded(casters, vectors_to_device(Array3f64, positions), Bool(True)))
    rays = np.broadcast_to(sun.direction, positions.shape)
    expected = np.isfinite(cast_triangles(objects, positions, rays, nearest=0.0))
    assert 0.1 < np.mean(expected) < 0.9
    np.testing.assert_array_equal(result, expected)


def test_distant_bodies_do_not_slow_down_shadows() -> None:
    """Hills at kilometres may stand around a camera among thousands of rocks.

    In a grid of 64 x 64 cells over 20 km nearly all 4,000 rocks within 20 m would be in one cell.
    """
    rng = np.random.default_rng(3)
    rocks = np.column_stack([rng.uniform(-20.0, 20.0, (4000, 2)), rng.uniform(0.0, 0.1, 4000)])
    hills = np.array([[9000.0, 4000.0, 50.0], [-7000.0, -9000.0, 50.0]])
    bodies = _random_bodies(rng, np.concatenate([rocks, hills]), np.full(4002, 0.05))
    casters = casters_towards(bodies, Sun(direction(0.7, 0.6)))
    assert casters is not None
    ground = np.column_stack([rng.uniform(-20.0, 20.0, (20_000, 2)), np.zeros(20_000)])
    u, v, _ = casters.axes @ vectors_to_device(Array3f64, ground)
    cell, in_grid = casters.coarse.find_cell(UInt32(0), *casters.coarse.locate(UInt32(0), u, v, True), True)
    first, end = casters.fine.list_range(cell, *casters.fine.locate(cell, u, v, in_grid), in_grid)
    tested = (to_host(end) - to_host(first)).astype(int)
    assert 0.5 < tested.mean() < 20.0


def test_overlapping_bodies_are_listed_in_few_cells() -> None:
    """Fine cells that are not smaller than the bodies: without this limit each body would be in 100 times as many."""
    count = 400
    objects = _random_bodies(np.random.default_rng(5), np.zeros((count, 3)), np.full(count, 1.0))
    casters = casters_towards(objects, Sun(direction(0.7, 0.6)))
    assert casters is not None
    # at most all bodies in all of the coarse cells (one per body), and each in a few fine cells there
    assert len(casters.fine.items) < 4 * count * count


def test_another_photometry_keeps_the_shadows(terrain: Surface) -> None:
    """Photometry and number of rays at edges do not change shadows, which are slow to compute."""
    scene = Scene(terrain, (0.0, 0.0), Sun(direction(0.7, 0.6)), LAMBERT)
    occluders = scene.occluders
    changed = scene.with_photometry(replace(LAMBERT, sky_fraction=0.3)).with_edge_rays(1)
    assert changed.occluders is occluders
    assert (changed.photometry.sky_fraction, changed.edge_rays) == (0.3, 1)
    assert scene.photometry == LAMBERT


def _grid_values(shadow: GroundShadow) -> np.ndarray:
    """Return the heights of a shadow, shape (side, side)."""
    values = to_host(shadow.height.values)
    return values.reshape((round(np.sqrt(values.size)),) * 2)


@pytest.mark.parametrize("azimuth_deg", [20.0, 110.0, 200.0, 290.0, 45.0])
def test_shadow_sweep_of_an_area_equals_the_full_sweep(terrain: Surface, azimuth_deg: float) -> None:
    """The area includes the border of the terrain period."""
    sun = Sun(direction(np.radians(azimuth_deg), np.radians(35.0)))
    heights = Scene(terrain, (0.0, 0.0), sun, LAMBERT).height_range_m
    area_m = Bounds(-40.0, 60.0, 700.0, 760.0)
    full_shadow, area_shadow = (
        compute_ground_shadow(terrain, sun, heights),
        compute_ground_shadow(terrain, sun, heights, area_m),
    )
    assert full_shadow is not None
    assert area_shadow is not None
    full_grid, area_grid = (_grid_values(shadow) for shadow in (full_shadow, area_shadow))
    spacing = to_host(full_shadow.spacing)[0]
    assert full_shadow.along_x == area_shadow.along_x
    for name in ("spacing", "level", "row_m", "cos_elevation", "max_height"):
        np.testing.assert_array_equal(to_host(getattr(full_shadow, name)), to_host(getattr(area_shadow, name)))
    assert len(area_grid) < len(full_grid)
    x, y = (np.arange(int(low / spacing) - 1, int(high / spacing) + 3) for low, high in (area_m[:2], area_m[2:]))
    rows, columns = (x, y) if full_shadow.along_x else (y, x)
    # Grids are periodic; their numbers of rows and columns are powers of two.
    full_values, area_values = (
        grid[np.ix_(rows & (len(grid) - 1), columns & (len(grid) - 1))] for grid in (full_grid, area_grid)
    )
    np.testing.assert_array_equal(area_values, full_values)


def test_shadow_needs_a_level_with_few_enough_samples(terrain: Surface, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ground_shadow, "SHADOW_SIDE", len(terrain.levels[-1]) - 1)
    sun = Sun(direction(np.radians(20.0), np.radians(35.0)))
    with pytest.raises(ValueError, match="no level of the terrain has at most"):
        compute_ground_shadow(terrain, sun, (0.0, 1.0))


@pytest.mark.parametrize("azimuth_deg", [20.0, 110.0, 225.0])
def test_ground_less_steep_than_the_sun_has_no_shadow(terrain: Surface, azimuth_deg: float) -> None:
    def sun_at(elevation_rad: float) -> Sun:
        return Sun(direction(np.radians(azimuth_deg), elevation_rad))

    high_sun = sun_at(np.radians(80.0))
    max_slopes = slope_bounds(terrain, high_sun)
    rng = np.random.default_rng(4)
    x, y = rng.uniform(0.0, terrain.period_m, (2, 20000))
    slopes = np.abs(terrain.gradient(x, y))
    assert np.all(slopes <= max_slopes)
    assert np.all(slopes.max(axis=0) > 0.6 * np.array(max_slopes))
    east, north = np.abs(high_sun.direction[:2]) / np.hypot(*high_sun.direction[:2])
    max_slope_angle = np.arctan(max_slopes[0] * east + max_slopes[1] * north)
    just_above, just_below = (
        sun_at(max_slope_angle + high_sun.angular_radius_rad + offset) for offset in (1e-4, -1e-4)
    )
    assert is_sun_above_slopes(just_above, max_slopes)
    assert slope_bounds(terrain, just_above) == max_slopes
    assert not is_sun_above_slopes(just_below, max_slopes)
    # Below this elevation the ground may hide part of the sun; the bounds are infinite.
    assert slope_bounds(terrain, just_below) == (np.inf, np.inf)
    # The sweep finds no shadow; the tolerance covers rounding.
    scene = Scene(terrain, (0.0, 0.0), just_above, Photometry())
    shadow = compute_ground_shadow(terrain, just_above, scene.height_range_m)
    assert shadow is not None
    heights = terrain.levels[to_host(shadow.level)[0]][..., 0]
    assert np.all(_grid_values(shadow) < (heights.T if shadow.along_x else heights) + 1e-3)
    assert scene.shadow is None
    below = scene.with_light(just_below, Photometry())
    assert below.shadow is not None


@pytest.mark.parametrize("axis", [0, 1])
def test_slopes_are_bounded_across_the_border_of_the_period(axis: int) -> None:
    """A ramp of 0.1 m per sample falls back by 6.3 m at the border."""
    ramp = 0.1 * np.arange(64.0)
    surface = make_ground(np.broadcast_to(ramp if axis == 0 else ramp[:, None], (64, 64)), 2.0)
    slopes = slope_bounds(surface, Sun(direction(0.25 * np.pi, np.radians(85.0))))
    expected = (6.3 / 2.0, 0.0) if axis == 0 else (0.0, 6.3 / 2.0)
    assert slopes == pytest.approx(expected, rel=1e-6)


def test_bounds_contain_all_ground_in_a_cone() -> None:
    """The ground is not below -0.4 m. Random positions are in the cone, most of them near that height."""
    lowest_m = -0.4
    rng = np.random.default_rng(2)
    apex, half_angle_rad = np.array([3.0, -2.0, 1.5]), 0.12
    axis = direction(2.0, -0.3)
    bounds = ground_in_cones([(apex, axis, half_angle_rad)], lowest_m)
    assert bounds is not None
    rays = axis + np.tan(half_angle_rad) * rng.uniform(-1.0, 1.0, (20000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rays = rays[rays @ axis >= np.cos(half_angle_rad)]
    positions = apex + (rng.uniform(0.0, 1.0, len(rays)) ** 0.1 * (lowest_m - apex[2]) / rays[:, 2])[:, None] * rays
    low, high = np.array(bounds).reshape(2, 2).T
    assert np.all((positions[:, :2] > low) & (positions[:, :2] < high))
    assert np.all(high - low < 1.1 * np.ptp(np.vstack([positions, apex])[:, :2], axis=0))
    # A cone that contains the horizon has no bounds.
    assert ground_in_cones([(apex, direction(2.0, -0.1), half_angle_rad)], lowest_m) is None


def test_changed_scene_keeps_no_outdated_shadow(renderer: Renderer) -> None:
    """After each change of a scene the image is that of a new scene, also if all results of the old one exist."""
    hills = make_ground(0.4 * np.sin(np.linspace(0.0, 8.0 * np.pi, 64, endpoint=False)) * np.ones((64, 1)), 0.5)
    scene = Scene(hills, (8.0, 8.0), Sun(direction(0.5, 0.3)), LAMBERT, level_plate(1), **NEAR_MESH)
    moved = level_plate(2, 13.0)
    changes: tuple[Callable[[], Scene], ...] = (
        lambda: scene.with_objects(moved),
        lambda: scene.with_light(Sun(direction(2.5, 0.4)), LAMBERT),
        lambda: scene.with_viewpoint(moved, (14.0, 12.0), 0.2, 60.0, 257),
        lambda: scene.with_mesh((12.0, 12.0), 0.3, 60.0, 257),
    )
    look_down(renderer, scene, (10.0, 10.0, 12.0), 1.2, 96)
    for change in changes:
        changed = change()
        images = [look_down(renderer, item, (10.0, 10.0, 12.0), 1.2, 96) for item in (changed, replace(changed))]
        np.testing.assert_array_equal(images[0].radiance, images[1].radiance)


@pytest.mark.parametrize(("start", "selected"), [(0, [0, 1, 2, 3]), (6, [0, 1, 6, 7]), (-3, [0, 5, 6, 7])])
def test_periodic_window_keeps_coordinates_modulo_its_period(start: int, selected: list[int]) -> None:
    """Four of eight samples, also across the ends of the axis."""
    window = periodic_window(start, 4, 8)
    assert sorted(window) == selected
    np.testing.assert_array_equal(window % 4, np.arange(4))
