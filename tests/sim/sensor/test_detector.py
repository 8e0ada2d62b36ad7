"""Tests of detector and optics: noise, smear, dark current, defects, calibration, point spread, fall-off and dust."""

from typing import Any, cast

import numpy as np
import pytest
from scipy import stats
from scipy.ndimage import gaussian_filter

from marsyard.algorithms.image.frame_transfer import remove_frame_transfer
from marsyard.sim.camera import Cahv, Cahvore
from marsyard.sim.sensor import Detector, DetectorParameters, natural_fall_off
from marsyard.sim.sensor.detector import MIN_COMMON_E, BurstParameters, DefectParameters, add_noise, dark_seconds
from marsyard.sim.sensor.optics import OpticsParameters, apply_point_spread, dust_transmission, line_spread
from tests.sim.scenes import DOWN
from tests.sim.sensor.motions import uniform_motion

#: A uniform and a dark scene: radiance factors, shape (rows, columns).
UNIFORM = np.ones((64, 48), dtype=np.float32)
DARK = np.zeros_like(UNIFORM)
#: Optics without spread.
SHARP = OpticsParameters(diffraction_px=0.0, diffusion_px=0.0)
NO_ERRORS = {"response_spread": 0.0, "calibration_error": 0.0, "read_noise_e": 0.0, "optics": SHARP}


def _make_detector(shape: tuple[int, int] = UNIFORM.shape, **changes: object) -> Detector:
    parameters = DetectorParameters.model_validate(NO_ERRORS | changes)
    return Detector.draw(np.ones(shape, dtype=np.float32), parameters, np.random.default_rng(0))


def test_signal_divided_by_variance_equals_the_gain() -> None:
    """Signal divided by variance of uniform images, both in counts, is the gain in electrons per count.

    The tolerance of 2 % is four standard errors of 100 images.
    """
    detector = _make_detector(transfer_row_s=0.0, clear_row_s=0.0, responsivity_e_s=5e7)
    images = np.stack([detector.expose(0.2 * UNIFORM, np.random.default_rng(n)).astype(np.float64) for n in range(100)])
    signal_dn = images.mean() - detector.parameters.offset_dn
    # Rounding adds one twelfth of a count to the variance.
    variance = images.var(axis=0, ddof=1).mean() - 1.0 / 12.0
    assert signal_dn / variance == pytest.approx(detector.parameters.gain_e_dn, rel=0.02)


def test_smear_of_a_bright_row_matches_transfer_times() -> None:
    """The charge of a row passes the previous rows during readout and the following rows during clearing."""
    detector = _make_detector(rows_summed=1, transfer_row_s=1e-5, clear_row_s=2e-6)
    scene = np.zeros_like(UNIFORM)
    scene[20] = 1.0
    charge = detector.charge(scene)
    rate = detector.parameters.responsivity_e_s
    np.testing.assert_allclose(charge[21:], rate * 1e-5, rtol=1e-5)
    np.testing.assert_allclose(charge[:20], rate * 2e-6, rtol=1e-5)
    np.testing.assert_allclose(charge[20], rate * detector.parameters.exposure_s, rtol=1e-5)


def test_signal_saturates_at_full_well_and_full_scale() -> None:
    counts = _make_detector().expose(1e3 * UNIFORM, np.random.default_rng(0))
    parameters = DetectorParameters()
    assert (counts == min(4095, round(parameters.full_well_e / parameters.gain_e_dn + parameters.offset_dn))).all()
    assert (_make_detector(gain_e_dn=1.0).expose(1e3 * UNIFORM, np.random.default_rng(0)) == 4095).all()


def test_calibration_response_has_the_specified_error() -> None:
    parameters = DetectorParameters(response_spread=0.02, calibration_error=0.005)
    detector = Detector.draw(UNIFORM, parameters, np.random.default_rng(3))
    true_response = detector.response.reshape(16, 4, 48).mean(axis=1)
    # The standard error of the deviation from 768 pixels is 2.6 %. The mean of four rows has half the deviation of one.
    assert (detector.calibration.flat_field / true_response).std() == pytest.approx(0.005, rel=0.1)
    assert true_response.std() == pytest.approx(0.02 / 2, rel=0.1)


