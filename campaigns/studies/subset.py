"""Subset simulation: the probability of a rare violation as a product of larger conditional probabilities.

Au & Beck 2001, Probabilistic Engineering Mechanics 16, 263-277. A violation is a margin below 0. Each level contains
the cases with a margin of at most its threshold, a quantile of the previous level's margins. Cases of a level are drawn
by Markov chains that start at the cases of the previous level below the threshold: conditional sampling with an
adaptive step in standard normal space (Papaioannou et al. 2015, Probabilistic Engineering Mechanics 41, 89-103,
algorithm with acceptance 0.44). The random streams of a case are a further variable: a step replaces them by new ones
with probability 0.25.

The estimated coefficient of variation of one run is too small, because its chains are correlated. Intervals therefore
use the spread of independent replicates (`marsyard.campaigns.studies.interval`).
"""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

#: Fraction of the cases that define the next level.
LEVEL_FRACTION = 0.1
#: Target acceptance rate of the chains, to which their step is adapted, and initial step.
_TARGET_ACCEPTANCE, _INITIAL_STEP = 0.44, 0.6
#: Probability that a step draws new random streams.
_NEW_STREAM_PROBABILITY = 0.25
#: Stream number of a proposed case that gets new random streams.
NEW_STREAM = -1

Coordinates = Float64[np.ndarray, "n dimensions"]
StreamNumbers = Int64[np.ndarray, " n"]
Margins = Float64[np.ndarray, " n"]


@dataclass(frozen=True)
class Proposals:
    """Cases to be evaluated: coordinates, and numbers of their random streams (`NEW_STREAM` for new ones)."""

    coordinates: Coordinates
    streams: StreamNumbers


@dataclass(frozen=True)
class Evaluated:
    """Evaluated cases: numbers of their random streams, and margins.

    A margin is infinite if a violation is excluded, and minus infinite if it is certain.
    """

    streams: StreamNumbers
    margins: Margins


@dataclass(frozen=True)
class SubsetResult:
    """Result of one subset simulation.

    - probability: estimated probability of a violation; the probability of the last level if `reached` is false
    - reached: whether a violation was reached; otherwise `probability` is an upper limit
    - thresholds: margin of each intermediate level
    - violations: coordinates of the violating cases of the last level
    """

    probability: float
    reached: bool
    thresholds: tuple[float, ...]
    violations: Coordinates


#: Coroutine that yields cases to be evaluated, receives their margins, and returns the result.
SubsetRun = Generator[Proposals, Evaluated, SubsetResult]


def subset_simulation(dimension: int, samples: int, min_probability: float, rng: np.random.Generator) -> SubsetRun:
    """Run one subset simulation with `samples` cases per level; stop at levels less likely than `min_probability`.

    `dimension` is the number of standard normal variables.
    """
    coordinates = rng.standard_normal((samples, dimension))
    evaluated = yield Proposals(coordinates, np.full(samples, NEW_STREAM))
    streams, margins = evaluated.streams, evaluated.margins
    probability, step, thresholds = 1.0, _INITIAL_STEP, list[float]()
    while True:
        is_violation = margins < 0.0
        threshold = _next_threshold(margins)
        if threshold is None or is_violation.mean() >= LEVEL_FRACTION or probability < min_probability:
            reached = bool(is_violation.any())
            fraction = float(is_violation.mean()) if reached else 1.0
            return SubsetResult(probability * fraction, reached, tuple(thresholds), coordinates[is_violation])
        thresholds.append(threshold)
        seeds = rng.permutation(np.flatnonzero(margins <= threshold))
        probability *= seeds.size / samples
        # all chains advance together; the cases of the level are the states of the chains, including the seeds
        states = coordinates[seeds], streams[seeds], margins[seeds]
        level = [states]
        for chain_step in range(1, math.ceil(samples / seeds.size)):
            size = min(seeds.size, samples - chain_step * seeds.size)
            points, previous_streams, previous_margins = (values[:size] for values in states)
            proposed_points = math.sqrt(1.0 - step**2) * points + step * rng.standard_normal(points.shape)
            new_streams = np.where(rng.random(size) < _NEW_STREAM_PROBABILITY, NEW_STREAM, previous_streams)
            evaluated = yield Proposals(proposed_points, new_streams)
            is_accepted = evaluated.margins <= threshold
            states = (
                np.where(is_accepted[:, None], proposed_points, points),
                np.where(is_accepted, evaluated.streams, previous_streams),
                np.where(is_accepted, evaluated.margins, previous_margins),
            )
            level.append(states)
            log_step_change = (float(is_accepted.mean()) - _TARGET_ACCEPTANCE) / math.sqrt(chain_step)
            step = min(step * math.exp(log_step_change), 1.0)
        coordinates, streams, margins = (np.concatenate(values) for values in zip(*level, strict=True))


def _next_threshold(margins: Margins) -> float | None:
    """Select the threshold of the next level: a quantile of the margins; None if no lower level exists.

    Equal margins (infinite ones, for example) may cover the quantile. The threshold is then the next lower margin.
    """
    sorted_margins = np.sort(margins)
    index = round(LEVEL_FRACTION * sorted_margins.size)
    below, above = float(sorted_margins[index - 1]), float(sorted_margins[index])
    threshold = 0.5 * (below + above) if math.isfinite(below + above) else below
    if threshold >= sorted_margins[-1]:
        lower_margins = sorted_margins[sorted_margins < sorted_margins[-1]]
        if lower_margins.size == 0:
            return None
        threshold = float(lower_margins[-1])
    return threshold if threshold >= 0.0 else 0.0
