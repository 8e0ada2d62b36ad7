"""Bounds of a success rate that decide a requirement, at one look at a campaign or at several.

Cases are counted one by one where each has a terrain of its own, and by `marsyard.reports.statistics.clusters` where
terrains are shared. At a first look both bounds have the requirement's confidence. A campaign to which cases were
appended has been judged before: its bounds then have the confidences that keep the risk of all looks together
(`marsyard.reports.statistics.sequential.LaterLook`). One that stops itself spends a planned share of the risk at each
look.
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
    """When a campaign is judged.

    Attributes
    ----------
    before
        Which cases the first look had, shape (n,), where it was an earlier one; None at a first look.
    share
        Share of the risk that this look may spend, where the looks were planned; 1 otherwise.
    """

    before: Success | None = None
    share: float = 1.0


@dataclass(frozen=True)
class Bounds:
    """One-sided bounds of a success rate.

    Attributes
    ----------
    lower, upper
        The bounds that decide.
    lower_confidence, upper_confidence
        The confidence of each.
    plain_lower, plain_upper
        As they would be for independent cases.
    clustered
        What the cases show when terrains are shared between them; None where none is.
    further_cases
        Cases (whole terrains, where these are counted) that show the requirement met if no more fail.
    """

    lower: float
    upper: float
    lower_confidence: float
    upper_confidence: float
    plain_lower: float
    plain_upper: float
    clustered: ClusteredEvidence | None
    further_cases: int


def bounds_of(success: Success, groups: Groups | None, probability: float, confidence: float, looks: Looks) -> Bounds:
    """Bounds of the success rate of n cases, n at least 1.

    Parameters
    ----------
    success
        Whether each case succeeded.
    groups
        The terrain of each case, numbered from 0; None where it is not known.
    probability, confidence
        What the requirement asks.
    looks
        Which look this is.
    """
    n, failures = success.size, int((~success).sum())
    first = n if looks.before is None else int(looks.before.sum())
    levels = _confidences(first, n, probability, confidence, looks)
    plain = proportion_lower(n - failures, n, levels[0]), proportion_upper(n - failures, n, levels[1])
    if groups is None or int(groups.max()) + 1 == n:
        needed = _needed(first, n, failures, probability, confidence, looks)
        return Bounds(*plain, *levels, *plain, None, needed - n)
    shared = clustered_evidence(success, groups, confidence)
    first = _effective_size(success, groups, confidence, looks)
    levels = _confidences(first, shared.effective_n, probability, confidence, looks)
    lower, upper = (clustered_evidence(success, groups, level) for level in levels)
    shared = replace(lower, upper=upper.upper)
    if shared.method is ClusterMethod.TERRAIN_COUNT:
        size, worth = shared.terrains, 1.0
        # the tolerance keeps whole numbers whole
        failed = math.ceil(size - shared.effective_successes - 1e-9)
    else:
        worth = shared.effective_n / n
        size, failed = math.floor(shared.effective_n), math.ceil(failures * worth)
    needed = _needed(first, size, failed, probability, confidence, looks)
    return Bounds(shared.lower, shared.upper, *levels, *plain, shared, math.ceil((needed - size) / worth))


def _effective_size(success: Success, groups: Groups, confidence: float, looks: Looks) -> int:
    """Independent cases that the first look was worth."""
    before = np.ones(success.size, dtype=np.bool_) if looks.before is None else looks.before
    if not before.any():
        return 0
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
    passing = LaterLook(1.0 - probability, 1.0 - confidence, first).risk_of_bound(n)
    failing = LaterLook(probability, 1.0 - confidence, first).risk_of_bound(n)
    return 1.0 - passing, 1.0 - failing


def _needed(first: int, n: int, failures: int, probability: float, confidence: float, looks: Looks) -> int:
    """Cases in all that show the requirement met if no more fail."""
    if looks.share < 1.0:
        return n + further_cases_needed(n, failures, probability, confidence_at(confidence, looks.share))
    return LaterLook(1.0 - probability, 1.0 - confidence, first).cases_needed(n, failures)
