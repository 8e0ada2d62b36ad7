"""Tests of radiometric corrections: frame transfer smear and lens fall-off are removed from the images."""

from __future__ import annotations

import numpy as np
import pytest

from marsyard.algorithms.hda.motion import apply_flat_field
from marsyard.sim.measurements import DetectorImage
from marsyard.sim.sensor import Detector, DetectorParameters, natural_fall_off
from marsyard.sim.sensor.optics import OpticsParameters
from tests.algorithms.hda.relief_scene import make_camera


def render_detector_image(transfer_row_s: float, clear_row_s: float) -> tuple[np.ndarray, DetectorImage]:
    """Render a scene with a brightness gradient, and its image, exposed for 4 ms with negligible noise."""
    optics = make_camera(320)
    rows, columns = optics.size[1], optics.size[0]
    rng = np.random.default_rng(3)
    scene = (0.2 + 0.1 * np.arange(columns) / columns + 0.02 * rng.standard_normal((rows, columns))).astype(np.float32)
    parameters = DetectorParameters(
        rows_summed=1,
        transfer_row_s=transfer_row_s,
        clear_row_s=clear_row_s,
        full_well_e=1e9,
        responsivity_e_s=4e9,
        gain_e_dn=4000.0,
        read_noise_e=0.0,
        calibration_error=0.0,
        optics=OpticsParameters(diffraction_px=0.0, diffusion_px=0.0, pixel_aperture=False),
    )
    detector = Detector.draw(natural_fall_off(optics), parameters, rng)
    return scene, DetectorImage(detector.expose(scene, rng), 0.0, optics, detector.calibration)


@pytest.mark.parametrize("row_times_s", [(0.0, 0.0), (5e-6, 0.0), (5e-6, 1e-6)])
def test_corrected_counts_match_ideal_image(row_times_s: tuple[float, float]) -> None:
    scene, image = render_detector_image(*row_times_s)
    counts = apply_flat_field(image).astype(np.float64)
    # Ideal counts: 4 ms x 4e9 e/s / 4000 e/DN. Each count is rounded twice, and the response is at least 0.65.
    expected = 0.004 * 4e9 / 4000.0 * scene
    assert np.abs(counts - expected).max() < 0.01 * expected.mean()
    smeared_counts = (image.counts - image.calibration.offset_dn) / image.calibration.flat_field
    max_smear = np.abs(smeared_counts - expected).max() / expected.mean()
    # The transfer of 240 rows takes 240 x 5 us = 1.2 ms, 30 % of the exposure time; lens fall-off reduces it.
    assert (max_smear > 0.2) == (row_times_s[0] > 0.0)
