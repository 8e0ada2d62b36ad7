"""Distribution functions and their inverses: the standard normal distribution, and those of `scipy.stats` by name."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Hashable, Mapping
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from scipy.special import ndtr, ndtri


class Shape(Hashable, Protocol):
    """A distribution: distribution function, survival function, inverses of both, and support."""

    @property
    def is_discrete(self) -> bool: ...  # noqa: D102
    def cdf(self, x: float, /) -> float: ...  # noqa: D102
    def sf(self, x: float, /) -> float: ...  # noqa: D102
    def ppf(self, q: float, /) -> float: ...  # noqa: D102
    def isf(self, q: float, /) -> float: ...  # noqa: D102
    def support(self) -> tuple[float, float]: ...  # noqa: D102


class _StandardNormal:
    """Standard normal distribution without importing `scipy.stats`, which takes a second."""

    is_discrete = False

    def cdf(self, x: float) -> float:
        return float(ndtr(x))

    def ppf(self, q: float) -> float:
        return float(ndtri(q))

    def sf(self, x: float) -> float:
        return float(ndtr(-x))

    def isf(self, q: float) -> float:
        return float(-ndtri(q))

    def support(self) -> tuple[float, float]:
        return -math.inf, math.inf


STANDARD_NORMAL = _StandardNormal()


@lru_cache(maxsize=1)
def scipy_distributions() -> Mapping[str, bool]:
    """Univariate distributions of `scipy.stats` by name: whether each is discrete.

    `uniform` is excluded, since campaign files write it with other parameters.
    """
    from scipy import stats

    kinds = ((name, getattr(stats, name)) for name in dir(stats) if name != "uniform")
    known = (stats.rv_continuous, stats.rv_discrete)
    return {name: isinstance(kind, stats.rv_discrete) for name, kind in kinds if isinstance(kind, known)}


def scipy_parameters(distribution: str) -> tuple[list[str], list[str]]:
    """Parameters that a distribution of `scipy.stats` requires, and all that it accepts."""
    from scipy import stats

    shapes = getattr(stats, distribution).shapes
    required = [name.strip() for name in shapes.split(",")] if shapes else []
    return required, [*required, "loc"] if scipy_distributions()[distribution] else [*required, "loc", "scale"]


class ScipyShape:
    """A distribution of `scipy.stats` with given parameters. Raises ValueError where it is not defined for them."""

    def __init__(self, distribution: str, parameters: Mapping[str, float]) -> None:
        from scipy import stats

        self.is_discrete = scipy_distributions()[distribution]
        self._where = (
            f"{distribution} is not defined for {', '.join(f'{key} = {one}' for key, one in parameters.items())}"
        )
        try:
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                self._shape: Any = getattr(stats, distribution)(**parameters)
                low, high = (float(one) for one in self._shape.support())
        except (ArithmeticError, TypeError, ValueError) as error:
            raise ValueError(f"{self._where}: {error}") from error
        if math.isnan(low) or math.isnan(high) or not low <= high:
            raise ValueError(self._where)
        self._support = low, high

    def cdf(self, x: float) -> float:
        """Probability of a value of at most `x`."""
        return self._evaluate("cdf", x)

    def sf(self, x: float) -> float:
        """Probability of a value above `x`."""
        return self._evaluate("sf", x)

    def ppf(self, q: float) -> float:
        """Inverse of `cdf`."""
        return self._evaluate("ppf", q)

    def isf(self, q: float) -> float:
        """Inverse of `sf`."""
        return self._evaluate("isf", q)

    def support(self) -> tuple[float, float]:
        """Minimum and maximum."""
        return self._support

    def _evaluate(self, function: str, x: float) -> float:
        """Call a function of SciPy without its warnings: an invalid result shows as NaN."""
        try:
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                result = float(getattr(self._shape, function)(x))
        except (ArithmeticError, TypeError, ValueError, RuntimeError) as error:
            raise ValueError(f"{self._where}: {error}") from error
        if math.isnan(result):
            raise ValueError(f"{self._where}: its {function} of {x} is not a number")
        return result


def truncated_quantile(shape: Shape, limits: tuple[float, float] | None, probability: float) -> float | int:
    """Quantile of a distribution truncated to `limits`, evaluated in the tail that keeps its digits.

    The inverse of F truncated to [a, b] is F^-1(F(a) + p (F(b) - F(a))). Where a lies above the median, the survival
    function replaces F, since its small values keep digits that 1 - F loses. Limits of discrete distributions are
    included.

    Raises ValueError where the limits are in the wrong order or have no probability between them.
    """
    low, high = shape.support() if limits is None else limits
    if limits is None:
        value = shape.ppf(probability)
    else:
        inverse, at_low, at_high = _truncated_inverse(shape, low, high)
        value = inverse(at_low + probability * (at_high - at_low))
    value = min(max(value, low), high)
    if shape.is_discrete and not math.isfinite(value):
        raise ValueError(f"the distribution reaches {value}")
    return round(value) if shape.is_discrete else value


@lru_cache(maxsize=1024)
def _truncated_inverse(shape: Shape, low: float, high: float) -> tuple[Callable[[float], float], float, float]:
    """Inverse function that keeps its digits between two limits, and its arguments at them."""
    if not (low <= high if shape.is_discrete else low < high):
        raise ValueError(f"truncate = [{low}, {high}]: the first limit must be below the second")
    below = math.ceil(low) - 1.0 if shape.is_discrete else low
    upper = shape.cdf(below) > 0.5
    function, inverse = (shape.sf, shape.isf) if upper else (shape.cdf, shape.ppf)
    at_low, at_high = function(below), function(high)
    if not abs(at_high - at_low) > 0.0:
        raise ValueError(f"truncate = [{low}, {high}]: the distribution has no probability between the limits")
    return inverse, at_low, at_high
