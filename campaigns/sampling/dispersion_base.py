"""Base class of the dispersions, and the types of their fields.

A dispersion defines the distribution of a parameter over the cases by its inverse distribution function, which maps one
uniform number to a value. The uniform numbers can be independent, correlated or stratified. The parameters of a
distribution can be formulas of other parameters of the campaign; `Dispersion.insert_values` evaluates the formulas.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Annotated, Any, ClassVar, Self

from pydantic import Field, PlainValidator
from pydantic_core import PydanticKnownError

from marsyard.campaigns.sampling.formulas import Formula, parse_formula
from marsyard.sim.parameters import Parameters

#: Probability of each tail that is ignored when a distribution is compared with the allowed range of a parameter.
TAIL = 1e-12
#: Maximum number of characters of a list of more than two values in a description.
_MAX_LIST = 60


class Dispersion(Parameters, ABC):
    """Base class of the dispersions.

    By default, `unit` and `description` are those of the parameter: the suffix of its name, and its description in the
    scenario.
    """

    #: Whether the distribution has a density; only then can its ranks be correlated.
    continuous: ClassVar[bool] = False
    #: Fields that contain texts or literal values, never formulas.
    _literals: ClassVar[set[str]] = {"distribution", "unit", "description", "source", "values", "value"}

    unit: str | None = None
    description: str | None = None
    source: str = ""

    @abstractmethod
    def quantile(self, probability: float) -> Any:
        """Return the quantile of the distribution at a probability, 0 < probability < 1."""

    def bounds(self) -> tuple[float, float] | None:
        """Return the range of all values, infinite if unbounded; None if values are no numbers or use formulas."""
        return None

    def extremes(self) -> tuple[Any, ...]:
        """Return the values that are compared with the allowed range of the parameter."""
        return self.quantile(TAIL), self.quantile(1.0 - TAIL)

    @cached_property
    def formulas(self) -> Mapping[tuple[str | int, ...], Formula]:
        """Formulas in the fields of the dispersion, by their keys."""
        return dict(_find_formulas(self.model_dump(mode="json", exclude=self._literals)))

    @property
    def names(self) -> tuple[str, ...]:
        """Paths of the parameters on which the distribution depends, each once."""
        return tuple(dict.fromkeys(name for item in self.formulas.values() for name in item.names))

    def insert_values(self, values: Mapping[str, Any]) -> Self:
        """Evaluate the formulas for parameter values by path, and return the resulting distribution.

        Raises ValueError if a formula is undefined, limits are in the wrong order, or a width is not positive.
        """
        if not self.formulas:
            return self
        fields = self.model_dump(mode="json")
        for key, expression in self.formulas.items():
            table: Any = fields
            for part in key[:-1]:
                table = table[part]
            table[key[-1]] = expression.evaluate(values)
        return type(self).model_validate(fields)

    def describe(self) -> str:
        """Describe the distribution and its parameters in one line."""
        fields = self.model_dump(exclude={"distribution", "unit", "description", "source"}, exclude_none=True)
        texts = []
        for name, value in fields.items():
            text = str(value)
            if isinstance(value, list | tuple):
                values_text = ", ".join(str(item) for item in value)
                is_short = len(value) <= 2 or len(values_text) <= _MAX_LIST
                text = f"[{values_text}]" if is_short else f"[{value[0]}, ... {len(value)} in all]"
            texts.append(f"{name}={text}")
        return f"{getattr(self, 'distribution', '?')}({', '.join(texts)})"


def _find_formulas(tree: Any, key: tuple[str | int, ...] = ()) -> Iterator[tuple[tuple[str | int, ...], Formula]]:
    """Yield the formulas in nested tables and lists, with their keys."""
    if isinstance(tree, str):
        yield key, parse_formula(tree)
        return
    inner = tree.items() if isinstance(tree, Mapping) else enumerate(tree) if isinstance(tree, list) else ()
    for part, value in inner:
        yield from _find_formulas(value, (*key, part))


def _check_number(value: Any) -> float | str:
    """Return a finite number, or the text of a formula."""
    if isinstance(value, str):
        return parse_formula(value).text
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise PydanticKnownError("float_type")
    if not abs(value) < math.inf:
        raise PydanticKnownError("finite_number")
    try:
        return float(value)
    except OverflowError:
        raise PydanticKnownError("finite_number") from None


def _check_positive_number(value: Any) -> float | str:
    """Return a positive number, or the text of a formula."""
    number = _check_number(value)
    if isinstance(number, float) and not number > 0.0:
        raise PydanticKnownError("greater_than", {"gt": 0})
    return number


def _check_whole_number(value: Any) -> int | str:
    """Return an integer that a float represents exactly, or the text of a formula."""
    if isinstance(value, str):
        return parse_formula(value).text
    if type(value) is not int:
        raise PydanticKnownError("int_type")
    if abs(value) > 2**52:
        raise ValueError(f"must lie between -2**52 and 2**52, got {value}")
    return value


def _check_literal(value: Any) -> Any:
    """Return a value in which all numbers are finite, because result files cannot store other numbers."""
    items = value.values() if isinstance(value, Mapping) else value if isinstance(value, list | tuple) else ()
    for inner in items:
        _check_literal(inner)
    if isinstance(value, float) and not math.isfinite(value):
        raise PydanticKnownError("finite_number")
    return value


Number = Annotated[float | str, PlainValidator(_check_number)]
PositiveNumber = Annotated[float | str, PlainValidator(_check_positive_number)]
Limits = tuple[Number, Number]
WholeNumber = Annotated[int | str, PlainValidator(_check_whole_number)]
LiteralValue = Annotated[Any, PlainValidator(_check_literal)]
Weight = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0.0)]


def read_interval(low: float | str, high: float | str) -> tuple[float, float] | None:
    """Convert limits to numbers; None if one of them is a formula."""
    return None if isinstance(low, str) or isinstance(high, str) else (float(low), float(high))
