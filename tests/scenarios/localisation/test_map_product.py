"""Tests of the map product: exact without errors, and with the stated errors otherwise."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from jaxtyping import Float64
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from marsyard.scenarios.localisation.map_product import blur, make_map
from marsyard.scenarios.localisation.map_rendering import orbital_rays
from marsyard.scenarios.localisation.map_truth import SmoothField
from marsyard.scenarios.localisation.parameters import MapParameters
from marsyard.scenarios.localisation.sites import localisation_site
from marsyard.scenarios.localisation.world import LocalisationWorld
from marsyard.scenarios.radiance import add_haze, sun_at
from marsyard.scenarios.views import Viewpoint, site_scene
from marsyard.sim.camera import Cahv
from marsyard.sim.frames import rigid
from marsyard.sim.render import Frame, PixelRays, process_renderer
from marsyard.sim.render.backend import default_backend

#: Side of the test maps, and position of their centre (m), which is no symmetry point of the periodic terrain.
SIDE_PX = 96
CENTRE = np.array([700.0, 1150.0])
#: Parameters of a map without errors.
EXACT = MapParameters(
    side_px=SIDE_PX,
    signal_to_noise=1e12,
    aperture_px=1.0,
    nyquist_mtf=1.0,
    bits=None,
    registration_sd_m=0.0,
    distortion_sd_m=0.0,
    elevation_sd_m=0.0,
    elevation_post_m=0.0,
)


@pytest.fixture(scope="module")
def world() -> LocalisationWorld:
    return _make_world()


def _make_world(azimuth_deg: float = 120.0, optical_depth: float | None = None) -> LocalisationWorld:
    site = localisation_site("highland")
    changes = {"samples": 512, "crater_diameter_max_m": 300.0, "craters_per_km2": 30.0}
    return LocalisationWorld.from_parameters(
        site,
        site.terrain(changes=changes),
        bank_seed=4,
        terrain_number=0,
        sun_azimuth_deg=azimuth_deg,
        sun_elevation_deg=50.0,
        optical_depth=optical_depth,
    )


def _make_map(world: LocalisationWorld, parameters: MapParameters = EXACT, seed: int = 1, **changes: Any) -> Any:
    """Return a map product and its ground truth; `changes` replaces parameters."""
    parameters = MapParameters(**{**parameters.model_dump(), **changes})
    return make_map(world, parameters, CENTRE, np.random.default_rng(seed), default_backend())


def _pixel_positions() -> tuple[Float64[np.ndarray, "side side"], Float64[np.ndarray, "side side"]]:
    """Return the east and north coordinates of the pixel centres, m."""
    offsets = (np.arange(SIDE_PX) - 0.5 * (SIDE_PX - 1)) * EXACT.pixel_m
    east, north = np.meshgrid(CENTRE[0] + offsets, CENTRE[1] + offsets)
    return east, north


def _render_under_map_sun(
    world: LocalisationWorld,
    rays: PixelRays,
    position: Float64[np.ndarray, "3"],
    sun_elevation_deg: float = EXACT.sun_elevation_deg,
) -> Frame:
    """Render with a scene that differs from that of the map: the scene of a site from the orbiter's height."""
    sun = sun_at(world.air, EXACT.sun_azimuth_deg, sun_elevation_deg)
    view = Viewpoint(float(CENTRE[0]), float(CENTRE[1]), EXACT.orbit_height_m, EXACT.pixel_m / EXACT.orbit_height_m)
    scene = replace(site_scene(world.ground, view, sun), mesh_finest_m=100.0)
    return process_renderer(default_backend()).render(scene, rays, rigid(Rotation.identity(), position))


def _orbiter(world: LocalisationWorld) -> Float64[np.ndarray, "3"]:
    """Return the position of the orbiter, above the centre of the maps."""
    return np.array([*CENTRE, float(world.surface.height(*CENTRE)) + EXACT.orbit_height_m])


def test_elevation_without_errors_is_the_height_of_the_surface(world: LocalisationWorld) -> None:
    product, _ = _make_map(world)
    east, north = _pixel_positions()
    # single precision of heights of up to 500 m
    np.testing.assert_allclose(product.elevation_m, world.surface.height(east, north), atol=3e-5)
    # row 0 is the southernmost; the origin is the centre of pixel (0, 0)
    np.testing.assert_allclose(product.origin_m, [east[0, 0], north[0, 0]])


