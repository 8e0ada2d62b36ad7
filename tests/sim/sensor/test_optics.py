"""Tests of the optics model: point spread, defocus, stray light, fall-off and dust."""

import numpy as np
import pytest

from marsyard.sim.camera import Cahv, Cahvore
from marsyard.sim.sensor import Detector, DetectorParameters, natural_fall_off
from marsyard.sim.sensor.optics import OpticsParameters, apply_point_spread, dust_transmission, line_spread
from tests.sim.scenes import DOWN

OPTICS = OpticsParameters()


@pytest.mark.parametrize(
    "parameters", [OPTICS, OpticsParameters(pixel_aperture=True), OpticsParameters(diffusion_px=1.0)]
)
def test_point_spread_preserves_total_light_and_position(parameters: OpticsParameters) -> None:
    scene = np.zeros((41, 41), dtype=np.float32)
    scene[20, 17] = 1.0
    image = apply_point_spread(scene, parameters).astype(np.float64)
    assert image.sum() == pytest.approx(1.0, abs=1e-6)
    assert image[20, 17] < 0.8
    rows, columns = np.indices(image.shape)
    assert (image * rows).sum() / image.sum() == pytest.approx(20.0, abs=1e-3)
    assert (image * columns).sum() / image.sum() == pytest.approx(17.0, abs=1e-3)


def test_point_spread_has_the_specified_modulation_transfer() -> None:
    """The modulation has a closed form; light beyond the ends of the kernel is the tolerance."""
    frequency = np.array([0.02, 0.05, 0.1, 0.25, 0.5])
    # Spatial frequency s relative to the cut-off of diffraction.
    s = frequency * OPTICS.diffraction_px
    diffraction = 2.0 / np.pi * (np.arccos(s) - s * np.sqrt(1.0 - s * s))
    diffusion = np.exp(-2.0 * (np.pi * OPTICS.diffusion_px * frequency) ** 2)
    np.testing.assert_allclose(_modulation(OPTICS, frequency), diffraction * diffusion, atol=0.01)


def _modulation(parameters: OpticsParameters, frequency: np.ndarray) -> np.ndarray:
    taps = line_spread(parameters)
    return np.cos(2.0 * np.pi * frequency[:, None] * (np.arange(taps.size) - taps.size // 2)) @ taps


def test_zero_spread_returns_the_scene() -> None:
    scene = np.random.default_rng(0).random((8, 8), dtype=np.float32)
    assert apply_point_spread(scene, OpticsParameters(diffraction_px=0.0, diffusion_px=0.0)) is scene


def test_perspective_fall_off_is_cosine_to_the_fourth() -> None:
    camera = Cahv.from_field_of_view(np.radians(60.0), (101, 101), **DOWN)
    fall_off = natural_fall_off(camera)
    assert fall_off[50, 50] == pytest.approx(1.0)
    cosine = camera.rays(camera.pixel_grid())[1] @ camera.a
    # The tolerance covers finite differences over pixels of 0.6 deg.
    np.testing.assert_allclose(fall_off, cosine**4, rtol=2e-3)


def test_equidistant_fisheye_fall_off_matches_formula() -> None:
    """The solid angle of a pixel decreases with sin(theta) / theta, and the pupil tilts by a twentieth of theta."""
    pinhole = Cahv.from_focal_length(5.58e-3, 96e-6, (128, 128), **DOWN)
    camera = Cahvore.from_cahv(pinhole, r=np.zeros(3), linearity=0.0)
    theta = np.arccos(np.clip(camera.rays(camera.pixel_grid())[1] @ camera.a, -1.0, 1.0))
    expected = np.cos(0.95 * theta) * np.sinc(theta / np.pi)
    np.testing.assert_allclose(natural_fall_off(camera)[20:-20, 20:-20], expected[20:-20, 20:-20], rtol=5e-3)


def test_dust_attenuates_light_and_is_absent_from_the_flat_field() -> None:
    dusty = OpticsParameters(dust_discs=4, dust_depth=0.4, dust_radius_px=12.0)
    transmission = dust_transmission((128, 128), dusty, np.random.default_rng(4))
    assert transmission.max() == 1.0
    assert 0.6**4 <= transmission.min() <= 0.6 + 1e-6
    # Four shadows of 12 px in an image of 128 px cover about 11 %.
    assert 0.03 < (transmission < 0.99).mean() < 0.4
    # The smooth step of an edge has a slope of up to 1.5 over its width, which is at least the minimum radius of 8 px.
    assert np.abs(np.diff(transmission, axis=1)).max() < 0.4 * 1.5 / 8.0
    flat = np.ones((128, 128), dtype=np.float32)
    clean, with_dust = (
        Detector.draw(flat, DetectorParameters(optics=optics), np.random.default_rng(1)) for optics in (OPTICS, dusty)
    )
    assert with_dust.response.sum() < clean.response.sum()
    np.testing.assert_array_equal(with_dust.calibration.flat_field, clean.calibration.flat_field)


@pytest.mark.parametrize("diameter", [1.0, 2.5])
def test_defocus_has_the_transfer_of_a_uniform_disc(diameter: float) -> None:
    sharp_optics, defocused_optics = (
        OpticsParameters(diffraction_px=0.0, diffusion_px=0.0, defocus_px=defocus_px) for defocus_px in (1e-6, diameter)
    )
    frequency = np.array([0.1, 0.2, 0.3])
    modulation = _modulation(defocused_optics, frequency) / _modulation(sharp_optics, frequency)
    x = np.pi * diameter * frequency
    # Bessel function J1(x): the integral of cos(t - x sin t) from 0 to pi, divided by pi.
    t = np.linspace(0.0, np.pi, 2001)
    bessel = np.trapezoid(np.cos(t - x[:, None] * np.sin(t)), t, axis=1) / np.pi
    np.testing.assert_allclose(modulation, 2.0 * bessel / x, atol=0.02)


def test_stray_light_reduces_contrast_but_not_the_mean() -> None:
    scene = np.random.default_rng(0).uniform(0.1, 0.3, (32, 48)).astype(np.float32)
    no_spread = OpticsParameters(diffraction_px=0.0, diffusion_px=0.0)
    with_stray_light = apply_point_spread(scene, no_spread.model_copy(update={"stray_light": 0.2}))
    assert with_stray_light.mean() == pytest.approx(scene.mean(), rel=1e-5)
    assert with_stray_light.std() == pytest.approx(0.8 * scene.std(), rel=1e-5)
