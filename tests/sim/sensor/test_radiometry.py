"""Tests of the radiometry of detectors against published values, of automatic exposure, and of replaced bad pixels."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from marsyard.sim.sensor import AutoExposureParameters, Detector, DetectorParameters, auto_expose, preset
from marsyard.sim.sensor.detector import dark_seconds, fill_bad_pixels
from marsyard.sim.sensor.radiometry import DARK_E_S, DARKEST_RADIANCE_FACTOR, LightPath, solar_photons

FLIGHT_CAMERA, FIELD_CAMERA = preset("mer-descent-flown"), preset("mer-descent-field")


def _compute_snr(parameters: DetectorParameters, radiance_factor: float) -> float:
    """Compute the mean SNR of the rows on axis: shot noise, dark current, readout and rounding; no smear."""
    signal = radiance_factor * parameters.responsivity_e_s * parameters.exposure_s * parameters.rows_summed
    dark = parameters.rows_summed * parameters.dark_e_s * parameters.dark_growth * dark_seconds(parameters, 1024)
    noise = np.sqrt(signal + dark + parameters.read_noise_e**2 + parameters.gain_e_dn**2 / 12.0)
    return float(np.mean(signal / noise))


def test_total_sunlight_equals_the_solar_constant() -> None:
    waves_nm = np.linspace(150.0, 20000.0, 100000)
    photon_energy_j = 6.62607015e-34 * 2.99792458e8 / (waves_nm * 1e-9)
    # The solar constant is 1361 W/m2; 0.2 % of it are outside these wavelengths.
    assert np.trapezoid(solar_photons(waves_nm) * photon_energy_j, waves_nm) == pytest.approx(1361.0, rel=0.003)


def test_neutral_density_filters_match_the_paper() -> None:
    """Optical densities of 0.67 and 0.97 transmit 22 % and 11 % (field test paper, section III.B.2)."""
    for camera, fraction in ((FLIGHT_CAMERA, 0.22), (FIELD_CAMERA, 0.11)):
        without_filter = replace(camera.light, neutral_density=None)
        transmission = camera.light.responsivity_e_s(1.5) / without_filter.responsivity_e_s(1.5)
        assert transmission == pytest.approx(fraction, abs=0.005)


@pytest.mark.parametrize(
    ("temperature_c", "ratio", "dark_fraction"), [(-34.0, 102.0, None), (0.0, 100.0, 0.02), (23.0, 87.0, 0.15)]
)
def test_noise_and_dark_current_match_the_paper(
    temperature_c: float, ratio: float, dark_fraction: float | None
) -> None:
    """One set of constants reproduces the values of the field test paper, section III.B.3.

    The tolerances are 2 for the ratio and a factor of 1.2 for the fractions of noise from dark current.
    """
    for camera in (FLIGHT_CAMERA, FIELD_CAMERA):
        parameters = camera.detector.model_copy(update={"temperature_c": temperature_c})
        assert _compute_snr(parameters, DARKEST_RADIANCE_FACTOR) == pytest.approx(ratio, abs=2.0)
        without_dark = _compute_snr(parameters.model_copy(update={"dark_e_s": 0.0}), DARKEST_RADIANCE_FACTOR)
        actual_fraction = 1.0 - _compute_snr(parameters, DARKEST_RADIANCE_FACTOR) / without_dark
        if dark_fraction is None:
            assert actual_fraction < 0.001
        else:
            assert dark_fraction / 1.2 < actual_fraction < dark_fraction * 1.2


def test_field_test_and_flight_collect_similar_charge() -> None:
    flight, field = FLIGHT_CAMERA.detector, FIELD_CAMERA.detector
    electrons = flight.responsivity_e_s * flight.exposure_s
    assert field.responsivity_e_s * field.exposure_s == pytest.approx(electrons)
    # On Mars the sunlight is 44 % of that on Earth. The filters transmit 22 % (flight) and 11 % (field test).
    assert flight.responsivity_e_s / field.responsivity_e_s == pytest.approx(0.44 * 0.22 / 0.11, rel=0.03)
    assert 0.003 < field.exposure_s < flight.exposure_s < 0.005


def test_default_detector_equals_the_flight_descent_camera() -> None:
    parameters = DetectorParameters()
    flight = FLIGHT_CAMERA.detector.model_dump()
    assert parameters.responsivity_e_s == pytest.approx(flight.pop("responsivity_e_s"), rel=2e-3)
    assert parameters.optics.diffraction_px == pytest.approx(flight.pop("optics")["diffraction_px"], abs=0.01)
    # the pattern is calibrated to pairs of images of this camera only
    assert flight.pop("residual_spread") > parameters.residual_spread == 0.0
    assert parameters.model_dump(include=set(flight)) == flight
    assert parameters.dark_e_s == DARK_E_S


def test_responsivity_depends_on_aperture_pixel_area_band_and_distance() -> None:
    # Arguments: f-number, pixel pitch (um) and band (nm).
    light = LightPath(12.0, 12.0, (400.0, 1100.0))
    rate = light.responsivity_e_s(1.0)
    assert light.responsivity_e_s(2.0) == pytest.approx(rate / 4.0)
    assert LightPath(6.0, 12.0, (400.0, 1100.0)).responsivity_e_s(1.0) == pytest.approx(4.0 * rate)
    assert LightPath(12.0, 6.0, (400.0, 1100.0)).responsivity_e_s(1.0) == pytest.approx(rate / 4.0)
    assert LightPath(12.0, 12.0, (600.0, 800.0)).responsivity_e_s(1.0) < rate


#: Radiance factors, mean 0.11.
GROUND = (0.1 + 0.02 * np.random.default_rng(0).random((128, 96))).astype(np.float32)
OPTIONS = AutoExposureParameters()


def _make_detector(exposure_s: float) -> Detector:
    parameters = DetectorParameters(exposure_s=exposure_s, rows_summed=1, transfer_row_s=0.0, clear_row_s=0.0)
    return Detector.draw(np.ones_like(GROUND), parameters, np.random.default_rng(1))


@pytest.mark.parametrize("start_s", [0.0005, 0.02, 0.5])
def test_auto_exposure_converges_from_dark_and_bright(start_s: float) -> None:
    result = auto_expose(_make_detector(start_s), GROUND, OPTIONS, np.random.default_rng(2))
    assert result.converged
    assert len(result.exposures_s) <= 5
    # By default the 98th percentile of the counts is at 75 % of full scale.
    image = result.detector.expose(GROUND, np.random.default_rng(3))
    assert np.percentile(image, 98.0) == pytest.approx(0.75 * 4095, rel=OPTIONS.tolerance + 0.01)
    assert result.detector.calibration.exposure_s == result.exposures_s[-1]


def test_unreachable_exposure_is_reported() -> None:
    short_exposure = AutoExposureParameters(max_exposure_s=0.001)
    result = auto_expose(_make_detector(0.001), GROUND, short_exposure, np.random.default_rng(2))
    assert not result.converged
    assert result.exposures_s == (0.001,)
    one_image = auto_expose(_make_detector(0.5), GROUND, AutoExposureParameters(images=1), np.random.default_rng(2))
    assert not one_image.converged
    assert one_image.detector.parameters.exposure_s < 0.5


def test_invalid_parameters_are_rejected() -> None:
    with pytest.raises(ValidationError, match="is greater than max_exposure_s"):
        AutoExposureParameters(min_exposure_s=0.1, max_exposure_s=0.01)


def test_bad_pixels_are_replaced_by_the_mean_of_good_neighbours() -> None:
    counts = (10 * np.arange(6)[:, None] + np.arange(8)[None]).astype(np.uint16)
    is_bad = np.zeros(counts.shape, dtype=bool)
    is_bad[2, 3] = is_bad[2, 4] = is_bad[0, 0] = True
    corrupted = counts.copy()
    corrupted[is_bad] = 4000
    corrected = fill_bad_pixels(corrupted, is_bad)
    np.testing.assert_array_equal(corrected[~is_bad], counts[~is_bad])
    # Pixel (2, 3) has seven good neighbours: (2, 4) is bad.
    neighbours = [counts[i, j] for i in (1, 2, 3) for j in (2, 3, 4) if (i, j) not in ((2, 3), (2, 4))]
    assert corrected[2, 3] == np.rint(np.mean(neighbours))
    assert corrected[0, 0] == np.rint(np.mean([counts[0, 1], counts[1, 0], counts[1, 1]]))


def test_pixel_without_good_neighbours_is_unchanged() -> None:
    is_bad = np.zeros((5, 5), dtype=bool)
    is_bad[1:4, 1:4] = True
    counts = np.full((5, 5), 7, dtype=np.uint16)
    counts[2, 2] = 99
    assert fill_bad_pixels(counts, is_bad)[2, 2] == 99
    assert fill_bad_pixels(counts, is_bad)[1, 1] == 7


@pytest.mark.parametrize(("name", "mean_dn"), [("mer-descent-flown", 6), ("mer-navcam", 13), ("mer-hazcam", 13)])
def test_hot_pixels_of_the_cold_mer_cameras_add_few_counts(name: str, mean_dn: int) -> None:
    """The numbers are those of the description of the fault `bad_pixels`; full scale is 4096 counts."""
    p = preset(name).detector
    charge = p.defects.hot_e_s * p.dark_growth * dark_seconds(p, 1024)
    assert np.mean(charge) / p.gain_e_dn == pytest.approx(mean_dn, abs=0.5)
