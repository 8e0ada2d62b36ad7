"""Tests of the verdict on rare violations: gross errors, steps and plateaus give no false PASS and no false FAIL."""

import itertools

import numpy as np
import pytest

from benchmarks.validation.limit_states import (
    KnownState,
    cliff_margin,
    discontinuous_states,
    linear_margin,
    outlier_margin,
)
from benchmarks.validation.rare_verdicts import DEFAULTS, NOMINAL_RISK, measure_rates, simulate_study
from marsyard.campaigns.studies.counting import find_units_needed
from marsyard.campaigns.studies.rare_decision import Basis, RareSample, RareVerdict, decide_rare
from marsyard.campaigns.studies.subset import Level, SubsetEnd, SubsetResult

STATES = tuple(discontinuous_states())
OPPOSITE = KnownState("step in the opposite direction", cliff_margin(1e-4, is_opposite=True), 2, 1e-4)


def create_replicate(probability: float, end: SubsetEnd = SubsetEnd.VIOLATION, jumps: int = 0) -> SubsetResult:
    """Create a replicate of four levels with 200 cases, with violations that were reached from the second level."""
    levels = (Level(1.0, 200, 0), Level(0.1, 180, jumps), Level(1e-2, 180, 1), Level(1e-3, 180, 10))
    return SubsetResult(probability, end, (3.0, 2.0, 1.0), levels, np.zeros((1, 2)))


def create_sample(replicates: list[SubsetResult], violations: int, cases: int) -> RareSample:
    is_violation = np.arange(cases) < violations
    return RareSample(replicates, is_violation, [None] * cases)


SMOOTH = [create_replicate(probability) for probability in (0.8e-4, 1e-4, 1.3e-4, 0.9e-4)]


def test_no_study_passes_with_gross_errors_at_twice_the_limit() -> None:
    """20 studies with seeds that no other test uses: gross errors with 1e-4, limit 5e-5, default number of cases."""
    state = KnownState("gross errors", outlier_margin(1e-4), 2, 1e-4)
    studies = [simulate_study(state, 5e-5, seed) for seed in range(530_000, 530_020)]
    verdicts = [study.decide(state, 5e-5, DEFAULTS.random_cases[0]).verdict for study in studies]
    assert verdicts.count(RareVerdict.PASS) == 0


@pytest.mark.parametrize("state", STATES, ids=[state.name for state in STATES])
def test_false_verdicts_are_not_more_frequent_than_nominal(state: KnownState) -> None:
    """At half of the true probability a PASS is wrong, at twice the probability a FAIL; each has a risk of 5 %."""
    half = measure_rates(state, 0.5, 8, first_seed=8_000)
    double = measure_rates(state, 2.0, 8, first_seed=9_000)
    # 8 studies at a rate of 5 %: three or more wrong verdicts have a probability of 0.6 %
    assert max(half.default[RareVerdict.PASS], half.counting[RareVerdict.PASS]) <= 2 / 8
    assert max(double.default[RareVerdict.FAIL], double.counting[RareVerdict.FAIL]) <= 2 / 8


@pytest.mark.slow
def test_probabilities_of_the_limit_states_are_the_known_ones() -> None:
    rng, n, chunks = np.random.default_rng(4), 250_000, 4
    # with fewer than 90 expected violations the tolerance would be too wide; the states of 1e-5 have the same functions
    for state in (item for item in STATES if item.probability > 5e-5):
        violations = 0
        for chunk in range(chunks):
            streams = [((chunk * n + index, 1.0),) for index in range(n)]
            violations += int(np.sum(state.margins(rng.standard_normal((n, state.dimension)), streams) < 0.0))
        expected = state.probability * n * chunks
        # four standard deviations of a Poisson number
        assert abs(violations - expected) <= 4.0 * expected**0.5, state.name


def test_violations_are_found_where_the_margin_is_continuous() -> None:
    state = KnownState("linear", linear_margin(20, 1e-4), 20, 1e-4)
    assert measure_rates(state, 0.1, 10, first_seed=10_000).default[RareVerdict.FAIL] >= 0.9