def test_indivisible_rows_are_rejected() -> None:
    with pytest.raises(ValueError, match="cannot be summed"):
        Detector.draw(UNIFORM[:63], DetectorParameters(), np.random.default_rng(0))


def test_dimes_correction_removes_the_smear() -> None:
    """The static scene has the height of the detector, large-scale contrast, and texture of a few pixels."""
    rng = np.random.default_rng(5)
    large_scale = gaussian_filter(rng.standard_normal((1024, 32)), 60.0, mode="wrap")
    fine_scale = gaussian_filter(rng.standard_normal((1024, 32)), 1.5, mode="wrap")
    contrast = 0.3 * large_scale / large_scale.std() + 0.08 * fine_scale / fine_scale.std()
    scene = (0.15 * (1.0 + contrast)).clip(0.05).astype(np.float32)
    detector = _make_detector(scene.shape)
    parameters = detector.parameters

    def sum_rows(charge: np.ndarray) -> np.ndarray:
        return np.asarray(charge.reshape(256, 4, 32).sum(axis=1) / parameters.gain_e_dn)

    smeared_counts = sum_rows(detector.charge(scene))
    exposed_counts = sum_rows(scene * np.float32(parameters.responsivity_e_s * parameters.exposure_s))
    assert np.abs(smeared_counts - exposed_counts).max() > 0.2 * parameters.full_scale_dn
    assert smeared_counts.max() < parameters.full_scale_dn
    error = remove_frame_transfer(smeared_counts, detector.calibration, 4) - exposed_counts
    # The requirement is 0.2 % of full scale. The residual is caused by differences between the rows that are summed.
    assert np.abs(error).max() < 0.002 * parameters.full_scale_dn


def test_dark_current_doubles_every_six_degrees() -> None:
    cold, warm = (_make_detector(temperature_c=t).dark_charge() for t in (-34.0, -28.0))
    np.testing.assert_allclose(warm, 2.0 * cold, rtol=1e-6)
    detector = _make_detector(temperature_c=0.0)
    parameters = detector.parameters
    seconds = dark_seconds(parameters, 64)
    assert seconds[0] == pytest.approx(parameters.exposure_s + 64 * parameters.transfer_row_s)
    np.testing.assert_allclose(np.diff(seconds), parameters.readout_row_s)
    np.testing.assert_allclose(detector.dark_charge()[:, 0], 4 * parameters.dark_e_s * seconds, rtol=1e-6)


class _GivenNormals:
    """A random generator with given normal numbers."""

    def __init__(self, values: np.ndarray) -> None:
        self.values = values

    def standard_normal(self, size: tuple[int, ...], dtype: type) -> np.ndarray:
        return self.values.reshape(size).astype(dtype)


@pytest.mark.parametrize("mean_e", [MIN_COMMON_E, 300.0, 1e4])
@pytest.mark.parametrize(("read_noise_e", "tolerance"), [(0.0, 2.5e-3), (5.0, 5e-5), (25.0, 5e-5)])
def test_common_noise_has_the_distribution_of_poisson_and_normal_noise(
    mean_e: float, read_noise_e: float, tolerance: float
) -> None:
    """Tolerances: terms that the expansion omits, plus rounding of single precision (docstring of `add_noise`)."""
    normal = np.linspace(-4.0, 4.0, 161)
    mean = np.full((1, normal.size), mean_e, dtype=np.float32)
    charge = add_noise(mean, read_noise_e, True, cast(Any, _GivenNormals(normal))).ravel().astype(np.float64)
    # Exact distribution: Poisson probabilities, each with normal noise (a whole number without it).
    counts = np.arange(int(mean_e + 10.0 * mean_e**0.5))
    excess = charge[:, None] - counts
    below = stats.norm.cdf(excess / read_noise_e) if read_noise_e else np.clip(excess + 0.5, 0.0, 1.0)
    np.testing.assert_allclose(below @ stats.poisson.pmf(counts, mean_e), stats.norm.cdf(normal), atol=tolerance)


