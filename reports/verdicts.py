"""Verdicts on requirements: status, confidence and further evidence needed, from stored rows.

A requirement asks that `|metric| <= bound`, or a true column, holds for a fraction of a population at a confidence. Its
status follows from one-sided Clopper-Pearson bounds of the success rate. MET BY RATE: decided by the estimate, whose
rate reaches the fraction, but not at the confidence. Cases on shared terrains get bounds that allow for correlation
(`marsyard.reports.statistics.proportions`). Looks at appended cases keep their joint risk (`LaterLook` there); each
planned look spends a fraction of the risk. Cases that are no independent random draws (Latin hypercube, Sobol, grids)
have neither bounds nor confidence: their rate decides only requirements that are decided by the estimate.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Int

from marsyard.reports import rates
from marsyard.reports.sampling_design import INDEPENDENT, SamplingDesign
from marsyard.reports.statistics import proportions
from marsyard.reports.statistics.proportions import (
    ClusteredEvidence,
    ClusterMethod,
    LaterLook,
    clustered_evidence,
    confidence_at,
)
from marsyard.reports.wording import count, format_fraction, percent

#: Value of a requirement's `decide_by` that has the rate seen compared with the probability.
ESTIMATE = "estimate"


class Status(StrEnum):
    """What the evidence says of a requirement."""

    PASS = "PASS"  # noqa: S105  (a verdict, not a password)
    MET_BY_RATE = "MET BY RATE"
    FAIL = "FAIL"
    INSUFFICIENT = "INSUFFICIENT"


@dataclass(frozen=True)
class Verdict:
    """One requirement with its verdict; NaN for a number that the requirement lacks.

    status: PASS if the lower bound reaches the probability, FAIL if the upper bound is below it, else INSUFFICIENT.
        Where the estimate decides and the bounds do not pass: FAIL if the rate is below the probability, else MET BY
        RATE, but INSUFFICIENT for fewer cases than `min_cases_for_rate`
    failures: cases whose metric is missing, NaN or out of bound, unfinished cases, and those of unknown membership
    estimate, lower, upper: success rate and its one-sided bounds; NaN for an empty population, bounds also for designs
    further_cases: cases that pass the requirement if none fails, on new terrains where terrains are counted; or None
    reason: why the requirement is not evaluated, or the verdict is withheld
    advice: why more cases cannot help, and the change that does
    accept_rate: whether MET BY RATE gives the exit status 0
    terrains: distinct terrains of the population; None if unknown
    clustered: evidence of shared terrains; None where no terrain is shared
    plain_lower, plain_upper: bounds for independent cases
    bounds_confidence, upper_confidence: of the two bounds; above the requirement's for repeated evaluations
    """

    requirement_id: str
    statement: str
    metric: str
    bound: float
    probability: float
    confidence: float
    population: str
    status: Status = Status.INSUFFICIENT
    n: int = 0
    failures: int = 0
    estimate: float = math.nan
    lower: float = math.nan
    upper: float = math.nan
    further_cases: int | None = None
    decide_by: str = "confidence"
    reason: str = ""
    terrains: int | None = None
    clustered: ClusteredEvidence | None = None
    plain_lower: float = math.nan
    plain_upper: float = math.nan
    bounds_confidence: float = math.nan
    upper_confidence: float = math.nan
    advice: str = ""
    accept_rate: bool = False
    source: str = ""
    kind: str = ""
    scale: float = 1.0

    @property
    def plain_status(self) -> Status | None:
        """The status for independent cases; None where no terrain is shared or the estimate decides."""
        if self.clustered is None or self.decide_by == ESTIMATE:
            return None
        return compare_bounds(self.plain_lower, self.plain_upper, self.probability)

    @property
    def confident_status(self) -> Status:
        """The status by the bounds alone; INSUFFICIENT without bounds."""
        return compare_bounds(self.lower, self.upper, self.probability)

    @property
    def consumer_risk(self) -> float:
        """Probability of evidence at least as good if the rate is just the one asked; NaN without bounds."""
        if math.isnan(self.lower):
            return math.nan
        shared = self.clustered
        if shared is None:
            return proportions.consumer_risk(self.n - self.failures, self.n, self.probability)
        return proportions.consumer_risk(shared.effective_successes, shared.effective_n, self.probability)

    @property
    def design_effect(self) -> float:
        """The design effect of shared terrains; NaN where no terrain is shared."""
        return math.nan if self.clustered is None else self.clustered.design_effect

    @property
    def margin(self) -> float:
        """Deciding bound, or estimate, less the rate asked; NaN without bounds."""
        decisive = self.estimate if self.decide_by == ESTIMATE else self.lower
        return decisive - self.probability

    @property
    def note(self) -> str:
        """Limits of the verdict in words; may be empty."""
        if self.reason:
            return self.reason
        return " ".join(part for part in (self._basis(), self._sharing(), self._look(), self.advice) if part)

    def _basis(self) -> str:
        if self.decide_by != ESTIMATE or self.n == 0:
            return ""
        at = f"at {format_fraction(self.confidence)} confidence"
        if self.status is Status.PASS:
            return f"Decided by the rate; met {at} as well."
        if self.status is Status.INSUFFICIENT:
            return f"Decided by the rate, which takes {count(min_cases_for_rate(self.probability), 'case')} or more."
        return f"Decided by the rate; {at} it would be {self.confident_status}."

    def _sharing(self) -> str:
        shared = self.clustered
        if shared is None:
            return ""
        effect = f", design effect {shared.design_effect:.3g}"
        if math.isnan(shared.design_effect):
            worst = self.n / shared.effective_n
            effect = f", the design effect taken for {worst:.3g}: too few failures, or terrains, to estimate it"
        text = (
            f"{count(self.n, 'case')} share {count(self.terrains or 0, 'terrain')} and so are not independent; "
            f"the bounds allow for that ({shared.method}, effective n {shared.effective_n:.4g}{effect})."
        )
        if self.plain_status is not None and self.plain_status is not self.status:
            text += f" Independent cases would show at least {percent(self.plain_lower)}: {self.plain_status}."
        if shared.method is ClusterMethod.TERRAIN_COUNT and self.further_cases and self.decide_by != ESTIMATE:
            text += f" {count(self.further_cases, 'additional terrain')} without a failure would decide."
        return text

    def _look(self) -> str:
        if math.isnan(self.bounds_confidence) or self.bounds_confidence == self.upper_confidence == self.confidence:
            return ""
        lower, upper = (f"{100.0 * level:.4g} %" for level in (self.bounds_confidence, self.upper_confidence))
        joint_note = f"so that all looks together keep {format_fraction(self.confidence)}"
        if lower == upper:
            return f"The campaign is evaluated more than once: its bounds are at {lower} confidence, {joint_note}."
        return (
            f"The campaign is evaluated more than once: its lower bound is at {lower} confidence, its upper bound at "
            f"{upper}, {joint_note}."
        )


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


def add_bounds(verdict: Verdict, success: Success, groups: Groups | None, looks: Looks) -> tuple[Verdict, int]:
    """Bounds of the success rate of at least one case, and the cases that pass the requirement if none fails.

    groups: terrains numbered from 0; None if unknown. Where terrains are counted, the further cases are whole terrains.
    """
    n, failures, probability, confidence = success.size, verdict.failures, verdict.probability, verdict.confidence
    first = n if looks.before is None else int(looks.before.sum())
    levels = _confidences(first, n, probability, confidence, looks)
    lower = proportions.proportion_lower(n - failures, n, levels[0])
    upper = proportions.proportion_upper(n - failures, n, levels[1])
    verdict = replace(verdict, lower=lower, upper=upper, plain_lower=lower, plain_upper=upper)
    if groups is None or int(groups.max()) + 1 == n:
        needed = _cases_needed(first, n, failures, probability, confidence, looks)
        return replace(verdict, bounds_confidence=levels[0], upper_confidence=levels[1]), needed - n
    shared = clustered_evidence(success, groups, confidence)
    before = np.ones(n, dtype=np.bool_) if looks.before is None else looks.before
    if np.unique(groups[before]).size != first:  # independent cases that the first look was worth
        first = math.floor(clustered_evidence(success[before], groups[before], confidence).effective_n)
    levels = _confidences(first, shared.effective_n, probability, confidence, looks)
    by_level = [clustered_evidence(success, groups, level) for level in levels]
    shared = replace(by_level[0], upper=by_level[1].upper)
    if shared.method is ClusterMethod.TERRAIN_COUNT:
        # the tolerance keeps whole numbers whole
        size, weight, failed = shared.terrains, 1.0, math.ceil(shared.terrains - shared.effective_successes - 1e-9)
    else:
        weight = shared.effective_n / n
        size, failed = math.floor(shared.effective_n), math.ceil(failures * weight)
    needed = _cases_needed(first, size, failed, probability, confidence, looks)
    verdict = replace(verdict, lower=shared.lower, upper=shared.upper, clustered=shared)
    further = math.ceil((needed - size) / weight)
    return replace(verdict, bounds_confidence=levels[0], upper_confidence=levels[1]), further


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
    """Total of cases that pass the requirement without a further failure."""
    if looks.share < 1.0:
        return n + proportions.further_cases_needed(n, failures, probability, confidence_at(confidence, looks.share))
    return LaterLook(1.0 - probability, 1.0 - confidence, first).cases_needed(n, failures)


def evaluate_requirements(
    frame: pd.DataFrame, requirements: Sequence[Mapping[str, Any]], how: SamplingDesign = INDEPENDENT
) -> list[Verdict]:
    """Evaluate every requirement on all rows of a campaign; missing columns or numbers give INSUFFICIENT, no exception.

    how: the sampling design; without independent random draws, verdicts have no bounds
    """
    return [_evaluate(how.draw(frame), requirement, how) for requirement in requirements]


def _evaluate(frame: pd.DataFrame, requirement: Mapping[str, Any], how: SamplingDesign) -> Verdict:
    verdict = _empty_verdict(requirement)
    fault = _requirement_fault(frame, verdict)
    if fault:
        return replace(verdict, reason=fault)
    try:
        chosen = frame[rates.members(frame, verdict.population)]
        suspected = frame[rates.members_if_answered(frame, verdict.population)]
    except ValueError as error:
        text = str(error)
        return replace(verdict, reason=f"{text[:1].upper()}{text[1:]}.")
    if chosen.empty:
        needed = LaterLook(1.0 - verdict.probability, 1.0 - verdict.confidence, 0).cases_needed(0, 0)
        reason = f"No case belongs to the population '{verdict.population}'."
        return replace(verdict, reason=reason, further_cases=needed if how.independent else None)
    return _withhold(*(_decide(verdict, cases, how, frame) for cases in (chosen, suspected)))


def _withhold(verdict: Verdict, suspected: Verdict) -> Verdict:
    """Withhold a good verdict that unfinished cases, counted as failures, would change.

    `valid` and `completed` leave unfinished cases out, so that a crash instead of a wrong answer could earn a PASS.
    """
    if verdict.status in (Status.FAIL, Status.INSUFFICIENT, suspected.status):
        return verdict
    lost = suspected.n - verdict.n
    reason = (
        f"{count(lost, 'case')} did not come to an end and so {'belongs' if lost == 1 else 'belong'} to no population "
        f"of answers; counted as failures they change the verdict {verdict.status}, which is withheld."
    )
    return replace(verdict, status=Status.INSUFFICIENT, reason=reason)


def _decide(verdict: Verdict, chosen: pd.DataFrame, how: SamplingDesign, frame: pd.DataFrame) -> Verdict:
    """The verdict by the members of its population, at least one, among all cases."""
    _, unknown = rates.members_and_unknown(chosen, verdict.population.split(" and "))
    success = np.asarray(rates.success_mask(chosen, verdict.metric, verdict.bound, verdict.scale) & ~unknown)
    n, failures, groups = success.size, int((~success).sum()), rates.terrain_groups(chosen)
    rate, by_rate = (n - failures) / n, verdict.decide_by == ESTIMATE
    terrains = None if groups is None else int(chosen["terrain"].nunique())
    counted = replace(verdict, n=n, failures=failures, estimate=rate, terrains=terrains)
    if not how.independent:
        reason = f"Decided by the rate of these cases. {how.no_probability}" if by_rate else how.no_probability
        status = _status_by_rate(rate, n, verdict.probability) if by_rate else verdict.status
        return replace(counted, status=status, reason=reason)
    looks = Looks(how.mask_first_look(frame, chosen), how.risk_share(len(frame)))
    evaluated, further = add_bounds(counted, success, groups, looks)
    status = evaluated.confident_status
    by_rate = by_rate and status is not Status.PASS
    if by_rate:
        status = _status_by_rate(rate, n, verdict.probability)
    evaluated = replace(evaluated, status=status)
    if status is not Status.INSUFFICIENT:
        return evaluated
    if by_rate:
        return replace(evaluated, further_cases=min_cases_for_rate(verdict.probability) - n)
    # further cases, or the advice why these cannot help
    shared, supply = evaluated.clustered, how.terrains
    are_counted = shared is not None and shared.method is ClusterMethod.TERRAIN_COUNT
    if not are_counted or supply is None or (terrains or 0) + further <= supply.terrains:
        return replace(evaluated, further_cases=further)
    fewest = proportions.minimum_sample_size(verdict.probability, verdict.confidence)
    return replace(evaluated, advice=supply.advice(fewest, verdict.probability, verdict.confidence))


def _status_by_rate(rate: float, n: int, probability: float) -> Status:
    if rate < probability:
        return Status.FAIL
    return Status.MET_BY_RATE if n >= min_cases_for_rate(probability) else Status.INSUFFICIENT


def min_cases_for_rate(probability: float) -> int:
    """Minimum number of cases for MET BY RATE: 1 / (1 - probability), of which one may fail."""
    # the tolerance keeps 1 / (1 - 0.9), which is 10.000000000000002, at 10
    return math.ceil(1.0 / (1.0 - probability) - 1e-9)


def compare_bounds(lower: float, upper: float, probability: float) -> Status:
    """Compare bounds of a success rate with the rate asked."""
    if lower >= probability:
        return Status.PASS
    return Status.FAIL if upper < probability else Status.INSUFFICIENT


def _requirement_fault(frame: pd.DataFrame, verdict: Verdict) -> str:
    """Why a requirement cannot be evaluated; empty if it can."""
    for name in ("probability", "confidence"):
        value = getattr(verdict, name)
        if not 0.0 < value < 1.0:
            return f"The requirement's {name} is {value}; it must lie between 0 and 1, both excluded."
    missing = next((part for part in verdict.metric.split(" + ") if part not in frame), None)
    if missing is not None:
        return f"The rows have no column '{missing}', which is the requirement's metric."
    if not math.isfinite(verdict.bound) and not rates.is_flag(frame, verdict.metric):
        return "The requirement states no bound, and its metric is no column of true and false."
    return ""


def _empty_verdict(requirement: Mapping[str, Any]) -> Verdict:
    """The requirement without evidence; a decision by rate is added to its statement."""
    decide_by, statement = str(requirement.get("decide_by", "confidence")), str(requirement.get("statement", ""))
    if decide_by == ESTIMATE:
        statement = f"{statement.rstrip('.')} (decided by rate).".lstrip()
    return Verdict(
        requirement_id=str(requirement.get("id", "?")),
        statement=statement,
        metric=str(requirement.get("metric", "?")),
        bound=_number(requirement.get("bound")),
        probability=_number(requirement.get("probability")),
        confidence=_number(requirement.get("confidence")),
        population=str(requirement.get("population", "all")),
        decide_by=decide_by,
        source=str(requirement.get("source") or ""),
        kind=str(requirement.get("kind") or ""),
        scale=_number(requirement.get("scale", 1.0)),
        accept_rate=requirement.get("accept_rate") is True,
    )


def _number(value: object) -> float:
    try:
        return float(value)  # type: ignore[arg-type]  # anything a JSON file may hold
    except (TypeError, ValueError):
        return math.nan
