import numpy as np
import pytest

from sim.camera import Cahv
from sim.sensor import Detector, DetectorParameters
from sim.sensor.detector import natural_fall_off

EVEN = np.ones((64, 48), dtype=np.float32)
PERFECT = {"response_spread": 0.0, "calibration_error": 0.0, "read_noise_e": 0.0}


def _detector(**changes: float) -> Detector:
    return Detector.drawn(EVEN, DetectorParameters(**(PERFECT | changes)), np.random.default_rng(0))


def test_shot_noise_and_gain_by_photon_transfer() -> None:
    """Variance over mean of flat pictures is the gain: 2 % is four standard errors of 100 pictures' variance."""
    detector = _detector(transfer_row_s=0.0, clear_row_s=0.0, responsivity_e_s=5e7)
    pictures = np.stack(
        [detector.expose(0.2 * EVEN, np.random.default_rng(seed)).astype(np.float64) for seed in range(100)]
    )
    signal_dn = pictures.mean() - detector.parameters.offset_dn
    # rounding adds a twelfth of a count to the variance
    variance = pictures.var(axis=0, ddof=1).mean() - 1.0 / 12.0
    assert signal_dn / variance == pytest.approx(detector.parameters.gain_e_dn, rel=0.02)


def test_paper_signal_to_noise_on_the_darkest_terrain() -> None:
    """Calibrated: 102:1 at albedo 0.1, radiance factor 0.07, in a row-summed pixel without smear (section III.B.3)."""
    p = DetectorParameters()
    electrons = 0.07 * p.responsivity_e_s * p.exposure_s * p.rows_summed
    assert electrons / np.sqrt(electrons + p.read_noise_e**2) == pytest.approx(102.0, abs=2.0)


def test_smear_of_a_bright_row() -> None:
    """A packet of row r passes the rows before it on the way out, and was under the rows after it while cleared."""
    detector = _detector(rows_summed=1, transfer_row_s=1e-5, clear_row_s=2e-6)
    scene = np.zeros_like(EVEN)
    scene[20] = 1.0
    charge = detector.charge(scene)
    rate = detector.parameters.responsivity_e_s
    np.testing.assert_allclose(charge[21:], rate * 1e-5, rtol=1e-5)
    np.testing.assert_allclose(charge[:20], rate * 2e-6, rtol=1e-5)
    np.testing.assert_allclose(charge[20], rate * detector.parameters.exposure_s, rtol=1e-5)


def test_rows_are_summed_and_columns_are_not() -> None:
    counts = _detector(rows_summed=4).expose(EVEN, np.random.default_rng(0))
    assert counts.shape == (16, 48)
    assert counts.dtype == np.uint16


def test_saturates_at_full_well_and_at_full_scale() -> None:
    counts = _detector().expose(1e3 * EVEN, np.random.default_rng(0))
    p = DetectorParameters()
    assert (counts == min(4095, round(p.full_well_e / p.gain_e_dn + p.offset_dn))).all()
    assert (_detector(gain_e_dn=1.0).expose(1e3 * EVEN, np.random.default_rng(0)) == 4095).all()


def test_same_stream_same_picture() -> None:
    detector = _detector()
    first = detector.expose(0.1 * EVEN, np.random.default_rng(1))
    assert (first == detector.expose(0.1 * EVEN, np.random.default_rng(1))).all()
    assert (first != detector.expose(0.1 * EVEN, np.random.default_rng(2))).any()


def test_calibration_knows_the_response_to_its_error() -> None:
    detector = Detector.drawn(
        EVEN, DetectorParameters(response_spread=0.02, calibration_error=0.005), np.random.default_rng(3)
    )
    true = detector.response.reshape(16, 4, 48).mean(axis=1)
    # 768 pixels: the spread is known to 2.6 %
    assert (detector.calibration.flat_field / true).std() == pytest.approx(0.005, rel=0.1)
    assert true.std() == pytest.approx(0.02 / 2, rel=0.1)


def test_fall_off_is_the_fourth_power_of_the_cosine() -> None:
    camera = Cahv.from_field_of_view(
        horizontal_rad=np.radians(60.0),
        size=(101, 101),
        centre=np.zeros(3),
        axis=np.array([0.0, 0.0, -1.0]),
        right=np.array([1.0, 0.0, 0.0]),
    )
    fall_off = natural_fall_off(camera)
    assert fall_off[50, 50] == pytest.approx(1.0)
    # the middle of the edge is half a pixel inside 30 deg
    assert fall_off[50, 0] == pytest.approx(np.cos(np.radians(30.0)) ** 4, rel=0.01)


def test_refuses_rows_that_do_not_divide() -> None:
    with pytest.raises(ValueError, match="cannot be summed"):
        Detector.drawn(EVEN[:63], DetectorParameters(), np.random.default_rng(0))
