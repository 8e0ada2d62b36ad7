"""Tests of sky radiance, irradiance, cloud layers and relief on the horizon against formulas."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from marsyard.sim.camera import Cahv, CameraModel
from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import (
    CloudLayer,
    CloudParameters,
    DustySky,
    Frame,
    Photometry,
    PixelRays,
    Renderer,
    Scene,
    Sun,
)
from marsyard.sim.render.arrays import to_device, to_host
from marsyard.sim.render.device import Float64
from marsyard.sim.render.skyline import Relief
from marsyard.sim.terrain import Surface
from tests.sim.scenes import FORWARD, LAMBERT, descent_camera, flat_ground, make_ground

#: Sky with an optical depth of 0.5, a single-scattering albedo of 0.95 and an asymmetry of 0.65.
DUSTY = Photometry(sky_fraction=0.25, sky=DustySky(0.5, 0.95, 0.65))


def _make_sky_camera(size: int = 200) -> Cahv:
    """Return a camera with a field of view of 40 deg that looks north, 10 deg above the horizon."""
    up = np.radians(10.0)
    axis = np.array([0.0, np.cos(up), np.sin(up)])
    return Cahv.from_field_of_view(np.radians(40.0), (size, size), axis=axis, right=(1.0, 0.0, 0.0))


def _render_from_mast(renderer: Renderer, camera: Cahv, sun: Sun, photometry: Photometry) -> Frame:
    scene = Scene(flat_ground(), (0.0, 0.0), sun, photometry, mesh_finest_m=0.5, mesh_half_width_m=5000.0)
    return renderer.render(scene, PixelRays.from_camera(camera), rigid(Rotation.identity(), np.array([0.0, 0.0, 1.5])))


@pytest.mark.parametrize("elevation_deg", [15.0, 40.0, 90.0])
@pytest.mark.parametrize("depth", [0.1, 0.9, 3.0])
def test_sky_irradiance_on_level_ground_matches_sky_fraction(elevation_deg: float, depth: float) -> None:
    photometry = replace(DUSTY, sky=DustySky(depth, 0.95, 0.65))
    sun = Sun(direction(0.3, np.radians(elevation_deg)))
    sky = photometry.sky_model(sun)
    up_squared, azimuth_turns = qmc.Sobol(2, rng=np.random.default_rng(2)).random_base2(14).T
    up, horizontal, azimuth = np.sqrt(up_squared), np.sqrt(1.0 - up_squared), 2.0 * np.pi * azimuth_turns
    directions = np.stack([horizontal * np.sin(azimuth), horizontal * np.cos(azimuth), up], axis=1)
    cos_sun_angles = directions @ sun.direction
    # The directions have a density proportional to the sine of elevation. Angles of at least 1e-3 rad from the sun
    # exclude the solar disc.
    mu, cos_g = to_device(Float64, directions[:, 2]), to_device(Float64, np.minimum(cos_sun_angles, np.cos(1e-3)))
    brightness = to_host(sky.radiance(Float64(sun.direction[2]), Float64(1e-9), mu, cos_g, Float64(1e-3)))
    t = depth * (1.0 - 0.95 * 0.65**2)
    multiple = np.mean(to_host(sky.diffuse)[0] * (1.0 - np.exp(-t / directions[:, 2])))
    # The forward peak (0.65**2 of the singly scattered light) counts as direct sunlight.
    single_scattering = np.mean(brightness) - multiple
    assert multiple + (1.0 - 0.65**2) * single_scattering == pytest.approx(0.25, rel=0.01)


def test_sky_radiance_matches_the_formula(renderer: Renderer) -> None:
    """Single scattering by the Henyey-Greenstein phase function, plus the light of an isotropic layer.

    mu and mu0 are the sines of the elevations of view and sun. The optical depth excludes the forward peak.
    """
    camera, sun = _make_sky_camera(), Sun(direction(np.radians(160.0), np.radians(35.0)))
    frame = _render_from_mast(renderer, camera, sun, DUSTY)
    _, directions = camera.rays(camera.pixel_grid())
    is_sky = ~np.isfinite(frame.range_m) & (directions[..., 2] > 0.01)
    mu, mu0 = directions[..., 2][is_sky], sun.direction[2]
    phase = (1 - 0.65**2) / (1 + 0.65**2 - 2 * 0.65 * (directions @ sun.direction)[is_sky]) ** 1.5
    depth = 0.5 * (1.0 - 0.95 * 0.65**2)
    single_scattering = 0.95 * 0.5 / (4.0 * depth) * phase * mu0 / (mu0 - mu) * (1.0 - np.exp(depth / mu0 - depth / mu))
    assert single_scattering.min() > 0.0
    # The remainder is that of a layer with a uniform source function.
    source = (frame.radiance[is_sky] - single_scattering) / (1.0 - np.exp(-depth / mu))
    assert source.mean() > 0.01
    np.testing.assert_allclose(source, source.mean(), rtol=1e-2)


def test_solar_disc_contains_the_direct_irradiance(renderer: Renderer) -> None:
    camera = _make_sky_camera(400)
    sun = Sun(direction(np.radians(3.0), np.radians(14.0)))
    frame = _render_from_mast(renderer, camera, sun, DUSTY)
    is_disc = frame.radiance > 1000.0
    solid_angle = np.square(PixelRays.from_camera(camera).pixel_angles.reshape(is_disc.shape))
    # The radiance factor is pi times the radiance divided by the irradiance of a plane that faces the sun.
    assert (frame.radiance * solid_angle)[is_disc].sum() == pytest.approx(np.pi, rel=0.03)
    expected, visible = camera.project(1e9 * sun.direction)
    assert visible
    rows, columns = np.nonzero(is_disc)
    assert np.abs([columns.mean() - expected[0], rows.mean() - expected[1]]).max() < 0.25


def test_uniform_sky_has_no_solar_disc(renderer: Renderer) -> None:
    sun = Sun(direction(np.radians(3.0), np.radians(14.0)))
    frame = _render_from_mast(renderer, _make_sky_camera(), sun, Photometry(sky_radiance=0.3))
    assert set(frame.radiance[~np.isfinite(frame.range_m)]) == {np.float32(0.3)}


@pytest.mark.parametrize(
    ("depth", "albedo", "asymmetry"),
    [(0.0, 0.9, 0.6), (-1.0, 0.9, 0.6), (0.5, 0.9, 1.0), (0.5, 0.9, -0.1), (0.5, 0.0, 0.6), (0.5, 1.1, 0.6)],
)
def test_invalid_sky_is_rejected(depth: float, albedo: float, asymmetry: float) -> None:
    with pytest.raises(ValueError, match="dusty sky of optical depth"):
        DustySky(depth, albedo, asymmetry)


ALBEDO = 0.3
SUN = Sun(direction(np.radians(130.0), np.radians(50.0)))


def _make_layer(seed: int = 1, **changes: float) -> CloudLayer:
    return CloudLayer.draw(CloudParameters(**changes), np.random.default_rng(seed))


def _make_scene(clouds: CloudLayer | None, photometry: Photometry = LAMBERT) -> Scene:
    return Scene(flat_ground(64, 64.0, ALBEDO), (0.0, 0.0), SUN, photometry, clouds=clouds, edge_rays=1)


def _render_from_above(
    renderer: Renderer,
    scene: Scene,
    camera: CameraModel,
    time_s: float = 0.0,
    position_m: tuple[float, float] = (100.0, 300.0),
) -> Frame:
    pose = rigid(Rotation.from_euler("z", 25.0, degrees=True), np.array([*position_m, 2000.0]))
    return renderer.render(scene, PixelRays.from_camera(camera), pose, time_s)


@pytest.mark.parametrize("cover", [0.1, 0.3, 0.6])
def test_cover_and_size_equal_the_parameters(cover: float) -> None:
    layers = [_make_layer(seed, cover=cover, size_m=900.0, edge_m=20.0) for seed in range(4)]
    assert np.mean([layer.cover.mean() for layer in layers]) == pytest.approx(cover, rel=0.01)
    is_cloud = np.stack([layer.cover > 0.5 for layer in layers])
    n_crossings = np.count_nonzero(is_cloud & ~np.roll(is_cloud, 1, axis=2))
    # The size is the mean length of clouds along the rows. The 1024 rows cross about 400 clouds per layer.
    assert is_cloud.sum() / n_crossings * layers[0].cell_m == pytest.approx(900.0, rel=0.05)


def test_rendered_transmittance_equals_truth(renderer: Renderer) -> None:
    scene = _make_scene(_make_layer(seed=3, asymmetry=0.0, optical_depth=2.0))
    frame = _render_from_above(renderer, scene, descent_camera(128), time_s=12.0)
    transmittance = scene.clouds.transmittance(frame.points_world(), SUN, 12.0)
    sky_light = scene.clouds.parameters.sky_light(SUN)
    expected = ALBEDO * (SUN.direction[2] * transmittance + sky_light)
    np.testing.assert_allclose(frame.radiance, expected, rtol=2e-5, atol=1e-6)
    assert 0.1 < np.mean(transmittance < 0.5) < 0.9
    assert transmittance.min() == pytest.approx(np.exp(-2.0 / np.sin(np.radians(50.0))), rel=1e-3)


def test_shadows_move_with_the_wind(renderer: Renderer) -> None:
    """From a camera that drifts with the wind, the shadows on uniform ground are static."""
    scene, camera = _make_scene(_make_layer(wind_east_m_s=9.0, wind_north_m_s=-4.0)), descent_camera(128)
    first = _render_from_above(renderer, scene, camera, 5.0)
    moving = _render_from_above(renderer, scene, camera, 8.75, position_m=(100.0 + 3.75 * 9.0, 300.0 - 3.75 * 4.0))
    fixed_camera = _render_from_above(renderer, scene, camera, 8.75)
    assert np.ptp(first.radiance) > 0.1
    # An error of 0.13 m (a hundredth of a pixel) would change the radiance at the 40 m wide edges by up to 7e-4.
    assert np.abs(moving.radiance - first.radiance).max() < 1e-4
    assert np.abs(fixed_camera.radiance - first.radiance).max() > 0.05


def test_zero_cover_is_bitwise_equal_to_no_clouds(renderer: Renderer, terrain: Surface) -> None:
    camera = PixelRays.from_camera(descent_camera(128))
    pose = rigid(Rotation.identity(), np.array([380.0, 200.0, 900.0]))
    clear_scene = Scene(terrain, (380.0, 200.0), SUN, Photometry())
    zero_cover_scene = replace(clear_scene, clouds=_make_layer(cover=0.0))
    assert (
        renderer.render(clear_scene, camera, pose).radiance.tobytes()
        == renderer.render(zero_cover_scene, camera, pose, 40.0).radiance.tobytes()
    )


def test_scattered_light_does_not_exceed_the_removed_light() -> None:
    for depth in (0.0, 0.5, 5.0, 50.0):
        parameters = CloudParameters(optical_depth=depth, cover=0.4)
        removed_light = 0.4 * (1.0 - parameters.direct_transmittance(SUN)) * SUN.direction[2]
        assert 0.0 <= parameters.sky_light(SUN) <= removed_light
    assert CloudParameters(optical_depth=0.0).sky_light(SUN) == 0.0


def test_equal_generators_draw_equal_clouds() -> None:
    assert _make_layer(7).cover.tobytes() == _make_layer(7).cover.tobytes()
    assert _make_layer(7).cover.tobytes() != _make_layer(8).cover.tobytes()


def test_clouds_cast_no_shadow_without_direct_sunlight(renderer: Renderer) -> None:
    hills = make_ground(np.random.default_rng(3).uniform(0.0, 40.0, (64, 64)), 64.0)
    sun = Sun(direction(1.0, 0.0))
    scenes = (replace(_make_scene(clouds), surface=hills, sun=sun) for clouds in (_make_layer(), None))
    cloudy, clear = (_render_from_above(renderer, scene, descent_camera(64)).radiance for scene in scenes)
    assert np.all(np.isfinite(clear))
    np.testing.assert_array_equal(cloudy, clear)


def test_transmittance_of_the_sky_is_nan() -> None:
    points = np.array([[np.nan, np.nan, np.nan], [3.0, 4.0, 5.0]])
    transmittance = _make_layer().transmittance(points, SUN, 0.0)
    assert np.isnan(transmittance[0])
    assert 0.0 < transmittance[1] <= 1.0


LEVEL = flat_ground(64, 1.0)
#: Attitude of a camera that looks east by north, 3 deg upwards.
UPWARDS = Rotation.from_euler("ZY", [13.0, -3.0], degrees=True)


@pytest.mark.parametrize("transmission", [0.5, 1.0])
def test_relief_hides_the_sky_below_its_upper_edge(renderer: Renderer, transmission: float) -> None:
    """A ridge of constant elevation, seen from two positions: brightness, haze, and the place of its edge."""
    ridge = Relief(np.full((1, 64), 0.05, np.float32), np.array([transmission]), np.zeros(1), 0.4)
    sun, photometry = Sun(direction(0.0, np.radians(60.0))), replace(LAMBERT, sky_radiance=0.05)
    scene = Scene(LEVEL, (8.0, 8.0), sun, photometry, horizon=ridge, mesh_finest_m=0.2, mesh_half_width_m=60.0)
    rays = PixelRays.from_camera(Cahv.from_field_of_view(0.4, (200, 200), **FORWARD))
    for east_m in (8.0, 30.0):
        frame = renderer.render(scene, rays, rigid(UPWARDS, np.array([east_m, 8.0, 1.5])))
        up = rays.directions.reshape(200, 200, 3) @ frame.world_from_body.rotation.as_matrix()[2]
        tangent, is_sky = up / np.sqrt(1.0 - up**2), np.isinf(frame.range_m)
        edge = 0.8 * 0.4 / 200
        assert np.all(frame.radiance[is_sky & (tangent > 0.05 + edge)] == np.float32(0.05))
        # level ground under this sun: A (sin 60 + D), behind air of the sky's brightness
        face = 0.4 * (np.sin(np.radians(60.0)) + photometry.sky_fraction)
        expected = 0.05 + transmission * (face - 0.05)
        np.testing.assert_allclose(
            frame.radiance[is_sky & (tangent > 0.01) & (tangent < 0.05 - edge)], expected, rtol=1e-3
        )
