"""Dispersions: how a parameter is distributed over the cases, and the value at each probability.

Every dispersion turns one uniform number into a value, by the inverse of its distribution function. A case's values so
depend on one number a dispersion, however the numbers are laid out: drawn independently, correlated, or stratified.

Numbers of a distribution may be formulas (`campaigns.formulas`) over other parameters, drawn ones among them;
`Dispersion.given` puts a case's values in their place.
"""

from __future__ import annotations

import bisect
import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BaseModel, ConfigDict, Discriminator, Field, PlainValidator, Tag, field_validator, model_validator
from pydantic_core import PydanticKnownError

from campaigns.errors import near_match
from campaigns.formulas import Formula, formula
from campaigns.shapes import STANDARD_NORMAL, Frozen, Shape, parameters_of, scipy_distributions, truncated_quantile

#: Probability left out on either side when the reach of a distribution is checked against what a parameter allows.
TAIL = 1e-12
#: The most levels of one grid; a slip of the keyboard (a step of 1e-9) shows.
MOST_LEVELS = 100_000


def _number_or_formula(stated: Any) -> float | str:
    """A finite number, or the text of a formula."""
    if isinstance(stated, str):
        return formula(stated).text
    if isinstance(stated, bool) or not isinstance(stated, int | float):
        raise PydanticKnownError("float_type")
    if not abs(stated) < math.inf:
        raise PydanticKnownError("finite_number")
    try:
        return float(stated)
    except OverflowError:
        raise PydanticKnownError("finite_number") from None


def _positive_number_or_formula(stated: Any) -> float | str:
    """A finite number above 0, or the text of a formula."""
    known = _number_or_formula(stated)
    if isinstance(known, float) and not known > 0.0:
        raise PydanticKnownError("greater_than", {"gt": 0})
    return known


def _whole_number_or_formula(stated: Any) -> int | str:
    """A whole number that a float holds exactly, or the text of a formula."""
    if isinstance(stated, str):
        return formula(stated).text
    if type(stated) is not int:
        raise PydanticKnownError("int_type")
    if abs(stated) > 2**52:
        raise ValueError(f"must lie between -2**52 and 2**52, got {stated}")
    return stated


def _literal(stated: Any) -> Any:
    """A value that is drawn as it stands; numbers in it must be finite, as files of results cannot hold others."""
    tables = stated.values() if isinstance(stated, Mapping) else stated if isinstance(stated, list | tuple) else ()
    for inner in tables:
        _literal(inner)
    if isinstance(stated, float) and not math.isfinite(stated):
        raise PydanticKnownError("finite_number")
    return stated


Number = Annotated[float | str, PlainValidator(_number_or_formula)]
PositiveNumber = Annotated[float | str, PlainValidator(_positive_number_or_formula)]
Limits = tuple[Number, Number]
WholeNumber = Annotated[int | str, PlainValidator(_whole_number_or_formula)]
Literally = Annotated[Any, PlainValidator(_literal)]
Weight = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0.0)]


