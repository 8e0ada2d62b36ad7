"""Distributions of one variable: standard normal, those of SciPy, and quantiles of truncated ones."""

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.special import ndtr, ndtri


class TruncationError(ValueError):
    """A distribution cannot be truncated to the limits `low` and `high`; `reason` states why, without the limits.

    A limit can be a formula of a campaign file.
    """

    def __init__(self, low: float | str, high: float | str, reason: str) -> None:
        # all arguments, so that the error can be pickled
        super().__init__(low, high, reason)
        self.low, self.high, self.reason = low, high, reason

    def __str__(self) -> str:
        return f"truncate = [{self.low}, {self.high}]: {self.reason}"


@dataclass(frozen=True, eq=False)
class UnivariateDistribution:
    """A distribution of one variable.

    - evaluate: evaluates `cdf`, `sf` (survival function), or the inverse functions `ppf` and `isf`, by name
    - support: minimum and maximum
    """

    evaluate: Callable[[str, float], float]
    support: tuple[float, float] = (-math.inf, math.inf)
    is_discrete: bool = False


_NORMAL_FUNCTIONS: Mapping[str, Callable[[float], Any]] = {
    "cdf": ndtr,
    "sf": lambda x: ndtr(-x),
    "ppf": ndtri,
    "isf": lambda q: -ndtri(q),
}
#: Standard normal distribution, without `scipy.stats`, whose import takes a second.
STANDARD_NORMAL = UnivariateDistribution(lambda function, x: float(_NORMAL_FUNCTIONS[function](x)))


@lru_cache(maxsize=1)
def scipy_distributions() -> Mapping[str, bool]:
    """Return the univariate distributions of `scipy.stats` by name, and whether each is discrete.

    `uniform` is excluded, since `Uniform` has other parameters.
    """
    from scipy import stats

    kinds = ((name, getattr(stats, name)) for name in dir(stats) if name != "uniform")
    accepted = (stats.rv_continuous, stats.rv_discrete)
    return {name: isinstance(kind, stats.rv_discrete) for name, kind in kinds if isinstance(kind, accepted)}


def scipy_parameters(distribution: str) -> tuple[list[str], list[str]]:
    """Return the parameters that a distribution of `scipy.stats` requires, and all parameters that it accepts."""
    from scipy import stats

    shapes = getattr(stats, distribution).shapes
    required = [name.strip() for name in shapes.split(",")] if shapes else []
    return required, [*required, "loc"] if scipy_distributions()[distribution] else [*required, "loc", "scale"]


def create_scipy_distribution(distribution: str, parameters: Mapping[str, float]) -> UnivariateDistribution:
    """Create a distribution of `scipy.stats` with parameters.

    Raises ValueError if the distribution is not defined for the parameters; its evaluation can raise it as well.
    """
    from scipy import stats

    failure = f"{distribution} is not defined for {', '.join(f'{key} = {value}' for key, value in parameters.items())}"

    def call_without_warnings(function: Callable[[], Any]) -> Any:
        # SciPy's warnings are not needed, since invalid results are recognized as NaN
        try:
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return function()
        except (ArithmeticError, TypeError, ValueError, RuntimeError) as error:
            raise ValueError(f"{failure}: {error}") from error

    def evaluate(function: str, x: float) -> float:
        result = call_without_warnings(lambda: float(getattr(scipy_distribution, function)(x)))
        if math.isnan(result):
            raise ValueError(f"{failure}: its {function} at {x} is not a number")
        return float(result)

    scipy_distribution = call_without_warnings(lambda: getattr(stats, distribution)(**parameters))
    low, high = call_without_warnings(lambda: [float(limit) for limit in scipy_distribution.support()])
    if not low <= high:
        raise ValueError(failure)
    return UnivariateDistribution(evaluate, (low, high), scipy_distributions()[distribution])


def truncated_quantile(
    distribution: UnivariateDistribution, limits: tuple[float, float] | None, probability: float
) -> float | int:
    """Compute a quantile of a distribution F, truncated to `limits` [a, b] if they are defined.

    The quantile at p is F^-1(F(a) + p (F(b) - F(a))). If a exceeds the median, the survival function replaces F, since
    1 - F would lose digits of small values. The limits of discrete distributions are included.

    Raises TruncationError if the limits are in the wrong order or the probability between them is zero, and ValueError
    if a discrete distribution includes infinity or the distribution is not defined for its parameters.
    """
    low, high = distribution.support if limits is None else limits
    if limits is None:
        value = distribution.evaluate("ppf", probability)
    else:
        inverse, at_low, at_high = _find_truncated_inverse(distribution, low, high)
        value = distribution.evaluate(inverse, at_low + probability * (at_high - at_low))
    value = min(max(value, low), high)
    if distribution.is_discrete and not math.isfinite(value):
        raise ValueError(f"the distribution includes {value}")
    return round(value) if distribution.is_discrete else value


@lru_cache(maxsize=1024)
def _find_truncated_inverse(distribution: UnivariateDistribution, low: float, high: float) -> tuple[str, float, float]:
    """Return the name of the inverse function with the higher precision, and its arguments at the two limits."""
    if not (low <= high if distribution.is_discrete else low < high):
        raise TruncationError(low, high, "the first limit must be below the second")
    # the lower limit of a discrete distribution is included: F is evaluated at the previous integer
    low_argument = math.ceil(low) - 1.0 if distribution.is_discrete else low
    function, inverse = ("sf", "isf") if distribution.evaluate("cdf", low_argument) > 0.5 else ("cdf", "ppf")
    at_low, at_high = distribution.evaluate(function, low_argument), distribution.evaluate(function, high)
    if not abs(at_high - at_low) > 0.0:
        raise TruncationError(low, high, "the distribution has no probability between the limits")
    return inverse, at_low, at_high
