"""Probability of a statistic of events among cases that share terrains, by generating functions."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Complex128, Float64
from scipy import special

from marsyard.reports.statistics.terrain_sizes import Sizes, event_scores, largest_statistic

#: Factor of suppression of unresolved coefficients of a generating function; the rounding error is 1e-16 / this.
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
    for digit in bin(exponent)[3:]:
        result = result * result * values if digit == "1" else result * result
    return np.asarray(result)
