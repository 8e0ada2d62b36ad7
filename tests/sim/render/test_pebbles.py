"""Tests of pebbles, dust on rocks, borders between sand and bedrock, and the surface of rocks."""

from typing import Any

import drjit as dr
import numpy as np
import pytest
from scipy.ndimage import center_of_mass, gaussian_filter, label
from scipy.special import expit

from marsyard.sim.frames import direction
from marsyard.sim.render import Objects, Photometry, Renderer, Scene, Sun, Texture
from marsyard.sim.render.arrays import to_host
from marsyard.sim.render.device import Array3f, Array3f64, Array4f, Float
from marsyard.sim.render.objects import FIRST_MESH_NUMBER
from marsyard.sim.render.pebbles import CELL_DIAMETERS, PebbleField, pebble_surface
from marsyard.sim.render.rock_surface import MAX_BED_RATIO, RockSurface, describe_grain, rock_surface, texture_frame
from marsyard.sim.render.rover import ROVER_NAME
from marsyard.sim.terrain import TerrainBank, site
from marsyard.sim.terrain.sites import SiteCover, SitePebbles
from marsyard.sim.terrain.surface import ALBEDO, Surface
from tests.sim.scenes import LAMBERT, NEAR_MESH, flat_ground, level_plate, look_down

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


def test_border_is_sharper_than_the_samples(renderer: Renderer) -> None:
    """Albedo rises from sand, in the west, to bedrock over about a metre; the border is much narrower."""
    x = np.arange(64.0)
    samples = np.zeros((64, 64, 2), dtype=np.float32)
    # periodic: two borders, at columns 8 and 40
    samples[..., ALBEDO] = 0.2 * np.exp(0.6 * (expit(4.0 * (x - 8.0)) - expit(4.0 * (x - 40.0))) - 0.3)
    surface, sun = Surface.from_samples(samples, 1.0), Sun(direction(0.5 * np.pi, 1.0))
    plain, covered = (
        look_down(
            renderer, Scene(surface, (8.0, 8.0), sun, LAMBERT, cover=cover, **NEAR_MESH), (8.0, 8.0, 9.0), 0.6, 200
        )
        .radiance[100]
        .astype(np.float64)
        for cover in (None, SiteCover(border=0.0, contrast=0.2, softness=0.05))
    )
    change = np.log(covered / plain)
    # sand is unchanged, bedrock has twice the contrast; 0.3 is six times the softness
    assert change[:20] == pytest.approx(0.0, abs=1e-3)
    assert change[-20:] == pytest.approx(0.4, abs=1e-3)
    # the mean logarithm of albedo, which is that of the border, is in the middle of the ramp
    assert np.searchsorted(change, 0.2) == pytest.approx(100, abs=4)

    def width(values: np.ndarray) -> int:
        """Count the pixels between a tenth and nine tenths of the rise."""
        rise = (values - values.min()) / np.ptp(values)
        return int(np.count_nonzero((rise > 0.1) & (rise < 0.9)))

    assert width(change) < 0.4 * width(np.log(plain))


def _surface(grain: tuple[float, ...], points_m: np.ndarray, footprint_m: float) -> RockSurface:
    position, normal = Array3f64(*points_m.T), Array3f(0.0, 0.0, 1.0)
    return rock_surface(Array4f(*grain), position, normal, Float(footprint_m))


def _line(length_m: float, count: int = 4000) -> np.ndarray:
    """Points along a line that no lattice direction is parallel to."""
    return np.linspace(0.0, length_m, count)[:, None] * np.array([0.48, 0.64, 0.6]) + (3.1, 1.7, 0.4)