class Dispersion(BaseModel, ABC):
    """What every dispersion states: its distribution, and where it was taken from.

    `unit` and `description` are those of the parameter (the ending of its name, the scenario's own words) where they
    are not stated.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    #: Whether the values fill a range without gaps, so that their ranks can be correlated.
    continuous: ClassVar[bool] = False
    #: Fields that hold texts or values as they stand, and no formulas.
    _literals: ClassVar[frozenset[str]] = frozenset(
        {"distribution", "unit", "description", "source", "values", "value"}
    )

    unit: str | None = None
    description: str | None = None
    source: str = ""

    @abstractmethod
    def quantile(self, probability: float) -> Any:
        """The value below which a draw falls with this probability, which lies strictly between 0 and 1."""

    def bounds(self) -> tuple[float, float] | None:
        """Between what all values lie, infinite where nothing bounds them; None where they are not numbers."""
        return None

    def extremes(self) -> tuple[Any, ...]:
        """Values that stand for all that can be drawn, to be held against what the parameter allows."""
        return self.quantile(TAIL), self.quantile(1.0 - TAIL)

    @cached_property
    def formulas(self) -> Mapping[tuple[str | int, ...], Formula]:
        """The formulas that stand for numbers, by their keys."""
        return dict(_formulas(self.model_dump(mode="json", exclude=set(self._literals))))

    @property
    def names(self) -> tuple[str, ...]:
        """Paths of the parameters on which the distribution depends, each once."""
        return tuple(dict.fromkeys(name for one in self.formulas.values() for name in one.names))

    def given(self, values: Mapping[str, Any]) -> Self:
        """The distribution where the parameters that its formulas name have these values.

        Raises
        ------
        ValueError
            Where there is none: a formula without a value, limits in the wrong order, a width that is not positive.
        """
        if not self.formulas:
            return self
        stated = self.model_dump(mode="json")
        for key, one in self.formulas.items():
            table: Any = stated
            for part in key[:-1]:
                table = table[part]
            table[key[-1]] = one.value(values)
        return type(self).model_validate(stated)

    def describe(self) -> str:
        """The distribution and its parameters in one line."""
        stated = self.model_dump(exclude={"distribution", "unit", "description", "source"}, exclude_none=True)
        texts = [f"{name}={_short(value)}" for name, value in stated.items()]
        return f"{getattr(self, 'distribution', '?')}({', '.join(texts)})"


def _formulas(stated: Any, key: tuple[str | int, ...] = ()) -> Iterator[tuple[tuple[str | int, ...], Formula]]:
    if isinstance(stated, str):
        yield key, formula(stated)
        return
    inner = stated.items() if isinstance(stated, Mapping) else enumerate(stated) if isinstance(stated, list) else ()
    for part, value in inner:
        yield from _formulas(value, (*key, part))


def _short(value: Any) -> str:
    """A value as text; of a long list how long it is."""
    if isinstance(value, list | tuple):
        told = ", ".join(str(one) for one in value)
        return f"[{told}]" if len(value) <= 2 or len(told) <= 60 else f"[{value[0]}, ... {len(value)} in all]"
    return str(value)


def _numbers(*stated: float | str) -> list[float]:
    """The numbers, none where one of them is a formula yet."""
    return [] if any(isinstance(one, str) for one in stated) else [float(one) for one in stated]


def _limits(truncate: Limits | None) -> tuple[float, float] | None:
    """Limits as numbers; a formula among them must have been worked out."""
    return None if truncate is None else (float(truncate[0]), float(truncate[1]))


class Uniform(Dispersion):
    """Every value between `low` and `high` alike."""

    continuous = True

    distribution: Literal["uniform"]
    low: Number
    high: Number

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.bounds() is not None and not self._low < self._high:
            raise ValueError(f"low = {self.low} must be below high = {self.high}")
        if self.bounds() is not None and not math.isfinite(self._high - self._low):
            raise ValueError(f"from low = {self.low} to high = {self.high} is too far")
        return self

    @property
    def _low(self) -> float:
        return float(self.low)

    @property
    def _high(self) -> float:
        return float(self.high)

    def quantile(self, probability: float) -> float:
        """See `Dispersion.quantile`."""
        return min(self._low + (self._high - self._low) * probability, self._high)

    def bounds(self) -> tuple[float, float] | None:
        """See `Dispersion.bounds`."""
        known = _numbers(self.low, self.high)
        return (known[0], known[1]) if known else None


class Normal(Dispersion):
    """Normal with mean `mean` and standard deviation `sd`, cut to `truncate` where given.

    `sd` is left out where a group states a covariance (`campaigns.correlation`), and nowhere else.
    """

    continuous = True

    distribution: Literal["normal"]
    mean: Number
    sd: PositiveNumber | None = None
    truncate: Limits | None = None

    @model_validator(mode="after")
    def _drawable(self) -> Self:
        if self.sd is not None and not self.formulas:
            truncated_quantile(STANDARD_NORMAL, self._standard_limits, 0.5)
        return self

    @cached_property
    def _standard_limits(self) -> tuple[float, float] | None:
        limits, sd = _limits(self.truncate), self._sd
        return None if limits is None else ((limits[0] - self._mean) / sd, (limits[1] - self._mean) / sd)

    @property
    def _mean(self) -> float:
        return float(self.mean)

    @property
    def _sd(self) -> float:
        if self.sd is None:
            raise ValueError("the standard deviation is stated by a group's covariance only")
        return float(self.sd)

    def quantile(self, probability: float) -> float:
        """See `Dispersion.quantile`."""
        value = self._mean + self._sd * truncated_quantile(STANDARD_NORMAL, self._standard_limits, probability)
        limits = _limits(self.truncate)
        return value if limits is None else min(max(value, limits[0]), limits[1])

    def bounds(self) -> tuple[float, float] | None:
        """See `Dispersion.bounds`."""
        if self.truncate is None:
            return -math.inf, math.inf
        known = _numbers(*self.truncate)
        return (known[0], known[1]) if known else None


class Integer(Dispersion):
    """Every whole number from `low` to `high` alike, both included."""

    distribution: Literal["integer"]
    low: WholeNumber
    high: WholeNumber

    @model_validator(mode="before")
    @classmethod
    def _whole(cls, stated: Any) -> Any:
        """Lets a formula's whole number pass, which comes as a float."""
        if not isinstance(stated, Mapping):
            return stated
        known = {key: stated[key] for key in ("low", "high") if isinstance(stated.get(key), float)}
        return {**stated, **{key: int(value) for key, value in known.items() if value.is_integer()}}

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.bounds() is not None and not int(self.low) <= int(self.high):
            raise ValueError(f"low = {self.low} must not be above high = {self.high}")
        return self

    def quantile(self, probability: float) -> int:
        """See `Dispersion.quantile`."""
        low, high = int(self.low), int(self.high)
        return min(low + int((high - low + 1) * probability), high)

    def bounds(self) -> tuple[float, float] | None:
        """See `Dispersion.bounds`."""
        known = _numbers(self.low, self.high)
        return (known[0], known[1]) if known else None


