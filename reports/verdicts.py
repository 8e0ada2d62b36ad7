"""Verdicts on requirements, computed from stored rows: status, bounds, and number of additional cases needed.

A requirement specifies that `|metric| <= bound`, or a true column, holds for a fraction of a population at a
confidence. Its status follows from one-sided Clopper-Pearson bounds of the success rate. Bounds of cases on shared
terrains allow for correlation (`marsyard.reports.statistics.proportions`). If a campaign is evaluated repeatedly, the
probability of a wrong verdict in any evaluation is at most 1 - confidence: each planned look (evaluation) uses a
fraction of this risk, and looks at appended cases use `SequentialTest`. MET BY RATE: the requirement has
`decide_by = "estimate"`, and the observed rate is sufficient, but the lower bound is not. Cases that are not
independent random samples (Latin hypercube, Sobol, grids) have no bounds; requirements with `decide_by = "estimate"`
can still be decided.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from fnmatch import fnmatchcase
from itertools import zip_longest
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd

from marsyard.reports import rates
from marsyard.reports.case_evidence import CaseEvidence, Groups, RequirementEvidence, Success
from marsyard.reports.sampling_design import INDEPENDENT, SamplingDesign
from marsyard.reports.statistics import proportions
from marsyard.reports.statistics.proportions import (
    ClusteredEvidence,
    ClusterMethod,
    SequentialTest,
    clustered_evidence,
    confidence_at,
)
from marsyard.reports.wording import count, format_fraction, percent, population_text

#: Beginning of the statement of a requirement whose population the flight system cannot know.
GIVEN_TRUTH = "Given truth"
#: Value of a requirement's `decide_by`: compare the observed rate with the required probability.
ESTIMATE = "estimate"


class Status(StrEnum):
    """Result of the evaluation of a requirement."""

    PASS = "PASS"  # noqa: S105  (a verdict, not a password)
    MET_BY_RATE = "MET BY RATE"
    FAIL = "FAIL"
    INSUFFICIENT = "INSUFFICIENT"
    #: PASS of a confirmation whose record of earlier runs is missing, broken or not registered.
    UNREGISTERED = "PASS (unregistered)"
    #: PASS of a confirmation after other claims about the same campaign without PASS.
    OTHER_CLAIMS = "PASS (other claims)"


@dataclass(frozen=True)
class AllCases:
    """Result of a requirement on all cases instead of its population; the numbers are defined as in `Verdict`.

    Cases without a value of the metric are failures. `configured` are the conditions that remain, because the
    configuration of a case determines them; empty for all cases of the campaign.
    """

    status: Status
    n: int
    failures: int
    estimate: float
    lower: float
    upper: float
    configured: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """The result in a sentence."""
        cases = f"all {self.n:,} {population_text(' and '.join(self.configured))}"
        successes = f"{self.n - self.failures:,} ({percent(self.estimate)}) would meet the criterion"
        condition = f"if {cases} counted, and cases without a value were failures"
        return f"For comparison: {condition}, {successes}, and the verdict would be {self.status}."


@dataclass(frozen=True)
class Verdict:
    """One requirement with its verdict; numbers that the requirement does not define are NaN.

    - status: PASS if the lower bound is at least the probability, FAIL if the upper bound is below it, otherwise
      INSUFFICIENT. If `decide_by` is "estimate" and the bounds do not result in PASS: FAIL if the rate is below the
      probability, INSUFFICIENT for fewer cases than `min_cases_for_rate`, otherwise MET BY RATE
    - failures: cases with a missing, NaN or too large metric, unfinished cases, cases with a missing population flag
    - estimate, lower, upper: success rate and its one-sided bounds; NaN for no cases; no bounds for other designs
    - further_cases: additional cases without failure for PASS, on new terrains if terrains are counted; None if unknown
    - reason: why the requirement is not evaluated, or why the verdict is withheld
    - advice: why more cases cannot lead to PASS, and which change of the campaign can
    - accept_rate: whether MET BY RATE results in the exit status 0
    - withheld_status: status without regard to the kind of evidence, if it was replaced by INSUFFICIENT; otherwise None
    - all_cases: result of the same requirement on all cases; None if its population is all cases
    - definitions: definitions of the columns of the population that the flight system cannot know; may be empty
    - joint_text: contribution of this run to the joint evidence of all confirmations, as a sentence; may be empty
    - terrains: number of distinct terrains of the population; None if unknown
    - clustered: evidence from shared terrains; None if no terrain is shared
    - plain_lower, plain_upper: bounds for independent cases
    - bounds_confidence, upper_confidence: confidence of lower and upper bound; increased for repeated evaluations
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
    withheld_status: Status | None = None
    all_cases: AllCases | None = None
    definitions: str = ""
    joint_text: str = ""
    source: str = ""
    kind: str = ""
    scale: float = 1.0

    @property
    def plain_status(self) -> Status | None:
        """The status for independent cases; None if no terrain is shared or the observed rate decides."""
        if self.clustered is None or self.decide_by == ESTIMATE:
            return None
        return compare_bounds(self.plain_lower, self.plain_upper, self.probability)

    @property
    def confident_status(self) -> Status:
        """The status by the bounds alone; INSUFFICIENT without bounds."""
        return compare_bounds(self.lower, self.upper, self.probability)

    @property
    def consumer_risk(self) -> float:
        """Probability of this result or a better one if the true rate equals the required rate; NaN without bounds."""
        if math.isnan(self.lower):
            return math.nan
        evidence = self.clustered
        if evidence is None:
            return proportions.consumer_risk(self.n - self.failures, self.n, self.probability)
        return proportions.consumer_risk(evidence.effective_successes, evidence.effective_n, self.probability)

    @property
    def design_effect(self) -> float:
        """The design effect of shared terrains; NaN if no terrain is shared."""
        return math.nan if self.clustered is None else self.clustered.design_effect

    @property
    def margin(self) -> float:
        """Lower bound (or rate, if the observed rate decides) minus the required rate; NaN without bounds."""
        decisive_rate = self.estimate if self.decide_by == ESTIMATE else self.lower
        return decisive_rate - self.probability

    @property
    def note(self) -> str:
        """Explanation of the verdict and of its limitations, in sentences; may be empty."""
        all_cases_text = "" if self.all_cases is None or self.all_cases.n == self.n else self.all_cases.text
        definitions = f"{self.definitions}." if self.definitions else ""
        texts: tuple[str, ...] = (definitions, self.reason, all_cases_text, self.joint_text)
        if not self.reason:
            decision, terrains = self._decision_text(), self._terrain_text()
            texts = (definitions, decision, all_cases_text, terrains, self._look_text(), self.advice, self.joint_text)
        return " ".join(text for text in texts if text)

    def _decision_text(self) -> str:
        if self.decide_by != ESTIMATE or self.n == 0:
            return ""
        confidence_text = f"at {format_fraction(self.confidence)} confidence"
        if self.status is Status.PASS:
            return f"Evaluated by observed rate; also met {confidence_text}."
        if self.status is Status.INSUFFICIENT:
            min_cases = count(min_cases_for_rate(self.probability), "case")
            return f"The evaluation by observed rate needs at least {min_cases}."
        return f"Evaluated by observed rate; {confidence_text} the verdict would be {self.confident_status}."

    def _terrain_text(self) -> str:
        evidence = self.clustered
        if evidence is None:
            return ""
        is_effect_unknown = math.isnan(evidence.design_effect)
        effect = self.n / evidence.effective_n if is_effect_unknown else evidence.design_effect
        reason = "Cases on one terrain are correlated"
        if evidence.method is ClusterMethod.TERRAIN_COUNT:
            reason = "With too few failures to estimate their correlation, each terrain counts as one case"
        text = (
            f"The {count(self.n, 'case')} lie on {count(self.terrains or 0, 'terrain')}. {reason}: the bounds are "
            f"those of {evidence.effective_n:.4g} independent cases (design effect {effect:.3g})."
        )
        if self.plain_status is not None and self.plain_status is not self.status:
            text += f" For independent cases the lower bound would be {percent(self.plain_lower)}: {self.plain_status}."
        if evidence.method is ClusterMethod.TERRAIN_COUNT and self.further_cases and self.decide_by != ESTIMATE:
            cases = count(self.further_cases, "additional case")
            text += f" {cases} without a failure, each on a new terrain, would lead to PASS."
        return text

    def _look_text(self) -> str:
        if math.isnan(self.bounds_confidence) or self.bounds_confidence == self.upper_confidence == self.confidence:
            return ""
        lower, upper = (f"{100.0 * level:.4g} %" for level in (self.bounds_confidence, self.upper_confidence))
        joint_note = f"so that all evaluations together have {format_fraction(self.confidence)} confidence"
        if lower == upper:
            return f"The campaign is evaluated more than once. Its bounds are at {lower} confidence, {joint_note}."
        return (
            f"The campaign is evaluated more than once. Its lower bound is at {lower} confidence and its upper bound "
            f"at {upper} confidence, {joint_note}."
        )


