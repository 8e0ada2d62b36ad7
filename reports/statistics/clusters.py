"""Bounds of the rate of an event among cases that share terrains; exact for every distribution of rates over terrains.

Model: a terrain has an unknown rate theta of events, which varies between terrains with an unknown distribution G on
[0, 1]. Given theta, the cases on the terrain are independent: k of its n cases have the event with the binomial
probability B(k; n, theta). The rate q of a case is the mean of G. The numbers n are part of the design.

The statistic is S = sum of k^2 over the terrains: the number of events, plus twice the number of pairs of events on one
terrain. Events that are spread over terrains are therefore stronger evidence for a low rate than as many events on one
terrain. `event_scores` limits the number of values of S for large n, and `select_counted` the number of cases that the
bounds use, because their cost increases with the largest value of S.

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
from jaxtyping import Bool, Complex128, Float64, Int
from scipy import ndimage, optimize, special, stats

#: Numbers of terrains by their number of cases: pairs (cases on a terrain, terrains with this number).
Sizes = tuple[tuple[int, int], ...]
#: Number of cases on a terrain up to which the squares of numbers of events are not rounded.
_MAX_SQUARED = 16


def number_terrains(terrain: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Number the terrains consecutively from 0, in the order of their original numbers."""
    lowest, highest = int(terrain.min()), int(terrain.max())
    if highest - lowest > 4 * terrain.size:
        return np.unique(terrain, return_inverse=True)[1]
    # for dense numbers: count instead of sorting, which is slow for a million cases
    shifted = terrain - lowest
    return np.asarray((np.cumsum(np.bincount(shifted) > 0) - 1)[shifted])


def count_sizes(cases_on_terrain: Int[np.ndarray, " terrains"]) -> Sizes:
    """Count the terrains with each number of cases."""
    cases, terrains = np.unique(cases_on_terrain[cases_on_terrain > 0], return_counts=True)
    return tuple(zip(cases.tolist(), terrains.tolist(), strict=True))