class Choice(Dispersion):
    """One of `values`, all alike or by their `weights`, which need not sum to one.

    Where the parameter is a table each value is one, and stands for the whole of it: what it does not set has its
    default.
    """

    distribution: Literal["choice"]
    values: Annotated[list[Literally], Field(min_length=1)]
    weights: list[Weight] | None = None

    @model_validator(mode="after")
    def _one_weight_each(self) -> Self:
        if self.weights is not None and len(self.weights) != len(self.values):
            raise ValueError(f"{len(self.weights)} weights for {len(self.values)} values; give one for each value")
        if not math.isfinite(self._cumulative[-1]):
            raise ValueError("the weights are too large to be summed")
        return self

    @cached_property
    def _cumulative(self) -> list[float]:
        return list(itertools.accumulate(self.weights or [1.0] * len(self.values)))

    def quantile(self, probability: float) -> Any:
        """See `Dispersion.quantile`."""
        place = bisect.bisect_right(self._cumulative, probability * self._cumulative[-1])
        return self.values[min(place, len(self.values) - 1)]

    def bounds(self) -> tuple[float, float] | None:
        """See `Dispersion.bounds`."""
        return _span(self.values)

    def extremes(self) -> tuple[Any, ...]:
        """See `Dispersion.extremes`."""
        return tuple(self.values)


class Fixed(Dispersion):
    """The same value in every case: a parameter that is set with its source beside those that are drawn."""

    distribution: Literal["fixed"]
    value: Literally

    def quantile(self, probability: float) -> Any:
        """See `Dispersion.quantile`."""
        return self.value

    def bounds(self) -> tuple[float, float] | None:
        """See `Dispersion.bounds`."""
        return _span([self.value])

    def extremes(self) -> tuple[Any, ...]:
        """See `Dispersion.extremes`."""
        return (self.value,)


class Derived(Dispersion):
    """What a formula makes of other parameters of the case."""

    distribution: Literal["derived"]
    formula: Number

    def quantile(self, probability: float) -> float:
        """See `Dispersion.quantile`."""
        return float(self.formula)

    def bounds(self) -> tuple[float, float] | None:
        """See `Dispersion.bounds`."""
        known = _numbers(self.formula)
        return (known[0], known[0]) if known else None


