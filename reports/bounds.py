"""One-sided bounds of a success rate, for a campaign that is judged once or several times.

Independent cases count one by one; cases on shared terrains by `marsyard.reports.statistics.clusters`. Where cases were
appended, the bounds keep the risk of all looks together (`marsyard.reports.statistics.sequential.LaterLook`). A
campaign that stops itself spends a planned fraction of the risk at each look.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Int

from marsyard.reports.statistics.clusters import ClusteredEvidence, ClusterMethod, clustered_evidence
from marsyard.reports.statistics.proportions import further_cases_needed, proportion_lower, proportion_upper
from marsyard.reports.statistics.sequential import LaterLook, confidence_at

Success = Bool[np.ndarray, " n"]
Groups = Int[np.ndarray, " n"]


@dataclass(frozen=True)
class Looks:
    """Earlier and planned looks at a campaign.

    before: cases of an earlier first look; None at a first look
    share: fraction of the risk that this look may spend; 1 where no looks were planned
    """

    before: Success | None = None
    share: float = 1.0


@dataclass(frozen=True)
class Bounds:
    """One-sided bounds of a success rate.

    lower, upper: the bounds that decide, each at its own confidence
    plain_lower, plain_upper: bounds for independent cases
    clustered: evidence of shared terrains; None where no terrain is shared
    further_cases: cases, or whole terrains where these are counted, that pass the requirement if none fails
    """

    lower: float
    upper: float
    lower_confidence: float
    upper_confidence: float
    plain_lower: float
    plain_upper: float
    clustered: ClusteredEvidence | None
    further_cases: int


def compute_bounds(
    success: Success, groups: Groups | None, probability: float, confidence: float, looks: Looks
) -> Bounds:
    """Bounds of the success rate of at least one case; `groups` numbers the terrains from 0, None if unknown."""
    n, failures = success.size, int((~success).sum())
    first = n if looks.before is None else int(looks.before.sum())
    levels = _confidences(first, n, probability, confidence, looks)
    plain = proportion_lower(n - failures, n, levels[0]), proportion_upper(n - failures, n, levels[1])
    if groups is None or int(groups.max()) + 1 == n:
        needed = _cases_needed(first, n, failures, probability, confidence, looks)
        return Bounds(*plain, *levels, *plain, None, needed - n)
    shared = clustered_evidence(success, groups, confidence)
    first = _effective_first_look(success, groups, confidence, looks)
    levels = _confidences(first, shared.effective_n, probability, confidence, looks)
    lower, upper = (clustered_evidence(success, groups, level) for level in levels)
    shared = replace(lower, upper=upper.upper)
    if shared.method is ClusterMethod.TERRAIN_COUNT:
        # the tolerance keeps whole numbers whole
        size, weight, failed = shared.terrains, 1.0, math.ceil(shared.terrains - shared.effective_successes - 1e-9)
    else:
        weight = shared.effective_n / n
        size, failed = math.floor(shared.effective_n), math.ceil(failures * weight)
    needed = _cases_needed(first, size, failed, probability, confidence, looks)
    return Bounds(shared.lower, shared.upper, *levels, *plain, shared, math.ceil((needed - size) / weight))


def _effective_first_look(success: Success, groups: Groups, confidence: float, looks: Looks) -> int:
    """Independent cases that the first look was worth."""
    before = np.ones(success.size, dtype=np.bool_) if looks.before is None else looks.before
    if np.unique(groups[before]).size == before.sum():
        return int(before.sum())
    return math.floor(clustered_evidence(success[before], groups[before], confidence).effective_n)


def _confidences(
    first: int, n: float | int, probability: float, confidence: float, looks: Looks
) -> tuple[float, float]:
    """Confidences of the lower and of the upper bound."""
    if looks.before is None:
        level = confidence_at(confidence, looks.share)
        return level, level
    passing, failing = (LaterLook(p, 1.0 - confidence, first) for p in (1.0 - probability, probability))
    return 1.0 - passing.risk_of_bound(n), 1.0 - failing.risk_of_bound(n)


def _cases_needed(first: int, n: int, failures: int, probability: float, confidence: float, looks: Looks) -> int:
    """Total of cases that pass the requirement if no more fail."""
    if looks.share < 1.0:
        return n + further_cases_needed(n, failures, probability, confidence_at(confidence, looks.share))
    return LaterLook(1.0 - probability, 1.0 - confidence, first).cases_needed(n, failures)