def event_scores(sizes: Sizes) -> Int[np.ndarray, " _"]:
    """Return the score of 0 to n events on a terrain, for the largest number of cases n.

    It is k^2 for k events if n is at most 16, otherwise k^2 in units of (n / 16)^2, rounded up.
    """
    largest = max(cases for cases, _ in sizes)
    events = np.arange(largest + 1, dtype=np.int64)
    scale = max(largest, _MAX_SQUARED)
    # integers: -(-a // b) rounds a / b up
    return np.asarray(-(-(events**2) * _MAX_SQUARED**2 // scale**2))


#: Maximum cost of a bound, about 1 core-s: the largest value of its statistic, times the number of distinct numbers of
#: cases on a terrain.
_MAX_COST = 30_000


def max_counted(cases_on_terrain: Int[np.ndarray, " terrains"]) -> int:
    """Return how many cases of a terrain the bounds use: all if their cost permits it, or else 1 to 16.

    It depends on the design only, so the bounds remain exact. The other cases would add little: however many cases are
    on a terrain, without an event it counts as one.
    """
    largest = int(cases_on_terrain.max(initial=1))
    numbers = [largest, *range(min(_MAX_SQUARED, largest), 1, -1)]
    sizes = (count_sizes(np.minimum(cases_on_terrain, number)) for number in numbers)
    costs = (largest_statistic(size) * len(size) for size in sizes)
    return next((number for number, cost in zip(numbers, costs, strict=True) if cost <= _MAX_COST), 1)


def select_counted(index: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Select the cases that the bounds use: the first ones of each terrain (`max_counted`).

    index: number of each case's terrain from 0, in the order of the cases
    """
    cases = np.bincount(index)
    counted = max_counted(cases)
    if counted >= cases.max(initial=0):
        return np.ones(index.size, dtype=np.bool_)
    order = np.argsort(index, kind="stable")
    rank = np.empty_like(index)
    rank[order] = np.arange(index.size) - (np.cumsum(cases) - cases)[index[order]]
    return np.asarray(rank < counted)


def largest_statistic(sizes: Sizes) -> int:
    """Return the statistic if all cases have the event."""
    scores = event_scores(sizes)
    return sum(terrains * int(scores[cases]) for cases, terrains in sizes)


#: Factor of suppression of unresolved coefficients of a generating function: the absolute error of a probability.
#: Rounding errors of 1e-16 are divided by the square root of this factor.
_ALIASING = 1e-10


class TailFunction:
    """P(S <= statistic) as a function of the distribution of the rate over terrains.

    The generating function of S is the product of those of all terrains. It is evaluated at `nodes` on a circle in the
    complex plane, and the sum of its first coefficients is a weighted sum of these values (discrete Fourier transform).
    The radius of the circle is below 1, to suppress the coefficients that the number of nodes does not resolve.

    If this needs fewer nodes, the missing scores are summed: P(S <= s) is 1 - P(S_max - S <= S_max - s - 1).
    """

    def __init__(self, sizes: Sizes, statistic: int) -> None:
        complement = largest_statistic(sizes) - statistic - 1
        self._is_complement = complement < statistic
        length = 1 + min(statistic, complement)
        count = 2 * length
        radius = _ALIASING ** (1.0 / count)
        indices = np.arange(length + 1)
        #: Nodes in the upper half plane; the values in the lower half plane are their complex conjugates.
        self.nodes = radius * np.exp(2j * np.pi * indices / count)
        # geometric series: sum of (radius^-1 exp(-2 pi i k / count))^power over the powers below `length`
        ratios = 1.0 / self.nodes
        self._weights = (1.0 - ratios**length) / (1.0 - ratios) / count
        self._weights[1:-1] *= 2.0
        self._sizes = sizes
        # for each size: logarithms of the binomial coefficients, numbers of events at which the score changes, and
        # node^score there
        self._log_coefficients, self._starts, self._factors = [], [], []
        for cases, _ in sizes:
            events = np.arange(cases + 1)
            self._log_coefficients.append(-special.betaln(events + 1, cases - events + 1) - math.log(cases + 1))
            scores, starts = np.unique(event_scores(sizes)[: cases + 1], return_index=True)
            scores = scores[-1] - scores if self._is_complement else scores
            self._starts.append(starts)
            self._factors.append(self.nodes ** scores[:, None])

    def of_pairs(
        self, low: Float64[np.ndarray, " rows"], high: Float64[np.ndarray, " columns"], mean: float
    ) -> Float64[np.ndarray, "rows columns"]:
        """Evaluate all distributions with one support point in `low`, one in `high`, and the given mean."""
        weight = ((mean - low[:, None]) / (high - low[:, None]))[..., None]
        product = np.ones((low.size, high.size, self.nodes.size), dtype=np.complex128)
        rates = np.concatenate([low, high])
        for index, (_, terrains) in enumerate(self._sizes):
            at_low, at_high = np.split(self._terrain(index, rates), [low.size])
            product *= _power((1.0 - weight) * at_low[:, None] + weight * at_high, terrains)
        return self._sum(product)

    def of_distribution(self, rates: Float64[np.ndarray, " points"], weights: Float64[np.ndarray, " points"]) -> float:
        """Evaluate the distribution with the support points `rates` and their `weights`, which sum to 1."""
        product = np.ones(self.nodes.size, dtype=np.complex128)
        for index, (_, terrains) in enumerate(self._sizes):
            product *= _power(weights @ self._terrain(index, rates), terrains)
        return float(self._sum(product))

    def _terrain(self, index: int, rates: Float64[np.ndarray, " m"]) -> Complex128[np.ndarray, "m nodes"]:
        """Evaluate the generating function of the score of one terrain, for each rate."""
        events, cases, p = np.arange(self._sizes[index][0] + 1), self._sizes[index][0], rates[:, None]
        # the binomial distribution; SciPy's takes ten times longer for few values
        logs = self._log_coefficients[index] + special.xlogy(events, p) + special.xlog1py(cases - events, -p)
        probabilities = np.add.reduceat(np.exp(logs), self._starts[index], axis=1)
        # without BLAS, whose threads cost more than such small products
        return np.asarray(np.einsum("ij,jk->ik", probabilities, self._factors[index]))

    def _sum(self, values: Complex128[np.ndarray, "*batch nodes"]) -> Float64[np.ndarray, "*batch"]:
        """Sum the first coefficients of the generating function."""
        probability = np.einsum("...k,k->...", values, self._weights).real
        return np.asarray(1.0 - probability if self._is_complement else probability)


def _power(values: Complex128[np.ndarray, "*batch"], exponent: int) -> Complex128[np.ndarray, "*batch"]:
    """Raise to a positive power by repeated squaring, which is much faster than the power of complex numbers."""
    result = values
    for digit in f"{exponent:b}"[1:]:  # the binary digits after the first
        result = result * result * values if digit == "1" else result * result
    return np.asarray(result)


#: Relative positions of two support points: of the lower one between 0 and the mean, of the other between mean and 1.
Pair = tuple[float, float]

#: Maximum number of values of one batch of distributions, and limits of the number of positions of a support point.
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
        if rate == 1.0:
            break
    return rate


def _solve_rate(tail: TailFunction, pair: Pair, rate: float, risk: float) -> float:
    """Find the rate above `rate` at which the tail probability of a pair of support points equals `risk`."""

    def log_ratio(logit: float) -> float:
        mean = float(special.expit(logit))
        probability = tail.of_pairs(*_support(np.array(pair[:1]), np.array(pair[1:]), mean), mean)
        return math.log(max(float(probability[0, 0]), 1e-300) / risk)

    start = float(special.logit(rate))
    stop = start + 1.0
    while special.expit(stop) < 1.0 and log_ratio(stop) > 0.0:
        stop += 1.0
    if special.expit(stop) == 1.0:  # the rounding errors of the tail exceed the risk
        return 1.0
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
    positions = special.expit(np.linspace(-_MAX_LOGIT, _MAX_LOGIT, grid))
    low, high = np.concatenate([[0.0], positions, [1.0]]), np.append(positions, 1.0)
    probabilities = tail.of_pairs(*_support(low, high, rate), rate)
    is_maximum = probabilities == ndimage.maximum_filter(probabilities, 3, mode="nearest")
    starts = np.argwhere(is_maximum)
    order = np.argsort(-probabilities[tuple(starts.T)], kind="stable")[:_MAX_STARTS]
    row, column = starts[order[0]]
    if probabilities[row, column] > sufficient:
        return min(float(probabilities[row, column]), 1.0), (float(low[row]), float(high[column]))
    probability, pair = max(_refine(tail, rate, (low, high), (int(row), int(column))) for row, column in starts[order])
    return min(probability, 1.0), pair


def _support(low: np.ndarray, high: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute support points below and above the mean `rate` from their relative positions (see `Pair`)."""
    return low * rate, rate + high * (1.0 - rate)


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