def test_grain_depends_on_the_name_of_a_rock_only() -> None:
    names, sizes = np.arange(1000), np.full(1000, 0.3)
    grain = describe_grain(names, sizes)
    assert np.array_equal(grain[[7, 400]], describe_grain(names[[7, 400]], sizes[:2]))
    ratio = 1.0 + np.sum(grain[:, :3] ** 2, axis=1)
    # half of the rocks are bedded, with ratios uniform from 1 to the maximum
    assert np.mean(ratio > 1.0) == pytest.approx(0.5, abs=0.02)
    assert ratio.max() == pytest.approx(MAX_BED_RATIO, rel=0.01)
    assert len(np.unique(np.round(grain[:, :3], 6), axis=0)) > 490


def test_grain_scales_with_the_rock_and_fades_with_the_footprint() -> None:
    small = to_host(_surface((0.0, 0.0, 0.0, 0.2), _line(2.0), 1e-4).slope)
    large = to_host(_surface((0.0, 0.0, 0.0, 2.0), 10.0 * _line(2.0), 1e-3).slope)
    # noise of equal offsets from the lattice, in single precision
    assert np.max(np.abs(small - large)) < 1e-3
    assert 0.05 < small.std(axis=0).mean() < 0.4
    # the coarsest cells, 4 cm, are smaller than pixels of 10 cm
    assert not to_host(_surface((0.0, 0.0, 0.0, 0.2), _line(2.0), 0.1).slope).any()


def test_bedded_grain_is_longer_along_the_beds() -> None:
    bedding = (0.0, 0.0, float(np.sqrt(3.0)), 0.5)
    slope = to_host(_surface(bedding, _line(4.0), 1e-3).slope)
    # relief is 4 times shorter along z, across the beds
    assert slope[:, 2].std() / slope[:, 0].std() == pytest.approx(4.0, rel=0.2)
    position, _ = texture_frame(Array4f(*bedding), Array3f64(0.0, 0.0, 1.0), Float(0.01))
    across, _ = texture_frame(Array4f(*bedding), Array3f64(1.0, 0.0, 0.0), Float(0.01))
    assert to_host(position.z)[0] == pytest.approx(4.0 * to_host(across.x)[0], rel=1e-6)


def test_dust_has_a_patchy_margin_and_fractures_are_dark_and_rare() -> None:
    surface = _surface((0.0, 0.0, 0.0, 0.3), _line(3.0), 1e-4)
    fractures = to_host(surface.log_albedo)
    assert fractures.min() < -0.35
    assert np.mean(fractures < -0.1) < 0.15
    steep = rock_surface(Array4f(0.0, 0.0, 0.0, 0.3), Array3f64(*_line(3.0).T), Array3f(0.8, 0.0, 0.6), Float(1e-4))
    assert np.ptp(to_host(steep.dust)) > 0.2


@pytest.mark.parametrize(
    ("name", "amplitudes", "contrast"),
    [
        (5, (), (0.0, 1e-3)),
        (5, (0.12,) * 7, (0.1, 1.0)),
        (ROVER_NAME, (0.12,) * 7, (0.1, 1.0)),
        (FIRST_MESH_NUMBER, (0.12,) * 7, (1e-6, 0.02)),
    ],
    ids=["bare rock", "rock", "rover", "mesh of a user"],
)
def test_rocks_and_rovers_have_grain_and_meshes_slight_wear_where_there_is_texture(
    renderer: Renderer, name: int, amplitudes: tuple[float, ...], contrast: tuple[float, float]
) -> None:
    """The normals in the truth are those of the geometry."""
    sun, texture = Sun(direction(0.0, np.radians(40.0))), Texture(0.2, amplitudes)
    plate, ground = level_plate(name), flat_ground(64, 1.0)
    scene = Scene(ground, (8.0, 8.0), sun, LAMBERT, plate, object_texture=texture, **NEAR_MESH)
    frame = look_down(renderer, scene, (8.0, 8.0, 3.0), 0.5, 60)
    assert contrast[0] <= frame.radiance.std() / frame.radiance.mean() < contrast[1]
    assert frame.normal.reshape(-1, 3) == pytest.approx(np.tile([0.0, 0.0, 1.0], (3600, 1)), abs=1e-6)
