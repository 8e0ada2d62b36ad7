"""Limit states with known probabilities, and subset simulations of them, for the checks of `marsyard rare`.

A limit state returns the margins of cases, which are negative if the requirement is violated.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from marsyard.campaigns.sampling.study_points import NEW_STREAM
from marsyard.campaigns.studies.subset import Evaluated, SubsetResult, subset_simulation
from marsyard.sim.streams import Blend

#: Default probability below which a simulation stops, which no simulation reaches.
LOWEST_LEVEL = 1e-9
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


@dataclass(frozen=True)
class KnownState:
    """A limit state with its name, number of standard normal variables, and probability of a violation."""

    name: str
    margins: LimitState
    dimension: int
    probability: float


def outlier_margin(probability: float) -> LimitState:
    """Return the margin |z|, which is never negative, with a gross error that is independent of all variables.

    The gross error depends only on the newest random streams of a case, as the draws for an image do.
    """

    def margins(coordinates: np.ndarray, blends: Sequence[Blend]) -> np.ndarray:
        newest_streams = np.array([blend[-1][0] for blend in blends], dtype=np.int64)
        return np.where(stream_noise(newest_streams) > norm.isf(probability), -1.0, np.abs(coordinates[:, 0]))

    return margins


def cliff_margin(probability: float, *, is_opposite: bool = False) -> LimitState:
    """Return a margin that falls along the first variable, with a step to a violation along another direction.

    The step is along the second variable, or opposite to the direction in which the margin falls (`is_opposite`).
    """

    def margins(coordinates: np.ndarray, _blends: Sequence[Blend]) -> np.ndarray:
        # a margin of 40 standard deviations gives no violation of its own
        step_variable = -coordinates[:, 0] if is_opposite else coordinates[:, 1]
        return np.where(step_variable > norm.isf(probability), -1.0, 40.0 - coordinates[:, 0])

    return margins


def plateau_margin(fraction: float, probability: float) -> LimitState:
    """Return a margin that is 1 for a fraction of the cases, and falls linearly for the other ones."""
    start, end = norm.isf(1.0 - fraction), norm.isf(probability)

    def margins(coordinates: np.ndarray, _blends: Sequence[Blend]) -> np.ndarray:
        z = coordinates[:, 0]
        return np.where(z < start, 1.0, (end - z) / (end - start))

    return margins


def channel_margin(probability: float) -> LimitState:
    """Return a margin whose violations lie in a channel with a width of 0.2 standard deviations."""
    half_width = 0.1
    end = norm.isf(probability / (1.0 - 2.0 * norm.sf(half_width)))

    def margins(coordinates: np.ndarray, _blends: Sequence[Blend]) -> np.ndarray:
        return np.maximum(end - coordinates[:, 0], 20.0 * (np.abs(coordinates[:, 1]) - half_width))

    return margins


def unequal_lobes_margin(probability: float) -> LimitState:
    """Return a margin with two regions: the likely one (90 %) is steep, the unlikely one attracts the chains."""

    def margins(coordinates: np.ndarray, _blends: Sequence[Blend]) -> np.ndarray:
        z = coordinates[:, 0]
        return np.minimum(3.0 * (norm.isf(0.9 * probability) - z), norm.isf(0.1 * probability) + z)

    return margins


def discrete_margin(coordinates: np.ndarray, _blends: Sequence[Blend]) -> np.ndarray:
    """Return a margin in steps of 1, of a count and of a category with the probability 1 %."""
    is_rare_category = coordinates[:, 0] > norm.isf(0.01)
    return np.asarray(7.5 - np.floor(2.0 * coordinates[:, 1]) - 3.0 * is_rare_category)


#: Probability of a violation of `discrete_margin`: the count reaches 8, or 5 in the rare category.
DISCRETE_PROBABILITY = float(0.99 * norm.sf(4.0) + 0.01 * norm.sf(2.5))


def far_regions_margin(dimension: int, probability: float) -> LimitState:
    """Return a margin with two regions per variable, in opposite directions."""
    # the regions are |z| > bound for each variable: 1 - (1 - 2 sf(bound))^dimension is the probability of their union
    bound = norm.isf(-0.5 * math.expm1(math.log1p(-probability) / dimension))
    return lambda coordinates, _blends: np.asarray(bound - np.abs(coordinates).max(axis=1))


def discontinuous_states() -> Iterator[KnownState]:
    """Yield limit states with gross errors, steps, plateaus, narrow or unequal regions, and smooth ones."""
    for probability in (1e-3, 3e-4, 1e-4, 1e-5):
        yield KnownState(f"gross errors at random, {probability:g}", outlier_margin(probability), 2, probability)
    for probability in (1e-4, 1e-5):
        yield KnownState(f"step of another variable, {probability:g}", cliff_margin(probability), 2, probability)
    opposite = cliff_margin(1e-4, is_opposite=True)
    yield KnownState("step in the opposite direction, 0.0001", opposite, 2, 1e-4)
    yield KnownState("margin flat for 99 % of cases, 0.0001", plateau_margin(0.99, 1e-4), 2, 1e-4)
    yield KnownState("narrow channel, 0.0001", channel_margin(1e-4), 2, 1e-4)
    yield KnownState("two regions, 9 to 1, 0.0001", unequal_lobes_margin(1e-4), 2, 1e-4)
    name = f"discrete parameters, {DISCRETE_PROBABILITY:.2g}"
    yield KnownState(name, discrete_margin, 2, DISCRETE_PROBABILITY)
    yield KnownState("20 regions, 0.0001", far_regions_margin(10, 1e-4), 10, 1e-4)
    yield KnownState("linear with noise (95 % of variance), 0.0001", linear_margin(20, 1e-4, 0.95), 20, 1e-4)
    yield KnownState("linear, 20 variables, 0.0001", linear_margin(20, 1e-4), 20, 1e-4)


def run_subset(
    margins: LimitState, dimension: int, seed: int, samples: int = 200, min_probability: float = LOWEST_LEVEL
) -> tuple[SubsetResult, int]:
    """Run one subset simulation; also return its number of cases.

    The simulation is a coroutine: it yields proposed cases and receives their margins. Proposals with `NEW_STREAM` get
    the next stream number.
    """
    process = subset_simulation(dimension, samples, min_probability, np.random.default_rng(seed))
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
