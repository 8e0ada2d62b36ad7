"""Tests of automatic exposure: convergence, a region of the image, and limits."""

import numpy as np
import pytest
from pydantic import ValidationError

from marsyard.sim.sensor import AutoExposureParameters, Detector, DetectorParameters, auto_expose

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


def test_exposure_can_use_a_part_of_the_image() -> None:
    """Under a bright sky the ground is underexposed, unless the exposure uses only the ground."""
    scene = GROUND.copy()
    scene[:40] = 0.6
    full_image = auto_expose(_make_detector(0.01), scene, OPTIONS, np.random.default_rng(2))
    ground_region = auto_expose(
        _make_detector(0.01), scene, OPTIONS, np.random.default_rng(2), region=(slice(60, 110), slice(20, 70))
    )
    assert full_image.converged
    assert ground_region.converged
    # The controlled radiance is that of the sky, 0.6, or the maximum of the ground, 0.12.
    assert ground_region.exposures_s[-1] / full_image.exposures_s[-1] == pytest.approx(0.6 / 0.12, rel=0.12)


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
    with pytest.raises(ValueError, match="region is empty"):
        auto_expose(_make_detector(0.01), GROUND, OPTIONS, np.random.default_rng(0), region=(slice(0, 0), slice(0, 0)))
