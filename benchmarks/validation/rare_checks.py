"""Checks of the intervals of subset simulation and importance sampling on limit states with known probabilities.

The checks measure the coverage of the intervals, and the cost.
"""

import math
from collections.abc import Iterator, Sequence

import numpy as np
from scipy.stats import norm

from benchmarks.validation.limit_states import LimitState, four_branch_margin, linear_margin, run_subset
from benchmarks.validation.records import Check, Measure
from marsyard.campaigns.studies.importance import fit_density
from marsyard.campaigns.studies.interval import (
    ProbabilityInterval,
    effective_number,
    enclose,
    replicate_interval,
    weighted_interval,
)
from marsyard.campaigns.studies.rare_decision import MIN_EFFECTIVE_VIOLATIONS
from marsyard.campaigns.studies.results import RareParameters
from marsyard.campaigns.studies.subset import SubsetResult
from marsyard.sim.streams import Blend

#: Cases per level and replicates of `marsyard rare`, and confidence of its interval.
SAMPLES, REPLICATES, CONFIDENCE = 200, 6, 0.9
#: Minimum coverage of the 90 % intervals, and minimum number of crude Monte Carlo cases divided by the number of cases
#: of subset simulation, for intervals of the same width, by probability.
MIN_COVERAGE, MIN_SAVINGS = 0.87, {1e-4: 8.0, 1e-6: 300.0}
#: Probabilities of violation of the linear limit states.
PROBABILITIES = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
#: Minimum number of studies with an interval of importance sampling, for which its coverage is measured.
MIN_STUDIES = 100


def run_importance(
    results: Sequence[SubsetResult], margins: LimitState, dimension: int, seed: int
) -> ProbabilityInterval | None:
    """Sample around the violations of subset simulations; None where `marsyard rare` does not use the interval."""
    density = fit_density(np.concatenate([result.violations for result in results]))
    if density is None:
        return None
    count = RareParameters.importance_cases
    coordinates, weights = density.draw(count, np.random.default_rng((seed, dimension)))
    # streams that no subset simulation uses
    blends: list[Blend] = [((10**12 + seed * count + number, 1.0),) for number in range(count)]
    violation_weights = (weights * (margins(coordinates, blends) < 0.0)).tolist()
    if effective_number(violation_weights) < MIN_EFFECTIVE_VIOLATIONS:
        return None
    return weighted_interval(violation_weights, CONFIDENCE)


def limit_states() -> Iterator[tuple[str, LimitState, int, float]]:
    """Yield name, margins, dimension and probability of each limit state."""
    for dimension in (2, 20, 100):
        for probability in PROBABILITIES:
            name = f"probability {probability:g}, linear, {dimension} variables"
            yield name, linear_margin(dimension, probability), dimension, probability
    for noise_fraction in (0.3, 0.95):
        for probability in (1e-3, 1e-4):
            name = f"probability {probability:g}, linear with noise ({noise_fraction:.0%} of variance), 20 variables"
            yield name.replace("%", " %"), linear_margin(20, probability, noise_fraction), 20, probability
    rng, n = np.random.default_rng(0), 500_000
    violation_rates = [np.mean(four_branch_margin(rng.standard_normal((n, 2)), ()) < 0.0) for _ in range(40)]
    probability = float(np.mean(violation_rates))
    yield f"probability {probability:.3g}, four regions, 2 variables", four_branch_margin, 2, probability


def run_rare(quick: bool) -> Iterator[Measure]:
    """Measure coverage and cost for each limit state."""
    trials = 40 if quick else 300
    for name, margins, dimension, probability in limit_states():
        covered_count, cases, widths = 0, 0, []
        importance_intervals, enclosing_intervals = list[ProbabilityInterval](), list[ProbabilityInterval]()
        for trial in range(trials):
            runs = [run_subset(margins, dimension, 1 + trial * REPLICATES + index) for index in range(REPLICATES)]
            results = [result for result, _ in runs]
            cases += sum(count for _, count in runs)
            interval = replicate_interval([result.probability for result in results], CONFIDENCE)
            covered_count += interval.lower <= probability <= interval.upper
            widths.append(math.log(interval.upper / interval.lower) if interval.lower > 0.0 else math.inf)
            importance = run_importance(results, margins, dimension, 1 + trial)
            if importance:
                importance_intervals.append(importance)
                enclosing_intervals.append(enclose(importance, interval))
        how = f"{trials} studies, each of {REPLICATES} simulations with {SAMPLES} cases per level"
        yield Measure(
            f"rare violations, coverage of the 90 % interval: {name}",
            covered_count / trials,
            "",
            MIN_COVERAGE,
            how,
            "at least",
        )
        n_importance = len(importance_intervals)
        claim = f"rare violations, studies with an interval of importance sampling: {name}"
        how = f"at least {MIN_EFFECTIVE_VIOLATIONS:.0f} effective violations of {RareParameters.importance_cases} cases"
        yield Measure(claim, n_importance / trials, "", None, how)
        if n_importance >= min(MIN_STUDIES, trials):
            for which, limit, intervals in (
                ("importance sampling alone", None, importance_intervals),
                ("importance sampling and subset simulation", MIN_COVERAGE, enclosing_intervals),
            ):
                coverage = sum(item.lower <= probability <= item.upper for item in intervals) / n_importance
                claim = f"rare violations, coverage of the 90 % interval of {which}: {name}"
                yield Measure(claim, coverage, "", limit, f"{n_importance} studies", "at least")
        if probability in MIN_SAVINGS:
            # n cases of crude Monte Carlo have the interval p exp(+-z sqrt((1 - p) / (n p)))
            z = float(norm.ppf(0.5 * (1.0 + CONFIDENCE)))
            crude_cases = (2.0 * z / float(np.median(widths))) ** 2 * (1.0 - probability) / probability
            savings = crude_cases * trials / cases
            how = f"for an interval of the same width; {cases / trials:.0f} cases"
            claim = f"rare violations, cases of counting divided by cases of the study: {name}"
            yield Measure(claim, savings, "1", MIN_SAVINGS[probability], how, "at least")


CHECKS = (Check("rare", "Statistics", run_rare),)
