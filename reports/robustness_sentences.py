"""Robustness of a verdict in words."""

from __future__ import annotations

import math
from collections.abc import Sequence

from marsyard.reports.dispersion_changes import ChangeKind
from marsyard.reports.robustness import Robustness, sort_key
from marsyard.reports.verdicts import ESTIMATE, Verdict
from marsyard.reports.wording import format_fraction, number, percent

#: Statements hold for each change, but not for several at once.
_ONE = "one change at a time"
#: Maximum number of listed changes to FAIL.
_MAX_CHANGES = 3


def reach_text(verdict: Verdict, records: Sequence[Robustness]) -> str:
    """Describe the smallest change of one distribution up to which a verdict is met; empty if it is not, or unknown."""
    changes = [
        item
        for item in records
        if item.requirement == verdict.requirement_id and item.kind not in (ChangeKind.DIVERGENCE, ChangeKind.VALUE)
    ]
    # unknown changes (NaN) of an evaluation by rate are larger than those of others
    known = [item for item in changes if item.lower > 0.0]
    if not known or not verdict.status.is_met:
        return ""
    nearest = min(known, key=lambda item: item.lower)
    return f"holds up to {number(nearest.lower)} spreads ({nearest.name}, {nearest.kind})"


def robustness_text(verdict: Verdict, records: Sequence[Robustness]) -> str:
    """Describe how far the PASS of a requirement reaches, and the nearest changes to FAIL; empty without records."""
    own = [item for item in records if item.requirement == verdict.requirement_id]
    if not own:
        return ""
    shifts = [
        item.lower for item in own if item.kind in (ChangeKind.MEAN_UP, ChangeKind.MEAN_DOWN) and item.lower > 0.0
    ]
    factors = [item.lower for item in own if item.kind is ChangeKind.WIDER and item.lower > 0.0]
    ball = next(item for item in own if item.kind is ChangeKind.DIVERGENCE)
    ranges = [f"for a shift of any mean by {number(min(shifts))} standard deviations"] if shifts else []
    ranges += [f"for any standard deviation up to + {percent(min(factors))}"] if factors else []
    if ball.lower > 0.0:
        ranges.append(f"for any change of all dispersions up to a divergence of {number(ball.passes_at)} nat")
    nearest: dict[str, Robustness] = {}
    for item in sorted(own, key=sort_key):
        if item.fail_text and item is not ball:
            nearest.setdefault(item.parameter, item)
    changes = "; ".join(item.fail_text for item in [*nearest.values()][:_MAX_CHANGES])
    by_rate = verdict.decide_by == ESTIMATE
    # a calibration excludes PASS
    word = "PASS holds" if verdict.status.is_met else "PASS would hold for another kind of evidence"
    confidence = f"{format_fraction(verdict.confidence)} confidence"
    word = f"Met by the rate (no confidence, {_ONE})" if by_rate else f"{word} ({confidence}, {_ONE})"
    none = "These cases do not show PASS."
    if verdict.status.is_met:
        none = f"The cases are too few to state how far PASS reaches (effective number: {ball.effective_cases:.0f})."
    reach = f"{word} {', '.join(ranges)}." if ranges else none
    examined = sum(item.kind not in (ChangeKind.DIVERGENCE, ChangeKind.VALUE) for item in own)
    by_chance = math.floor(examined * (1.0 - verdict.confidence) + 1e-9)
    chance = (
        f" (of {examined} examined, of which at most {by_chance} appear by chance on average)"
        if by_chance and changes
        else ""
    )
    return f"{reach} Nearest changes to FAIL{chance}: {changes or 'unknown, because too few cases fail'}."
