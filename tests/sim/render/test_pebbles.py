"""Tests of pebbles: coverage, fading, position on the ground, shadows, and dust on rocks."""

from typing import Any

import drjit as dr
import numpy as np
import pytest
from scipy.ndimage import center_of_mass, gaussian_filter, label

from marsyard.sim.frames import direction
from marsyard.sim.render import Objects, Photometry, Renderer, Scene, Sun
from marsyard.sim.render.arrays import to_host
from marsyard.sim.render.device import Array3f, Array3f64, Float
from marsyard.sim.render.objects import FIRST_MESH_NUMBER
from marsyard.sim.render.pebbles import CELL_DIAMETERS, PebbleField, pebble_surface
from marsyard.sim.render.rover import ROVER_NAME
from marsyard.sim.terrain import TerrainBank, site
from marsyard.sim.terrain.sites import SitePebbles
from marsyard.sim.terrain.surface import Surface
from tests.sim.scenes import LAMBERT, NEAR_MESH, flat_ground, look_down

ONE_SIZE = SitePebbles(coverage=0.06, largest_m=0.04, smallest_m=0.02, log_albedo=-0.5, log_albedo_sd=0.0)
SUN = Sun(direction(0.5 * np.pi, np.radians(35.0)))
LEVEL = flat_ground(64, 1.0)


def _sample(
    pebbles: SitePebbles, footprint_m: float, *, density: float = 1.0, side: int = 700, spacing_m: float = 0.0071
) -> tuple[np.ndarray, ...]:
    """Return normals, log albedo and shadow on a square grid of positions; rows are north."""
    grid = spacing_m * np.arange(side)
    x, y = np.meshgrid(grid, grid)
    position = Array3f64(*(np.ravel(values) for values in (x, y, np.zeros_like(x))))
    footprint, sun = dr.full(Float, footprint_m, side * side), Array3f(*SUN.direction.tolist())
    surface = pebble_surface(PebbleField.of(pebbles, LEVEL), position, footprint, sun, Float(density))
    normal, albedo, shadow = (to_host(values) for values in (surface.normal, surface.log_albedo, surface.shadow))
    return normal.reshape(side, side, 3), albedo.reshape(side, side), shadow.reshape(side, side)


