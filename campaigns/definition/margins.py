"""Margins of requirements: signed numbers that are below 0 if and only if a case violates its requirement.

- A metric with a bound has the margin bound - |scale * metric|, in the unit of the bound.
- A boolean metric has the margin of the requirement's `margin` column. Without such a column its margin is 1 if the
  metric is true, and -1 if it is false or missing.
- A case outside the population cannot violate the requirement: its margin is infinite. For the population `valid`,
  these are the finished cases without a valid answer.
- An unfinished case, and a case without the flag of its population or the value of a bounded metric, violate the
  requirement: their margin is minus infinity.
"""

import math
from collections.abc import Mapping
from typing import Any

from marsyard.campaigns.definition.campaign_file import Requirement
from marsyard.campaigns.outcomes import ENGINE_FAILURES

#: Margin of a case whose boolean metric is false, although its margin column is not negative: the nearest violation.
MAX_VIOLATION_MARGIN = -1e-12


def compute_margin(row: Mapping[str, Any], requirement: Requirement) -> float:
    """Compute the margin of a stored row."""
    if row["outcome"] in ENGINE_FAILURES:
        return -math.inf
    memberships = {"all": True, "completed": True, "valid": row["answered"]}
    populations = requirement.population.split(" and ")
    flags = [memberships[name] if name in memberships else row.get(name) for name in populations]
    if any(value is False for value in flags):
        return math.inf
    if None in flags:
        return -math.inf
    values: list[Any] = [row.get(name) for name in requirement.metric_columns]
    if requirement.bound is None:
        is_met = values == [True]
        margin = None if requirement.margin is None else row.get(requirement.margin)
        if not isinstance(margin, int | float) or math.isnan(margin):
            return 1.0 if is_met else -1.0
        return max(margin, 0.0) if is_met else min(margin, MAX_VIOLATION_MARGIN)
    if not all(isinstance(value, int | float) for value in values):
        return -math.inf
    margin = requirement.bound - abs(requirement.scale * sum(values))
    return -math.inf if math.isnan(margin) else margin


def describe_margin(requirement: Requirement) -> str:
    """Describe the margin of a requirement, and which cases without a value are violations, in two sentences."""
    if requirement.bound is not None:
        factor = "" if requirement.scale == 1.0 else f"{requirement.scale:g} * "
        text = f"The margin is {requirement.bound:g} - |{factor}{requirement.metric}|"
    elif requirement.margin is not None:
        text = f"The margin is {requirement.margin}"
    else:
        text = f"The margin is 1 if {requirement.metric} is true and -1 otherwise, so only its sign has a meaning"
    outside = "" if requirement.population == "all" else f"A case outside '{requirement.population}' is no violation; "
    return f"{text}. {outside}{'a' if outside else 'A'}n unfinished case or a missing value is a violation."
