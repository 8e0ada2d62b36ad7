"""Distribution functions and their inverses: the normal's own, and those of `scipy.stats` by their names."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Hashable, Mapping
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from scipy.special import ndtr, ndtri


class Shape(Hashable, Protocol):
    """A distribution: its function, the survival function, the inverses of both, and where it lies."""

    @property
    def whole(self) -> bool:
        """Whether its values are whole numbers."""
        ...

    def cdf(self, x: float, /) -> float: ...  # noqa: D102
    def sf(self, x: float, /) -> float: ...  # noqa: D102
    def ppf(self, q: float, /) -> float: ...  # noqa: D102
    def isf(self, q: float, /) -> float: ...  # noqa: D102
    def support(self) -> tuple[float, float]: ...  # noqa: D102


class _StandardNormal:
    """The normal distribution without the second that importing `scipy.stats` takes."""

    whole = False

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
    """The distributions of one variable in `scipy.stats` by their names: whether each is discrete.

    `uniform` is left out, as it is written with other parameters here.
    """
    from scipy import stats

    kinds = ((name, getattr(stats, name)) for name in dir(stats) if name != "uniform")
    known = (stats.rv_continuous, stats.rv_discrete)
    return {name: isinstance(kind, stats.rv_discrete) for name, kind in kinds if isinstance(kind, known)}


def parameters_of(distribution: str) -> tuple[list[str], list[str]]:
    """The parameters that a distribution of `scipy.stats` requires, and all that it takes."""
    from scipy import stats

    shapes = getattr(stats, distribution).shapes
    required = [name.strip() for name in shapes.split(",")] if shapes else []
    return required, [*required, "loc"] if scipy_distributions()[distribution] else [*required, "loc", "scale"]


class Frozen:
    """A distribution of `scipy.stats` with its parameters.

    Parameters
    ----------
    distribution
        Its name there.
    stated
        Its parameters.

    Raises
    ------
    ValueError
        Where it is not defined for them.
    """

    def __init__(self, distribution: str, stated: Mapping[str, float]) -> None:
        from scipy import stats

        self.whole = scipy_distributions()[distribution]
        self._where = f"{distribution} is not defined for {', '.join(f'{key} = {one}' for key, one in stated.items())}"
        try:
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                self._shape: Any = getattr(stats, distribution)(**stated)
                low, high = (float(one) for one in self._shape.support())
        except (ArithmeticError, TypeError, ValueError) as error:
            raise ValueError(f"{self._where}: {error}") from error
        if math.isnan(low) or math.isnan(high) or not low <= high:
            raise ValueError(self._where)
        self._support = low, high

    def cdf(self, x: float) -> float:
        """Probability of at most `x`."""
        return self._of("cdf", x)

    def sf(self, x: float) -> float:
        """Probability of more than `x`."""
        return self._of("sf", x)

    def ppf(self, q: float) -> float:
        """Inverse of `cdf`."""
        return self._of("ppf", q)

    def isf(self, q: float) -> float:
        """Inverse of `sf`."""
        return self._of("isf", q)

    def support(self) -> tuple[float, float]:
        """Least and greatest value."""
        return self._support

    def _of(self, function: str, x: float) -> float:
        """One of SciPy's functions, without its warnings: what is wrong shows in the number."""
        try:
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                found = float(getattr(self._shape, function)(x))
        except (ArithmeticError, TypeError, ValueError, RuntimeError) as error:
            raise ValueError(f"{self._where}: {error}") from error
        if math.isnan(found):
            raise ValueError(f"{self._where}: its {function} of {x} is not a number")
        return found


def truncated_quantile(shape: Shape, limits: tuple[float, float] | None, probability: float) -> float | int:
    """The value at a probability of a distribution cut to `limits`, computed on the side where digits are kept.

    Of F cut to [a, b] the inverse is F^-1(F(a) + p (F(b) - F(a))); where a lies beyond the median the same is said by
    the survival function, whose small values have digits that 1 - F has lost. Limits of whole numbers are included.

    Raises
    ------
    ValueError
        Where the limits are in the wrong order, or leave nothing to draw.
    """
    low, high = shape.support() if limits is None else limits
    if limits is None:
        value = shape.ppf(probability)
    else:
        inverse, at_low, at_high = _cut(shape, low, high)
        value = inverse(at_low + probability * (at_high - at_low))
    value = min(max(value, low), high)
    return _whole(value) if shape.whole else value


@lru_cache(maxsize=1024)
def _cut(shape: Shape, low: float, high: float) -> tuple[Callable[[float], float], float, float]:
    """The inverse that keeps digits between two limits, and its arguments there."""
    if not (low <= high if shape.whole else low < high):
        raise ValueError(f"truncate = [{low}, {high}]: the first limit must be below the second")
    below = math.ceil(low) - 1.0 if shape.whole else low
    upper = shape.cdf(below) > 0.5
    function, inverse = (shape.sf, shape.isf) if upper else (shape.cdf, shape.ppf)
    at_low, at_high = function(below), function(high)
    if not abs(at_high - at_low) > 0.0:
        raise ValueError(f"truncate = [{low}, {high}]: the distribution has no probability between the limits")
    return inverse, at_low, at_high


def _whole(value: float) -> int:
    if not math.isfinite(value):
        raise ValueError(f"the distribution reaches {value}")
    return round(value)
