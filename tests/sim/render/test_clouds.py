"""Tests of cloud layers: cover, transmittance, motion and scattered light."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.sim.camera import Cahvor, CameraModel
from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import CloudLayer, CloudParameters, Frame, Photometry, PixelRays, Renderer, Scene, Sun
from marsyard.sim.terrain import Surface

ALBEDO = 0.3
SUN = Sun(direction(np.radians(130.0), np.radians(50.0)))
#: With this law the radiance is albedo times the cosine of incidence times the transmittance of the clouds.
LAMBERT = Photometry(lunar_fraction=0.0, surge_amplitude=0.0, sky_fraction=0.0, surrounding_albedo=0.0)


def _make_flat_ground() -> Surface:
    samples = np.zeros((64, 64, 2), dtype=np.float32)
    samples[..., 1] = ALBEDO
    return Surface.from_samples(samples, 64.0)


def _make_layer(seed: int = 1, **changes: float) -> CloudLayer:
    return CloudLayer.draw(CloudParameters(**changes), np.random.default_rng(seed))


def _make_scene(clouds: CloudLayer | None, photometry: Photometry = LAMBERT) -> Scene:
    return Scene(_make_flat_ground(), (0.0, 0.0), SUN, photometry, clouds=clouds, edge_rays=1)


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


def test_direct_sunlight_is_attenuated_by_the_optical_depth(
    renderer: Renderer, descent_camera: Callable[..., Cahvor]
) -> None:
    layer = _make_layer(cover=0.4, optical_depth=1.0, edge_m=10.0)
    frame = _render_from_above(renderer, _make_scene(layer), descent_camera(128))
    elevation = np.radians(50.0)
    sunlight = ALBEDO * np.sin(elevation)
    skylight = layer.parameters.sky_light(SUN) * ALBEDO
    assert frame.radiance.max() == pytest.approx(sunlight + skylight, rel=1e-4)
    assert frame.radiance.min() == pytest.approx(sunlight * np.exp(-1.0 / np.sin(elevation)) + skylight, rel=1e-3)


def test_rendered_transmittance_equals_truth(renderer: Renderer, descent_camera: Callable[..., Cahvor]) -> None:
    scene = _make_scene(_make_layer(seed=3, asymmetry=0.0, optical_depth=100.0))
    frame = _render_from_above(renderer, scene, descent_camera(128), time_s=12.0)
    assert scene.clouds is not None
    transmittance = scene.clouds.transmittance(frame.points_world(), SUN, 12.0)
    sky_light = scene.clouds.parameters.sky_light(SUN)
    expected = ALBEDO * (SUN.direction[2] * transmittance + sky_light)
    np.testing.assert_allclose(frame.radiance, expected, rtol=2e-5, atol=1e-6)
    assert 0.1 < np.mean(transmittance < 0.5) < 0.9


def test_shadows_move_with_the_wind(renderer: Renderer, descent_camera: Callable[..., Cahvor]) -> None:
    """From a camera that drifts with the wind, the shadows on uniform ground are static."""
    scene, camera = _make_scene(_make_layer(wind_east_m_s=9.0, wind_north_m_s=-4.0)), descent_camera(128)
    first = _render_from_above(renderer, scene, camera, 5.0)
    moving_camera = _render_from_above(
        renderer, scene, camera, 8.75, position_m=(100.0 + 3.75 * 9.0, 300.0 - 3.75 * 4.0)
    )
    fixed_camera = _render_from_above(renderer, scene, camera, 8.75)
    assert np.ptp(first.radiance) > 0.1
    # An error of 0.13 m (a hundredth of a pixel) would change the radiance at the 40 m wide edges by up to 7e-4.
    assert np.abs(moving_camera.radiance - first.radiance).max() < 1e-4
    assert np.abs(fixed_camera.radiance - first.radiance).max() > 0.05


def test_zero_cover_is_bitwise_equal_to_no_clouds(
    renderer: Renderer, descent_camera: Callable[..., Cahvor], terrain: Surface
) -> None:
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


def test_transmittance_of_the_sky_is_nan() -> None:
    points = np.array([[np.nan, np.nan, np.nan], [3.0, 4.0, 5.0]])
    transmittance = _make_layer().transmittance(points, SUN, 0.0)
    assert np.isnan(transmittance[0])
    assert 0.0 < transmittance[1] <= 1.0
