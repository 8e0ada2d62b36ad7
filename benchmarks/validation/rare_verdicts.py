"""Checks of the verdicts of `marsyard rare` on limit states with gross errors, steps, plateaus and narrow regions.

The verdicts come from the function of the product (`decide_rare`). Random cases violate the requirement independently
with the known probability, so that only the replicates evaluate margins.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from benchmarks.validation.limit_states import KnownState, discontinuous_states, run_subset
from benchmarks.validation.records import Check, Measure
from marsyard.campaigns.studies.counting import find_units_needed
from marsyard.campaigns.studies.interval import replicate_interval
from marsyard.campaigns.studies.rare import MIN_PROBABILITY_FRACTION
from marsyard.campaigns.studies.rare_decision import Decision, RareSample, RareVerdict, decide_rare
from marsyard.campaigns.studies.results import RareParameters
from marsyard.campaigns.studies.subset import SubsetResult

#: Parameters of `marsyard rare` without options, and its one-sided risk of a wrong verdict.
DEFAULTS = RareParameters("", 1e-4)
NOMINAL_RISK = 0.5 * (1.0 - DEFAULTS.confidence)
#: Limits of the probability, divided by the true one: PASS is wrong at the first one, FAIL at the last ones.
FALSE_PASS_RATIO, FALSE_FAIL_RATIO = 0.5, 2.0


@dataclass(frozen=True)
class SimulatedStudy:
    """Replicates of a study, violations of their first levels, and the generator of its random cases."""

    replicates: list[SubsetResult]
    first_violations: int
    rng: np.random.Generator

    def decide(self, state: KnownState, limit: float, random_cases: int) -> Decision:
        """Draw random cases, and decide."""
        first_level = np.zeros(DEFAULTS.samples * len(self.replicates), dtype=bool)
        first_level[: self.first_violations] = True
        drawn = self.rng.random(random_cases) < state.probability
        is_violation = np.concatenate([first_level, drawn])
        sample = RareSample(self.replicates, is_violation, [None] * len(is_violation))
        return decide_rare(sample, limit, DEFAULTS.confidence)


def simulate_study(state: KnownState, limit: float, seed: int) -> SimulatedStudy:
    """Run the replicates of a study with the defaults of `marsyard rare`."""
    count, min_probability = DEFAULTS.replicates[0], MIN_PROBABILITY_FRACTION * limit
    run = partial(run_subset, samples=DEFAULTS.samples, min_probability=min_probability)
    results = [run(state.margins, state.dimension, seed * count + index)[0] for index in range(count)]
    first_violations = sum(result.levels[0].entered for result in results)
    return SimulatedStudy(results, first_violations, np.random.default_rng((seed, 53)))


@dataclass(frozen=True)
class VerdictRates:
    """Rates of the verdicts of simulated studies.

    - default: with the default number of random cases
    - counting: with as many random cases as the counting bound needs without a violation
    - interval_pass: rate of an upper bound of the simulations' interval below the limit, on which no PASS rests
    """

    default: Mapping[RareVerdict, float]
    counting: Mapping[RareVerdict, float]
    interval_pass: float


def measure_rates(state: KnownState, ratio: float, trials: int, first_seed: int) -> VerdictRates:
    """Measure the rates at a limit of `ratio` times the true probability."""
    limit = ratio * state.probability
    counting_cases = find_units_needed(0, limit, NOMINAL_RISK)
    decisions: tuple[list[Decision], list[Decision]] = ([], [])
    interval_passes = 0
    for seed in range(first_seed, first_seed + trials):
        study = simulate_study(state, limit, seed)
        decisions[0].append(study.decide(state, limit, DEFAULTS.random_cases[0]))
        decisions[1].append(study.decide(state, limit, counting_cases))
        # replicates without a violation have the probability of their last level
        estimates = [result.probability for result in study.replicates]
        interval_passes += replicate_interval(estimates, DEFAULTS.confidence).upper <= limit
    few, many = (
        {verdict: sum(item.verdict is verdict for item in group) / trials for verdict in RareVerdict}
        for group in decisions
    )
    return VerdictRates(few, many, interval_passes / trials)


def run_verdicts(quick: bool) -> Iterator[Measure]:
    """Measure the rates of wrong and right verdicts on each limit state."""
    trials = 20 if quick else 200
    for state in discontinuous_states():
        half = measure_rates(state, FALSE_PASS_RATIO, trials, first_seed=1)
        how = f"{trials} studies, limit half of the true probability"
        interval_how = f"{how}; by the 90 % interval of the simulations it would be {half.interval_pass:.2g}"
        for budget, rates, method in (
            ("default number of cases", half.default, interval_how),
            ("as many random cases as counting needs", half.counting, how),
        ):
            claim = f"rare violations, false PASS, {budget}: {state.name}"
            yield Measure(claim, rates[RareVerdict.PASS], "", NOMINAL_RISK, method)
        double = measure_rates(state, FALSE_FAIL_RATIO, trials, first_seed=1 + trials)
        how = f"{trials} studies, limit twice the true probability, default number of cases"
        claim = f"rare violations, false FAIL: {state.name}"
        yield Measure(claim, double.default[RareVerdict.FAIL], "", NOMINAL_RISK, how)
        tenfold = measure_rates(state, 10.0, trials, first_seed=1 + 2 * trials)
        how = (
            "limit ten times the true probability, as many random cases as counting needs; limit twice the true "
            f"probability: {double.counting[RareVerdict.PASS]:.2g}"
        )
        claim = f"rare violations, rate of PASS: {state.name}"
        yield Measure(claim, tenfold.counting[RareVerdict.PASS], "", None, how)
        tenth = measure_rates(state, 0.1, trials, first_seed=1 + 3 * trials)
        how = (
            "limit a tenth of the true probability, default number of cases; "
            f"limit half of the true probability: {half.default[RareVerdict.FAIL]:.2g}"
        )
        yield Measure(f"rare violations, rate of FAIL: {state.name}", tenth.default[RareVerdict.FAIL], "", None, how)


CHECKS = (Check("rare-verdicts", "Statistics", run_verdicts),)
