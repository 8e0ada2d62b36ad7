"""Records of validation checks: claim, limit and measured value."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

from marsyard.reports.validation_rows import Conditions


@dataclass(frozen=True)
class Measure:
    """One measurement: a row of the tables in docs/validation.md.

    - claim: validated property
    - measured, unit: measured value and its unit; "" for a fraction, "1" for another number without a unit
    - limit, sense: limit (None for values without a limit), and whether it is an upper or lower limit
    - how: short description of the method
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


def min_coverage(nominal: float, trials: int) -> float:
    """Minimum of a simulated coverage: nominal coverage minus three standard deviations of the simulation."""
    return nominal - 3.0 * math.sqrt(nominal * (1.0 - nominal) / trials)


@dataclass(frozen=True)
class Check:
    """A group of measurements that run together.

    - name: name on the command line
    - section: heading of its rows in the document
    - run: function that yields the measurements; its argument `quick` selects fewer samples (with the same limits)
    - method_columns: headings of the last columns of its table; `Measure.how` contains a cell for each, separated by
      " | "
    - conditions: conditions in which its rows are checked; the first whose pattern matches the claim of a row applies
      to it
    """

    name: str
    section: str
    run: Callable[[bool], Iterator[Measure]]
    method_columns: tuple[str, ...] = ("method",)
    conditions: tuple[Conditions, ...] = ()
