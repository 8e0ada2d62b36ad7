"""Verdicts on requirements: what stored rows show, at what confidence, and how much more evidence it takes.

A requirement asks that `metric <= bound` (in magnitude), or a column of true and false, holds for a stated fraction of
a population of cases, at a stated confidence. Its status follows from one-sided Clopper-Pearson bounds of the success
rate. A requirement that is decided by the estimate and whose rate reaches the fraction, but not at the confidence, is
MET BY RATE. Where cases share terrains they are not independent: the bounds then are those that hold nevertheless
(`marsyard.reports.statistics.clusters`), and the verdict says what independent cases would have shown. Where a campaign
is judged more than once (cases were appended, or it stops itself when it is decided) the bounds keep the risk of all
looks together (`marsyard.reports.bounds`). Where cases are no random draws at all (Latin hypercube, Sobol, grids) there
are no bounds and no confidence: only a requirement that is decided by the estimate is then decided, by the rate of
these very cases, and the verdict says so.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool

from marsyard.reports.bounds import Looks, bounds_of
from marsyard.reports.populations import (
    is_flag,
    members,
    members_and_unknown,
    members_if_answered,
    succeeded,
    terrain_groups,
)
from marsyard.reports.sampled import INDEPENDENT, Sampled
from marsyard.reports.statistics.clusters import ClusteredEvidence, ClusterMethod
from marsyard.reports.statistics.proportions import consumer_risk, minimum_sample_size
from marsyard.reports.statistics.sequential import LaterLook
from marsyard.reports.wording import count, percent, stated

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
    """One requirement judged.

    Attributes
    ----------
    requirement_id, statement, metric, bound, probability, confidence, population, decide_by, source, kind, scale
        The requirement, as the campaign states it; NaN for a number that is missing or is none. Without a bound the
        metric is a column of true and false.
    status
        PASS where the lower bound reaches the probability, FAIL where the upper bound is below it, else INSUFFICIENT.
        Where the estimate decides and the bounds do not give PASS: FAIL if the rate is below the probability, MET BY
        RATE if it is not, INSUFFICIENT instead if the cases are fewer than `fewest_cases_for_rate`.
    n, failures
        Cases of the population, and those that did not succeed: a metric that is missing or NaN is a failure, and so is
        a case that the engine could not finish, or whose membership is unknown.
    estimate, lower, upper
        Success rate and the one-sided bounds that decide, each at `bounds_confidence`; NaN for an empty population,
        bounds also where the cases are not independent random draws.
    further_cases
        Cases still needed if no more fail, each on a terrain of its own where whole terrains are counted; None for PASS
        and FAIL, and where it cannot be said.
    reason
        Why nothing could be judged, or why the verdict is withheld; empty otherwise.
    advice
        What keeps more cases from helping, and the change that helps; empty where there is nothing to say.
    accept_rate
        Whether MET BY RATE is enough for the exit status 0.
    terrains
        Distinct terrains behind the population; None where the rows do not say.
    clustered
        What the cases show when terrains are shared between them; None where none is.
    plain_lower, plain_upper
        The bounds as they would be for independent cases; NaN where there are none.
    bounds_confidence, upper_confidence
        The confidences of the lower and of the upper bound: the requirement's, or higher where the campaign is judged
        more than once.
    """

    requirement_id: str
    statement: str
    metric: str
    bound: float
    probability: float
    confidence: float
    population: str
    status: Status
    n: int
    failures: int
    estimate: float
    lower: float
    upper: float
    further_cases: int | None
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
        """The status as it would be for independent cases; None where no terrain is shared or the estimate decides."""
        if self.clustered is None or self.decide_by == ESTIMATE:
            return None
        return status_of(self.plain_lower, self.plain_upper, self.probability)

    @property
    def confident_status(self) -> Status:
        """The status by the bounds, also where the estimate decides; INSUFFICIENT where there are none."""
        return status_of(self.lower, self.upper, self.probability)

    @property
    def consumer_risk(self) -> float:
        """The chance of evidence as good from a rate only just the one asked; NaN where there are no bounds."""
        if math.isnan(self.lower):
            return math.nan
        shared = self.clustered
        if shared is None:
            return consumer_risk(self.n - self.failures, self.n, self.probability)
        return consumer_risk(shared.effective_successes, shared.effective_n, self.probability)

    @property
    def margin(self) -> float:
        """By how much the bound that decides is on the right side: of the rate asked; NaN where there are no bounds."""
        decisive = self.estimate if self.decide_by == ESTIMATE else self.lower
        return decisive - self.probability

    @property
    def note(self) -> str:
        """What a reader must know before trusting the verdict; empty where there is nothing to say."""
        if self.reason:
            return self.reason
        return " ".join(part for part in (self._basis(), self._sharing(), self._look(), self.advice) if part)

    def _basis(self) -> str:
        if self.decide_by != ESTIMATE or self.n == 0:
            return ""
        at = f"at {stated(self.confidence)} confidence"
        if self.status is Status.PASS:
            return f"Decided by the rate; met {at} as well."
        if self.status is Status.INSUFFICIENT:
            return f"Decided by the rate, which takes {count(fewest_cases_for_rate(self.probability), 'case')} or more."
        return f"Decided by the rate; {at} it would be {self.confident_status}."

    def _sharing(self) -> str:
        shared = self.clustered
        if shared is None:
            return ""
        effect = f", design effect {shared.design_effect:.3g}"
        if math.isnan(shared.design_effect):
            worst = self.n / shared.effective_n
            effect = f", the design effect taken for {worst:.3g}: too few failures, or terrains, to estimate it"
        said = (
            f"{count(self.n, 'case')} share {count(self.terrains or 0, 'terrain')} and so are not independent; "
            f"the bounds allow for that ({shared.method}, effective n {shared.effective_n:.4g}{effect})."
        )
        if self.plain_status is not None and self.plain_status is not self.status:
            said += f" Independent cases would show at least {percent(self.plain_lower)}: {self.plain_status}."
        if shared.method is ClusterMethod.TERRAIN_COUNT and self.further_cases and self.decide_by != ESTIMATE:
            said += f" {count(self.further_cases, 'further terrain')} would do if no case fails on them."
        return said

    def _look(self) -> str:
        if math.isnan(self.bounds_confidence) or self.bounds_confidence == self.upper_confidence == self.confidence:
            return ""
        lower, upper = (f"{100.0 * level:.4g} %" for level in (self.bounds_confidence, self.upper_confidence))
        kept = f"so that all looks together keep {stated(self.confidence)}"
        if lower == upper:
            return f"The campaign is judged more than once: its bounds are at {lower} confidence, {kept}."
        return (
            f"The campaign is judged more than once: its lower bound is at {lower} confidence and its upper bound at "
            f"{upper}, {kept}."
        )


def judge_campaign(
    frame: pd.DataFrame, requirements: Sequence[Mapping[str, Any]], how: Sampled = INDEPENDENT
) -> list[Verdict]:
    """Judges every requirement on the stored rows of a campaign; never raises for what rows or requirements lack.

    Parameters
    ----------
    frame
        All rows; that of a nominal case is left out here.
    requirements
        As the campaign states them.
    how
        How the cases were drawn. Where they are not independent random draws rates are told without bounds, and
        requirements that ask for a confidence stay INSUFFICIENT; those decided by the estimate are decided by the rate.
    """
    return [_judge(how.drawn(frame), requirement, how) for requirement in requirements]


def _judge(frame: pd.DataFrame, requirement: Mapping[str, Any], how: Sampled) -> Verdict:
    open_verdict = _unjudged(requirement)
    fault = _fault(frame, open_verdict)
    if fault:
        return replace(open_verdict, reason=fault)
    try:
        chosen = frame[members(frame, open_verdict.population)]
        suspected = frame[members_if_answered(frame, open_verdict.population)]
    except ValueError as error:
        return replace(open_verdict, reason=_sentence(str(error)))
    if chosen.empty:
        needed = LaterLook(1.0 - open_verdict.probability, 1.0 - open_verdict.confidence, 0).cases_needed(0, 0)
        reason = f"No case belongs to the population '{open_verdict.population}'."
        return replace(open_verdict, reason=reason, further_cases=needed if how.independent else None)
    return _withhold(*(_decide(open_verdict, cases, how, frame) for cases in (chosen, suspected)))


def _withhold(verdict: Verdict, suspected: Verdict) -> Verdict:
    """The verdict; withheld if it is good and unfinished cases, counted as failures, would change it.

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


