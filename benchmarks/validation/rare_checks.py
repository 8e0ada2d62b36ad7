"""Checks of subset simulation and importance sampling on limit states with known probabilities.

The checks measure the coverage of the intervals, and the cost.

A limit state returns the margin of a case, which is negative if the requirement is violated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from scipy.stats import norm

from benchmarks.validation.records import Check, Measure
from marsyard.campaigns.studies.importance import fit_density
from marsyard.campaigns.studies.interval import (
    ProbabilityInterval,
    effective_number,
    enclose,
    replicate_interval,
    weighted_interval,
)
from marsyard.campaigns.studies.rare import MIN_EFFECTIVE_VIOLATIONS, RareSettings
from marsyard.campaigns.studies.subset import NEW_STREAM, Evaluated, SubsetResult, subset_simulation
from marsyard.sim.streams import Blend

#: Cases per level and replicates of `marsyard rare`, and confidence of its interval.
SAMPLES, REPLICATES, CONFIDENCE = 200, 6, 0.9
#: Minimum coverage of the 90 % intervals, and minimum number of crude Monte Carlo cases divided by the number of cases
#: of subset simulation, for intervals of the same width, by probability.
MIN_COVERAGE, MIN_SAVINGS = 0.87, {1e-4: 8.0, 1e-6: 300.0}
#: Probability below which a simulation stops; never reached here.
LOWEST_LEVEL = 1e-9
#: Probabilities of violation of the linear limit states.
PROBABILITIES = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
#: Minimum number of studies with an interval of importance sampling, for which its coverage is measured.
MIN_STUDIES = 100
#: Function of the coordinates and random streams of cases that returns their margins.
LimitState = Callable[[np.ndarray, Sequence[Blend]], np.ndarray]


def linear_margin(dimension: int, probability: float, noise_fraction: float = 0.0) -> LimitState:
    """Return a linear limit state; a fraction of the variance of its load is noise of the random streams."""
    beta = float(norm.isf(probability))

    def margins(coordinates: np.ndarray, blends: Sequence[Blend]) -> np.ndarray:
        load = math.sqrt(1.0 - noise_fraction) * coordinates.sum(axis=1) / math.sqrt(dimension)
        noise = math.sqrt(noise_fraction) * blended_noise(blends) if noise_fraction else 0.0
        return np.asarray(beta - load - noise)

    return margins


def stream_noise(streams: np.ndarray) -> np.ndarray:
    """Return one standard normal number per stream (SplitMix64; Steele et al. 2014)."""
    state = (streams.astype(np.uint64) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    state ^= state >> np.uint64(31)
    return np.asarray(norm.ppf(((state >> np.uint64(11)).astype(np.float64) + 0.5) / 2.0**53))


def blended_noise(blends: Sequence[Blend]) -> np.ndarray:
    """Return one standard normal number per case: the weighted sum over the components of its streams."""
    components = np.array([component for blend in blends for component in blend])
    starts = np.cumsum([0, *(len(blend) for blend in blends[:-1])])
    return np.asarray(np.add.reduceat(components[:, 1] * stream_noise(components[:, 0].astype(np.int64)), starts))


def four_branch_margin(coordinates: np.ndarray, _blends: Sequence[Blend]) -> np.ndarray:
    """Series system with four branches (Waarts 2000), a usual test of reliability methods."""
    x, y = coordinates.T
    curved_branch = 3.0 + 0.1 * (x - y) ** 2
    branches = [curved_branch - (x + y) / math.sqrt(2.0), curved_branch + (x + y) / math.sqrt(2.0)]
    branches += [(x - y) + 7.0 / math.sqrt(2.0), (y - x) + 7.0 / math.sqrt(2.0)]
    return np.asarray(np.min(branches, axis=0))


def run_subset(margins: LimitState, dimension: int, seed: int, samples: int = SAMPLES) -> tuple[SubsetResult, int]:
    """Run one subset simulation; also return its number of cases.

    The simulation is a coroutine: it yields proposed cases and receives their margins. Proposals with `NEW_STREAM` get
    the next stream number.
    """
    process = subset_simulation(dimension, samples, LOWEST_LEVEL, np.random.default_rng(seed))
    cases, first_stream = 0, seed * 1_000_000
    try:
        proposals = next(process)
        while True:
            blends = [
                tuple((number if old == NEW_STREAM else old, weight) for old, weight in blend)
                for number, blend in enumerate(proposals.blends, start=first_stream + cases)
            ]
            cases += len(blends)
            proposals = process.send(Evaluated(blends, margins(proposals.coordinates, blends)))
    except StopIteration as stop:
        return stop.value, cases


def run_importance(
    results: Sequence[SubsetResult], margins: LimitState, dimension: int, seed: int
) -> ProbabilityInterval | None:
    """Sample around the violations of subset simulations; None where `marsyard rare` does not use the interval."""
    density = fit_density(np.concatenate([result.violations for result in results]))
    if density is None:
        return None
    count = RareSettings.importance_cases
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
            estimates, is_reached = [result.probability for result in results], [result.reached for result in results]
            interval = replicate_interval(estimates, is_reached, CONFIDENCE)
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
        how = f"at least {MIN_EFFECTIVE_VIOLATIONS:.0f} effective violations of {RareSettings.importance_cases} cases"
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
