"""Subset simulation: the probability of a rare violation as a product of larger conditional probabilities.

Au & Beck 2001, Probabilistic Engineering Mechanics 16, 263-277. A violation is a margin below 0. Each level contains
the cases with a margin of at most its threshold, a quantile of the previous level's margins. Cases of a level are drawn
by Markov chains that start at the cases of the previous level below the threshold: conditional sampling with an
adaptive step in standard normal space (Papaioannou et al. 2015, Probabilistic Engineering Mechanics 41, 89-103,
algorithm with acceptance 0.44). The normal and uniform numbers of the random streams (noise of the instruments) move by
the same step: a new stream is blended into the previous ones (`marsyard.sim.streams.Blend`).

The estimated coefficient of variation of one run is too small, because its chains are correlated. Intervals therefore
use the spread of independent replicates (`marsyard.campaigns.studies.interval`).

The chains find a violation only if the margin falls to it through the levels. A violation without intermediate margins
is found at its own rate per case, as by counting.
"""

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float64

from marsyard.campaigns.sampling.study_points import NEW_STREAM
from marsyard.sim.streams import Blend

#: Fraction of the cases that define the next level.
LEVEL_FRACTION = 0.1
#: Target acceptance rate of the chains, to which their step is adapted, and initial step.
_TARGET_ACCEPTANCE, _INITIAL_STEP = 0.44, 0.6
#: Minimum number of cases below a plateau: the fraction of fewer cases is too uncertain for the product of fractions.
_MIN_CASES_BELOW_PLATEAU = 5

Coordinates = Float64[np.ndarray, "n dimensions"]
Margins = Float64[np.ndarray, " n"]


@dataclass(frozen=True)
class Proposals:
    """Cases to be evaluated: coordinates, and components of their random streams; the last one is `NEW_STREAM`.

    is_independent: whether the cases are independent draws of the nominal distribution, which may be counted
    """

    coordinates: Coordinates
    blends: Sequence[Blend]
    is_independent: bool = False


@dataclass(frozen=True)
class Evaluated:
    """Evaluated cases: components of their random streams, with the numbers of the new ones, and margins.

    A margin is infinite if a violation is excluded, and minus infinite if it is certain.
    """

    blends: Sequence[Blend]
    margins: Margins


class SubsetEnd(StrEnum):
    """Reason why a subset simulation ended."""

    VIOLATION = "violations reached"
    UNLIKELY = "level too unlikely"
    PLATEAU = "plateau of the margin"


@dataclass(frozen=True)
class Level:
    """One level: its probability, and the new cases whose parent does not violate the requirement.

    - probability: estimated probability of the level; 1 for the first one, whose cases have no parent
    - drawn, entered: number of these cases, and of the violations among them
    """

    probability: float
    drawn: int
    entered: int


@dataclass(frozen=True)
class SubsetResult:
    """Result of one subset simulation.

    - probability: estimated probability of a violation; if the simulation ended early, that of its last level
    - end: reason why it ended; only `SubsetEnd.VIOLATION` gives an estimate
    - thresholds: margin of each intermediate level; levels: all levels with the first one
    - violations: coordinates of the violating cases of the last level
    """

    probability: float
    end: SubsetEnd
    thresholds: tuple[float, ...]
    levels: tuple[Level, ...]
    violations: Coordinates

    @property
    def reached(self) -> bool:
        """Whether the probability is an estimate."""
        return self.end is SubsetEnd.VIOLATION


#: Coroutine that yields cases to be evaluated, receives their margins, and returns the result.
SubsetRun = Generator[Proposals, Evaluated, SubsetResult]


