"""Counting bound: exact bounds of the probability of a violation from independently drawn cases.

The bounds are those of Clopper and Pearson (1934). They assume nothing about the margin, so that they also hold for
violations without intermediate margins.
"""

import bisect
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool
from scipy.stats import beta

from marsyard.campaigns.definition.campaign_file import MAX_CASES

#: Maximum number of units: that of the cases of a campaign.
MAX_UNITS = MAX_CASES


@dataclass(frozen=True)
class CountingBound:
    """Bounds of the probability of a violation per case, from independently drawn cases.

    Cases on one terrain are correlated, so that only terrains are independent. The units are terrains if a terrain has
    several cases; otherwise each case is a unit.

    - cases, violations: number of cases, and of violations
    - units, violating_units, first_violations: number of units, of units with a violation, and of units whose first
      case is a violation
    - lower, upper: bounds; lower_confidence, upper_confidence: their one-sided confidence

    The first cases of all units are independent. The upper bound uses `violating_units` instead of `first_violations`:
    it is at least as large, and no violation is ignored. The lower bound uses `first_violations`. A case with an
    unknown terrain (it crashed, for example) is a unit, but not a first violation if other terrains are known.
    """

    cases: int
    violations: int
    units: int
    violating_units: int
    first_violations: int
    lower: float
    upper: float
    lower_confidence: float
    upper_confidence: float


def count_violations(
    is_violation: Bool[np.ndarray, " n"], terrains: Sequence[str | None], lower_risk: float, upper_risk: float
) -> CountingBound:
    """Compute the counting bound; each bound is wrong with a probability of at most its risk.

    terrains: terrain of each case, in the order in which the cases were drawn; None if it is unknown
    """
    names = {name: number for number, name in enumerate(dict.fromkeys(name for name in terrains if name is not None))}
    numbers = np.array([-1 if name is None else names[name] for name in terrains], dtype=np.int64)
    is_unknown = numbers < 0
    numbers[is_unknown] = len(names) + np.arange(int(is_unknown.sum()))
    _, first_cases, unit_of_case = np.unique(numbers, return_index=True, return_inverse=True)
    can_be_first = ~is_unknown if names else is_unknown
    units, first_violations = len(first_cases), int(np.sum((is_violation & can_be_first)[first_cases]))
    violating_units = len(np.unique(unit_of_case[is_violation]))
    lower = float(beta.ppf(lower_risk, first_violations, units - first_violations + 1)) if first_violations else 0.0
    return CountingBound(
        cases=len(is_violation),
        violations=int(is_violation.sum()),
        units=units,
        violating_units=violating_units,
        first_violations=first_violations,
        lower=lower,
        upper=_upper_bound(violating_units, units, upper_risk),
        lower_confidence=1.0 - lower_risk,
        upper_confidence=1.0 - upper_risk,
    )


def find_units_needed(violating_units: int, max_probability: float, upper_risk: float) -> int:
    """Find the number of units whose upper bound is at most the limit, for a number of units with a violation.

    `MAX_UNITS` if fewer are not sufficient.
    """
    return bisect.bisect_left(
        range(MAX_UNITS), True, key=lambda units: _upper_bound(violating_units, units, upper_risk) <= max_probability
    )


def _upper_bound(violating_units: int, units: int, risk: float) -> float:
    """Compute the upper Clopper-Pearson bound; 1 if all units violate, or without any."""
    if violating_units >= units:
        return 1.0
    return float(beta.isf(risk, violating_units + 1, units - violating_units))