def test_few_electrons_have_poisson_noise() -> None:
    charge = add_noise(np.full((200, 500), 4.0, dtype=np.float32), 0.0, True, np.random.default_rng(3))
    observed = np.bincount(charge.astype(int).ravel(), minlength=16)[:16] / charge.size
    # Four standard errors of a frequency of 0.2 in 100,000 numbers.
    np.testing.assert_allclose(observed, stats.poisson.pmf(np.arange(16), 4.0), atol=5e-3)


def test_dark_current_adds_signal_and_shot_noise() -> None:
    detector = _make_detector(temperature_c=40.0, gain_e_dn=1.0, bits=16, offset_dn=0.0)
    image = detector.expose(DARK, np.random.default_rng(1)).astype(np.float64)
    expected = np.broadcast_to(detector.dark_charge(), image.shape)
    assert (expected > 50.0).all()
    # 768 pixels, each with a standard error of the square root of its charge.
    assert ((image - expected) / np.sqrt(expected)).mean() == pytest.approx(0.0, abs=4.0 / np.sqrt(768))
    assert ((image - expected) / np.sqrt(expected)).std() == pytest.approx(1.0, abs=0.1)


def test_hot_and_dead_pixels_have_specified_fractions() -> None:
    defects = DefectParameters(hot_fraction=0.01, dead_fraction=0.02, hot_e_s=5000.0)
    detector = _make_detector((512, 512), defects=defects)
    assert detector.hot_e_s is not None
    is_hot = detector.hot_e_s > 0.0
    # For 262,144 pixels the standard errors are 2 % and 1.4 % of the fractions, and 2 % of the mean current.
    assert is_hot.mean() == pytest.approx(0.01, rel=0.06)
    assert (detector.response == 0.0).mean() == pytest.approx(0.02, rel=0.05)
    assert detector.hot_e_s[is_hot].mean() == pytest.approx(5000.0, rel=0.08)
    # The calibration contains neither hot nor dead pixels.
    assert (detector.calibration.flat_field == 1.0).all()
    warmer = _make_detector((512, 512), defects=defects, temperature_c=detector.parameters.temperature_c + 6.0)
    np.testing.assert_allclose(warmer.dark_charge(), 2.0 * detector.dark_charge(), rtol=1e-5)


def test_bursts_disturb_runs_along_the_rows() -> None:
    scene = 0.1 * np.ones((256, 64), dtype=np.float32)
    bursts = BurstParameters(bursts=3.0, length_px=200.0, amplitude_dn=500.0)
    detectors = (_make_detector(scene.shape, rows_summed=1), _make_detector(scene.shape, rows_summed=1, bursts=bursts))
    undisturbed, disturbed = (
        np.stack([detector.expose(scene, np.random.default_rng(n)).reshape(-1) for n in range(60)])
        for detector in detectors
    )
    is_disturbed = undisturbed != disturbed
    # The standard error from 180 bursts of 200 pixels is 10 %. The image border clips 1 % of the pixels.
    assert is_disturbed.sum() / 60 == pytest.approx(600.0, rel=0.25)
    # A burst is one run of pixels, so few disturbed pixels follow an undisturbed one (some noise rounds to zero).
    run_starts = (is_disturbed[:, 1:] & ~is_disturbed[:, :-1]).sum() / 60
    assert run_starts < 10.0


def test_companding_noise_is_below_shot_noise() -> None:
    scene = np.tile(np.linspace(0.02, 0.25, 48, dtype=np.float32), (64, 1))
    uncompanded, companded = (
        _make_detector(companded=value).expose(scene, np.random.default_rng(3)).astype(np.float64)
        for value in (False, True)
    )
    assert len(np.unique(companded)) < len(np.unique(uncompanded))
    # The default offset is 20 counts, the gain 41.5 electrons per count. The limit is two sigma of shot noise.
    signal_dn = uncompanded - 20.0
    assert (np.abs(companded - uncompanded) <= np.sqrt(signal_dn * 41.5) / 41.5 * 2.0 + 1.0).all()


