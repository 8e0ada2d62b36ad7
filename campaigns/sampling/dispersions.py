# ruff: noqa: D102  (the base class `Dispersion` describes the methods)
"""Dispersions of a campaign file: built-in distributions, and distributions of `scipy.stats` by name."""

import bisect
import itertools
import math
import re
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import ConfigDict, Discriminator, Field, Tag, field_validator, model_validator

from marsyard.campaigns.errors import suggest_similar
from marsyard.campaigns.sampling import dispersion_base as base
from marsyard.campaigns.sampling.distributions import (
    STANDARD_NORMAL,
    TruncationError,
    UnivariateDistribution,
    create_scipy_distribution,
    scipy_distributions,
    scipy_parameters,
    truncated_quantile,
)

#: Maximum number of levels of one grid.
MAX_LEVELS = 100_000
#: Finite number that is no formula.
_Bound = Annotated[float, Field(strict=True, allow_inf_nan=False)]


def _check_range(low: float, high: float) -> None:
    if not low < high:
        raise ValueError(f"low = {low} must be below high = {high}")
    if not math.isfinite(high - low):
        raise ValueError(f"the range from low = {low} to high = {high} is too large")


class _Levels(base.Dispersion):
    """A dispersion over an ordered list of values, its `points`."""

    @property
    @abstractmethod
    def points(self) -> Sequence[Any]:
        """The values in order."""

    def bounds(self) -> tuple[float, float] | None:
        points = self.points
        if any(isinstance(value, bool) or not isinstance(value, int | float) for value in points):
            return None
        try:
            return float(min(points)), float(max(points))
        except OverflowError:
            return None

    def extremes(self) -> tuple[Any, ...]:
        return tuple(self.points)


class Choice(_Levels):
    """One of `values`, with equal probabilities or with probabilities proportional to `weights`.

    If the parameter is a table, each value is a table; missing keys take their default values.
    """

    distribution: Literal["choice"]
    values: Annotated[list[base.LiteralValue], Field(min_length=1)]
    weights: list[base.Weight] | None = None

    @model_validator(mode="after")
    def _check_weights(self) -> Self:
        if self.weights is not None and len(self.weights) != len(self.values):
            raise ValueError(f"{len(self.weights)} weights for {len(self.values)} values; expected one per value")
        if not math.isfinite(self._cumulative[-1]):
            raise ValueError("the weights are too large to be summed")
        return self

    @cached_property
    def _cumulative(self) -> list[float]:
        return list(itertools.accumulate(self.weights or [1.0] * len(self.values)))

    @property
    def points(self) -> Sequence[Any]:
        return self.values

    def quantile(self, probability: float) -> Any:
        last = len(self.values) - 1
        return self.values[bisect.bisect_right(self._cumulative, probability * self._cumulative[-1], hi=last)]


class Fixed(_Levels):
    """The same value in every case; the report lists the parameter and its source with the dispersed parameters."""

    distribution: Literal["fixed"]
    value: base.LiteralValue

    @property
    def points(self) -> Sequence[Any]:
        return (self.value,)

    def quantile(self, probability: float) -> Any:
        return self.value


class Derived(base.Dispersion):
    """A value computed by a formula from other parameters of the case."""

    distribution: Literal["derived"]
    formula: base.Number

    def quantile(self, probability: float) -> float:
        return float(self.formula)

    def bounds(self) -> tuple[float, float] | None:
        return base.read_interval(self.formula, self.formula)


class GridDispersion(_Levels):
    """Levels of a full factorial: every combination of the levels of all grids occurs equally often.

    Either `values`, or the range from `low` to `high`, both included, with a number of `levels` or a `step`.
    """

    distribution: Literal["grid"]
    values: Annotated[list[base.LiteralValue], Field(min_length=1, max_length=MAX_LEVELS)] | None = None
    low: _Bound | None = None
    high: _Bound | None = None
    levels: Annotated[int, Field(strict=True, ge=2, le=MAX_LEVELS)] | None = None
    step: Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0.0)] | None = None

    @model_validator(mode="after")
    def _check_keys(self) -> Self:
        keys = {name for name in ("values", "low", "high", "levels", "step") if getattr(self, name) is not None}
        if keys not in ({"values"}, {"low", "high", "levels"}, {"low", "high", "step"}):
            keys_text = ", ".join(sorted(keys)) or "none of these"
            raise ValueError(f"a grid needs values, or low, high and levels, or low, high and step; got {keys_text}")
        if self.low is not None and self.high is not None:
            _check_range(self.low, self.high)
        if self.step is not None:
            steps = (self.high - self.low) / self.step  # type: ignore[operator]  # both are set, see above
            if not 0.5 <= steps < MAX_LEVELS or abs(steps - round(steps)) > 1e-6:
                required = f"the range from {self.low} to {self.high} into 1 to {MAX_LEVELS - 1} whole steps"
                raise ValueError(f"step = {self.step} does not divide {required}")
        return self

    @cached_property
    def points(self) -> tuple[Any, ...]:
        if self.values is not None:
            return tuple(self.values)
        low, high = float(self.low or 0.0), float(self.high or 0.0)
        steps = round((high - low) / self.step) if self.step is not None else (self.levels or 2) - 1
        return tuple(low + (high - low) * index / steps for index in range(steps + 1))

    def quantile(self, probability: float) -> Any:
        """Return the level at a probability, for levels with equal probabilities."""
        return self.points[min(int(len(self.points) * probability), len(self.points) - 1)]


