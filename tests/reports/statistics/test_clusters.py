"""Tests of the bounds of rates of cases that share terrains: exactness, coverage and power."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
from scipy import stats

from marsyard.reports.statistics import clusters
from marsyard.reports.statistics.clustered_cases import ClusteredCases
from marsyard.reports.statistics.clusters import (
    Sizes,
    TailFunction,
    TerrainCounts,
    event_scores,
    max_statistic,
    number_terrains,
    select_counted,
)
from marsyard.reports.statistics.proportions import proportion_lower, proportion_upper

#: Designs: 8 terrains of 3 cases, 250 of 4, and unequal numbers of cases.
DESIGNS: dict[str, Sizes] = {
    "8 x 3": ((3, 8),),
    "250 x 4": ((4, 250),),
    "unequal": ((1, 60), (2, 40), (5, 30), (16, 8)),
}


def _draw_events(rng: np.random.Generator, sizes: Sizes, rate: float, correlation: float, trials: int) -> np.ndarray:
    """Draw the number of events on each terrain of each trial, with beta-distributed rates of the terrains.

    The correlation r of two cases on one terrain is 1 / (a + b + 1) for a beta distribution with parameters a and b.
    """
    cases = np.repeat([size for size, _ in sizes], [terrains for _, terrains in sizes])
    shape = trials, cases.size
    if correlation == 0.0:
        rates = np.full(shape, rate)
    elif correlation == 1.0:
        rates = (rng.random(shape) < rate).astype(float)
    else:
        total = (1.0 - correlation) / correlation
        rates = rng.beta(rate * total, (1.0 - rate) * total, shape)
    return rng.binomial(cases, rates)


def _enumerate_tail(sizes: Sizes, statistic: int, rates: np.ndarray, weights: np.ndarray) -> float:
    """Compute P(S <= statistic) by enumeration of the numbers of events of all terrains."""
    terrains = [size for size, count in sizes for _ in range(count)]
    pmf = [weights @ stats.binom.pmf(np.arange(size + 1), size, rates[:, None]) for size in terrains]
    return sum(
        math.prod(distribution[k] for distribution, k in zip(pmf, events, strict=True))
        for events in itertools.product(*(range(size + 1) for size in terrains))
        if sum(k * k for k in events) <= statistic
    )


def test_bound_at_a_risk_below_the_rounding_errors_is_1() -> None:
    assert TerrainCounts(((4, 30),), 300).max_rate(1e-12) == 1.0


@pytest.mark.parametrize("statistic", [1, 2, 4, 9, 13, 20])
def test_tail_equals_enumeration(statistic: int) -> None:
    sizes, rates, weights = ((1, 2), (2, 2), (3, 2)), np.array([0.05, 0.4, 0.9]), np.array([0.6, 0.3, 0.1])
    expected = _enumerate_tail(sizes, statistic, rates, weights)
    assert TailFunction(sizes, statistic).of_distribution(rates, weights) == pytest.approx(expected, abs=1e-9)


def test_tail_with_rounded_scores_equals_enumeration() -> None:
    sizes, rates, weights = ((20, 2),), np.array([0.1, 0.6]), np.array([0.7, 0.3])
    pmf = weights @ stats.binom.pmf(np.arange(21), 20, rates[:, None])
    scores = event_scores(sizes)
    for statistic in (3, 40, 300):
        expected = pmf @ (np.add.outer(scores, scores) <= statistic) @ pmf
        assert TailFunction(sizes, statistic).of_distribution(rates, weights) == pytest.approx(expected, abs=1e-9)


def test_pairs_of_support_points_have_the_mean() -> None:
    sizes, low, high, mean = ((2, 3), (4, 2)), np.array([0.0, 0.1]), np.array([0.3, 1.0]), 0.2
    tail = TailFunction(sizes, 7)
    probabilities = tail.of_pairs(low, high, mean)
    for row, column in itertools.product(range(2), range(2)):
        weight = (mean - low[row]) / (high[column] - low[row])
        points, weights = np.array([low[row], high[column]]), np.array([1.0 - weight, weight])
        assert probabilities[row, column] == pytest.approx(_enumerate_tail(sizes, 7, points, weights), abs=1e-9)


@pytest.mark.parametrize("terrains", [5, 230, 4000])
def test_terrains_count_as_cases_without_an_event(terrains: int) -> None:
    counts = TerrainCounts(((4, terrains),), 0)
    assert counts.p_value(0.01) == pytest.approx(0.99**terrains)
    assert counts.max_rate(0.1) == pytest.approx(1.0 - proportion_lower(terrains, terrains, 0.9))


@pytest.mark.parametrize("events", [0, 1, 7, 59, 60])
def test_single_cases_have_clopper_pearson_bounds(events: int) -> None:
    cases = ClusteredCases.of(np.arange(60) >= events, np.arange(60))
    assert 1.0 - cases.max_failure_rate(0.1) == pytest.approx(proportion_lower(60 - events, 60, 0.9), abs=1e-5)
    assert 1.0 - cases.min_failure_rate(0.1) == pytest.approx(proportion_upper(60 - events, 60, 0.9), abs=1e-5)


@pytest.mark.parametrize(
    ("sizes", "rate"),
    [(DESIGNS["8 x 3"], 0.4), (DESIGNS["250 x 4"], 0.01), (DESIGNS["unequal"], 0.05), (((10, 60),), 0.1),
     (((8, 67),), 0.3), (((5, 46),), 0.3), (((1, 30), (12, 5)), 0.6)],
)  # fmt: skip
def test_no_distribution_exceeds_the_supremum(sizes: Sizes, rate: float) -> None:
    """Random distributions with five support points, and a fine grid of those with two, have no larger probability."""
    statistic = max_statistic(sizes, rate, 0.1)
    supremum = TerrainCounts(sizes, statistic).p_value(rate)
    tail = TailFunction(sizes, statistic)
    rng = np.random.default_rng(3)
    best = 0.0
    for _ in range(800):
        points = np.sort(rng.beta(0.3, 0.3, 4))
        weights = rng.dirichlet(np.full(4, 0.3))
        mean = float(weights @ points)
        # the mean is corrected by a point at 0 or at 1
        extreme = 0.0 if mean > rate else 1.0
        fraction = (mean - rate) / (mean - extreme)
        distribution = np.append(points, extreme), np.append((1.0 - fraction) * weights, fraction)
        assert distribution[0] @ distribution[1] == pytest.approx(rate)
        best = max(best, tail.of_distribution(*distribution))
    # accuracy of the search: the probability at its maximum is flat
    low, high = np.linspace(0.0, rate, 60), np.linspace(rate + 1e-3, 1.0, 60)
    assert max(best, tail.of_pairs(low, high, rate).max()) <= supremum * (1.0 + 1e-3)


def _false_verdict_rates(sizes: Sizes, rate: float, correlation: float, trials: int) -> tuple[float, float]:
    """Simulate the frequency of bounds below and above a rate of events; each must be at most 10 %."""
    rng = np.random.default_rng(11)
    cases = np.repeat([size for size, _ in sizes], [terrains for _, terrains in sizes])
    events = _draw_events(rng, sizes, rate, correlation, trials)
    limits = max_statistic(sizes, rate, 0.1), max_statistic(sizes, 1.0 - rate, 0.1)
    statistics = (events**2).sum(axis=1), ((cases - events) ** 2).sum(axis=1)
    return float(np.mean(statistics[0] <= limits[0])), float(np.mean(statistics[1] <= limits[1]))


@pytest.mark.parametrize("correlation", [0.0, 0.05, 0.3, 1.0])
@pytest.mark.parametrize("rate", [0.01, 0.05])
@pytest.mark.parametrize("design", DESIGNS)
def test_bounds_cover_the_true_rate(design: str, rate: float, correlation: float) -> None:
    # 2000 campaigns: standard deviation of a frequency of 10 % is 0.7 %
    too_low, too_high = _false_verdict_rates(DESIGNS[design], rate, correlation, 2000)
    assert max(too_low, too_high) <= 0.1 + 3 * 0.007


@pytest.mark.parametrize(
    ("terrains", "cases_per_terrain", "answer_rate", "bad_fraction", "rates"),
    [pytest.param(40, 4, 0.1, 0.3, (0.2, 0.99), marks=pytest.mark.slow),
     pytest.param(60, 4, 0.3, 0.1, (0.0, 1.0), marks=pytest.mark.slow),
     pytest.param(60, 4, 0.2, 0.9, (1.0, 0.5), marks=pytest.mark.slow)],
)  # fmt: skip
def test_bounds_cover_the_rate_if_answers_depend_on_the_terrain(
    terrains: int, cases_per_terrain: int, answer_rate: float, bad_fraction: float, rates: tuple[float, float]
) -> None:
    """The rate is that of the answers; failing terrains can have fewer or several times as many answers as others.

    `rates`: success rates of terrains with few and with all answers; `answer_rate`: rate of answers on the former.
    """
    rng = np.random.default_rng(15)
    weights = np.array([bad_fraction * answer_rate, 1.0 - bad_fraction])
    rate, n_missed, trials = float(weights @ np.array(rates) / weights.sum()), np.zeros(2), 40
    index = np.repeat(np.arange(terrains), cases_per_terrain)
    for _ in range(trials):
        is_bad = rng.random(terrains) < bad_fraction
        member = rng.random(index.size) < np.where(is_bad, answer_rate, 1.0)[index]
        cases = ClusteredCases(rng.random(index.size) < np.where(is_bad, *rates)[index], member, index)
        n_missed += cases.consumer_risk(1.0 - rate, 0.1) <= 0.1, 1.0 - cases.min_failure_rate(0.1) < rate
    # standard deviation of a frequency of 10 % of 40: 4.7 %
    assert (n_missed / trials <= 0.1 + 2 * 0.047).all()


def test_more_cases_do_not_make_the_verdict_worse() -> None:
    """Probability of PASS of 99 % at 90 % confidence for a true failure rate of 0.1 % without correlation.

    If a terrain with any failure counted as failed, it would be 0.78, 0.37 and 0.02 (0.999 to the power of the number
    of cases: with 250 terrains no failed terrain is permitted).
    """
    powers = []
    for cases in (1, 4, 16):
        sizes = ((cases, 250),)
        limit = max_statistic(sizes, 0.01, 0.1)
        powers.append(
            TailFunction(sizes, limit).of_distribution(np.array([0.001]), np.ones(1)) if limit else 0.999**250
        )
    assert powers[0] == pytest.approx(0.999**250)
    assert powers[1] > 0.9
    assert powers[2] > 0.9


def test_search_for_a_statistic_ends_at_a_sufficient_probability(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes, rate, risk, calls = ((1, 4), (3, 12)), 0.21, 0.1, [0]
    evaluate = TailFunction.of_pairs

    def count(*arguments: Any) -> Any:
        calls[0] += 1
        return evaluate(*arguments)

    monkeypatch.setattr(TailFunction, "of_pairs", count)
    p_values = [TerrainCounts(sizes, statistic).p_value(rate) for statistic in range(12)]
    assert clusters.max_statistic(sizes, rate, risk) == sum(value <= risk for value in p_values) - 1
    calls[0] = 0
    probability, _ = clusters._find_supremum(sizes, 11, rate, risk)
    # the grid of support points is sufficient: 17 evaluations without the limit
    assert (calls[0], risk < probability <= p_values[11]) == (1, True)


@pytest.mark.parametrize(
    ("index", "counted"),
    [
        (np.tile(np.arange(300), 4), 4),  # all
        (np.tile(np.arange(300), 40), 10),  # 300 terrains of 10: the statistic is at most 30,000
        (np.tile(np.arange(3), 40_000), 40_000),  # all: scores of many cases on a terrain are rounded
        (np.append(np.tile(np.arange(1000), 2), np.repeat(np.arange(1000, 1100), 60)), 10),
        (np.tile(np.arange(40_000), 3), 1),
    ],
)
def test_bounds_use_the_first_cases_of_each_terrain_if_all_cost_too_much(index: np.ndarray, counted: int) -> None:
    expected = [np.flatnonzero(index == terrain)[:counted] for terrain in range(3)]
    selected = np.flatnonzero(select_counted(index))
    for terrain, cases in enumerate(expected):
        np.testing.assert_array_equal(selected[index[selected] == terrain], cases)
    assert selected.size == np.minimum(np.bincount(index), counted).sum()
    evidence = ClusteredCases.of(np.ones(index.size, dtype=bool), index).count_terrains()
    assert evidence.counted == (None if selected.size == index.size else counted)


@pytest.mark.parametrize("correlation", [pytest.param(0.02, marks=pytest.mark.slow), 0.3])
def test_bounds_of_many_cases_on_shared_terrains_cover_the_true_rate(correlation: float) -> None:
    rng, rate, trials = np.random.default_rng(8), 0.05, 1000
    index, n_missed = np.tile(np.arange(200), 60), np.zeros(2)
    total = (1.0 - correlation) / correlation
    for _ in range(trials):
        success = rng.random(index.size) >= rng.beta(rate * total, (1.0 - rate) * total, 200)[index]
        counts = ClusteredCases.of(success, index).failures, ClusteredCases.of(~success, index).failures
        n_missed += [
            count.statistic <= max_statistic(count.sizes, limit, 0.1)
            for count, limit in zip(counts, (rate, 1.0 - rate), strict=True)
        ]
    assert counts[0].sizes == ((12, 200),)
    # standard deviation of a frequency of 10 % of 1000: 0.95 %
    assert (n_missed / trials <= 0.1 + 3 * 0.0095).all()


def test_spread_failures_are_stronger_evidence_than_failures_on_one_terrain() -> None:
    index = np.repeat(np.arange(300), 4)
    spread, concentrated = np.ones(1200, dtype=bool), np.ones(1200, dtype=bool)
    spread[[0, 4, 8]] = False
    concentrated[[0, 1, 2]] = False
    lower = [1.0 - ClusteredCases.of(success, index).max_failure_rate(0.1) for success in (spread, concentrated)]
    assert proportion_lower(1197, 1200, 0.9) > lower[0] > lower[1]


def test_consumer_risk_decides_like_the_bound() -> None:
    rng = np.random.default_rng(5)
    for _ in range(6):
        index = number_terrains(rng.integers(0, 60, 90))
        member = rng.random(90) < 0.9
        cases = ClusteredCases(rng.random(90) < 0.97, member, index)
        for limit in (0.03, 0.06, 0.1):
            assert (cases.consumer_risk(limit, 0.1) <= 0.1) == (cases.max_failure_rate(0.1) <= limit)


def test_additional_cases_are_the_minimum() -> None:
    index, success = np.repeat(np.arange(100), 2), np.ones(200, dtype=bool)
    success[7] = False
    needed = ClusteredCases.of(success, index).additional_cases_needed(0.01, 0.1)

    def passes(additional: int) -> bool:
        new_terrains = 100 + np.arange(additional)
        cases = ClusteredCases.of(np.append(success, np.ones(additional, dtype=bool)), np.append(index, new_terrains))
        return cases.consumer_risk(0.01, 0.1) <= 0.1

    assert passes(needed)
    assert not passes(needed - 1)


def test_terrains_are_counted_by_outcome() -> None:
    success, index = np.ones(600, dtype=bool), np.arange(600) % 60
    success[[0, 60, 1]] = False  # two on terrain 0, one on terrain 1
    success[2::60] = False
    evidence = ClusteredCases.of(success, index).count_terrains()
    assert (evidence.terrains, evidence.failed_terrains, evidence.successful_terrains) == (60, 3, 59)
    assert evidence.failure_pairs == 1 + 45


def test_terrains_are_numbered_consecutively() -> None:
    for terrain in ([7, 3, 7, 5], [-2, 10**15, -2], [4]):
        terrain_ids = np.array(terrain, dtype=np.int64)
        np.testing.assert_array_equal(number_terrains(terrain_ids), np.unique(terrain_ids, return_inverse=True)[1])


def test_scores_are_squares_or_rounded_up() -> None:
    assert event_scores(((2, 5), (4, 1))).tolist() == [0, 1, 4, 9, 16]
    scores = event_scores(((32, 3),))
    # in units of 4: 1 / 4 and 4 / 4 are 1, 9 / 4 is 3
    assert scores[:4].tolist() == [0, 1, 1, 3]
    assert scores[-1] == 16**2
    assert (np.diff(scores) >= 0).all()
