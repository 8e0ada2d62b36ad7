"""Bounds of the rate of an event among cases that share terrains; exact for every distribution of rates over terrains.

Model: a terrain has an unknown rate theta of events, which varies between terrains with an unknown distribution G on
[0, 1]. Given theta, the cases on the terrain are independent: k of its n cases have the event with the binomial
probability B(k; n, theta). The rate q of a case is the mean of G. The numbers n are part of the design.

The statistic is S = sum of k^2 over the terrains: the number of events, plus twice the number of pairs of events on one
terrain. Events that are spread over terrains are therefore stronger evidence for a low rate than as many events on one
terrain. `event_scores` limits the number of values of S for large n.

The p-value of a rate q is the supremum of P(S <= observed) over all G with the mean q (the least favourable mixing
distribution). For a given distribution of all other terrains, P is linear in the G of one terrain, so its maximum has
two support points. The supremum is therefore searched among the G with two support points; the tests verify that other
distributions do not exceed it. Without an event it is (1 - q)^terrains: each terrain counts as one case. With one case
on each terrain it is the binomial distribution of Clopper and Pearson.
"""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float64, Int
from scipy import ndimage, optimize, special, stats

from marsyard.reports.statistics.tail_function import TailFunction
from marsyard.reports.statistics.terrain_sizes import Sizes, count_sizes, event_scores, largest_statistic

#: Relative positions of two support points: of the lower one between 0 and the mean, of the other between mean and 1.
Pair = tuple[float, float]

#: Maximum number of values of one batch of distributions, and limits of the number of support points per axis.
_MAX_BATCH, _MIN_GRID, _MAX_GRID = 2**16, 8, 18
#: Range of the logits of support points in the search, number of its refinements, and of refined local maxima.
_MAX_LOGIT, _REFINEMENTS, _MAX_STARTS = 7.0, 4, 4
#: Maximum number of searches for a bound, and its relative accuracy.
_MAX_STEPS, _TOLERANCE = 20, 1e-4


@dataclass(frozen=True)
class TerrainCounts:
    """Numbers of cases by terrain (`sizes`), and the statistic of an event: the sum of k^2 over the terrains."""

    sizes: Sizes
    statistic: int

    @classmethod
    def of(cls, event: Bool[np.ndarray, " n"], index: Int[np.ndarray, " n"]) -> TerrainCounts:
        """Count cases and events; `index` numbers the terrains from 0 (`number_terrains`)."""
        cases, events = np.bincount(index), np.bincount(index, weights=event).astype(np.int64)
        sizes = count_sizes(cases)
        return cls(sizes, int(event_scores(sizes)[events].sum()))

    def with_single_cases(self, cases: int) -> TerrainCounts:
        """Return the counts with additional cases without the event, each on a new terrain."""
        if cases == 0:
            return self
        terrains = dict(self.sizes)
        return TerrainCounts(tuple(sorted({**terrains, 1: terrains.get(1, 0) + cases}.items())), self.statistic)

    def p_value(self, rate: float) -> float:
        """Compute the largest probability of a statistic at most as large, if the rate of the event is `rate`."""
        return _max_tail(self.sizes, self.statistic, rate)

    def max_rate(self, risk: float) -> float:
        """Compute the upper bound of the rate of the event: the rate whose p-value equals `risk`."""
        return _max_rate(self.sizes, self.statistic, risk)


@lru_cache(maxsize=4096)
def max_statistic(sizes: Sizes, rate: float, risk: float) -> int:
    """Find the largest statistic whose p-value at a rate is at most `risk`; -1 if there is none."""
    largest = largest_statistic(sizes)

    def exceeds(statistic: int) -> bool:
        return _max_tail(sizes, statistic, rate, risk) > risk

    # bracket the result from the nearer end: statistics near the ends are much faster to evaluate
    width = 1
    if rate < 0.5:
        while width < largest and not exceeds(width):
            width *= 2
        values = range(min(width, largest) + 1)
    else:
        while width < largest and exceeds(largest - width):
            width *= 2
        values = range(max(largest - width, 0), largest + 1)
    return values.start + bisect.bisect_left(values, True, key=exceeds) - 1


@lru_cache(maxsize=4096)
def _max_rate(sizes: Sizes, statistic: int, risk: float) -> float:
    """See `TerrainCounts.max_rate`."""
    terrains = sum(count for _, count in sizes)
    if statistic >= largest_statistic(sizes):
        return 1.0
    # without an event, the p-value is (1 - rate)^terrains; events increase it
    lower = 1.0 - math.pow(risk, 1.0 / terrains)
    if statistic == 0:
        return lower

    tail, rate = TailFunction(sizes, statistic), lower
    for _ in range(_MAX_STEPS):
        probability, pair = _find_supremum(sizes, statistic, rate)
        if probability <= risk * (1.0 + _TOLERANCE):
            break
        # the rate with this p-value for the same pair; the least favourable pair there has a larger p-value
        rate = _solve_rate(tail, pair, rate, risk)
    return rate


