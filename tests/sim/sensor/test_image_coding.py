"""Tests of the compression of images: square-root companding to 8 bits, and lossy compression with a given error."""

from itertools import pairwise

import cv2
import numpy as np
import pytest

from marsyard.sim.sensor.image_coding import (
    compand,
    compress_and_decompress,
    compression_table,
    expand,
    expansion_table,
)

#: Smooth random relief, and its image in counts of 12 bits.
SCENE = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(256, 384)), (0, 0), 2.0)
COUNTS = np.clip(2000.0 + 4000.0 * SCENE, 0.0, 4095.0).astype(np.uint16)


def test_error_increases_with_compression() -> None:
    errors = [
        float(np.std(compress_and_decompress(COUNTS, bits, 4095).astype(float) - COUNTS))
        for bits in (16.0, 4.0, 2.0, 1.0, 0.5)
    ]
    assert errors[0] == 0.0
    assert all(coarse > fine for fine, coarse in pairwise(errors))
    assert 0.5 < errors[3] < 200.0


def test_compression_preserves_mean_and_position_of_the_image() -> None:
    lossy = compress_and_decompress(COUNTS, 1.0, 4095).astype(float)
    assert lossy.mean() == pytest.approx(COUNTS.mean(), rel=1e-3)
    shift, _ = cv2.phaseCorrelate(COUNTS.astype(float), lossy)
    assert np.abs(shift).max() < 0.02


def test_counts_stay_within_full_scale() -> None:
    edges = np.where(np.indices((128, 128)).sum(axis=0) % 32 < 16, 0, 4095).astype(np.uint16)
    assert compress_and_decompress(edges, 0.5, 4095).max() == 4095


def test_images_that_are_too_small_for_the_coder_are_rejected() -> None:
    assert compress_and_decompress(COUNTS[:32, :40], 16.0, 4095).shape == (32, 40)
    with pytest.raises(ValueError, match="an image of 40 x 31 pixels; allowed for compression: from 32 on each side"):
        compress_and_decompress(COUNTS[:31, :40], 16.0, 4095)


@pytest.mark.parametrize("bits", [0.0, 17.0, float("nan")])
def test_invalid_bits_per_pixel_are_rejected(bits: float) -> None:
    with pytest.raises(ValueError, match=r"allowed: 0\.1 to 16"):
        compress_and_decompress(COUNTS, bits, 4095)


@pytest.mark.parametrize("full_scale", [255, 1023, 4095])
def test_companding_round_trip_is_within_half_a_step(full_scale: int) -> None:
    codes = np.arange(256, dtype=np.uint8)[None]
    np.testing.assert_array_equal(compand(expand(codes, full_scale), full_scale), codes)
    counts = np.arange(full_scale + 1, dtype=np.uint16)[None]
    error = np.abs(expand(compand(counts, full_scale), full_scale).astype(int) - counts)
    step = np.gradient(expansion_table(full_scale).astype(float))[compression_table(full_scale)]
    # The last codes are excluded because the last step has half the width.
    assert (error <= 0.5 * step + 1.0)[counts < expansion_table(full_scale)[253]].all()
    # For twelve bits in eight the widest step is 32 counts. The first steps are single counts.
    assert error.max() <= full_scale / 255 * 1.1
    assert error[0, :2].max() == 0


def test_step_width_grows_with_square_root_of_signal() -> None:
    steps = np.diff(expansion_table(4095).astype(float))
    middle = expansion_table(4095)[1:-1].astype(float)
    widths = 0.5 * (steps[1:] + steps[:-1])
    # derivative of the inverse of the code: sqrt((count + b) / b), with b = 4.23 for a full scale of 4095 counts;
    # the mean of two steps is a multiple of half a count
    np.testing.assert_allclose(widths[100:-2], np.sqrt((middle[100:-2] + 4.23) / 4.23), atol=0.75)


def test_small_full_scale_is_rejected() -> None:
    with pytest.raises(ValueError, match="allowed: 255 or more"):
        compression_table(127)
