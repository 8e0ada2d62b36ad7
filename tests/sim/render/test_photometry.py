"""Tests of the rendered reflectance law: brightness, reciprocity, integrated albedo, opposition peak and texture."""

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import qmc

from marsyard.sim.camera import Cahv, Cahvore, CameraModel
from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import Photometry, PixelRays, Renderer, Scene, Sun
from marsyard.sim.render.arrays import to_device, to_host, vectors_to_device
from marsyard.sim.render.device import Array3f64, Bool, Float, Float64, UInt32
from marsyard.sim.render.noise import noise_in_space
from marsyard.sim.render.texture import MIN_CELLS, NOISE_VARIANCE, Octaves, log_relative_albedo
from marsyard.sim.terrain import Surface, sites
from tests.sim.scenes import DOWN, descent_camera, flat_ground, make_ground

LAWS = {
    "Lambert": Photometry(lunar_fraction=0.0, surge_amplitude=0.0),
    "Mars": Photometry(),
    "narrow surge": Photometry(lunar_fraction=1.0, surge_amplitude=1.5, surge_width=0.01),
}
with_each_law = pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)


@with_each_law
def test_albedo_is_the_reflected_fraction_of_light(law: Photometry) -> None:
    """For sun and eye directions with a cosine density, the mean of (I/F) / cos i is the spherical albedo."""
    sin2_i, sin2_e, turns = qmc.Sobol(3, rng=np.random.default_rng(1)).random_base2(17).T
    cos_i, cos_e = np.sqrt(1.0 - sin2_i), np.sqrt(1.0 - sin2_e)
    phase_angle = np.arccos(np.clip(cos_i * cos_e + np.sqrt(sin2_i * sin2_e) * np.cos(2.0 * np.pi * turns), -1.0, 1.0))
    surge = 1.0 + law.surge_amplitude / (1.0 + np.tan(0.5 * phase_angle) / law.surge_width)
    disc = 2.0 * law.lunar_fraction * cos_i / (cos_i + cos_e) + (1.0 - law.lunar_fraction) * cos_i
    assert law.normalisation() * np.mean(surge * disc / cos_i) == pytest.approx(1.0, rel=0.01)


FISHEYE = Cahvore.from_cahv(
    Cahv.from_focal_length(5.58e-3, 150e-6, (64, 64), **DOWN), r=np.array([0.0, -0.02, 0.002]), e=np.full(3, 0.006),
    linearity=-0.1,
)  # fmt: skip


#: Pose of a camera 1 km above the origin that looks down.
NADIR = rigid(Rotation.identity(), np.array([0.0, 0.0, 1000.0]))


FLAT = flat_ground(256)


def _render_ground(
    renderer: Renderer, camera: CameraModel, surface: Surface, sun: Sun, law: Photometry, pose: RigidTransform = NADIR
) -> np.ndarray:
    scene = Scene(surface, (0.0, 0.0), sun, law)
    return np.asarray(renderer.render(scene, PixelRays.from_camera(camera), pose).radiance)


@pytest.mark.parametrize("camera", [descent_camera(64), FISHEYE])
def test_lunar_lambert_matches_the_formula(renderer: Renderer, camera: CameraModel) -> None:
    """The image contains the antisolar point, where the opposition surge has its peak."""
    sun = Sun(direction(np.radians(200.0), np.radians(75.0)))
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
    np.testing.assert_allclose(_render_ground(renderer, camera, FLAT, sun, law), expected, rtol=1e-4)


def test_ground_facing_away_receives_only_sky_light(renderer: Renderer) -> None:
    x = np.arange(256) * 8.0
    heights = np.broadcast_to(40.0 * np.sin(2 * np.pi * x / 512.0), (256, 256))
    low_sun = Sun(direction(np.radians(90.0), np.radians(5.0)))
    without_sky, with_sky = (
        _render_ground(renderer, descent_camera(128), make_ground(heights, 8.0), low_sun, law)
        for law in (Photometry(sky_fraction=0.0, surrounding_albedo=0.0), Photometry(sky_fraction=0.15))
    )
    assert without_sky.min() == 0.0
    # Sky fraction times albedo, with a margin of 10 %.
    assert with_sky.min() > 0.15 * 0.2 * 0.9


def test_albedo_finer_than_a_pixel_is_averaged(renderer: Renderer) -> None:
    """Stripes four times finer than a pixel appear as their mean, without aliasing."""
    samples = np.zeros((512, 512, 2), dtype=np.float32)
    samples[..., 1] = 0.2
    samples[:, ::2, 1] = 0.4
    stripes = Surface.from_samples(samples, 1.0)
    law = Photometry(lunar_fraction=0.0, surge_amplitude=0.0, sky_fraction=0.0)
    overhead = Sun(np.array([0.0, 0.0, 1.0]))
    pose = rigid(Rotation.from_euler("z", 33.0, degrees=True), np.array([0.0, 0.0, 1200.0]))
    radiance = _render_ground(renderer, descent_camera(128), stripes, overhead, law, pose)
    np.testing.assert_allclose(radiance, 0.3, rtol=0.01)