def _solve_rate(tail: TailFunction, pair: Pair, rate: float, risk: float) -> float:
    """Find the rate above `rate` at which the tail probability of a pair of support points equals `risk`."""

    def log_ratio(logit: float) -> float:
        mean = float(special.expit(logit))
        probability = tail.of_pairs(*_support(np.array(pair[:1]), np.array(pair[1:]), mean), mean)
        return math.log(max(float(probability[0, 0]), 1e-300) / risk)

    start = float(special.logit(rate))
    stop = start + 1.0
    while log_ratio(stop) > 0.0:
        stop += 1.0
    if log_ratio(start) <= 0.0:  # by rounding
        return rate
    return float(special.expit(optimize.brentq(log_ratio, start, stop, xtol=_TOLERANCE)))


def _max_tail(sizes: Sizes, statistic: int, rate: float, sufficient: float = 1.0) -> float:
    """Compute the supremum of P(S <= statistic) over the distributions with the mean `rate`.

    If it is above `sufficient`, the result is a value between both, which needs no refinement.
    """
    terrains = sum(count for _, count in sizes)
    if statistic < 0:
        return 0.0
    if statistic >= largest_statistic(sizes):
        return 1.0
    if statistic == 0:
        return math.pow(1.0 - rate, terrains)
    if sizes == ((1, terrains),):
        return float(stats.binom.cdf(statistic, terrains, rate))
    return _find_supremum(sizes, statistic, rate, sufficient)[0]


@lru_cache(maxsize=16384)
def _find_supremum(sizes: Sizes, statistic: int, rate: float, sufficient: float = 1.0) -> tuple[float, Pair]:
    """Find the largest P(S <= statistic) of the distributions with two support points; return it with the points.

    The search ends at the first value above `sufficient`.
    """
    tail = TailFunction(sizes, statistic)
    grid = min(_MAX_GRID, max(_MIN_GRID, math.isqrt(_MAX_BATCH // tail.nodes.size)))
    # most points are close to 0, to the mean, and to 1
    logits = special.expit(np.linspace(-_MAX_LOGIT, _MAX_LOGIT, grid))
    x, y = np.concatenate([[0.0], logits, [1.0]]), np.append(logits, 1.0)
    probabilities = tail.of_pairs(*_support(x, y, rate), rate)
    is_maximum = probabilities == ndimage.maximum_filter(probabilities, 3, mode="nearest")
    starts = np.argwhere(is_maximum)
    order = np.argsort(-probabilities[tuple(starts.T)], kind="stable")[:_MAX_STARTS]
    row, column = starts[order[0]]
    if probabilities[row, column] > sufficient:
        return min(float(probabilities[row, column]), 1.0), (float(x[row]), float(y[column]))
    probability, pair = max(_refine(tail, rate, (x, y), (int(row), int(column))) for row, column in starts[order])
    return min(probability, 1.0), pair


def _support(x: np.ndarray, y: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute support points below and above the mean from their relative positions between 0, the mean and 1."""
    return x * rate, rate + y * (1.0 - rate)


def _refine(
    tail: TailFunction, rate: float, axes: tuple[np.ndarray, np.ndarray], position: tuple[int, int]
) -> tuple[float, Pair]:
    """Refine a maximum on a grid of the relative positions of two support points; return it with the positions."""
    probability = 0.0
    for _ in range(_REFINEMENTS):
        axes = _between_neighbours(axes[0], position[0]), _between_neighbours(axes[1], position[1])
        probabilities = tail.of_pairs(*_support(*axes, rate), rate)
        row, column = np.unravel_index(int(probabilities.argmax()), probabilities.shape)
        position, probability = (int(row), int(column)), float(probabilities[row, column])
    return probability, (float(axes[0][position[0]]), float(axes[1][position[1]]))


def _between_neighbours(axis: Float64[np.ndarray, " n"], index: int) -> Float64[np.ndarray, " 7"]:
    """Return seven points between the neighbours of a point of the grid."""
    return np.linspace(axis[max(index - 1, 0)], axis[min(index + 1, axis.size - 1)], 7)


@lru_cache(maxsize=1024)
def attainable_risk(sizes: Sizes, rate: float, risk: float) -> float:
    """Compute the largest p-value of a rate that is at most `risk`; 0 if there is none."""
    return _max_tail(sizes, max_statistic(sizes, rate, risk), rate, risk)