@dataclass(frozen=True)
class Looks:
    """Earlier and planned looks (evaluations) of a campaign.

    - in_first_look: mask of the cases that an earlier first look used; None at the first look
    - risk_fraction: fraction of the risk of a wrong verdict that this look may use; 1 if no looks were planned
    """

    in_first_look: Success | None = None
    risk_fraction: float = 1.0


def add_bounds(verdict: Verdict, success: Success, groups: Groups | None, looks: Looks) -> tuple[Verdict, int]:
    """Add bounds of the success rate of at least one case; also return the additional cases without failure for PASS.

    groups: terrain of each case, numbered from 0; None if unknown
    """
    n, failures, probability, confidence = success.size, verdict.failures, verdict.probability, verdict.confidence
    first_n = n if looks.in_first_look is None else int(looks.in_first_look.sum())
    # confidences of the lower and of the upper bound
    levels = _confidences(first_n, n, probability, confidence, looks)
    lower = proportions.proportion_lower(n - failures, n, levels[0])
    upper = proportions.proportion_upper(n - failures, n, levels[1])
    verdict = replace(verdict, lower=lower, upper=upper, plain_lower=lower, plain_upper=upper)
    if groups is None or int(groups.max()) + 1 == n:
        needed_cases = _cases_needed(first_n, n, failures, probability, confidence, looks)
        return replace(verdict, bounds_confidence=levels[0], upper_confidence=levels[1]), needed_cases - n
    evidence = clustered_evidence(success, groups, confidence)
    in_first_look = np.ones(n, dtype=np.bool_) if looks.in_first_look is None else looks.in_first_look
    if np.unique(groups[in_first_look]).size != first_n:
        # effective number of independent cases at the first look
        first_n = math.floor(clustered_evidence(success[in_first_look], groups[in_first_look], confidence).effective_n)
    levels = _confidences(first_n, evidence.effective_n, probability, confidence, looks)
    evidence_by_level = [clustered_evidence(success, groups, level) for level in levels]
    evidence = replace(evidence_by_level[0], upper=evidence_by_level[1].upper)
    if evidence.method is ClusterMethod.TERRAIN_COUNT:
        # the tolerance prevents a rounding error from increasing an integer by 1
        size, weight = evidence.terrains, 1.0
        n_failed = math.ceil(evidence.terrains - evidence.effective_successes - 1e-9)
    else:
        weight = evidence.effective_n / n
        size, n_failed = math.floor(evidence.effective_n), math.ceil(failures * weight)
    needed_cases = _cases_needed(first_n, size, n_failed, probability, confidence, looks)
    verdict = replace(verdict, lower=evidence.lower, upper=evidence.upper, clustered=evidence)
    # convert effective cases to cases
    additional = math.ceil((needed_cases - size) / weight)
    return replace(verdict, bounds_confidence=levels[0], upper_confidence=levels[1]), additional