def label_pebbles(pebbles: SitePebbles) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mask of pebbles, its connected regions, and their numbers."""
    mask = _sample(pebbles, 1e-4)[1] < -0.25
    regions, count = label(mask)
    return mask, regions, np.arange(1, count + 1)


def test_pebbles_cover_the_specified_fraction_of_the_ground() -> None:
    _, log_albedo, _ = _sample(ONE_SIZE, 1e-4)
    # 25 m2 with cells of 8 cm: 3900 cells, about 3500 pebbles; the outlines' corners add up to 7 % to their areas
    assert np.mean(log_albedo < -0.25) == pytest.approx(0.06, rel=0.1)


def test_sizes_follow_the_power_law_across_the_octaves() -> None:
    pebbles = SitePebbles(coverage=0.03, largest_m=0.064, smallest_m=0.008, log_albedo=-0.5, log_albedo_sd=0.0)
    spacing_m = 0.002
    _, log_albedo, _ = _sample(pebbles, 1e-4, side=2400, spacing_m=spacing_m)
    regions, count = label(log_albedo < -0.25)
    # the mean outline has the area of 0.75 circles of its diameter, for axes with ratios of 0.5 to 1
    area = np.bincount(regions.ravel())[1:] * spacing_m**2
    diameter = np.sqrt(area / (0.25 * np.pi * 0.75))
    larger = [np.sum(diameter > size) for size in (0.012, 0.017, 0.024, 0.034)]
    # three ranges, two of which contain the border of two octaves; about 65 pebbles are larger than 34 mm
    ratios = np.divide(larger[:-1], larger[1:])
    assert count > 1500
    assert ratios == pytest.approx(np.sqrt(2.0) ** 2.5, rel=0.25)


def test_pebbles_are_many_on_dark_ground_and_rare_on_bright_ground() -> None:
    rng = np.random.default_rng(5)
    samples = np.stack([np.zeros((64, 64)), 0.2 * np.exp(0.1 * rng.standard_normal((64, 64)))], axis=-1)
    field = PebbleField.of(SitePebbles(coverage=0.05), Surface.from_samples(samples.astype(np.float32), 1.0))
    deviations = rng.standard_normal(200_000)
    density = to_host(field.density_at(Float(0.2 * np.exp(0.1 * deviations)), Float(1.0)))
    # about 1 % of the pebbles of a log-normal density are above its maximum
    assert density.mean() == pytest.approx(1.0, abs=0.05)
    assert density[deviations < -1.0].mean() > 8.0 * density[deviations > 1.0].mean()
    # the coverage follows the density as long as cells are free
    sparse = SitePebbles(coverage=0.01, log_albedo=-0.5, log_albedo_sd=0.0)
    bare, lag = (np.mean(_sample(sparse, 1e-4, density=factor)[1] < -0.25) for factor in (0.5, 3.0))
    assert lag / bare == pytest.approx(6.0, rel=0.25)


@pytest.mark.parametrize("has_ripples", [False, True])
@pytest.mark.parametrize("name", ["gusev", "meridiani"])
def test_hollows_hold_lag_and_ripples_have_granules_on_their_crests(name: str, has_ripples: bool) -> None:
    changes = {} if has_ripples else {"ripples": None, "dunes": None}
    terrain, pebbles = site(name).terrain("ground", {"samples": 1024, **changes}), site(name).pebbles
    assert pebbles is not None
    surface = TerrainBank(terrain, 5).terrain(0)
    height, albedo = np.moveaxis(surface.levels[0], -1, 0)
    density = to_host(PebbleField.of(pebbles, surface).density_at(Float(albedo.ravel()), Float(1.0)))
    density = density.reshape(albedo.shape)
    # above the mean of the surroundings over half a metre
    relative = height - gaussian_filter(height, 0.5 / terrain.spacing_m, mode="wrap")
    low, high = np.quantile(relative, (0.1, 0.9))
    in_hollows, on_crests = density[relative < low].mean(), density[relative > high].mean()
    assert on_crests > 1.2 * in_hollows if has_ripples else in_hollows > 1.2 * on_crests


def test_pebbles_are_many_in_rough_units() -> None:
    factors = np.ones((2, 2, 3), dtype=np.float32)
    factors[0, :, 0] = 0.2
    samples = np.stack([np.zeros((16, 16)), np.full((16, 16), 0.2)], axis=-1).astype(np.float32)
    field = PebbleField.of(SitePebbles(coverage=0.05), Surface.from_samples(samples, 1.0, factors))
    smooth, rough = to_host(field.density_at(Float(0.2, 0.2), Float(0.2, 1.0)))
    # the mean roughness is 0.6
    assert (smooth, rough) == pytest.approx((1.0 / 3.0, 5.0 / 3.0), rel=1e-5)


def test_pebbles_do_not_stand_in_rows_and_columns() -> None:
    """In each octave, the positions are uniform in the cells and independent of those in neighbouring cells."""
    centres = center_of_mass(*label_pebbles(ONE_SIZE))
    x = np.array(centres)[:, 1] * 0.0071 / (CELL_DIAMETERS * ONE_SIZE.largest_m) % 1.0
    counts = np.histogram(x, bins=8, range=(0.0, 1.0))[0]
    # a chi-squared variable with 7 degrees of freedom is below 24 with a probability of 0.999
    assert np.sum((counts - counts.mean()) ** 2) / counts.mean() < 24.0


def test_shadows_point_away_from_the_sun() -> None:
    _, log_albedo, shadow = _sample(ONE_SIZE, 1e-4)
    pebble, shade = log_albedo < -0.25, shadow > 0.5
    # the sun is in the east; the mean shadow of a half spheroid is half the ellipse beyond its outline:
    # 0.5 (sqrt(1 + (2 ratio / tan)^2) - 1) of the outline's area, with the height ratio 0.4, tan(35 deg) = 0.70, and an
    # extent along the sun's azimuth of sqrt(0.75), for axes with ratios of 0.5 to 1
    expected = 0.5 * (np.hypot(1.0, 0.8 / 0.70 / np.sqrt(0.75)) - 1.0)
    assert shade.sum() / pebble.sum() == pytest.approx(expected, rel=0.15)
    west_of_pebbles, east_of_pebbles = np.roll(pebble, -2, axis=1), np.roll(pebble, 2, axis=1)
    assert np.mean(shade[west_of_pebbles & ~pebble]) > 5.0 * np.mean(shade[east_of_pebbles & ~pebble])


def test_pebbles_fade_where_they_are_smaller_than_a_pixel() -> None:
    strengths = [float(np.std(_sample(ONE_SIZE, footprint)[1])) for footprint in (0.002, 0.02, 0.04, 0.08)]
    assert strengths[0] > strengths[1] > strengths[2] > 0.0
    assert strengths[3] == 0.0


@pytest.mark.parametrize("elevation_deg", [25.0, 60.0])
def test_pebbles_move_with_the_ground_and_keep_its_mean_brightness(renderer: Renderer, elevation_deg: float) -> None:
    sun = Sun(direction(0.5 * np.pi, np.radians(elevation_deg)))
    plain, pebbly = (
        Scene(flat_ground(64, 1.0), (8.0, 8.0), sun, LAMBERT, pebbles=pebbles, **NEAR_MESH)
        for pebbles in (None, SitePebbles(coverage=0.2))
    )
    pixel_m = 2.0 * np.tan(0.3) * 1.5 / 300
    level, first, second = (
        look_down(renderer, scene, (8.0 + 40.0 * step * pixel_m, 8.0, 1.5), 0.6, 300).radiance
        for scene, step in ((plain, 0), (pebbly, 0), (pebbly, 1))
    )
    assert first.std() > 10.0 * level.std()
    assert first.mean() == pytest.approx(level.mean(), rel=0.03)
    # the second image is the first one shifted by 40 pixels
    assert np.corrcoef(first[:, 45:].ravel(), second[:, 5:-40].ravel())[0, 1] > 0.99


@pytest.mark.parametrize("elevation_deg", [25.0, 50.0])
def test_one_ray_per_pixel_sees_the_mean_over_its_footprint(renderer: Renderer, elevation_deg: float) -> None:
    """Pebbles of one to ten pixels, compared with the means of 36 rays."""
    sun = Sun(direction(0.5 * np.pi, np.radians(elevation_deg)))
    pebbles = SitePebbles(coverage=0.25, log_albedo_sd=0.25)
    scene = Scene(flat_ground(64, 1.0), (8.0, 8.0), sun, LAMBERT, pebbles=pebbles, **NEAR_MESH)
    factor = 6
    images = [look_down(renderer, scene, (8.0, 8.0, 1.5), 0.2, side).radiance for side in (140, 140 * factor)]
    mean = images[1].reshape(140, factor, 140, factor).mean(axis=(1, 3))
    # the ratio is 1.2 for ramps that do not preserve the outline's area and normals of the pixel's centre
    assert images[0].std() / mean.std() == pytest.approx(1.0, abs=0.1)
    assert images[0].mean() / mean.mean() == pytest.approx(1.0, abs=0.02)
    assert np.corrcoef(images[0].ravel(), mean.ravel())[0, 1] > 0.9


def test_dust_lies_on_level_faces_of_rocks_and_less_on_rovers(renderer: Renderer) -> None:
    level = np.array([[8.0, 8.0, 0.4], [8.4, 8.0, 0.4], [8.4, 8.4, 0.4], [8.0, 8.4, 0.4]])
    steep = np.array([[7.0, 8.0, 0.3], [7.05, 8.0, 1.0], [7.05, 8.4, 1.0], [7.0, 8.4, 0.3]])
    normal = np.cross(steep[1] - steep[0], steep[2] - steep[0])
    normals = np.repeat([[0.0, 0.0, 1.0], normal / np.linalg.norm(normal)], 4, axis=0)
    faces, body = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], dtype=np.int32), np.array([0, 0, 1, 1])
    sky_only = Photometry(lunar_fraction=0.0, surge_amplitude=0.0, sky_fraction=1.0, surrounding_albedo=0.0)
    night, brightness = Sun(direction(0.0, np.radians(-10.0))), {}
    for name in (5, ROVER_NAME, FIRST_MESH_NUMBER):
        names = np.full(4, name, dtype=np.int32)
        objects = Objects.of_mesh(np.concatenate([level, steep]), normals, faces, names, 0.1, body.astype(np.int32))
        dust: dict[str, Any] = {"dust_albedo": 0.5, "dust_cover": 0.8}
        scene = Scene(flat_ground(64, 1.0), (8.0, 8.0), night, sky_only, objects, **dust, **NEAR_MESH)
        frame = look_down(renderer, scene, (6.6, 8.2, 3.0), 1.2, 400)
        brightness[name] = [float(np.median(frame.radiance[frame.body == number])) for number in (0, 1)]
    # 0.2 * 0.1 + 0.8 * 0.5 on the rock; a rover has 40 % of this dust, a user's mesh none
    assert brightness[5][0] == pytest.approx(0.42, abs=1e-3)
    assert brightness[ROVER_NAME][0] == pytest.approx(0.68 * 0.1 + 0.32 * 0.5, abs=1e-3)
    assert brightness[FIRST_MESH_NUMBER][0] == pytest.approx(0.1, abs=1e-3)
    # the steep face, 86 deg from level, has (cos(86) - cos(115)) / (cos(30) - cos(115)) = 38.2 % of this dust
    assert brightness[5][1] / brightness[FIRST_MESH_NUMBER][1] == pytest.approx(1.0 + 3.2 * 0.382, abs=0.05)
