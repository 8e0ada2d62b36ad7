"""Dispersions: how a parameter is distributed over the cases, and the value at each probability.

Every dispersion turns one uniform number into a value, by the inverse of its distribution function. A case's values so
depend on one number a dispersion, however the numbers are laid out: drawn independently, correlated, or stratified.

Numbers of a distribution may be formulas (`marsyard.campaigns.sampling.formulas`) over other parameters, drawn ones
among them; `Dispersion.given` puts a case's values in their place.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Any, ClassVar, Self

from marsyard.campaigns.sampling.formulas import Formula, formula
from marsyard.campaigns.sampling.stated import StatedTable

#: Probability left out on either side when the reach of a distribution is checked against what a parameter allows.
TAIL = 1e-12


class Dispersion(StatedTable, ABC):
    """What every dispersion states: its distribution, and where it was taken from.

    `unit` and `description` are those of the parameter (the ending of its name, the scenario's own words) where they
    are not stated.
    """

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
