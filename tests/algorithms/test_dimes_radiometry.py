"""Tests of the radiometric corrections of DIMES against a forward model of each physical row."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.algorithms.dimes.rectification import correct_patch
from marsyard.algorithms.dimes.views import BinnedView, bin_factors, bin_mean, build_view
from marsyard.algorithms.image.frame_transfer import remove_frame_transfer
from marsyard.sim.measurements import DetectorImage
from tests.algorithms.synthetic_descent import (
    CAMERA,
    ROWS_SUMMED,
    compute_fall_off,
    draw_terrain,
    expose_scene,
    make_calibration,
    trace_scene,
)

LEVEL = 1600.0  #: Counts of radiance 1.
#: Times per row of the transfer and of the clearing, seconds.
ROW_TIMES_S = [(5e-6, 2e-6), (5e-6, 0.0), (0.0, 2e-6), (3e-6, 3e-6), (1e-6, 5e-6), (0.0, 0.0)]


def simulate_transfer(rates: np.ndarray, exposure_s: float, transfer_row_s: float, clear_row_s: float) -> np.ndarray:
    """Compute the charge of each physical row: its exposure, and the smear of the rows that it crosses.

    A row crosses the rows with higher numbers during clearing, and those with lower numbers during transfer.
    """
    charge = exposure_s * rates
    for row in range(len(rates)):
        for higher_row in range(len(rates) - 1, row, -1):
            charge[row] += clear_row_s * rates[higher_row]
        for lower_row in range(row - 1, -1, -1):
            charge[row] += transfer_row_s * rates[lower_row]
    return charge


@pytest.mark.parametrize("row_times_s", ROW_TIMES_S)
@pytest.mark.parametrize("rows_summed", [1, 2, 4])
def test_smear_removal_is_exact_for_uniform_summed_rows(row_times_s: tuple[float, float], rows_summed: int) -> None:
    rng = np.random.default_rng(5)
    rates = np.repeat(rng.uniform(0.0, 1e6, (16, 3)), rows_summed, axis=0)
    # A short exposure makes the smear as strong as the image.
    detector = replace(make_calibration(*row_times_s), exposure_s=1e-4, rows_summed=rows_summed)
    charge = simulate_transfer(rates, detector.exposure_s, *row_times_s)
    signal = charge.reshape(16, rows_summed, 3).mean(axis=1)
    corrected_signal = remove_frame_transfer(signal, detector, rows_summed)
    # Only rounding errors remain; the recursion amplifies them by at most a factor of ten per row block.
    np.testing.assert_allclose(corrected_signal, detector.exposure_s * rates[::rows_summed], rtol=1e-9, atol=1e-9)


def test_exposure_shorter_than_transfer_is_rejected() -> None:
    detector = replace(make_calibration(), exposure_s=1e-6)
    with pytest.raises(ValueError, match="1e-06 s is too short"):
        remove_frame_transfer(np.ones((256, 4)), detector, 4)


def test_exposure_is_optional_without_frame_transfer() -> None:
    """Real images have no exposure metadata and need no smear correction."""
    detector = replace(make_calibration(0.0, 0.0), exposure_s=0.0)
    signal = np.arange(12.0).reshape(4, 3)
    np.testing.assert_array_equal(remove_frame_transfer(signal, detector, 2), signal)


def render_view(transfer_row_s: float, clear_row_s: float) -> tuple[np.ndarray, BinnedView]:
    """Render a textured scene; return its radiance and the DIMES view of its image."""
    attitude = Rotation.from_euler("zy", [30.0, 12.0], degrees=True)
    radiance = trace_scene(draw_terrain(), attitude, np.array([500.0, 300.0, 1700.0]))
    detector = make_calibration(transfer_row_s, clear_row_s)
    image = DetectorImage(expose_scene(radiance, detector, level=LEVEL), 0.0, CAMERA.bin(1, ROWS_SUMMED), detector)
    return radiance, build_view(image, attitude, 1700.0, np.array([0.0, 0.0, 1.0]), (256, 256))


@pytest.mark.parametrize("row_times_s", [(5e-6, 2e-6), (1e-6, 5e-6), (0.0, 0.0)])
def test_static_scene_is_restored_within_tolerance(row_times_s: tuple[float, float]) -> None:
    radiance, view = render_view(*row_times_s)
    irradiance = bin_mean(LEVEL * radiance * compute_fall_off(), 4, 4)
    corrected_signal = remove_frame_transfer(view.signal, view.calibration, view.rows_summed)
    assert np.abs(view.signal - irradiance).max() > (0.1 * 4095 if row_times_s[0] else 0.0)  # the smear is significant
    # Rows within a delivered row differ slightly and counts are rounded: at most 0.2 % of full scale, 0.1 % rms.
    assert np.abs(corrected_signal - irradiance).max() < 0.002 * 4095
    assert np.sqrt(np.mean((corrected_signal - irradiance) ** 2)) < 0.001 * 4095


def test_patch_is_corrected_for_fall_off() -> None:
    radiance, view = render_view(5e-6, 2e-6)
    patch = correct_patch(view, slice(0, 60), slice(200, 256))  # a corner with a fall-off of one half
    expected = bin_mean(LEVEL * radiance, 4, 4)[0:60, 200:256]
    assert np.abs(patch - expected).max() < 0.004 * 4095


def test_binning_averages_blocks_and_rejects_indivisible_sizes() -> None:
    image = np.arange(48.0).reshape(4, 12)
    np.testing.assert_allclose(bin_mean(image, 4, 2)[0, 0], image[:2, :4].mean())
    assert bin_factors((256, 1024), (256, 256)) == (4, 1)
    assert bin_factors((1024, 1024), (256, 256)) == (4, 4)
    with pytest.raises(ValueError, match="1000 x 256 pixels cannot be binned to 256 x 256"):
        bin_factors((256, 1000), (256, 256))