def test_sun_must_be_a_unit_vector() -> None:
    with pytest.raises(ValueError, match="not a unit vector"):
        Sun(np.array([0.0, 0.0, 2.0]))


POSITIONS = np.random.default_rng(5).uniform(-500.0, 500.0, (60000, 3))


def _log_albedo(positions: np.ndarray, footprint_m: np.ndarray, coarsest_m: float, octaves: np.ndarray) -> np.ndarray:
    """Compute the logarithm of the relative albedo at positions, shape (n, 3)."""
    texture, no_texture = Octaves.of(coarsest_m, octaves), Octaves.of(1.0, ())
    points, footprint = vectors_to_device(Array3f64, positions), to_device(Float, footprint_m)
    on_ground = log_relative_albedo(texture, no_texture, Bool(False), points, footprint, Float(1.0))
    on_objects = log_relative_albedo(no_texture, texture, Bool(True), points, footprint, Float(1.0))
    np.testing.assert_array_equal(to_host(on_ground), to_host(on_objects))
    return to_host(on_ground).astype(np.float64)


def test_noise_has_the_specified_variance() -> None:
    noise = to_host(noise_in_space(list(vectors_to_device(Array3f64, POSITIONS)), Float64(1.0), UInt32(1)))
    assert np.mean(noise) == pytest.approx(0.0, abs=0.005)
    assert np.mean(noise**2) == pytest.approx(NOISE_VARIANCE, rel=0.02)


@pytest.mark.parametrize("footprint_m", [1e-4, 3e-3, 0.1])
def test_mean_albedo_is_unchanged_at_any_distance(footprint_m: float) -> None:
    texture = max((site.ground_texture for site in sites().values()), key=lambda texture: max(texture.amplitudes))
    octaves = np.array(texture.amplitudes)
    log_albedo = _log_albedo(POSITIONS, np.full(len(POSITIONS), footprint_m), texture.coarsest_m, octaves)
    assert np.mean(np.exp(log_albedo)) == pytest.approx(1.0, abs=0.005)


def test_detail_finer_than_a_footprint_is_removed() -> None:
    positions, footprint_m = np.tile([0.3, 0.4, 0.1], (3, 1)), np.array([1.001 / MIN_CELLS, 0.2, np.inf])
    log_albedo = _log_albedo(positions, footprint_m, 1.0, np.array([0.2, 0.3]))
    assert log_albedo[0] == 0.0
    assert log_albedo[1] != 0.0
    assert log_albedo[2] == 0.0


@pytest.mark.parametrize("cell_px", [4, 3, 2])
def test_octave_is_attenuated_as_by_averaging_over_a_pixel(cell_px: float) -> None:
    """The RMS on a plane through the noise is that of the average over ten samples per pixel in each direction."""
    samples_per_pixel, side = 10, 400
    rng = np.random.default_rng(7)
    plane_axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    y, x = np.mgrid[:side, :side].reshape(2, -1) / samples_per_pixel / cell_px
    positions = 50.0 + x[:, None] * plane_axes[0] + y[:, None] * plane_axes[1]
    sharp, attenuated = (
        _log_albedo(positions, np.full(len(positions), footprint_m), 1.0, np.array([0.1]))
        for footprint_m in (1e-6, 1.0 / cell_px)
    )
    # The kernel uses the attenuation of the median wavelength of the octave.
    pixel_means = ndimage.uniform_filter(sharp.reshape(side, side), samples_per_pixel, mode="nearest")
    assert np.std(attenuated) / np.std(sharp) == pytest.approx(np.std(pixel_means) / np.std(sharp), abs=0.03)


def _make_fisheye_camera() -> Cahvore:
    pinhole = Cahv.from_focal_length(5.58e-3, 24e-6, (512, 512), **DOWN)
    return Cahvore.from_cahv(pinhole, r=np.array([0.0, -0.02, 0.002]), e=np.full(3, 0.006), linearity=-0.1)


@pytest.mark.parametrize("is_fisheye", [False, True])
def test_opposition_peak_is_at_the_antisolar_point(renderer: Renderer, is_fisheye: bool) -> None:
    """The centroid of the peak is within half a pixel of the antisolar point."""
    camera = _make_fisheye_camera() if is_fisheye else descent_camera(512)
    law = Photometry(lunar_fraction=0.0, surge_amplitude=1.0, surge_width=0.02, sky_fraction=0.0)
    pose = rigid(Rotation.from_euler("zx", [40.0, 8.0], degrees=True), np.array([0.0, 0.0, 800.0]))
    for antisolar_pixel in np.array([[150.3, 201.8], [330.6, 255.1]]):
        _, ray = camera.transform(pose).rays(antisolar_pixel)
        frame = renderer.render(Scene(FLAT, (0.0, 0.0), Sun(-ray), law), PixelRays.from_camera(camera), pose)
        radiance = frame.radiance.astype(np.float64)
        weight = np.clip(radiance - radiance.max() + 0.1 * np.ptp(radiance), 0.0, None)
        v, u = np.mgrid[:512, :512]
        peak = np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()
        assert np.linalg.norm(peak - antisolar_pixel) < 0.5
