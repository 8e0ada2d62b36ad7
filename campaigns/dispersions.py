"""Dispersions: how a parameter is distributed over the cases, and the value at each probability.

Every dispersion turns one uniform number into a value, by the inverse of its distribution function. A case's values so
depend on one number a dispersion, however the numbers are laid out.
"""

from __future__ import annotations

import bisect
import itertools
from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cached_property
from typing import Annotated, Any, Literal, Protocol, Self

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, field_validator, model_validator
from scipy.special import ndtr, ndtri

from campaigns.errors import near_match

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Limits = Annotated[tuple[Number, Number], Field(strict=False)]

#: Probability left out on either side when the reach of a distribution is checked against what a parameter allows.
TAIL = 1e-12


class Shape(Protocol):
    """A continuous distribution: its function, the survival function and the inverses of both."""

    def cdf(self, x: Any, /) -> Any: ...  # noqa: D102
    def sf(self, x: Any, /) -> Any: ...  # noqa: D102
    def ppf(self, q: Any, /) -> Any: ...  # noqa: D102
    def isf(self, q: Any, /) -> Any: ...  # noqa: D102


class _StandardNormal:
    """The normal distribution without the second that importing `scipy.stats` takes."""

    cdf = staticmethod(ndtr)
    ppf = staticmethod(ndtri)

    def sf(self, x: float) -> float:
        return float(ndtr(-x))

    def isf(self, q: float) -> float:
        return float(-ndtri(q))


def truncated_quantile(shape: Shape, limits: tuple[float, float] | None, probability: float) -> float:
    """The value at a probability of a distribution cut to `limits`, computed on the side where digits are kept."""
    if limits is None:
        return float(shape.ppf(probability))
    low, high = limits
    if shape.cdf(low) > 0.5:
        value = shape.isf(shape.sf(low) + probability * (shape.sf(high) - shape.sf(low)))
    else:
        value = shape.ppf(shape.cdf(low) + probability * (shape.cdf(high) - shape.cdf(low)))
    return min(max(float(value), low), high)


def _check_limits(shape: Shape, limits: tuple[float, float] | None) -> None:
    """Refuses limits in the wrong order and limits that leave nothing to draw."""
    if limits is None:
        return
    low, high = limits
    if low >= high:
        raise ValueError(f"truncate = [{low}, {high}]: the first limit must be below the second")
    if not max(shape.cdf(high) - shape.cdf(low), shape.sf(low) - shape.sf(high)) > 0.0:
        raise ValueError(f"truncate = [{low}, {high}]: the distribution has no probability between the limits")


