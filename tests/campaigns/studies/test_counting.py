"""Tests of the counting bound: textbook numbers, coverage, and cases that share terrains."""

from __future__ import annotations

import math

import numpy as np
import pytest

from marsyard.campaigns.studies.counting import count_violations, find_units_needed


def test_bound_without_violations_is_the_textbook_one() -> None:
    counting = count_violations(np.zeros(1000, dtype=bool), [None] * 1000, 0.025, 0.05)
    assert counting.upper == pytest.approx(1.0 - 0.05 ** (1.0 / 1000.0))
    assert counting.lower == 0.0
    assert (counting.lower_confidence, counting.upper_confidence) == (0.975, 0.95)


@pytest.mark.parametrize(("violations", "limit", "risk", "units"), [(0, 1e-4, 0.1, 23025), (0, 1e-4, 0.05, 29956)])
def test_units_needed_are_the_textbook_ones(violations: int, limit: float, risk: float, units: int) -> None:
    # ln(risk) / ln(1 - limit), rounded up
    assert units == math.ceil(math.log(risk) / math.log1p(-limit))
    assert find_units_needed(violations, limit, risk) == units


def test_bound_needs_no_more_than_the_units_needed() -> None:
    units = find_units_needed(2, 1e-2, 0.05)
    is_violation = np.zeros(units, dtype=bool)
    is_violation[:2] = True
    assert count_violations(is_violation, [None] * units, 0.05, 0.05).upper <= 1e-2
    assert count_violations(is_violation[:-1], [None] * (units - 1), 0.05, 0.05).upper > 1e-2


def test_all_violations_have_the_upper_bound_1() -> None:
    counting = count_violations(np.ones(5, dtype=bool), [None] * 5, 0.05, 0.05)
    assert counting.upper == 1.0
    assert counting.lower == pytest.approx(0.05 ** (1.0 / 5.0))


def test_units_are_terrains_if_a_terrain_has_several_cases() -> None:
    is_violation = np.array([False, True, True, False, True])
    counting = count_violations(is_violation, ["a", "a", "b", "b", None], 0.05, 0.05)
    assert (counting.cases, counting.violations, counting.units) == (5, 3, 3)
    # the violation on "a" is not its first case; the unknown terrain may be "b"
    assert (counting.violating_units, counting.first_violations) == (3, 1)


@pytest.mark.parametrize("cluster_size", [1, 4])
def test_bounds_cover_the_probability_for_any_correlation(cluster_size: int) -> None:
    """Half of the terrains violate with 8 %, the others never: p = 4 %. Each bound has a risk of 5 %."""
    rng, n_terrains, n_too_low, n_too_high, trials = np.random.default_rng(1), 100, 0, 0, 1000
    terrains: list[str | None] = [f"terrain {index % n_terrains}" for index in range(n_terrains * cluster_size)]
    for _ in range(trials):
        rates = np.tile(0.08 * (rng.random(n_terrains) < 0.5), cluster_size)
        counting = count_violations(rng.random(rates.size) < rates, terrains, 0.05, 0.05)
        n_too_low += counting.upper < 0.04
        n_too_high += counting.lower > 0.04
    # three standard errors above 5 %: 0.05 + 3 sqrt(0.05 * 0.95 / 1000)
    assert n_too_low <= 70
    assert n_too_high <= 70
