"""Tests of the replacement of known bad pixels by the mean of their good neighbours."""

from __future__ import annotations

import numpy as np

from marsyard.sim.sensor.detector import fill_bad_pixels


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
