"""Dispersions over a range of numbers: uniform, normal, whole numbers drawn or taken in turn."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Any, Literal, Self

from pydantic import model_validator

from marsyard.campaigns.sampling.dispersion import Dispersion
from marsyard.campaigns.sampling.shapes import STANDARD_NORMAL, truncated_quantile
from marsyard.campaigns.sampling.stated import Limits, Number, PositiveNumber, WholeNumber, limits_of, numbers_of


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
        known = numbers_of(self.low, self.high)
        return (known[0], known[1]) if known else None


class Normal(Dispersion):
    """Normal with mean `mean` and standard deviation `sd`, cut to `truncate` where given.

    `sd` is left out where a group states a covariance (`marsyard.campaigns.sampling.correlation`), and nowhere else.
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
        limits, sd = limits_of(self.truncate), self._sd
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
        limits = limits_of(self.truncate)
        return value if limits is None else min(max(value, limits[0]), limits[1])

    def bounds(self) -> tuple[float, float] | None:
        """See `Dispersion.bounds`."""
        if self.truncate is None:
            return -math.inf, math.inf
        known = numbers_of(*self.truncate)
        return (known[0], known[1]) if known else None


class _WholeNumbers(Dispersion):
    """Whole numbers from `low` to `high`, both included."""

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
        known = numbers_of(self.low, self.high)
        return (known[0], known[1]) if known else None


class Integer(_WholeNumbers):
    """Every whole number from `low` to `high` alike, both included."""

    distribution: Literal["integer"]


class InTurn(_WholeNumbers):
    """The whole numbers from `low` to `high`, both included, one case after the other, then from `low` again.

    No number is met twice before all are met once: cases are on as many terrains as there can be. Where the numbers
    mean nothing but which of many independent terrains it is, cases with different ones are independent.
    """

    distribution: Literal["in-turn"]

    def value(self, case: int) -> int:
        """The number that a case takes."""
        low, high = int(self.low), int(self.high)
        return low + case % (high - low + 1)