def _confidences(
    first_n: int, n: float | int, probability: float, confidence: float, looks: Looks
) -> tuple[float, float]:
    """Compute the confidences of the lower and of the upper bound."""
    if looks.in_first_look is None:
        level = confidence_at(confidence, looks.risk_fraction)
        return level, level
    pass_test, fail_test = (
        SequentialTest(limit, 1.0 - confidence, first_n) for limit in (1.0 - probability, probability)
    )
    return 1.0 - pass_test.significance_level(n), 1.0 - fail_test.significance_level(n)


def _cases_needed(first_n: int, n: int, failures: int, probability: float, confidence: float, looks: Looks) -> int:
    """Compute the total number of cases that would lead to PASS without an additional failure."""
    if looks.risk_fraction < 1.0:
        level = confidence_at(confidence, looks.risk_fraction)
        return n + proportions.further_cases_needed(n, failures, probability, level)
    return SequentialTest(1.0 - probability, 1.0 - confidence, first_n).cases_needed(n, failures)


def evaluate_requirements(
    frame: pd.DataFrame,
    requirements: Sequence[Mapping[str, Any]],
    sampling: SamplingDesign = INDEPENDENT,
    from_truth: Mapping[str, str] = MappingProxyType({}),
    configured: Sequence[str] = (),
    earlier: Sequence[RequirementEvidence | None] = (),
) -> list[Verdict]:
    """Evaluate each requirement on all rows of a campaign; missing columns or numbers result in INSUFFICIENT.

    - sampling: the sampling design; without independent random samples, verdicts have no bounds
    - from_truth: columns that the flight system cannot know, with their definitions; mentioned in the statement of a
      requirement
    - configured: columns, or patterns of names, that the configuration of a case determines; they remain conditions
      over all cases
    - earlier: evidence of other confirmations of the same claim for each requirement; may be empty
    """
    frame = sampling.exclude_nominal_case(frame)
    verdicts = []
    for requirement, earlier_evidence in zip_longest(requirements, earlier):
        verdict = _evaluate(frame, requirement, sampling, earlier_evidence)
        names = [name for name in verdict.population.split(" and ") if name in from_truth]
        if names:
            title = f"{GIVEN_TRUTH} ({', '.join(name.replace('_', ' ') for name in names)}): "
            texts = {name.replace("_", " "): from_truth[name] for name in names if from_truth[name]}
            definitions = "; ".join(f"'{name}' means: {text}" for name, text in texts.items())
            verdict = replace(verdict, statement=f"{title}{verdict.statement}", definitions=definitions)
        verdicts.append(replace(verdict, all_cases=_evaluate_all_cases(frame, requirement, sampling, configured)))
    return verdicts