def subset_simulation(dimension: int, samples: int, min_probability: float, rng: np.random.Generator) -> SubsetRun:
    """Run one subset simulation with `samples` cases per level; stop at levels less likely than `min_probability`.

    `dimension` is the number of standard normal variables.
    """
    coordinates = rng.standard_normal((samples, dimension))
    evaluated = yield Proposals(coordinates, [new_blend()] * samples, is_independent=True)
    blends, margins = list(evaluated.blends), evaluated.margins
    probability, step, thresholds = 1.0, _INITIAL_STEP, list[float]()
    levels = [Level(1.0, samples, int(np.sum(margins < 0.0)))]
    while True:
        is_violation = margins < 0.0
        threshold = _next_threshold(margins)
        end = _find_end(is_violation, threshold, probability < min_probability)
        if end is not None:
            fraction = float(is_violation.mean()) if end is SubsetEnd.VIOLATION else 1.0
            return SubsetResult(
                probability * fraction, end, tuple(thresholds), tuple(levels), coordinates[is_violation]
            )
        thresholds.append(threshold)
        seeds = rng.permutation(np.flatnonzero(margins <= threshold))
        probability *= seeds.size / samples
        # all chains advance together; the cases of the level are the states of the chains, including the seeds
        points, point_blends, point_margins = coordinates[seeds], [blends[seed] for seed in seeds], margins[seeds]
        level_points, level_blends, level_margins = [points], list(point_blends), [point_margins]
        drawn = entered = 0
        for chain_step in range(1, math.ceil(samples / seeds.size)):
            size = min(seeds.size, samples - chain_step * seeds.size)
            points, point_blends, point_margins = points[:size], point_blends[:size], point_margins[:size]
            proposed_points = math.sqrt(1.0 - step**2) * points + step * rng.standard_normal(points.shape)
            evaluated = yield Proposals(proposed_points, [new_blend(blend, step) for blend in point_blends])
            is_accepted, has_safe_parent = evaluated.margins <= threshold, point_margins >= 0.0
            drawn += int(has_safe_parent.sum())
            entered += int(np.sum(has_safe_parent & (evaluated.margins < 0.0)))
            points = np.where(is_accepted[:, None], proposed_points, points)
            choices = zip(is_accepted, evaluated.blends, point_blends, strict=True)
            point_blends = [proposed if accepted else previous for accepted, proposed, previous in choices]
            point_margins = np.where(is_accepted, evaluated.margins, point_margins)
            level_points.append(points)
            level_blends += point_blends
            level_margins.append(point_margins)
            log_step_change = (float(is_accepted.mean()) - _TARGET_ACCEPTANCE) / math.sqrt(chain_step)
            step = min(step * math.exp(log_step_change), 1.0)
        coordinates, blends, margins = np.concatenate(level_points), level_blends, np.concatenate(level_margins)
        levels.append(Level(probability, drawn, entered))


def new_blend(previous: Blend = (), step: float = 1.0) -> Blend:
    """Blend new streams into the previous ones, as the coordinates by a step; only new streams for a step of 1."""
    factor = math.sqrt(1.0 - step**2)
    older = tuple((number, factor * weight) for number, weight in previous) if factor > 0.0 else ()
    return (*older, (NEW_STREAM, step if older else 1.0))


def _find_end(is_violation: Bool[np.ndarray, " n"], threshold: float, is_unlikely: bool) -> SubsetEnd | None:
    """Return the reason to end the simulation at a level; None to continue.

    threshold: that of the next level. It is below 0 if all cases below a plateau are violations, and NaN if too few
    cases are below it.
    """
    if is_violation.mean() >= LEVEL_FRACTION or threshold < 0.0:
        return SubsetEnd.VIOLATION
    if math.isnan(threshold):
        return SubsetEnd.PLATEAU
    return SubsetEnd.UNLIKELY if is_unlikely else None


def _next_threshold(margins: Margins) -> float:
    """Select the threshold of the next level: a quantile of the margins.

    On a plateau, equal margins (infinite ones, for example) cover the quantile and all larger margins. The threshold is
    then the next lower margin, or NaN if too few cases have a lower margin.
    """
    sorted_margins = np.sort(margins)
    index = round(LEVEL_FRACTION * sorted_margins.size)
    below, above = float(sorted_margins[index - 1]), float(sorted_margins[index])
    threshold = 0.5 * (below + above) if math.isfinite(below + above) else below
    if threshold < sorted_margins[-1]:
        return threshold
    lower_margins = sorted_margins[sorted_margins < sorted_margins[-1]]
    return float(lower_margins[-1]) if lower_margins.size >= _MIN_CASES_BELOW_PLATEAU else math.nan
