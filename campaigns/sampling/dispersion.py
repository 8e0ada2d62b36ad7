"""Base class of the dispersions: a parameter's distribution over the cases, as an inverse distribution function.

Every dispersion maps one uniform number to a value. The values of a case therefore depend on one number per dispersion,
whether these numbers are independent, correlated or stratified. Numbers of a distribution may be formulas
(`marsyard.campaigns.sampling.formulas`) of other parameters; `Dispersion.given` inserts the values of a case.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Annotated, Any, ClassVar, Self

from pydantic import Field, PlainValidator
from pydantic_core import PydanticKnownError

from marsyard.campaigns.sampling.formulas import Formula, formula
from marsyard.sim.parameters import Parameters

#: Tail probability left out on either side when a distribution is checked against the range that a parameter allows.
TAIL = 1e-12


class Dispersion(Parameters, ABC):
    """Fields that every dispersion has: its distribution, and the source of it.

    `unit` and `description` default to those of the parameter (the suffix of its name, its description in the
    scenario).
    """

    #: Whether the distribution has a density, so that ranks can be correlated.
    continuous: ClassVar[bool] = False
    #: Fields that hold texts or literal values, never formulas.
    _literals: ClassVar[frozenset[str]] = frozenset(
        {"distribution", "unit", "description", "source", "values", "value"}
    )

    unit: str | None = None
    description: str | None = None
    source: str = ""

    @abstractmethod
    def quantile(self, probability: float) -> Any:
        """Value below which a draw falls with this probability, 0 < probability < 1."""

    def bounds(self) -> tuple[float, float] | None:
        """Range of all values, infinite where unbounded; None where values are no numbers or depend on formulas."""
        return None

    def extremes(self) -> tuple[Any, ...]:
        """Values to be checked against the range that the parameter allows."""
        return self.quantile(TAIL), self.quantile(1.0 - TAIL)

    @cached_property
    def formulas(self) -> Mapping[tuple[str | int, ...], Formula]:
        """Formulas in place of numbers, by their keys."""
        return dict(_find_formulas(self.model_dump(mode="json", exclude=set(self._literals))))

    @property
    def names(self) -> tuple[str, ...]:
        """Paths of the parameters on which the distribution depends, each once."""
        return tuple(dict.fromkeys(name for one in self.formulas.values() for name in one.names))

    def given(self, values: Mapping[str, Any]) -> Self:
        """Return the distribution for given values of the parameters that its formulas name.

        Raises ValueError where a formula has no value, limits are in the wrong order, or a width is not positive.
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
        """Distribution and its parameters in one line."""
        stated = self.model_dump(exclude={"distribution", "unit", "description", "source"}, exclude_none=True)
        texts = [f"{name}={_short(value)}" for name, value in stated.items()]
        return f"{getattr(self, 'distribution', '?')}({', '.join(texts)})"


def _find_formulas(stated: Any, key: tuple[str | int, ...] = ()) -> Iterator[tuple[tuple[str | int, ...], Formula]]:
    if isinstance(stated, str):
        yield key, formula(stated)
        return
    inner = stated.items() if isinstance(stated, Mapping) else enumerate(stated) if isinstance(stated, list) else ()
    for part, value in inner:
        yield from _find_formulas(value, (*key, part))


def _short(value: Any) -> str:
    if isinstance(value, list | tuple):
        text = ", ".join(str(one) for one in value)
        return f"[{text}]" if len(value) <= 2 or len(text) <= 60 else f"[{value[0]}, ... {len(value)} in all]"
    return str(value)


def _number_or_formula(stated: Any) -> float | str:
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
    number = _number_or_formula(stated)
    if isinstance(number, float) and not number > 0.0:
        raise PydanticKnownError("greater_than", {"gt": 0})
    return number


def _whole_number_or_formula(stated: Any) -> int | str:
    """Whole number that a float represents exactly, or the text of a formula."""
    if isinstance(stated, str):
        return formula(stated).text
    if type(stated) is not int:
        raise PydanticKnownError("int_type")
    if abs(stated) > 2**52:
        raise ValueError(f"must lie between -2**52 and 2**52, got {stated}")
    return stated


def _literal(stated: Any) -> Any:
    """Value without formulas; numbers in it must be finite, since result files cannot hold others."""
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


def interval_of(low: float | str, high: float | str) -> tuple[float, float] | None:
    """Limits as numbers; None where one of them is a formula."""
    return None if isinstance(low, str) or isinstance(high, str) else (float(low), float(high))