def _evaluate_all_cases(
    frame: pd.DataFrame, requirement: Mapping[str, Any], sampling: SamplingDesign, configured: Sequence[str]
) -> AllCases | None:
    """Evaluate a requirement on all cases of its configuration; None if its population is the same, or has no case."""
    population = str(requirement.get("population", "all"))
    remaining_conditions = tuple(
        name for name in population.split(" and ") if any(fnmatchcase(name, flag) for flag in configured)
    )
    wider_population = " and ".join(remaining_conditions) or "all"
    if population == wider_population:
        return None
    result = _evaluate(frame, {**requirement, "population": wider_population}, sampling)
    if not result.n:
        return None
    return AllCases(
        result.status, result.n, result.failures, result.estimate, result.lower, result.upper, remaining_conditions
    )


def collect_evidence(
    frame: pd.DataFrame, requirement: Mapping[str, Any], sampling: SamplingDesign, *, has_own_terrains: bool
) -> RequirementEvidence | None:
    """Collect the results of the cases of a requirement; None if it cannot be evaluated.

    has_own_terrains: whether no other confirmation uses the terrains
    """
    frame, verdict = sampling.exclude_nominal_case(frame), _empty_verdict(requirement)
    if _describe_problem(frame, verdict):
        return None
    try:
        masks = [mask(frame, verdict.population) for mask in (rates.population_mask, rates.population_mask_if_answered)]
    except ValueError:
        return None
    evidence = [
        _case_evidence(verdict, frame[mask], sampling, frame, has_own_terrains=has_own_terrains) for mask in masks
    ]
    return RequirementEvidence(*evidence)