class Uniform(base.Dispersion):
    """Uniform distribution between `low` and `high`."""

    continuous = True

    distribution: Literal["uniform"]
    low: base.Number
    high: base.Number

    @model_validator(mode="after")
    def _check_limits(self) -> Self:
        if (interval := self.bounds()) is not None:
            _check_range(*interval)
        return self

    def quantile(self, probability: float) -> float:
        low, high = float(self.low), float(self.high)
        return min(low + (high - low) * probability, high)

    def bounds(self) -> tuple[float, float] | None:
        return base.read_interval(self.low, self.high)


class Normal(base.Dispersion):
    """Normal distribution with mean `mean` and standard deviation `sd`, truncated to `truncate` if defined.

    `sd` must be omitted if a correlated group defines it by a covariance; otherwise it is required.
    """

    continuous = True

    distribution: Literal["normal"]
    mean: base.Number
    sd: base.PositiveNumber | None = None
    truncate: base.Limits | None = None

    @model_validator(mode="after")
    def _check_limits(self) -> Self:
        if self.sd is None or self.truncate is None or self.formulas:
            return self
        try:
            self.quantile(0.5)
        except TruncationError as error:
            # its limits are those of the standard normal distribution
            raise TruncationError(*self.truncate, error.reason) from error
        return self

    @cached_property
    def _standard_limits(self) -> tuple[float, float] | None:
        if self.truncate is None:
            return None
        low, high = ((float(limit) - float(self.mean)) / self._sd for limit in self.truncate)
        return low, high

    @property
    def _sd(self) -> float:
        if self.sd is None:
            raise ValueError("the standard deviation is only defined by the covariance of a group")
        return float(self.sd)

    def quantile(self, probability: float) -> float:
        standard_quantile = truncated_quantile(STANDARD_NORMAL, self._standard_limits, probability)
        value = float(self.mean) + self._sd * standard_quantile
        return value if self.truncate is None else min(max(value, float(self.truncate[0])), float(self.truncate[1]))

    def bounds(self) -> tuple[float, float] | None:
        return (-math.inf, math.inf) if self.truncate is None else base.read_interval(*self.truncate)


class _WholeNumbers(base.Dispersion):
    """Whole numbers from `low` to `high`, both included."""

    low: base.WholeNumber
    high: base.WholeNumber

    @model_validator(mode="before")
    @classmethod
    def _convert_whole_floats(cls, values: Any) -> Any:
        if not isinstance(values, Mapping):
            return values
        floats = {key: values[key] for key in ("low", "high") if isinstance(values.get(key), float)}
        return {**values, **{key: int(value) for key, value in floats.items() if value.is_integer()}}

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if self.bounds() is not None and not int(self.low) <= int(self.high):
            raise ValueError(f"low = {self.low} must not be above high = {self.high}")
        return self

    def quantile(self, probability: float) -> int:
        low, high = int(self.low), int(self.high)
        return min(low + int((high - low + 1) * probability), high)

    def bounds(self) -> tuple[float, float] | None:
        return base.read_interval(self.low, self.high)


class Integer(_WholeNumbers):
    """Whole numbers from `low` to `high`, both included, with equal probabilities."""

    distribution: Literal["integer"]


class CyclicInteger(_WholeNumbers):
    """The whole numbers from `low` to `high`, both included, in sequence over the cases, then from `low` again.

    No number repeats before all numbers have occurred; for example, a campaign then uses as many terrains as possible.
    If the number only selects one of many independent terrains, cases with different numbers are independent; with any
    other number they are not (`list_sequences`). Several
    cases of a study can have the same random streams: they have the same number, that of these streams in the sequence.
    """

    distribution: Literal["in-turn"]

    @property
    def size(self) -> int:
        """Number of the values; formulas must have been evaluated."""
        return int(self.high) - int(self.low) + 1

    def value(self, case: int) -> int:
        """Return the number of a case; in a study, `case` is the number of the case's random streams."""
        return int(self.low) + case % self.size