def test_steps_would_pass_by_the_interval_of_the_simulations() -> None:
    """The chains move towards small margins, so that they never reach the step; only counting gives no PASS."""
    rates = measure_rates(OPPOSITE, 0.5, 10, first_seed=11_000)
    assert rates.interval_pass >= 0.5
    assert rates.default[RareVerdict.PASS] == 0.0


def test_pass_rests_on_counting_and_fail_on_either_bound() -> None:
    needed = find_units_needed(0, 1e-3, NOMINAL_RISK)
    passed = decide_rare(create_sample(SMOOTH, 0, needed), 1e-3, 0.9)
    assert (passed.verdict, passed.basis) == (RareVerdict.PASS, Basis.COUNTING)
    undecided = decide_rare(create_sample(SMOOTH, 0, needed - 1), 1e-3, 0.9)
    assert undecided.verdict is RareVerdict.INSUFFICIENT
    assert undecided.interval.upper < 1e-3
    assert undecided.additional_random_cases == find_units_needed(0, 1e-3, 0.5 * NOMINAL_RISK) - needed + 1
    by_simulation = decide_rare(create_sample(SMOOTH, 0, 2000), 2e-5, 0.9)
    assert (by_simulation.verdict, by_simulation.basis) == (RareVerdict.FAIL, Basis.SIMULATION)
    by_counting = decide_rare(create_sample(SMOOTH, 20, 2000), 1e-3, 0.9)
    assert (by_counting.verdict, by_counting.basis) == (RareVerdict.FAIL, Basis.COUNTING)


@pytest.mark.parametrize(
    ("end", "text"), [(SubsetEnd.PLATEAU, "reached a plateau"), (SubsetEnd.UNLIKELY, "hundredth of the limit")]
)
def test_replicate_that_stopped_early_gives_no_estimate(end: SubsetEnd, text: str) -> None:
    early = create_replicate(1e-2, end)
    decision = decide_rare(create_sample([*SMOOTH, early], 0, 2000), 2e-5, 0.9)
    assert decision.verdict is RareVerdict.INSUFFICIENT
    assert text in decision.reason
    assert (decision.interval.lower, decision.interval.upper) == (0.0, 1.0)
    needed = find_units_needed(0, 1e-2, NOMINAL_RISK)
    assert decide_rare(create_sample([*SMOOTH, early], 0, needed), 1e-2, 0.9).verdict is RareVerdict.PASS
    # 4e10 cases would be needed, more than any campaign can have
    assert decide_rare(create_sample([*SMOOTH, early], 0, 2000), 1e-10, 0.9).additional_random_cases is None


def test_violations_without_intermediate_margins_refute_the_estimate() -> None:
    """The second level has 720 cases and the probability 0.1: a continuous margin gives 0.7 violations at 1e-4."""
    jumping = [create_replicate(item.probability, jumps=2) for item in SMOOTH]
    decision = decide_rare(create_sample(jumping, 0, 2000), 2e-5, 0.9)
    assert decision.continuity.direct == 8
    assert decision.continuity.refuted
    assert decision.verdict is RareVerdict.INSUFFICIENT
    assert "8 violations were reached without intermediate margins" in decision.reason


def test_independent_sample_refutes_a_too_high_estimate() -> None:
    """10,000 random cases without a violation are incompatible with an estimate of 1 %, so there is no FAIL."""
    high = [create_replicate(100.0 * item.probability) for item in SMOOTH]
    decision = decide_rare(create_sample(high, 0, 10_000), 1e-4, 0.9)
    assert decision.continuity.refuted
    assert decision.verdict is RareVerdict.INSUFFICIENT


def test_sum_of_the_risks_of_all_evaluations_is_limited() -> None:
    confidences = [
        decide_rare(create_sample(SMOOTH, 0, 100), 1e-3, 0.9, evaluation).counting.upper_confidence
        for evaluation in range(1, 30)
    ]
    assert sum(1.0 - confidence for confidence in confidences) < 0.1
    assert all(later > earlier for earlier, later in itertools.pairwise(confidences))