def _case_evidence(
    verdict: Verdict,
    population: pd.DataFrame,
    sampling: SamplingDesign,
    frame: pd.DataFrame,
    *,
    has_own_terrains: bool = True,
) -> CaseEvidence:
    """Collect the results of the cases of a population."""
    _, has_unknown_flag = rates.population_and_unknown_masks(population, verdict.population.split(" and "))
    success = np.asarray(
        rates.success_mask(population, verdict.metric, verdict.bound, verdict.scale) & ~has_unknown_flag, dtype=np.bool_
    )
    in_first_look = sampling.mask_first_look(frame, population)
    if in_first_look is None:
        in_first_look = np.ones(success.size, dtype=np.bool_)
    groups = rates.terrain_groups(population) if success.size else None
    if groups is None or has_own_terrains:
        return CaseEvidence(success, groups, in_first_look)
    first_rows = np.unique(groups, return_index=True)[1]
    labels = tuple(f"terrain {value}" for value in population["terrain"].iloc[first_rows])
    return CaseEvidence(success, groups, in_first_look, labels)


def _evaluate(
    frame: pd.DataFrame,
    requirement: Mapping[str, Any],
    sampling: SamplingDesign,
    earlier: RequirementEvidence | None = None,
) -> Verdict:
    verdict = _empty_verdict(requirement)
    problem = _describe_problem(frame, verdict)
    if problem:
        return replace(verdict, reason=problem)
    try:
        population = frame[rates.population_mask(frame, verdict.population)]
        population_and_unfinished = frame[rates.population_mask_if_answered(frame, verdict.population)]
    except ValueError as error:
        text = str(error)
        return replace(verdict, reason=f"{text[:1].upper()}{text[1:]}.")
    if population.empty:
        needed_cases = SequentialTest(1.0 - verdict.probability, 1.0 - verdict.confidence, 0).cases_needed(0, 0)
        reason = f"No case belongs to the population '{verdict.population}'."
        return replace(verdict, reason=reason, further_cases=needed_cases if sampling.independent else None)
    earlier_parts = (None, None) if earlier is None else (earlier.population, earlier.with_unfinished)
    populations = (population, population_and_unfinished)
    verdicts = [
        _decide(verdict, cases, sampling, frame, earlier_part)
        for cases, earlier_part in zip(populations, earlier_parts, strict=True)
    ]
    return _withhold_if_uncertain(*verdicts)


def _withhold_if_uncertain(verdict: Verdict, with_unfinished: Verdict) -> Verdict:
    """Replace PASS or MET BY RATE by INSUFFICIENT if the verdict changes with unfinished cases as failures.

    `valid` and `completed` exclude unfinished cases. Without this check, crashes instead of wrong answers could lead to
    PASS.
    """
    if verdict.status in (Status.FAIL, Status.INSUFFICIENT, with_unfinished.status):
        return verdict
    n_unfinished = with_unfinished.n - verdict.n
    reason = (
        f"{count(n_unfinished, 'case')} did not finish and {'belongs' if n_unfinished == 1 else 'belong'} to no "
        f"population of answers. If they are counted as failures, the verdict is not {verdict.status}. It is therefore "
        "withheld."
    )
    return replace(verdict, status=Status.INSUFFICIENT, reason=reason)