class Dispersion(BaseModel, ABC):
    """What every dispersion states: its distribution and where it was taken from."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    source: str = ""

    @abstractmethod
    def quantile(self, probability: float) -> Any:
        """The value below which a draw falls with this probability, which lies strictly between 0 and 1."""

    def extremes(self) -> tuple[Any, ...]:
        """Values that stand for all that can be drawn, to be held against what the parameter allows."""
        return self.quantile(TAIL), self.quantile(1.0 - TAIL)

    def describe(self) -> str:
        """The distribution and its parameters in one line."""
        stated = self.model_dump(exclude={"source", "distribution"}, exclude_none=True)
        texts = [f"{name}={value}" for name, value in stated.items()]
        return f"{getattr(self, 'distribution', '?')}({', '.join(texts)})"


class Uniform(Dispersion):
    """Every value between `low` and `high` alike."""

    distribution: Literal["uniform"]
    low: Number
    high: Number

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.low >= self.high:
            raise ValueError(f"low = {self.low} must be below high = {self.high}")
        return self

    def quantile(self, probability: float) -> float:
        """See `Dispersion.quantile`."""
        return min(self.low + (self.high - self.low) * probability, self.high)


class Normal(Dispersion):
    """Normal with mean `mean` and standard deviation `sd`, cut to `truncate` where given."""

    distribution: Literal["normal"]
    mean: Number
    sd: Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0.0)]
    truncate: Limits | None = None

    @model_validator(mode="after")
    def _drawable(self) -> Self:
        _check_limits(_StandardNormal(), self._standard_limits())
        return self

    def _standard_limits(self) -> tuple[float, float] | None:
        if self.truncate is None:
            return None
        low, high = self.truncate
        return (low - self.mean) / self.sd, (high - self.mean) / self.sd

    def quantile(self, probability: float) -> float:
        """See `Dispersion.quantile`."""
        value = self.mean + self.sd * truncated_quantile(_StandardNormal(), self._standard_limits(), probability)
        return value if self.truncate is None else min(max(value, self.truncate[0]), self.truncate[1])


class Integer(Dispersion):
    """Every whole number from `low` to `high` alike, both included."""

    distribution: Literal["integer"]
    low: Annotated[int, Field(strict=True, ge=-(2**52))]
    high: Annotated[int, Field(strict=True, le=2**52)]

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.low > self.high:
            raise ValueError(f"low = {self.low} must not be above high = {self.high}")
        return self

    def quantile(self, probability: float) -> int:
        """See `Dispersion.quantile`."""
        return min(self.low + int((self.high - self.low + 1) * probability), self.high)


class Choice(Dispersion):
    """One of `values`, all alike or by their `weights`, which need not sum to one.

    Where the parameter is a table each value is one, and stands for the whole of it: what it does not set has its
    default.
    """

    distribution: Literal["choice"]
    values: Annotated[list[Any], Field(min_length=1)]
    weights: list[Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0.0)]] | None = None

    @model_validator(mode="after")
    def _one_weight_each(self) -> Self:
        if self.weights is not None and len(self.weights) != len(self.values):
            raise ValueError(f"{len(self.weights)} weights for {len(self.values)} values; give one for each value")
        return self

    @cached_property
    def _cumulative(self) -> list[float]:
        return list(itertools.accumulate(self.weights or [1.0] * len(self.values)))

    def quantile(self, probability: float) -> Any:
        """See `Dispersion.quantile`."""
        place = bisect.bisect_right(self._cumulative, probability * self._cumulative[-1])
        return self.values[min(place, len(self.values) - 1)]

    def extremes(self) -> tuple[Any, ...]:
        """See `Dispersion.extremes`."""
        return tuple(self.values)


def scipy_distributions() -> list[str]:
    """Names of the continuous distributions of `scipy.stats`, except the one that is written `uniform` here as well."""
    from scipy import stats

    kinds = ((name, getattr(stats, name)) for name in dir(stats))
    return [name for name, kind in kinds if isinstance(kind, stats.rv_continuous) and name != "uniform"]


class Scipy(Dispersion):
    """A continuous distribution of `scipy.stats` by its name there, with its parameters and cut to `truncate`."""

    model_config = ConfigDict(extra="allow", frozen=True)
    __pydantic_extra__: dict[str, Number] = Field(init=False)

    distribution: str
    truncate: Limits | None = None

    @field_validator("distribution")
    @classmethod
    def _known(cls, name: str) -> str:
        names = scipy_distributions()
        if name not in names:
            hint = near_match(name, [*FRIENDLY, *names])
            raise ValueError(
                f"unknown distribution '{name}'{hint}; allowed: {', '.join(FRIENDLY)}, "
                "or a continuous distribution of scipy.stats by its name there (norm, truncnorm, beta, ...)"
            )
        return name

    @model_validator(mode="after")
    def _drawable(self) -> Self:
        from scipy import stats

        given = self.__pydantic_extra__ or {}
        shapes = getattr(stats, self.distribution).shapes
        required = [name.strip() for name in shapes.split(",")] if shapes else []
        allowed = [*required, "loc", "scale"]
        problems = [f"unknown parameter '{name}'{near_match(name, allowed)}" for name in given if name not in allowed]
        problems += [f"parameter '{name}' is missing" for name in required if name not in given]
        if problems:
            raise ValueError(f"{', '.join(problems)}; {self.distribution} takes {', '.join(allowed)}")
        if any(limit != limit for limit in self._shape.support()):
            stated = ", ".join(f"{name} = {value}" for name, value in given.items())
            raise ValueError(f"{self.distribution} is not defined for {stated}")
        _check_limits(self._shape, self.truncate)
        return self

    @cached_property
    def _shape(self) -> Any:
        from scipy import stats

        return getattr(stats, self.distribution)(**(self.__pydantic_extra__ or {}))

    def quantile(self, probability: float) -> float:
        """See `Dispersion.quantile`."""
        return truncated_quantile(self._shape, self.truncate, probability)


#: The distributions with their own names and parameters; every other name is looked up in `scipy.stats`.
FRIENDLY: Mapping[str, type[Dispersion]] = {"uniform": Uniform, "normal": Normal, "choice": Choice, "integer": Integer}


def _kind(stated: Any) -> str:
    """The model that reads a dispersion: by its name, `scipy` where it is none of ours."""
    name = stated.get("distribution") if isinstance(stated, Mapping) else getattr(stated, "distribution", None)
    return name if isinstance(name, str) and name in FRIENDLY else "scipy"


AnyDispersion = Annotated[
    Annotated[Uniform, Tag("uniform")]
    | Annotated[Normal, Tag("normal")]
    | Annotated[Choice, Tag("choice")]
    | Annotated[Integer, Tag("integer")]
    | Annotated[Scipy, Tag("scipy")],
    Discriminator(_kind),
]
