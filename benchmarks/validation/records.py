"""Records of validation checks: claim, limit and measured value."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

from marsyard.reports.validation_rows import Conditions


@dataclass(frozen=True)
class Measure:
    """One measurement: a row of the tables in docs/validation.md.

    Attributes
    ----------
    claim
        Validated property.
    measured, unit
        Measured value and its unit; "" for a fraction, "1" for another number without a unit.
    limit, sense
        Limit (None for values without a limit), and whether it is an upper or lower limit.
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
        """Whether the limit is met; True without a limit."""
        if self.limit is None:
            return True
        # NaN passes neither limit
        return self.measured <= self.limit if self.sense == "at most" else self.measured >= self.limit


@dataclass(frozen=True)
class Check:
    """A group of measurements that run together.

    Attributes
    ----------
    name
        Name on the command line.
    section
        Heading of its rows in the document.
    run
        Function that yields the measurements; its argument `quick` selects fewer samples (with the same limits).
    method_columns
        Headings of the last columns of its table; `Measure.how` contains a cell for each, separated by " | ".
    conditions
        Conditions in which its rows are checked; the first whose pattern matches the claim of a row applies to it.
    """

    name: str
    section: str
    run: Callable[[bool], Iterator[Measure]]
    method_columns: tuple[str, ...] = ("method",)
    conditions: tuple[Conditions, ...] = ()
