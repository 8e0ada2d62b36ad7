"""Tests of the rendered reflectance law: reciprocity, albedo by independent integration, opposition peak."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from marsyard.sim.camera import Cahv, Cahvor, Cahvore
from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import Photometry, PixelRays, Renderer, Scene, Sun
from marsyard.sim.terrain import Surface

ALBEDO = 0.2
LAWS = {
    "Lambert": Photometry(lunar_fraction=0.0, surge_amplitude=0.0),
    "Mars": Photometry(),
    "narrow surge": Photometry(lunar_fraction=1.0, surge_amplitude=1.5, surge_width=0.01),
}
with_each_law = pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)


@pytest.fixture(scope="module")
def flat() -> Surface:
    samples = np.zeros((64, 64, 2), dtype=np.float32)
    samples[..., 1] = ALBEDO
    return Surface.from_samples(samples, 64.0)


def _render(renderer: Renderer, flat: Surface, law: Photometry, to_sun: np.ndarray, to_eye: np.ndarray) -> float:
    """Render the radiance factor of flat ground in direct sunlight."""
    camera = Cahv.from_field_of_view(
        horizontal_rad=0.002,
        size=(9, 9),
        centre=np.zeros(3),
        axis=np.array([0.0, 0.0, -1.0]),
        right=np.array([1.0, 0.0, 0.0]),
    )
    pose = rigid(Rotation.align_vectors(-to_eye[None], np.array([[0.0, 0.0, -1.0]]))[0], 100.0 * to_eye)
    scene = Scene(flat, (0.0, 0.0), Sun(to_sun), replace(law, sky_fraction=0.0, surrounding_albedo=0.0))
    return float(renderer.render(scene, PixelRays.from_camera(camera), pose).radiance[4, 4])


@with_each_law
def test_reflectance_law_is_reciprocal(renderer: Renderer, flat: Surface, law: Photometry) -> None:
    rng = np.random.default_rng(9)
    for _ in range(3):
        azimuths, elevations = rng.uniform(0.0, 2.0 * np.pi, 2), np.arcsin(rng.uniform(0.15, 1.0, 2))
        sun, eye = (direction(*angles) for angles in zip(azimuths.tolist(), elevations.tolist(), strict=True))
        forward, backward = _render(renderer, flat, law, sun, eye), _render(renderer, flat, law, eye, sun)
        # I/F divided by the cosine of incidence is pi times the bidirectional reflectance.
        assert forward / sun[2] == pytest.approx(backward / eye[2], rel=1e-5)


@with_each_law
def test_albedo_is_the_reflected_fraction_of_light(law: Photometry) -> None:
    """For sun and eye directions with a cosine density, the mean of (I/F) / cos i is the spherical albedo."""
    sin2_i, sin2_e, azimuth_turns = qmc.Sobol(3, rng=np.random.default_rng(1)).random_base2(17).T
    cos_i, cos_e = np.sqrt(1.0 - sin2_i), np.sqrt(1.0 - sin2_e)
    phase_angle = np.arccos(
        np.clip(cos_i * cos_e + np.sqrt(sin2_i * sin2_e) * np.cos(2.0 * np.pi * azimuth_turns), -1.0, 1.0)
    )
    surge = 1.0 + law.surge_amplitude / (1.0 + np.tan(0.5 * phase_angle) / law.surge_width)
    disc = 2.0 * law.lunar_fraction * cos_i / (cos_i + cos_e) + (1.0 - law.lunar_fraction) * cos_i
    assert law.normalisation() * np.mean(surge * disc / cos_i) == pytest.approx(1.0, rel=0.01)


def _make_fisheye_camera() -> Cahvore:
    pinhole = Cahv.from_focal_length(
        focal_m=5.58e-3,
        pixel_pitch_m=24e-6,
        size=(512, 512),
        centre=np.zeros(3),
        axis=np.array([0.0, 0.0, -1.0]),
        right=np.array([1.0, 0.0, 0.0]),
    )
    return Cahvore.from_cahv(pinhole, r=np.array([0.0, -0.02, 0.002]), e=np.full(3, 0.006), linearity=-0.1)


@pytest.mark.parametrize("is_fisheye", [False, True])
def test_opposition_peak_is_at_the_antisolar_point(
    renderer: Renderer, flat: Surface, descent_camera: Callable[..., Cahvor], is_fisheye: bool
) -> None:
    """The centroid of the peak is within half a pixel of the antisolar point."""
    camera = _make_fisheye_camera() if is_fisheye else descent_camera(512)
    law = Photometry(lunar_fraction=0.0, surge_amplitude=1.0, surge_width=0.02, sky_fraction=0.0)
    pose = rigid(Rotation.from_euler("zx", [40.0, 8.0], degrees=True), np.array([0.0, 0.0, 800.0]))
    for antisolar_pixel in np.array([[150.3, 201.8], [330.6, 255.1]]):
        _, ray = camera.transform(pose).rays(antisolar_pixel)
        frame = renderer.render(Scene(flat, (0.0, 0.0), Sun(-ray), law), PixelRays.from_camera(camera), pose)
        radiance = frame.radiance.astype(np.float64)
        weight = np.clip(radiance - radiance.max() + 0.1 * np.ptp(radiance), 0.0, None)
        v, u = np.mgrid[:512, :512]
        peak = np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()
        assert np.linalg.norm(peak - antisolar_pixel) < 0.5