def test_motion_blur_is_reproducible() -> None:
    scene = np.random.default_rng(2).random(UNIFORM.shape, dtype=np.float32) * np.float32(0.2)
    detector = _make_detector()
    motion = uniform_motion(900.0, -700.0)
    first = detector.expose(scene, np.random.default_rng(1), motion)
    np.testing.assert_array_equal(first, detector.expose(scene, np.random.default_rng(1), motion))
    static = detector.expose(scene, np.random.default_rng(1))
    assert (first != static).mean() > 0.5
    np.testing.assert_array_equal(static, detector.expose(scene, np.random.default_rng(1), uniform_motion(0.0, 0.0)))


def test_exposure_time_is_set_in_parameters_and_calibration() -> None:
    detector = _make_detector().with_exposure(0.002)
    assert detector.parameters.exposure_s == detector.calibration.exposure_s == 0.002
    with pytest.raises(ValueError, match="exposure_s"):
        _make_detector().with_exposure(-1.0)


def test_subframe_has_the_pixels_of_the_full_frame() -> None:
    defects = DefectParameters(hot_fraction=0.02)
    parameters = DetectorParameters(transfer_row_s=0.0, clear_row_s=0.0, optics=SHARP, defects=defects)
    full_frame = Detector.draw(UNIFORM, parameters, np.random.default_rng(6))
    subframe = full_frame.window(8, 16, (24, 32))
    scene = np.random.default_rng(2).random(UNIFORM.shape, dtype=np.float32)
    np.testing.assert_array_equal(subframe.charge(scene[16:48, 8:32]), full_frame.charge(scene)[16:48, 8:32])
    np.testing.assert_array_equal(subframe.calibration.flat_field, full_frame.calibration.flat_field[4:12, 8:32])
    assert subframe.expose(scene[16:48, 8:32], np.random.default_rng(0)).shape == (8, 24)
    for invalid in ((0, 2, (8, 8)), (0, 0, (8, 6)), (44, 0, (8, 8)), (0, -4, (8, 8)), (0, 0, (0, 8))):
        with pytest.raises(ValueError, match="a subframe of"):
            full_frame.window(*invalid)


def test_residual_pattern_is_smooth_and_not_in_the_calibration() -> None:
    parameters = DetectorParameters.model_validate(
        NO_ERRORS | {"residual_spread": 0.01, "residual_px": 3.0, "rows_summed": 1}
    )
    detector = Detector.draw(np.ones((256, 256), dtype=np.float32), parameters, np.random.default_rng(2))
    pattern = detector.response.astype(np.float64) - 1.0
    assert pattern.std() == pytest.approx(0.01, rel=1e-3)
    # white noise blurred with the SD s: correlation exp(-d**2 / (4 s**2)) at the distance d
    correlation = (pattern[:, 3:] * pattern[:, :-3]).mean() / pattern.var()
    assert correlation == pytest.approx(np.exp(-0.25), abs=0.03)
    np.testing.assert_array_equal(detector.calibration.flat_field, 1.0)


DEFAULT_OPTICS = OpticsParameters()


@pytest.mark.parametrize(
    "parameters", [DEFAULT_OPTICS, OpticsParameters(pixel_aperture=True), OpticsParameters(diffusion_px=1.0)]
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
    s = frequency * DEFAULT_OPTICS.diffraction_px
    diffraction = 2.0 / np.pi * (np.arccos(s) - s * np.sqrt(1.0 - s * s))
    diffusion = np.exp(-2.0 * (np.pi * DEFAULT_OPTICS.diffusion_px * frequency) ** 2)
    np.testing.assert_allclose(_modulation(DEFAULT_OPTICS, frequency), diffraction * diffusion, atol=0.01)


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
        Detector.draw(flat, DetectorParameters(optics=optics), np.random.default_rng(1))
        for optics in (DEFAULT_OPTICS, dusty)
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
