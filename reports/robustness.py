"""Records of robust verdicts: the smallest change of one kind that turns PASS of a requirement into FAIL, in words.

`marsyard.reports.robustness_evaluation` computes the records of changes of dispersions. `marsyard.reports.variants`
computes those of other values of a parameter that the campaign does not disperse (`ChangeKind.VALUE`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

from marsyard.campaigns.json_numbers import Number
from marsyard.reports.dispersion_changes import ChangeKind
from marsyard.reports.statistics.reweighted_rates import Crossing
from marsyard.reports.wording import number, percent
from marsyard.scenarios.columns import split_unit, to_words

#: Name of the parameter of a change of all dispersions at once.
ALL_DISPERSIONS = "all dispersions"


class ChangeOutcome(StrEnum):
    """What the cases say about a change to FAIL."""

    FOUND = "found"
    #: Fewer than 30 effective cases before the estimated rate reaches the permitted one.
    REFUSED = "refused"
    #: The estimated rate stays below the permitted one for all changes of this kind.
    NONE = "none"

    @classmethod
    def of(cls, crossing: Crossing, *, is_complete: bool) -> ChangeOutcome:
        """Return the outcome of a change; `is_complete`: whether the cases cover all changes of this kind."""
        if not math.isnan(crossing.change):
            return cls.FOUND
        return cls.NONE if is_complete else cls.REFUSED


@dataclass(frozen=True)
class Robustness:
    """Smallest change of one kind that turns PASS of a requirement into FAIL; unknown numbers are NaN.

    - kind: changed property of the dispersion; VALUE: another value of a parameter that is not dispersed
    - parameter: path of the parameter; `value` in addition for a value of `choice`; `ALL_DISPERSIONS`
    - unit: unit of `assumed`, `spread`, `passes_at` and `fails_at`
    - assumed: declared mean, standard deviation (wider, narrower), probability (more frequent) or value
    - spread: assumed spread, the unit of the changes, in this unit: the declared standard deviation, that of the
      indicator of a value of `choice`, or the magnitude of the value of a parameter that is not dispersed. A
      divergence r is expressed by the shift sqrt(2 r) of one normal dispersion, which has this divergence
    - passes_at, fails_at: `assumed` after the changes `lower` and `change`
    - change: change to FAIL in assumed spreads. If mean or variance can be infinite, a change of the standard normal
      variable z behind the dispersion (`marsyard.reports.dispersion_changes`), in standard deviations of z
    - lower, upper: PASS holds below the change `lower`, FAIL is shown above `upper`, each at `confidence`
    - reach: largest change about which the cases say something
    - effective_cases: effective number of cases (terrains if they are shared) at `change`, or at `reach` without it
    """

    requirement: str
    parameter: str
    kind: ChangeKind
    unit: str
    assumed: Number
    spread: Number
    passes_at: Number
    fails_at: Number
    change: Number
    lower: Number
    upper: Number
    reach: Number
    effective_cases: Number
    confidence: Number
    outcome: ChangeOutcome
    value: str = ""

    @property
    def name(self) -> str:
        """The quantity that changes, in words."""
        words = f"{to_words(split_unit(self.parameter)[0])}{f' = {self.value}' if self.value else ''}"
        if self.kind in (ChangeKind.MEAN_UP, ChangeKind.MEAN_DOWN):
            return f"mean of {words}"
        return f"standard deviation of {words}" if self.kind in (ChangeKind.WIDER, ChangeKind.NARROWER) else words

    def format_value(self, value: float, change: float) -> str:
        """Format the quantity after a change, or the change in assumed spreads if the quantity has no number."""
        if self.kind is ChangeKind.MORE_FREQUENT:
            return percent(value)
        if math.isnan(value) or self.kind is ChangeKind.DIVERGENCE:
            sign = "−" if self.kind in (ChangeKind.MEAN_DOWN, ChangeKind.NARROWER) else "+"
            return f"{sign}{number(change)} spreads"
        return f"{number(value)} {self.unit}".rstrip()

    @property
    def pass_text(self) -> str:
        """The largest change for which PASS holds, in words; empty if it is not shown for any."""
        return "" if math.isnan(self.lower) else self._describe(self.passes_at, self.lower)

    @property
    def fail_text(self) -> str:
        """The estimated change to FAIL in words, with that for which PASS holds.

        Empty if no change shows FAIL: the estimate can then be due to chance.
        """
        if self.outcome is not ChangeOutcome.FOUND or math.isnan(self.upper):
            return ""
        passes = "not shown" if math.isnan(self.lower) else f"up to {self.format_value(self.passes_at, self.lower)}"
        return self._describe(self.fails_at, self.change, f"PASS {passes}")

    def _describe(self, value: float, change: float, addition: str = "") -> str:
        if self.kind is ChangeKind.DIVERGENCE:
            return f"any change of {self.name} up to a divergence of {number(value)} nat"
        assumed = "" if math.isnan(self.assumed) else f"{self.format_value(self.assumed, 0.0)} assumed"
        notes = "; ".join(filter(None, (assumed, addition)))
        return f"{self.name} {self.format_value(value, change)}{f' ({notes})' if notes else ''}"


def sort_key(item: Robustness) -> tuple[int, float]:
    """Sort other values of a parameter first, then changes that show FAIL, both by the change to FAIL.

    The others follow, by the change for which PASS holds; without one, by the estimated change to FAIL.
    """
    if item.kind is ChangeKind.VALUE:
        return 0, item.change
    if item.fail_text:
        return 1, item.change
    known_sizes = (size for size in (item.lower, item.change) if not math.isnan(size))
    return 2, next(known_sizes, math.inf)
