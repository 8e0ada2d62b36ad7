"""Tests of lossy image compression: error for a given number of bits per pixel; mean, position and range of counts."""

from itertools import pairwise

import cv2
import numpy as np
import pytest

from marsyard.sim.sensor.compression import compress

#: Smooth random relief, and its image in counts of 12 bits.
SCENE = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(256, 384)), (0, 0), 2.0)
COUNTS = np.clip(2000.0 + 4000.0 * SCENE, 0.0, 4095.0).astype(np.uint16)


def test_error_increases_with_compression() -> None:
    errors = [float(np.std(compress(COUNTS, bits, 4095).astype(float) - COUNTS)) for bits in (16.0, 4.0, 2.0, 1.0, 0.5)]
    assert errors[0] == 0.0
    assert all(coarse > fine for fine, coarse in pairwise(errors))
    assert 0.5 < errors[3] < 200.0


def test_compression_preserves_mean_and_position_of_the_image() -> None:
    lossy = compress(COUNTS, 1.0, 4095).astype(float)
    assert lossy.mean() == pytest.approx(COUNTS.mean(), rel=1e-3)
    shift, _ = cv2.phaseCorrelate(COUNTS.astype(float), lossy)
    assert np.abs(shift).max() < 0.02


def test_counts_stay_within_full_scale() -> None:
    edges = np.where(np.indices((128, 128)).sum(axis=0) % 32 < 16, 0, 4095).astype(np.uint16)
    assert compress(edges, 0.5, 4095).max() == 4095


@pytest.mark.parametrize("bits", [0.0, 17.0, float("nan")])
def test_invalid_bits_per_pixel_are_rejected(bits: float) -> None:
    with pytest.raises(ValueError, match=r"allowed: 0\.1 to 16"):
        compress(COUNTS, bits, 4095)