def _decide(verdict: Verdict, chosen: pd.DataFrame, how: Sampled, frame: pd.DataFrame) -> Verdict:
    """The verdict by the members of its population, of which there is at least one, among all cases."""
    if not how.independent:
        return _described(verdict, chosen, how)
    return _weighed(verdict, chosen, Looks(how.seen_before(frame, chosen), how.risk_share(len(frame))), how)


def _successes(verdict: Verdict, chosen: pd.DataFrame) -> Bool[np.ndarray, " n"]:
    """Which members succeed: none of those whose membership is unknown."""
    _, unknown = members_and_unknown(chosen, verdict.population.split(" and "))
    return np.asarray(succeeded(chosen, verdict.metric, verdict.bound, verdict.scale) & ~unknown)


def _described(verdict: Verdict, chosen: pd.DataFrame, how: Sampled) -> Verdict:
    """The verdict by cases that carry no probability: the rate seen, which decides where the estimate is to."""
    success = _successes(verdict, chosen)
    groups = terrain_groups(chosen)
    rate = float(success.mean())
    decided = verdict.decide_by == ESTIMATE
    return replace(
        verdict,
        status=_status_by_rate(rate, success.size, verdict.probability) if decided else verdict.status,
        n=success.size,
        failures=int((~success).sum()),
        estimate=rate,
        terrains=None if groups is None else int(chosen["terrain"].nunique()),
        reason=f"Decided by the rate of these cases. {how.no_probability}" if decided else how.no_probability,
    )


