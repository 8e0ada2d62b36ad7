"""Tests of sky radiance and irradiance against formulas."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from marsyard.sim.camera import Cahv
from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import DustySky, Frame, Photometry, PixelRays, Renderer, Scene, Sun
from marsyard.sim.render.kernels.photometry import sky_brightness
from marsyard.sim.terrain import Surface

DUSTY = Photometry(sky_share=0.25, sky=DustySky(0.5, 0.95, 0.65))


def _make_flat_ground() -> Surface:
    samples = np.zeros((64, 64, 2), dtype=np.float32)
    samples[..., 1] = 0.2
    return Surface.from_samples(samples, 8.0)


def _make_camera_ahead(size: int = 200) -> Cahv:
    """Return a camera of 40 deg that looks north and up by 10 deg."""
    up = np.radians(10.0)
    return Cahv.from_field_of_view(
        horizontal_rad=np.radians(40.0),
        size=(size, size),
        centre=np.zeros(3),
        axis=np.array([0.0, np.cos(up), np.sin(up)]),
        right=np.array([1.0, 0.0, 0.0]),
    )


def _render_from_mast(renderer: Renderer, camera: Cahv, sun: Sun, photometry: Photometry) -> Frame:
    scene = Scene(_make_flat_ground(), (0.0, 0.0), sun, photometry, mesh_finest_m=0.5, mesh_reach_m=5000.0)
    return renderer.render(scene, PixelRays.of(camera), rigid(Rotation.identity(), np.array([0.0, 0.0, 1.5])))


@pytest.mark.parametrize("elevation_deg", [15.0, 40.0, 90.0])
@pytest.mark.parametrize("depth", [0.1, 0.9, 3.0])
def test_sky_irradiance_on_level_ground_matches_its_fraction(elevation_deg: float, depth: float) -> None:
    law = replace(DUSTY, sky=DustySky(depth, 0.95, 0.65))
    sun = Sun(direction(0.3, np.radians(elevation_deg)))
    numbers = law.sky_coefficients(sun)
    squared, turn = qmc.Sobol(2, rng=np.random.default_rng(2)).random_base2(14).T
    up, level, azimuth = np.sqrt(squared), np.sqrt(1.0 - squared), 2.0 * np.pi * turn
    looks = np.stack([level * np.sin(azimuth), level * np.cos(azimuth), up], axis=1)
    away = looks @ sun.direction
    # Drawn in proportion to the sine of elevation; the solar disc is excluded.
    seen = [
        sky_brightness(numbers, sun.direction[2], 1e-9, look[2], min(cos_g, np.cos(1e-3)), 1e-3)
        for look, cos_g in zip(looks, away, strict=True)
    ]
    # The forward peak, 0.65**2 of singly scattered light, counts as direct sunlight.
    once = np.mean(seen) - numbers[0]
    assert numbers[0] + (1.0 - 0.65**2) * once == pytest.approx(0.25, rel=0.01)


def test_sky_radiance_matches_the_formula(renderer: Renderer) -> None:
    camera, sun = _make_camera_ahead(), Sun(direction(np.radians(160.0), np.radians(35.0)))
    frame = _render_from_mast(renderer, camera, sun, DUSTY)
    _, looks = camera.rays(camera.pixel_grid())
    sky = ~np.isfinite(frame.range_m) & (looks[..., 2] > 0.01)
    mu, mu0 = looks[..., 2][sky], sun.direction[2]
    phase = (1 - 0.65**2) / (1 + 0.65**2 - 2 * 0.65 * (looks @ sun.direction)[sky]) ** 1.5
    depth = 0.5 * (1.0 - 0.95 * 0.65**2)
    once = 0.95 * 0.5 / (4.0 * depth) * phase * mu0 / (mu0 - mu) * (1.0 - np.exp(depth / mu0 - depth / mu))
    assert once.min() > 0.0
    # The remainder is isotropic.
    rest = frame.radiance[sky] - once
    assert rest.mean() > 0.01
    np.testing.assert_allclose(rest, rest.mean(), atol=1e-4)


def test_the_sky_is_brighter_towards_the_sun_and_the_horizon(renderer: Renderer) -> None:
    camera = _make_camera_ahead()
    even = replace(DUSTY, sky=DustySky(0.1, 0.95, 0.0))
    ahead, behind, unbent = (
        _render_from_mast(renderer, camera, Sun(direction(azimuth, np.radians(40.0))), law).radiance[:, 100]
        for azimuth, law in ((0.0, DUSTY), (np.pi, DUSTY), (np.pi, even))
    )
    _, looks = camera.rays(camera.pixel_grid())
    top, middle, low = (int(np.abs(looks[:, 100, 2] - np.sin(np.radians(e))).argmin()) for e in (28.0, 15.0, 1.5))
    assert ahead[top] > 2.0 * behind[top]
    assert unbent[low] > unbent[middle] > unbent[top]


def test_solar_disc_contains_the_direct_irradiance(renderer: Renderer) -> None:
    camera = _make_camera_ahead(400)
    sun = Sun(direction(np.radians(3.0), np.radians(14.0)))
    frame = _render_from_mast(renderer, camera, sun, DUSTY)
    disc = frame.radiance > 1000.0
    angle = np.square(PixelRays.of(camera).pixel_angles.reshape(disc.shape))
    # The radiance factor is pi times radiance over the irradiance of a plane facing the sun.
    assert (frame.radiance * angle)[disc].sum() == pytest.approx(np.pi, rel=0.03)
    at, visible = camera.project(1e9 * sun.direction)
    assert visible
    rows, columns = np.nonzero(disc)
    assert np.abs([columns.mean() - at[0], rows.mean() - at[1]]).max() < 0.25


def test_uniform_sky_has_no_solar_disc(renderer: Renderer) -> None:
    sun = Sun(direction(np.radians(3.0), np.radians(14.0)))
    frame = _render_from_mast(renderer, _make_camera_ahead(), sun, Photometry(sky_radiance=0.3))
    assert set(frame.radiance[~np.isfinite(frame.range_m)]) == {np.float32(0.3)}


@pytest.mark.parametrize(
    ("depth", "albedo", "asymmetry"),
    [(0.0, 0.9, 0.6), (-1.0, 0.9, 0.6), (0.5, 0.9, 1.0), (0.5, 0.9, -0.1), (0.5, 0.0, 0.6), (0.5, 1.1, 0.6)],
)
def test_invalid_sky_is_rejected(depth: float, albedo: float, asymmetry: float) -> None:
    with pytest.raises(ValueError, match="dusty sky of optical depth"):
        DustySky(depth, albedo, asymmetry)