def list_sequences(dispersions: Mapping[str, Any]) -> tuple[str, ...]:
    """List the paths of the dispersions `in-turn` whose cases are no independent draws.

    Only the number of a terrain (parameter `terrain`) selects an independent object, which has random streams of its
    own. Any other number, and one in a formula, is a quantity of which the cases use the first values of the range.

    dispersions: tables of the dispersions by path, as in a campaign file
    """
    tables = {path: item for path, item in dispersions.items() if isinstance(item, Mapping)}
    texts = [str(value) for item in tables.values() for key, value in item.items() if key != "source"]

    def is_in_formula(path: str) -> bool:
        pattern = re.compile(rf"(?<![\w.]){re.escape(path)}(?![\w.])")
        return any(pattern.search(text) for text in texts)

    paths = [path for path, item in tables.items() if item.get("distribution") == "in-turn"]
    return tuple(path for path in paths if path.rpartition(".")[2] != "terrain" or is_in_formula(path))


class Scipy(base.Dispersion):
    """A distribution of `scipy.stats` by its name, with its parameters, truncated to `truncate` if defined.

    Values of discrete distributions (`poisson`, `binom`, ...) are whole numbers; their limits are included.
    """

    model_config = ConfigDict(extra="allow", frozen=True)
    __pydantic_extra__: dict[str, base.Number] = Field(init=False)

    distribution: str
    truncate: base.Limits | None = None

    @field_validator("distribution")
    @classmethod
    def _check_name(cls, name: str) -> str:
        names = scipy_distributions()
        if name not in names:
            hint = suggest_similar(name, [*BUILT_IN, *names])
            alternative = "a univariate distribution of scipy.stats by its name (norm, beta, poisson, ...)"
            raise ValueError(f"unknown distribution '{name}'{hint}; allowed: {', '.join(BUILT_IN)}, or {alternative}")
        return name

    @model_validator(mode="after")
    def _check_parameters(self) -> Self:
        values = self.__pydantic_extra__ or {}
        required, allowed = scipy_parameters(self.distribution)
        problems = [
            f"unknown parameter '{name}'{suggest_similar(name, allowed)}" for name in values if name not in allowed
        ]
        problems += [f"parameter '{name}' is missing" for name in required if name not in values]
        if problems:
            raise ValueError(f"{', '.join(problems)}; {self.distribution} accepts {', '.join(allowed)}")
        if not self.formulas:
            self.quantile(0.5)
        return self

    @property
    def continuous(self) -> bool:  # type: ignore[override]  # depends on the distribution's name
        """Whether the distribution has a density."""
        return not scipy_distributions()[self.distribution]

    @cached_property
    def _scipy_distribution(self) -> UnivariateDistribution:
        parameters = {name: float(value) for name, value in (self.__pydantic_extra__ or {}).items()}
        return create_scipy_distribution(self.distribution, parameters)

    def quantile(self, probability: float) -> float | int:
        limits = None if self.truncate is None else (float(self.truncate[0]), float(self.truncate[1]))
        return truncated_quantile(self._scipy_distribution, limits, probability)

    def bounds(self) -> tuple[float, float] | None:
        if self.formulas:
            return None
        low, high = self._scipy_distribution.support
        limits = self.truncate or (-math.inf, math.inf)
        return max(low, float(limits[0])), min(high, float(limits[1]))


_Dispersion = (
    Annotated[Uniform, Tag("uniform")]
    | Annotated[Normal, Tag("normal")]
    | Annotated[Choice, Tag("choice")]
    | Annotated[Integer, Tag("integer")]
    | Annotated[CyclicInteger, Tag("in-turn")]
    | Annotated[Fixed, Tag("fixed")]
    | Annotated[Derived, Tag("derived")]
    | Annotated[GridDispersion, Tag("grid")]
    | Annotated[Scipy, Tag("scipy")]
)
#: Classes of dispersions by the tag that pydantic adds to the location of an error.
TAGGED_DISPERSIONS: Mapping[str, type[base.Dispersion]] = {
    tag.tag: kind for kind, tag in map(get_args, get_args(_Dispersion))
}
#: Distributions implemented in this module; any other name is looked up in `scipy.stats`.
BUILT_IN = {name: kind for name, kind in TAGGED_DISPERSIONS.items() if kind is not Scipy}


def _select_tag(value: Any) -> str:
    """Return the tag of the class that a dispersion's distribution selects."""
    name = value.get("distribution") if isinstance(value, Mapping) else getattr(value, "distribution", None)
    return name if isinstance(name, str) and name in BUILT_IN else "scipy"


AnyDispersion = Annotated[_Dispersion, Discriminator(_select_tag)]