def _decide(
    verdict: Verdict,
    population: pd.DataFrame,
    sampling: SamplingDesign,
    frame: pd.DataFrame,
    earlier: CaseEvidence | None = None,
) -> Verdict:
    """Decide the verdict from the cases of its population (at least one).

    - frame: all cases of the campaign
    - earlier: cases of other confirmations of the same claim
    """
    has_own_terrains = earlier is None or earlier.labels is None
    evidence = _case_evidence(verdict, population, sampling, frame, has_own_terrains=has_own_terrains)
    if earlier is not None:
        if earlier.contains_first:
            evidence = replace(evidence, in_first_look=np.zeros(evidence.success.size, dtype=np.bool_))
        evidence = earlier.join(evidence)
    success, groups = evidence.success, evidence.groups
    n, failures = success.size, int((~success).sum())
    rate, decides_by_rate = (n - failures) / n, verdict.decide_by == ESTIMATE
    terrains = None if groups is None else int(population["terrain"].nunique())
    if earlier is not None and groups is not None:
        terrains = int(groups.max()) + 1
    with_counts = replace(verdict, n=n, failures=failures, estimate=rate, terrains=terrains)
    if not sampling.independent:
        reason = f"{'Decided by the rate of these cases. ' if decides_by_rate else ''}{sampling.no_probability}"
        status = _status_by_rate(rate, n, verdict.probability) if decides_by_rate else verdict.status
        return replace(with_counts, status=status, reason=reason)
    in_first_look = None if evidence.in_first_look.all() else evidence.in_first_look
    looks = Looks(in_first_look, sampling.risk_fraction_at(len(frame)))
    verdict_with_bounds, additional = add_bounds(with_counts, success, groups, looks)
    status = verdict_with_bounds.confident_status
    decides_by_rate = decides_by_rate and status is not Status.PASS
    if decides_by_rate:
        status = _status_by_rate(rate, n, verdict.probability)
    verdict_with_bounds = replace(verdict_with_bounds, status=status)
    if status is not Status.INSUFFICIENT:
        return verdict_with_bounds
    if decides_by_rate:
        return replace(verdict_with_bounds, further_cases=min_cases_for_rate(verdict.probability) - n)
    # number of additional cases, or advice if the campaign has too few terrains for them
    clustered, terrain_supply = verdict_with_bounds.clustered, sampling.terrains
    counts_terrains = clustered is not None and clustered.method is ClusterMethod.TERRAIN_COUNT
    if not counts_terrains or terrain_supply is None or (terrains or 0) + additional <= terrain_supply.terrains:
        return replace(verdict_with_bounds, further_cases=additional)
    needed_terrains = proportions.minimum_sample_size(verdict.probability, verdict.confidence)
    return replace(
        verdict_with_bounds, advice=terrain_supply.advice(needed_terrains, verdict.probability, verdict.confidence)
    )


def _status_by_rate(rate: float, n: int, probability: float) -> Status:
    if rate < probability:
        return Status.FAIL
    return Status.MET_BY_RATE if n >= min_cases_for_rate(probability) else Status.INSUFFICIENT


def min_cases_for_rate(probability: float) -> int:
    """Minimum number of cases for MET BY RATE: 1 / (1 - probability), of which one may fail."""
    # the tolerance is for rounding errors: 1 / (1 - 0.9) is 10.000000000000002, which must result in 10
    return math.ceil(1.0 / (1.0 - probability) - 1e-9)


def compare_bounds(lower: float, upper: float, probability: float) -> Status:
    """Compare bounds of a success rate with the required rate."""
    if lower >= probability:
        return Status.PASS
    return Status.FAIL if upper < probability else Status.INSUFFICIENT


def _describe_problem(frame: pd.DataFrame, verdict: Verdict) -> str:
    """Describe why a requirement cannot be evaluated; empty if it can."""
    for name in ("probability", "confidence"):
        value = getattr(verdict, name)
        if not 0.0 < value < 1.0:
            return f"The requirement's {name} is {value}; it must lie between 0 and 1, both excluded."
    missing_column = next((part for part in verdict.metric.split(" + ") if part not in frame), None)
    if missing_column is not None:
        return f"The rows have no column '{missing_column}', which is the requirement's metric."
    if not math.isfinite(verdict.bound) and not rates.is_flag(frame, verdict.metric):
        return "The requirement has no bound, and its metric is not a column of true and false."
    return ""


def _empty_verdict(requirement: Mapping[str, Any]) -> Verdict:
    """Create the verdict without evidence; a decision by rate is added to the statement."""
    decide_by, statement = str(requirement.get("decide_by", "confidence")), str(requirement.get("statement", ""))
    if decide_by == ESTIMATE:
        statement = f"{statement.rstrip('.')} (evaluated by observed rate).".lstrip()
    return Verdict(
        requirement_id=str(requirement.get("id", "?")),
        statement=statement,
        metric=str(requirement.get("metric", "?")),
        bound=_to_float(requirement.get("bound")),
        probability=_to_float(requirement.get("probability")),
        confidence=_to_float(requirement.get("confidence")),
        population=str(requirement.get("population", "all")),
        decide_by=decide_by,
        source=str(requirement.get("source") or ""),
        kind=str(requirement.get("kind") or ""),
        scale=_to_float(requirement.get("scale", 1.0)),
        accept_rate=requirement.get("accept_rate") is True,
    )


def _to_float(value: object) -> float:
    try:
        return float(value)  # type: ignore[arg-type]  # anything a JSON file may hold
    except (TypeError, ValueError):
        return math.nan