def test_appearance_without_errors_equals_an_orthographic_render(world: LocalisationWorld) -> None:
    product, _ = _make_map(world)
    east, north = _pixel_positions()
    orbiter = _orbiter(world)
    perspective = orbital_rays(world.surface, orbiter, east, north, EXACT.pixel_m)
    # parallel rays that start above each pixel
    origins = np.stack([east - orbiter[0], north - orbiter[1], np.zeros_like(east)], axis=-1)
    vertical = replace(
        perspective,
        origins=origins.reshape(-1, 3).astype(np.float32),
        directions=np.tile(np.array([0.0, 0.0, -1.0], dtype=np.float32), (SIDE_PX**2, 1)),
    )
    frame = _render_under_map_sun(world, vertical, orbiter)
    extinction = world.air.mean_extinction_m(EXACT.orbit_height_m)
    sun = sun_at(world.air, EXACT.sun_azimuth_deg, EXACT.sun_elevation_deg)
    expected = add_haze(frame, world.air, sun, extinction)
    # rays are up to 0.08 deg from nadir; edges of shadows are supersampled around slightly different positions
    difference = np.abs(product.appearance / expected - 1.0)
    assert np.median(difference) < 2e-4
    assert np.quantile(difference, 0.995) < 5e-3


def test_map_equals_the_orthorectified_image_of_a_pinhole_camera(world: LocalisationWorld) -> None:
    """Independent method: an image of a pinhole camera at 300 km, interpolated at the projected map points."""
    # a high sun: at edges of shadows the map's radiance is a mean over the area of a pixel
    product, _ = _make_map(world, optical_depth=0.0, sun_elevation_deg=75.0)
    world = LocalisationWorld(replace(world.ground, site=world.ground.site.with_dust(0.0)), world.sun)
    # image pixels of 2 m on the ground, so that interpolation is exact enough; the footprint is that of a map pixel
    columns, rows = SIDE_PX * 3 + 40, SIDE_PX * 3 + 40
    orbiter = _orbiter(world)
    camera = Cahv.from_axes((150_000.0, 150_000.0), (columns, rows), axis=(0.0, 0.0, -1.0), right=(1.0, 0.0, 0.0))
    rays = PixelRays.from_camera(camera)
    frame = _render_under_map_sun(world, replace(rays, pixel_angles=3.0 * rays.pixel_angles), orbiter, 75.0)
    east, north = _pixel_positions()
    points = np.stack([east, north, world.surface.height(east, north)], axis=-1)
    pixels, visible = camera.project(points - orbiter)
    assert visible.all()
    expected = map_coordinates(frame.radiance.astype(np.float64), np.moveaxis(pixels[..., ::-1], -1, 0), order=3)
    difference = product.appearance - expected
    assert np.sqrt(np.mean(difference**2)) < 5e-3 * product.appearance.std()
    # displacement by least squares on the gradient of the image, map pixels
    gradient = np.stack([g.ravel() for g in np.gradient(expected)[::-1]], axis=-1)
    displacement = np.linalg.lstsq(gradient, -difference.ravel(), rcond=None)[0]
    np.testing.assert_allclose(displacement, 0.0, atol=1e-3)


def test_rays_from_300_km_hit_the_surface_points_of_a_whole_map(world: LocalisationWorld) -> None:
    offsets = np.linspace(-6141.0, 6141.0, 129)
    east, north = np.meshgrid(CENTRE[0] + offsets, CENTRE[1] + offsets)
    orbiter = _orbiter(world)
    frame = _render_under_map_sun(world, orbital_rays(world.surface, orbiter, east, north, 6.0), orbiter)
    horizontal = frame.points_world()[..., :2] - np.stack([east, north], axis=-1)
    # 1e-3 of a map pixel
    assert np.abs(horizontal).max() < 6e-3


def test_position_errors_are_those_of_the_truth(world: LocalisationWorld) -> None:
    product, truth = _make_map(world, registration_sd_m=80.0, distortion_sd_m=6.0, distortion_length_m=300.0)
    assert np.linalg.norm(truth.shift_m) > 1.0
    map_m = np.stack(_pixel_positions(), axis=-1)
    world_m = truth.world_position(map_m)
    np.testing.assert_allclose(product.elevation_m, world.surface.height(world_m[..., 0], world_m[..., 1]), atol=3e-5)
    np.testing.assert_allclose(truth.map_position(world_m), map_m, atol=1e-6)
    distortion = map_m - world_m - truth.shift_m
    assert 0.5 < distortion.std() / 6.0 < 2.0
    np.testing.assert_allclose(distortion, truth.distortion(map_m), atol=1e-9)
    # the appearance is displaced with the elevation: a map without errors around the shifted centre is equal
    shifted, truth = _make_map(world, registration_sd_m=80.0)
    expected, _ = make_map(world, EXACT, CENTRE - truth.shift_m, np.random.default_rng(1), default_backend())
    # the orbiter is above another point, so the emission angles differ by up to 0.02 deg
    assert np.median(np.abs(shifted.appearance / expected.appearance - 1.0)) < 3e-4


