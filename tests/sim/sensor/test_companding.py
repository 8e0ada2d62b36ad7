"""Tests of square-root companding, the compression of image counts to codes of 8 bits."""

import numpy as np
import pytest

from marsyard.sim.sensor.detector import compand, compression_table, expand, expansion_table


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
