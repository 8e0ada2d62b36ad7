"""Tests of the bounds of weighted failure rates: equal weights, shared terrains, and coverage under known rates."""

from collections.abc import Callable

import numpy as np
import pytest
from jaxtyping import Bool
from scipy import stats

from marsyard.reports.statistics.clustered_cases import ClusteredCases
from marsyard.reports.statistics.proportions import proportion_lower, proportion_upper
from marsyard.reports.statistics.reweighted_rates import weighted_rates


@pytest.mark.parametrize(("failures", "n"), [(0, 230), (1, 388), (7, 50), (40, 40)])
def test_equal_weights_give_the_bounds_of_verdicts(failures: int, n: int) -> None:
    failure = np.arange(n) < failures
    rates = weighted_rates(np.full((1, n), 3.0), failure, None, (0.8, 0.9))
    assert rates.estimate[0] == pytest.approx(failures / n)
    assert 1.0 - rates.lower[0] == pytest.approx(proportion_upper(n - failures, n, 0.8), abs=1e-12)
    assert 1.0 - rates.upper[0] == pytest.approx(proportion_lower(n - failures, n, 0.9), abs=1e-7)
    assert rates.effective_units[0] == pytest.approx(n)


def test_terrain_is_one_unit() -> None:
    """Without a failure, each of 50 terrains with four cases counts as one case, as in verdicts."""
    groups = np.repeat(np.arange(50), 4)
    rates = weighted_rates(np.ones((1, 200)), np.zeros(200, dtype=np.bool_), groups, (0.9, 0.9))
    bound = ClusteredCases.of(np.ones(200, dtype=np.bool_), groups).max_failure_rate(0.1)
    assert rates.upper[0] == pytest.approx(bound, rel=1e-6)
    assert rates.effective_units[0] == pytest.approx(50.0)


def test_weights_are_those_of_repeated_cases() -> None:
    """A case of the weight 3 gives the rate of three cases, but has the evidence of fewer than three."""
    weights, failure = np.array([[3.0, 1.0, 1.0, 1.0]]), np.array([True, False, False, False])
    rates = weighted_rates(weights, failure, None, (0.9, 0.9))
    assert rates.estimate[0] == pytest.approx(0.5)
    assert rates.effective_units[0] == pytest.approx(36.0 / 12.0)
    repeated = proportion_lower(3, 6, 0.9)
    assert rates.lower[0] < repeated


def test_unobserved_cases_with_large_weights_widen_the_upper_bound() -> None:
    weights, failure = np.ones((1, 300)), np.zeros(300, dtype=np.bool_)
    plain = weighted_rates(weights, failure, None, (0.9, 0.9))
    wide = weighted_rates(weights, failure, None, (0.9, 0.9), np.array([10.0]))
    assert wide.upper[0] == pytest.approx(10.0 * plain.upper[0])


def test_weights_that_are_all_rounded_to_zero_say_nothing() -> None:
    rates = weighted_rates(np.array([np.ones(60), np.full(60, 1e-300)]), np.zeros(60, dtype=np.bool_), None, (0.9, 0.9))
    assert rates.effective_units.tolist() == [60.0, 0.0]


#: Failures among standard normal numbers z, after which the mean moves to d: the rate is then the limit.
REGIONS: dict[str, Callable[[np.ndarray, float, float, np.random.Generator], Bool[np.ndarray, " n"]]] = {
    "in the direction of the change": lambda z, d, limit, rng: z > stats.norm.isf(limit) + d,
    "in the other direction": lambda z, d, limit, rng: z < d - stats.norm.isf(limit),
    "independent of the change": lambda z, d, limit, rng: rng.random(z.size) < limit,
}


@pytest.mark.parametrize("region", REGIONS)
@pytest.mark.parametrize(
    ("n", "limit", "shift"), [(300, 0.01, 0.1), (1000, 0.01, 0.3), (1000, 0.05, 1.0), (300, 0.1, 0.7), (1000, 0.5, 0.5)]
)
def test_bounds_cover_the_rate_under_a_change(region: str, n: int, limit: float, shift: float) -> None:
    """Both bounds hold with at least their confidence of 90 %; the standard deviation of 400 trials is 1.5 %."""
    rng = np.random.default_rng(58)
    covered = np.zeros(2)
    for _ in range(400):
        z = rng.standard_normal(n)
        weights = np.exp(shift * z - 0.5 * shift**2)[None]
        rates = weighted_rates(weights, REGIONS[region](z, shift, limit, rng), None, (0.9, 0.9))
        covered += [rates.lower[0] <= limit, rates.upper[0] >= limit]
    assert (covered / 400 >= 0.9 - 2.5 * 0.015).all(), covered / 400