def test_map_does_not_depend_on_the_light_of_the_landing(world: LocalisationWorld) -> None:
    first, _ = _make_map(world, optical_depth=0.8)
    second, _ = _make_map(_make_world(azimuth_deg=300.0, optical_depth=0.2), optical_depth=0.8)
    np.testing.assert_array_equal(first.appearance, second.appearance)
    other_sun, _ = _make_map(world, optical_depth=0.8, sun_azimuth_deg=95.0)
    correlation = np.corrcoef(first.appearance.ravel(), other_sun.appearance.ravel())[0, 1]
    assert correlation < 0.5
    clear, _ = _make_map(world, optical_depth=0.1)
    assert first.appearance.std() / first.appearance.mean() < 0.8 * clear.appearance.std() / clear.appearance.mean()


def test_noise_counts_and_elevation_errors_have_the_stated_size(world: LocalisationWorld) -> None:
    clean, _ = _make_map(world)
    noisy, truth = _make_map(world, signal_to_noise=50.0, bits=8, elevation_sd_m=5.0, elevation_length_m=60.0)
    assert noisy.appearance.min() >= 0.0
    assert noisy.appearance.max() == 255.0
    np.testing.assert_array_equal(noisy.appearance, np.rint(noisy.appearance))
    residual = noisy.appearance - truth.counts_per_radiance * clean.appearance
    is_inside = noisy.appearance < 255.0
    expected = float(np.hypot(truth.counts_per_radiance * clean.appearance.mean() / 50.0, np.sqrt(1.0 / 12.0)))
    # 9216 pixels: the standard error of the SD is 0.7 %
    np.testing.assert_allclose(residual[is_inside].std(), expected, rtol=0.03)
    error = noisy.elevation_m - clean.elevation_m
    np.testing.assert_allclose(error, truth.elevation_error.at(*_pixel_positions()), atol=1e-3)
    assert 0.7 < error.std() / 5.0 < 1.3


def test_posts_smooth_the_elevation(world: LocalisationWorld) -> None:
    exact, _ = _make_map(world)
    posts, _ = _make_map(world, elevation_post_m=20.0)
    difference = (posts.elevation_m - exact.elevation_m).astype(np.float64)
    # relief within 20 m on slopes of about 6 deg with a Hurst exponent near 1
    assert 0.02 < difference.std() < 1.5
    # symmetric smoothing: no horizontal displacement, pixels, beyond the regression's noise
    gradient = np.stack([g.ravel() for g in np.gradient(exact.elevation_m)[::-1]] + [np.ones(SIDE_PX**2)], axis=-1)
    displacement = np.linalg.lstsq(gradient, difference.ravel(), rcond=None)[0][:2]
    np.testing.assert_allclose(displacement, 0.0, atol=0.05)


def test_map_resolves_what_its_aperture_averages(world: LocalisationWorld) -> None:
    """A smaller aperture resolves finer relief and texture: more contrast between neighbouring pixels."""
    contrasts = []
    for aperture_px in (1.0, 0.3):
        appearance = _make_map(world, aperture_px=aperture_px)[0].appearance
        contrasts.append(float(np.diff(appearance, axis=1).std() / appearance.mean()))
    assert contrasts[1] > 1.05 * contrasts[0]


def test_blur_has_the_transfer_at_the_nyquist_frequency() -> None:
    stripes = np.tile(np.array([1.0, -1.0], dtype=np.float32), (32, 16))
    # tolerance: truncation of the sampled kernel, whose transfer includes aliases (largest at the Nyquist frequency)
    centre = blur(stripes, 0.25)[16, 16]
    sd_px = np.sqrt(-2.0 * np.log(0.25)) / np.pi
    kernel = np.exp(-0.5 * (np.arange(-9, 10) / sd_px) ** 2)
    expected = float(np.sum(kernel * (-1.0) ** np.arange(-9, 10)) / kernel.sum())
    np.testing.assert_allclose(centre, expected, atol=5e-3)


def test_smooth_field_has_its_standard_deviation_and_correlation() -> None:
    rng = np.random.default_rng(3)
    field = SmoothField.draw(np.array([-5000.0, 0.0]), np.array([5000.0, 8000.0]), 2.5, 100.0, rng)
    x, y = np.arange(-5000.0, 5000.0, 50.0), np.arange(0.0, 8000.0, 50.0)
    values = field.on_grid(x, y)
    np.testing.assert_allclose(values, field.at(*np.meshgrid(x, y)), atol=1e-12)
    # 8000 correlation areas of 100 m: standard errors of 1 to 2 %
    np.testing.assert_allclose(values.std(), 2.5, rtol=0.04)
    for lag in (1, 2, 3):
        correlation = np.mean(values[:, lag:] * values[:, :-lag]) / np.mean(values**2)
        np.testing.assert_allclose(correlation, np.exp(-0.5 * (0.5 * lag) ** 2), atol=0.03)
