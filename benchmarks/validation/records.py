"""Results of checks: claim, bound and measured value."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Measure:
    """One row of the validation.

    Attributes
    ----------
    claim
        Validated property.
    measured, unit
        Measured value and its unit; "" for a fraction.
    limit, sense
        Bound (None for values without a bound), and whether it is an upper or lower bound.
    how
        Short description of the method.
    """

    claim: str
    measured: float
    unit: str
    limit: float | None
    how: str
    sense: Literal["at most", "at least"] = "at most"

    @property
    def passed(self) -> bool:
        """Whether the bound is met; True without a bound."""
        if self.limit is None:
            return True
        # NaN exceeds every bound
        return self.measured <= self.limit if self.sense == "at most" else self.measured >= self.limit


@dataclass(frozen=True)
class Check:
    """A group of measurements.

    Attributes
    ----------
    name
        Name on the command line.
    section
        Heading of its rows in the document.
    run
        Function that yields the measurements; its argument selects fewer samples (with the same bounds).
    """

    name: str
    section: str
    run: Callable[[bool], Iterator[Measure]]
