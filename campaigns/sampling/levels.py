"""Dispersions over values that are stated: choices, levels of a grid, one value, or what a formula makes of others."""

from __future__ import annotations

import bisect
import itertools
import math
from functools import cached_property
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from marsyard.campaigns.sampling.dispersion import Dispersion
from marsyard.campaigns.sampling.stated import Literally, Number, Weight, numbers_of

#: The most levels of one grid; a slip of the keyboard (a step of 1e-9) shows.
MOST_LEVELS = 100_000


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
        known = numbers_of(self.formula)
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
