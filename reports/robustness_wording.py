"""Robust verdicts in sentences, for the terminal, the verdict tables of reports, and the dashboard."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from marsyard.campaigns.studies.results import ROBUST
from marsyard.reports.dispersion_changes import ChangeKind
from marsyard.reports.robustness import Robustness, sort_key
from marsyard.reports.verdicts import ESTIMATE, Verdict
from marsyard.reports.wording import count, format_fraction, number, percent

#: Maximum number of listed changes to FAIL.
_MAX_CHANGES = 3
#: Statements hold for each change, but not for several at once.
_ONE_CHANGE = "one change at a time"
#: Kinds of changes that are not changes of the distribution of one parameter.
_NOT_OF_ONE_DISTRIBUTION = (ChangeKind.DIVERGENCE, ChangeKind.VALUE)


def robust_sentences(record: Mapping[str, Any]) -> list[str]:
    """Describe a study `robust` in a record; empty for another run."""
    study = ROBUST.read(record)
    if study is None:
        return []
    parameters, result = study
    variants = count(len(parameters.variants), "variant")
    return [f"{count(result.cases, 'case')} in {variants}. The report of the run evaluates them."]


def reach_text(verdict: Verdict, records: Sequence[Robustness]) -> str:
    """Describe the smallest change of one distribution up to which a verdict is met; empty if it is not, or unknown."""
    changes = _select_changes(_select_requirement(verdict, records))
    # unknown changes (NaN) of an evaluation by rate are larger than those of others
    known = [item for item in changes if item.lower > 0.0]
    if not known or not verdict.status.is_met:
        return ""
    nearest = min(known, key=lambda item: item.lower)
    return f"holds up to {number(nearest.lower)} spreads ({nearest.name}, {nearest.kind})"


def robustness_text(verdict: Verdict, records: Sequence[Robustness]) -> str:
    """Describe how far the PASS of a requirement reaches, and the nearest changes to FAIL; empty without records."""
    own = _select_requirement(verdict, records)
    if not own:
        return ""
    nearest = _list_nearest_changes(own)
    by_chance = _describe_chance(verdict, own) if nearest else ""
    changes = "; ".join(nearest) or "unknown, because too few cases fail"
    return f"{_describe_reach(verdict, own)} Nearest changes to FAIL{by_chance}: {changes}."


def _select_requirement(verdict: Verdict, records: Sequence[Robustness]) -> list[Robustness]:
    return [item for item in records if item.requirement == verdict.requirement_id]


def _select_changes(records: Sequence[Robustness]) -> list[Robustness]:
    """Select the changes of the distribution of one parameter."""
    return [item for item in records if item.kind not in _NOT_OF_ONE_DISTRIBUTION]


def _describe_reach(verdict: Verdict, own: Sequence[Robustness]) -> str:
    """Describe for which changes PASS holds, or why this is unknown."""
    divergence = next(item for item in own if item.kind is ChangeKind.DIVERGENCE)
    if ranges := ", ".join(_list_ranges(own, divergence)):
        return f"{_introduce_ranges(verdict)} {ranges}."
    if not verdict.status.is_met:
        return "These cases do not show PASS."
    effective = f"{divergence.effective_cases:.0f}"
    return f"The cases are too few to state how far PASS reaches (effective number: {effective})."


def _introduce_ranges(verdict: Verdict) -> str:
    """Begin the sentence with the ranges of changes: which verdict holds in them, and with which confidence."""
    if verdict.decide_by == ESTIMATE:
        return f"Met by the rate (no confidence, {_ONE_CHANGE})"
    # a calibration excludes PASS
    holds = "PASS holds" if verdict.status.is_met else "PASS would hold for another kind of evidence"
    return f"{holds} ({format_fraction(verdict.confidence)} confidence, {_ONE_CHANGE})"


def _list_ranges(own: Sequence[Robustness], divergence: Robustness) -> list[str]:
    """List the ranges for which PASS holds: of any mean, of any standard deviation, and of all dispersions."""
    means = (ChangeKind.MEAN_UP, ChangeKind.MEAN_DOWN)
    shifts = [item.lower for item in own if item.kind in means and item.lower > 0.0]
    factors = [item.lower for item in own if item.kind is ChangeKind.WIDER and item.lower > 0.0]
    ranges = []
    if shifts:
        ranges.append(f"for a shift of any mean by {number(min(shifts))} standard deviations")
    if factors:
        ranges.append(f"for any standard deviation up to + {percent(min(factors))}")
    if divergence.lower > 0.0:
        ranges.append(f"for any change of all dispersions up to a divergence of {number(divergence.passes_at)} nat")
    return ranges


def _list_nearest_changes(own: Sequence[Robustness]) -> list[str]:
    """Describe the nearest change to FAIL of each of the first parameters, at most `_MAX_CHANGES`."""
    nearest: dict[str, Robustness] = {}
    for item in sorted(own, key=sort_key):
        if item.fail_text and item.kind is not ChangeKind.DIVERGENCE:
            nearest.setdefault(item.parameter, item)
    return [item.fail_text for item in [*nearest.values()][:_MAX_CHANGES]]


def _describe_chance(verdict: Verdict, own: Sequence[Robustness]) -> str:
    """Describe how many changes to FAIL appear by chance among the examined ones; empty for less than one."""
    examined = len(_select_changes(own))
    # the tolerance is for rounding errors, such as 10 * (1 - 0.9) = 0.9999999999999998
    by_chance = math.floor(examined * (1.0 - verdict.confidence) + 1e-9)
    return f" (of {examined} examined, of which at most {by_chance} appear by chance on average)" if by_chance else ""
