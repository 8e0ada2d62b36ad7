"""Pairs of algorithms: closed forms, and error rates where cases share terrains."""

from __future__ import annotations

import math

import numpy as np
import pytest

from marsyard.reports.statistics.changes import compare_errors, compare_successes

TERRAINS = np.repeat(np.arange(25), 8)


def test_mcnemar_is_exact() -> None:
    first = np.array([True] * 9 + [False] * 1 + [True] * 5)
    other = np.array([False] * 9 + [True] * 1 + [True] * 5)
    only_first, only_other, p = compare_successes(first, other)
    assert (only_first, only_other) == (9, 1)
    assert p == pytest.approx(2 * (1 + 10) / 2**10)  # two tails of ten fair coins
    assert compare_successes(first, first)[2] == 1.0


def test_alike_algorithms_differ_as_seldom_as_stated_on_shared_terrains() -> None:
    # Which of the two does better goes with the terrain alone: 150 repetitions, sd of a rate of 5 % is 1.8 %.
    rng = np.random.default_rng(1)
    split, errors, naive = 0, 0, 0
    for _ in range(150):
        moved = rng.normal(size=25)[TERRAINS]
        differences = moved + 0.1 * rng.normal(size=TERRAINS.size)
        split += compare_successes(moved < 0.5, moved > -0.5, TERRAINS)[2] < 0.05
        naive += compare_successes(moved < 0.5, moved > -0.5)[2] < 0.05
        errors += compare_errors(differences, TERRAINS, 0.9)[3] < 0.05
    assert max(split, errors) / 150 <= 0.05 + 3 * 0.018
    assert naive / 150 > 0.3


def test_the_interval_of_a_paired_mean_covers_it_on_shared_terrains() -> None:
    # 200 repetitions at 90 %: sd 2.1 %.
    rng = np.random.default_rng(2)
    draws = (0.3 + rng.normal(size=25)[TERRAINS] + 0.3 * rng.normal(size=TERRAINS.size) for _ in range(200))
    found = np.array([compare_errors(one, TERRAINS, 0.9) for one in draws])
    assert np.mean((found[:, 1] <= 0.3) & (found[:, 2] >= 0.3)) >= 0.9 - 3 * 0.021


def test_no_pairs_give_nan() -> None:
    assert all(math.isnan(one) for one in compare_errors(np.zeros(0), None, 0.9))
    mean, lower, upper, p = compare_errors(np.zeros(1), None, 0.9)
    assert (mean, p) == (0.0, 1.0)
    assert math.isnan(lower)
    assert math.isnan(upper)
