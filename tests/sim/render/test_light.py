"""Tests of rendered brightness against reflectance formulas."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.camera import Cahvor, CameraModel
from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import Photometry, PixelRays, Renderer, Scene, Sun
from marsyard.sim.terrain import Surface

#: Pose of a camera 1 km above the origin that looks down.
NADIR = rigid(Rotation.identity(), np.array([0.0, 0.0, 1000.0]))


def _make_surface(heights: np.ndarray, albedo: float = 0.2) -> Surface:
    samples = np.empty((*heights.shape, 2), dtype=np.float32)
    samples[..., 0] = heights
    samples[..., 1] = albedo
    return Surface.from_samples(samples, 8.0)


FLAT = _make_surface(np.zeros((256, 256)))


def _render(
    renderer: Renderer, camera: CameraModel, surface: Surface, sun: Sun, law: Photometry, pose: RigidTransform = NADIR
) -> np.ndarray:
    radiance: np.ndarray = renderer.render(
        Scene(surface, (0.0, 0.0), sun, law), PixelRays.from_camera(camera), pose
    ).radiance
    return radiance


def test_lambert_plane_follows_the_cosine_law(renderer: Renderer, descent_camera: Callable[..., Cahvor]) -> None:
    sun = Sun(direction(np.radians(70.0), np.radians(35.0)))
    law = Photometry(lunar_fraction=0.0, surge_amplitude=0.0, sky_fraction=0.0)
    radiance = _render(renderer, descent_camera(128), FLAT, sun, law)
    np.testing.assert_allclose(radiance, 0.2 * np.sin(np.radians(35.0)), rtol=1e-5)


def test_lunar_lambert_matches_the_formula(renderer: Renderer, descent_camera: Callable[..., Cahvor]) -> None:
    camera = descent_camera(64)
    sun = Sun(direction(np.radians(200.0), np.radians(50.0)))
    law = Photometry(
        lunar_fraction=0.6, surge_amplitude=0.8, surge_width=0.05, sky_fraction=0.2, surrounding_albedo=0.0
    )
    _, to_ground = camera.rays(camera.pixel_grid())
    # Cosines of the angles of incidence and emission.
    cos_i, cos_e = sun.direction[2], -to_ground[..., 2]
    phase = np.arccos(-to_ground @ sun.direction)

    def compute_surge(phase_angle: np.ndarray) -> np.ndarray:
        return 1 + 0.8 / (1 + np.tan(phase_angle / 2) / 0.05)

    disc = 0.6 * 2 * cos_i / (cos_i + cos_e) + 0.4 * cos_i
    expected = 0.2 * (law.normalisation() * compute_surge(phase) * disc + 0.2)
    np.testing.assert_allclose(_render(renderer, camera, FLAT, sun, law), expected, rtol=1e-4)


def test_opposition_spot_is_at_the_antisolar_point(renderer: Renderer, descent_camera: Callable[..., Cahvor]) -> None:
    camera = descent_camera()
    sun = Sun(direction(np.radians(30.0), np.radians(80.0)))
    law = Photometry(lunar_fraction=0.0, surge_amplitude=1.0, surge_width=0.02, sky_fraction=0.0)
    radiance = _render(renderer, camera, FLAT, sun, law)
    expected, visible = camera.transform(NADIR).project(NADIR.translation - 500.0 * sun.direction)
    assert visible
    peak = np.unravel_index(radiance.argmax(), radiance.shape)
    # The brightest pixel is the nearest to the antisolar point.
    assert np.abs(np.array(peak[::-1]) - expected).max() <= 0.51


def test_slopes_facing_the_sun_are_brighter(renderer: Renderer, descent_camera: Callable[..., Cahvor]) -> None:
    x = np.arange(256) * 8.0
    heights = np.broadcast_to(20.0 * np.sin(2 * np.pi * x / 512.0), (256, 256))
    law = Photometry(lunar_fraction=0.0, surge_amplitude=0.0, sky_fraction=0.0)
    camera = descent_camera(256)
    # The ground faces the eastern sun where its height decreases with x.
    eastern_sun = Sun(direction(np.radians(90.0), np.radians(40.0)))
    frame = renderer.render(
        Scene(_make_surface(heights), (0.0, 0.0), eastern_sun, law), PixelRays.from_camera(camera), NADIR
    )
    is_facing_east = np.cos(2 * np.pi * frame.points_world()[..., 0] / 512.0) < -0.5
    is_facing_west = np.cos(2 * np.pi * frame.points_world()[..., 0] / 512.0) > 0.5
    assert frame.radiance[is_facing_east].min() > frame.radiance[is_facing_west].max()


def test_ground_facing_away_receives_only_sky_light(renderer: Renderer, descent_camera: Callable[..., Cahvor]) -> None:
    x = np.arange(256) * 8.0
    heights = np.broadcast_to(40.0 * np.sin(2 * np.pi * x / 512.0), (256, 256))
    low_sun = Sun(direction(np.radians(90.0), np.radians(5.0)))
    without_sky = _render(
        renderer,
        descent_camera(128),
        _make_surface(heights),
        low_sun,
        Photometry(sky_fraction=0.0, surrounding_albedo=0.0),
    )
    assert without_sky.min() == 0.0
    with_sky = _render(renderer, descent_camera(128), _make_surface(heights), low_sun, Photometry(sky_fraction=0.15))
    # Sky fraction times albedo, with a margin of 10 %.
    assert with_sky.min() > 0.15 * 0.2 * 0.9


def test_albedo_finer_than_a_pixel_is_averaged(renderer: Renderer, descent_camera: Callable[..., Cahvor]) -> None:
    """Stripes four times finer than a pixel appear as their mean, without aliasing."""
    samples = np.zeros((512, 512, 2), dtype=np.float32)
    samples[..., 1] = 0.2
    samples[:, ::2, 1] = 0.4
    stripes = Surface.from_samples(samples, 1.0)
    law = Photometry(lunar_fraction=0.0, surge_amplitude=0.0, sky_fraction=0.0)
    overhead = Sun(np.array([0.0, 0.0, 1.0]))
    pose = rigid(Rotation.from_euler("z", 33.0, degrees=True), np.array([0.0, 0.0, 1200.0]))
    radiance = _render(renderer, descent_camera(128), stripes, overhead, law, pose)
    np.testing.assert_allclose(radiance, 0.3, rtol=0.01)


def test_sun_must_be_a_unit_vector() -> None:
    with pytest.raises(ValueError, match="not a unit vector"):
        Sun(np.array([0.0, 0.0, 2.0]))