def _weighed(verdict: Verdict, chosen: pd.DataFrame, looks: Looks, how: Sampled) -> Verdict:
    """The verdict by the cases of its population, of which there is at least one."""
    success = _successes(verdict, chosen)
    n, failures = success.size, int((~success).sum())
    groups = terrain_groups(chosen)
    bounds = bounds_of(success, groups, verdict.probability, verdict.confidence, looks)
    status = status_of(bounds.lower, bounds.upper, verdict.probability)
    by_rate = verdict.decide_by == ESTIMATE and status is not Status.PASS
    if by_rate:
        status = _status_by_rate((n - failures) / n, n, verdict.probability)
    judged = replace(
        verdict,
        status=status,
        n=n,
        failures=failures,
        estimate=(n - failures) / n,
        lower=bounds.lower,
        upper=bounds.upper,
        terrains=None if groups is None else int(chosen["terrain"].nunique()),
        clustered=bounds.clustered,
        plain_lower=bounds.plain_lower,
        plain_upper=bounds.plain_upper,
        bounds_confidence=bounds.lower_confidence,
        upper_confidence=bounds.upper_confidence,
    )
    if status is not Status.INSUFFICIENT:
        return judged
    if by_rate:
        return replace(judged, further_cases=fewest_cases_for_rate(verdict.probability) - n)
    return _with_advice(judged, bounds.further_cases, how)


def _with_advice(verdict: Verdict, further: int, how: Sampled) -> Verdict:
    """The verdict with the further cases that it needs, or with what keeps further cases from helping."""
    shared = verdict.clustered
    counted = shared is not None and shared.method is ClusterMethod.TERRAIN_COUNT
    supply = how.terrains
    if not counted or supply is None or (verdict.terrains or 0) + further <= supply.terrains:
        return replace(verdict, further_cases=further)
    fewest = minimum_sample_size(verdict.probability, verdict.confidence)
    return replace(verdict, advice=supply.advice(fewest, verdict.probability, verdict.confidence))


def _status_by_rate(rate: float, n: int, probability: float) -> Status:
    """What the rate of n cases says where it decides alone."""
    if rate < probability:
        return Status.FAIL
    return Status.MET_BY_RATE if n >= fewest_cases_for_rate(probability) else Status.INSUFFICIENT


def fewest_cases_for_rate(probability: float) -> int:
    """The fewest cases by whose rate alone a requirement can be met: those of which one may fail.

    Of fewer cases none may fail, and the rate of a requirement that is met and of one that is missed look alike: with
    n = 1 / (1 - probability) cases one failure is expected at the rate asked.
    """
    # the tolerance keeps 1 / (1 - 0.9), which is 10.000000000000002, at 10
    return math.ceil(1.0 / (1.0 - probability) - 1e-9)


def status_of(lower: float, upper: float, probability: float) -> Status:
    """What bounds of a success rate say of the rate that is asked."""
    if lower >= probability:
        return Status.PASS
    return Status.FAIL if upper < probability else Status.INSUFFICIENT


def _fault(frame: pd.DataFrame, verdict: Verdict) -> str:
    """What keeps a requirement from being judged; empty if nothing does."""
    for name in ("probability", "confidence"):
        value = getattr(verdict, name)
        if not 0.0 < value < 1.0:
            return f"The requirement's {name} is {value}; it must lie between 0 and 1, both excluded."
    missing = next((part for part in verdict.metric.split(" + ") if part not in frame), None)
    if missing is not None:
        return f"The rows have no column '{missing}', which is the requirement's metric."
    if not math.isfinite(verdict.bound) and not is_flag(frame, verdict.metric):
        return "The requirement states no bound, and its metric is no column of true and false."
    return ""


def _unjudged(requirement: Mapping[str, Any]) -> Verdict:
    """The requirement without evidence."""
    return Verdict(
        requirement_id=str(requirement.get("id", "?")),
        statement=_statement(requirement),
        metric=str(requirement.get("metric", "?")),
        bound=_number(requirement.get("bound")),
        probability=_number(requirement.get("probability")),
        confidence=_number(requirement.get("confidence")),
        population=str(requirement.get("population", "all")),
        decide_by=str(requirement.get("decide_by", "confidence")),
        source=str(requirement.get("source") or ""),
        kind=str(requirement.get("kind") or ""),
        scale=_number(requirement.get("scale", 1.0)),
        accept_rate=requirement.get("accept_rate") is True,
        status=Status.INSUFFICIENT,
        n=0,
        failures=0,
        estimate=math.nan,
        lower=math.nan,
        upper=math.nan,
        further_cases=None,
    )


def _statement(requirement: Mapping[str, Any]) -> str:
    """The requirement's text, which says where the rate decides."""
    text = str(requirement.get("statement", ""))
    return f"{text.rstrip('.')} (decided by rate).".lstrip() if requirement.get("decide_by") == ESTIMATE else text


def _number(value: object) -> float:
    try:
        return float(value)  # type: ignore[arg-type]  # anything a JSON file may hold
    except (TypeError, ValueError):
        return math.nan


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + "."