class Grid(Dispersion):
    """Levels that are swept: every one of them is met as often, with every level of each other grid.

    Either `values`, or from `low` to `high`, both included, by the number of `levels` or in a `step` that fits.
    """

    distribution: Literal["grid"]
    values: Annotated[list[Literally], Field(min_length=1, max_length=MOST_LEVELS)] | None = None
    low: Annotated[float, Field(strict=True, allow_inf_nan=False)] | None = None
    high: Annotated[float, Field(strict=True, allow_inf_nan=False)] | None = None
    levels: Annotated[int, Field(strict=True, ge=2, le=MOST_LEVELS)] | None = None
    step: Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0.0)] | None = None

    @model_validator(mode="after")
    def _stated_once(self) -> Self:
        given = {name for name in ("values", "low", "high", "levels", "step") if getattr(self, name) is not None}
        if given not in ({"values"}, {"low", "high", "levels"}, {"low", "high", "step"}):
            told = ", ".join(sorted(given)) or "none of them"
            raise ValueError(f"a grid takes values, or low, high and levels, or low, high and step; got {told}")
        if self.low is not None and self.high is not None and self.low >= self.high:
            raise ValueError(f"low = {self.low} must be below high = {self.high}")
        if self.low is not None and self.high is not None and not math.isfinite(self.high - self.low):
            raise ValueError(f"from low = {self.low} to high = {self.high} is too far")
        if self.step is not None:
            steps = (self.high - self.low) / self.step  # type: ignore[operator]  # both are there, see above
            if not 0.5 <= steps < MOST_LEVELS or abs(steps - round(steps)) > 1e-6:
                raise ValueError(
                    f"step = {self.step} does not divide the range from {self.low} to {self.high} "
                    f"into 1 to {MOST_LEVELS - 1} whole steps"
                )
        return self

    @cached_property
    def points(self) -> tuple[Any, ...]:
        """The levels, in order."""
        if self.values is not None:
            return tuple(self.values)
        low, high = float(self.low or 0.0), float(self.high or 0.0)
        steps = round((high - low) / self.step) if self.step is not None else (self.levels or 2) - 1
        return tuple(low + (high - low) * place / steps for place in range(steps + 1))

    def quantile(self, probability: float) -> Any:
        """The level at a probability, were a level drawn with all of them alike."""
        return self.points[min(int(len(self.points) * probability), len(self.points) - 1)]

    def bounds(self) -> tuple[float, float] | None:
        """See `Dispersion.bounds`."""
        return _span(self.points)

    def extremes(self) -> tuple[Any, ...]:
        """See `Dispersion.extremes`."""
        return self.points


def _span(values: Any) -> tuple[float, float] | None:
    """Least and greatest of values that are all numbers; None where one is none."""
    if any(isinstance(value, bool) or not isinstance(value, int | float) for value in values):
        return None
    try:
        return float(min(values)), float(max(values))
    except OverflowError:
        return None


class Scipy(Dispersion):
    """A distribution of `scipy.stats` by its name there, with its parameters and cut to `truncate`.

    Discrete ones (`poisson`, `binom`, ...) give whole numbers; their limits are included.
    """

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
                "or a distribution of one variable of scipy.stats by its name there (norm, beta, poisson, ...)"
            )
        return name

    @model_validator(mode="after")
    def _drawable(self) -> Self:
        given = self.__pydantic_extra__ or {}
        required, allowed = parameters_of(self.distribution)
        problems = [f"unknown parameter '{name}'{near_match(name, allowed)}" for name in given if name not in allowed]
        problems += [f"parameter '{name}' is missing" for name in required if name not in given]
        if problems:
            raise ValueError(f"{', '.join(problems)}; {self.distribution} takes {', '.join(allowed)}")
        if not self.formulas:
            truncated_quantile(self._shape, _limits(self.truncate), 0.5)
        return self

    @property
    def continuous(self) -> bool:  # type: ignore[override]  # known only with the distribution's name
        """Whether it is a density's."""
        return not scipy_distributions()[self.distribution]

    @cached_property
    def _shape(self) -> Shape:
        stated = {name: float(value) for name, value in (self.__pydantic_extra__ or {}).items()}
        return Frozen(self.distribution, stated)

    def quantile(self, probability: float) -> float | int:
        """See `Dispersion.quantile`."""
        return truncated_quantile(self._shape, _limits(self.truncate), probability)

    def bounds(self) -> tuple[float, float] | None:
        """See `Dispersion.bounds`."""
        if self.formulas:
            return None
        low, high = self._shape.support()
        limits = _limits(self.truncate) or (-math.inf, math.inf)
        return max(low, limits[0]), min(high, limits[1])


#: The distributions with their own names and parameters; every other name is looked up in `scipy.stats`.
FRIENDLY: Mapping[str, type[Dispersion]] = {
    "uniform": Uniform,
    "normal": Normal,
    "choice": Choice,
    "integer": Integer,
    "fixed": Fixed,
    "derived": Derived,
    "grid": Grid,
}


def _kind(stated: Any) -> str:
    """The model that reads a dispersion: by its name, `scipy` where it is none of ours."""
    name = stated.get("distribution") if isinstance(stated, Mapping) else getattr(stated, "distribution", None)
    return name if isinstance(name, str) and name in FRIENDLY else "scipy"


AnyDispersion = Annotated[
    Annotated[Uniform, Tag("uniform")]
    | Annotated[Normal, Tag("normal")]
    | Annotated[Choice, Tag("choice")]
    | Annotated[Integer, Tag("integer")]
    | Annotated[Fixed, Tag("fixed")]
    | Annotated[Derived, Tag("derived")]
    | Annotated[Grid, Tag("grid")]
    | Annotated[Scipy, Tag("scipy")],
    Discriminator(_kind),
]
