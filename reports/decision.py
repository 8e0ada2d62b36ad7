"""Decision of requirements from stored rows: the cases of each population, and the verdict that they result in."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from itertools import zip_longest
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Int

from marsyard.reports import populations, rates
from marsyard.reports.bounds import Looks, add_clustered_bounds, add_independent_bounds
from marsyard.reports.case_evidence import CaseEvidence, Mask, RequirementEvidence
from marsyard.reports.sampling_design import INDEPENDENT, SamplingDesign
from marsyard.reports.statistics import proportions
from marsyard.reports.statistics.sequential import SequentialTest
from marsyard.reports.verdicts import ESTIMATE, GIVEN_TRUTH, AllCases, Status, Verdict, min_cases_for_rate
from marsyard.reports.wording import count, plain_value


def _add_bounds(verdict: Verdict, evidence: CaseEvidence, looks: Looks) -> Verdict:
    """Add bounds of the success rate of at least one case, and the additional cases for PASS."""
    plain = add_independent_bounds(verdict, evidence.success, evidence.member, looks)
    clustered = evidence.clustered
    bounded = plain if clustered is None else add_clustered_bounds(plain, clustered, looks)
    return replace(bounded, plain_lower=plain.lower, plain_upper=plain.upper)


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
    - configured: columns, or patterns of names, that the definition of a case determines; they remain conditions
      over all cases
    - earlier: evidence of other confirmations of the same claim for each requirement; may be empty
    """
    frame = sampling.exclude_nominal_case(frame)
    verdicts = []
    for requirement, earlier_evidence in zip_longest(requirements, earlier):
        verdict = evaluate_requirement(frame, requirement, sampling, earlier_evidence)
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
    """Evaluate a requirement on all cases of its definition; None if its population is the same, or has no case."""
    population = str(requirement.get("population", "all"))
    remaining_conditions = tuple(
        name for name in population.split(" and ") if any(fnmatchcase(name, flag) for flag in configured)
    )
    wider_population = " and ".join(remaining_conditions) or "all"
    if population == wider_population:
        return None
    result = evaluate_requirement(frame, {**requirement, "population": wider_population}, sampling)
    if not result.n:
        return None
    return AllCases(
        result.status, result.n, result.failures, result.estimate, result.lower, result.upper, remaining_conditions
    )


def requirement_masks(frame: pd.DataFrame, requirement: Mapping[str, Any]) -> tuple[Mask, Mask] | None:
    """Return the population of a requirement, and the cases that meet it; None if the rows lack its columns."""
    verdict = _empty_verdict(requirement)
    if _describe_missing_column(frame, verdict):
        return None
    try:
        member = populations.population_mask(frame, verdict.population)
    except ValueError:
        return None
    return member, populations.success_mask(frame, verdict.metric, verdict.bound, verdict.scale)


def collect_evidence(
    frame: pd.DataFrame, requirement: Mapping[str, Any], sampling: SamplingDesign, *, has_own_terrains: bool
) -> RequirementEvidence | None:
    """Collect the results of the cases of a requirement; None if it cannot be evaluated.

    has_own_terrains: whether no other confirmation uses the terrains
    """
    verdict = _empty_verdict(requirement)
    frame = _complete_columns(sampling.exclude_nominal_case(frame), verdict)
    if _describe_problem(frame, verdict):
        return None
    try:
        return _requirement_evidence(verdict, sampling, frame, has_own_terrains=has_own_terrains)
    except ValueError:
        return None


def _requirement_evidence(
    verdict: Verdict, sampling: SamplingDesign, frame: pd.DataFrame, *, has_own_terrains: bool
) -> RequirementEvidence:
    """Collect the results of all cases (`frame`). Raises ValueError if the rows lack a column of the population."""
    unfinished = populations.mark_repeated_as_unfinished(frame)
    masks = (
        (frame, populations.population_mask(frame, verdict.population)),
        (unfinished, populations.population_mask_if_answered(unfinished, verdict.population)),
    )
    return RequirementEvidence(
        *(_case_evidence(verdict, mask, sampling, rows, has_own_terrains=has_own_terrains) for rows, mask in masks)
    )


def _case_evidence(
    verdict: Verdict, member: Mask, sampling: SamplingDesign, frame: pd.DataFrame, *, has_own_terrains: bool
) -> CaseEvidence:
    """Collect the results of all cases (`frame`) with regard to a population (`member`)."""
    _, has_unknown_flag = populations.population_and_unknown_masks(frame, verdict.population.split(" and "))
    success = populations.success_mask(frame, verdict.metric, verdict.bound, verdict.scale) & ~has_unknown_flag & member
    in_first_look = sampling.mask_first_look(frame)
    if in_first_look is None:
        in_first_look = np.ones(member.size, dtype=np.bool_)
    groups = rates.terrain_groups(frame) if member.size else None
    if groups is None or has_own_terrains:
        return CaseEvidence(success, member, groups, in_first_look)
    return CaseEvidence(success, member, groups, in_first_look, _label_terrains(frame, groups))


def _label_terrains(frame: pd.DataFrame, groups: Int[np.ndarray, " n"]) -> tuple[str, ...]:
    """Return a label for each terrain (index in `groups`), equal for equal terrains of other confirmations."""
    first_rows = np.unique(groups, return_index=True)[1]
    # a column with a missing terrain contains floating-point numbers: the labels have no decimals
    return tuple(
        f"unknown terrain of row {row}" if pd.isna(terrain) else f"terrain {plain_value(terrain)}"
        for row, terrain in zip(first_rows.tolist(), frame["terrain"].iloc[first_rows], strict=True)
    )


def evaluate_requirement(
    frame: pd.DataFrame,
    requirement: Mapping[str, Any],
    sampling: SamplingDesign,
    earlier: RequirementEvidence | None = None,
) -> Verdict:
    """Evaluate a requirement; INSUFFICIENT with a reason if the rows do not allow it, or no case is in its population.

    frame: rows without the nominal case
    earlier: evidence of other confirmations of the same claim
    """
    verdict = _empty_verdict(requirement)
    frame = _complete_columns(frame, verdict)
    problem = _describe_problem(frame, verdict)
    if problem:
        return replace(verdict, reason=problem)
    has_own_terrains = earlier is None or earlier.population.labels is None
    try:
        evidence = _requirement_evidence(verdict, sampling, frame, has_own_terrains=has_own_terrains)
    except ValueError as error:
        text = str(error)
        return replace(verdict, reason=f"{text[:1].upper()}{text[1:]}.")
    if not evidence.population.n:
        needed_cases = SequentialTest(1.0 - verdict.probability, 1.0 - verdict.confidence, 0).cases_needed(0, 0)
        reason = f"No case belongs to the population '{verdict.population}'."
        return replace(verdict, reason=reason, additional_cases=needed_cases if sampling.independent else None)
    population, with_unfinished = evidence.population, evidence.with_unfinished
    is_certain = (population.n, population.failures) == (with_unfinished.n, with_unfinished.failures)
    if earlier is not None:
        population = earlier.population.join_own(population)
        with_unfinished = earlier.with_unfinished.join_own(with_unfinished)
    decided = _decide(verdict, population, sampling, frame)
    if earlier is None and is_certain:
        return decided
    return _withhold_if_uncertain(decided, _decide(verdict, with_unfinished, sampling, frame))


def _withhold_if_uncertain(verdict: Verdict, with_unfinished: Verdict) -> Verdict:
    """Replace PASS or MET BY RATE by INSUFFICIENT if the verdict changes with unfinished cases as failures.

    `valid` and `completed` exclude unfinished cases. Without this check, crashes instead of wrong answers could lead to
    PASS. A case that finished in a second attempt counts as unfinished, since repetition would hide a random failure.
    """
    if not verdict.status.is_met or verdict.status is with_unfinished.status:
        return verdict
    n_unfinished = with_unfinished.n - verdict.n
    n_repeated = with_unfinished.failures - verdict.failures - n_unfinished
    text = (
        f"{count(n_unfinished, 'case')} did not finish and {'belongs' if n_unfinished == 1 else 'belong'} to no "
        "population of answers."
    )
    if n_repeated:
        unfinished = f"{count(n_unfinished, 'case')} did not finish, and " if n_unfinished else ""
        text = f"{unfinished}{count(n_repeated, 'case')} finished only in a second attempt."
    reason = f"{text} If they are counted as failures, the verdict is not {verdict.status}. It is therefore withheld."
    return verdict.withhold(reason)


def _decide(verdict: Verdict, evidence: CaseEvidence, sampling: SamplingDesign, frame: pd.DataFrame) -> Verdict:
    """Decide the verdict from the results of a population of at least one case.

    frame: all cases of the campaign
    """
    n, failures, decides_by_rate = evidence.n, evidence.failures, verdict.decide_by == ESTIMATE
    rate = (n - failures) / n
    with_counts = replace(verdict, n=n, failures=failures, estimate=rate, terrains=evidence.terrains)
    if not sampling.independent:
        prefix = "Evaluated by the observed rate of these cases. " if decides_by_rate else ""
        reason = prefix + sampling.no_probability_reason
        status = _status_by_rate(rate, n, verdict.probability) if decides_by_rate else verdict.status
        return replace(with_counts, status=status, reason=reason)
    in_first_look = None if evidence.in_first_look.all() else evidence.in_first_look
    looks = Looks(in_first_look, sampling.allowed_risk_fraction(len(frame)))
    bounded = _add_bounds(with_counts, evidence, looks)
    additional, verdict_with_bounds = bounded.additional_cases or 0, replace(bounded, additional_cases=None)
    status = verdict_with_bounds.confident_status
    decides_by_rate = decides_by_rate and status is not Status.PASS
    if decides_by_rate:
        status = _status_by_rate(rate, n, verdict.probability)
    verdict_with_bounds = replace(verdict_with_bounds, status=status)
    if status is not Status.INSUFFICIENT:
        return verdict_with_bounds
    if decides_by_rate:
        return replace(verdict_with_bounds, additional_cases=min_cases_for_rate(verdict.probability) - n)
    # number of additional cases, or advice if the campaign has too few terrains for them
    clustered, supply = verdict_with_bounds.clustered, sampling.terrains
    if clustered is None or supply is None or clustered.terrains + additional <= supply.terrains:
        return replace(verdict_with_bounds, additional_cases=additional)
    needed_terrains = proportions.minimum_sample_size(verdict.probability, verdict.confidence)
    return replace(verdict_with_bounds, advice=supply.advice(needed_terrains, verdict.probability, verdict.confidence))


def _status_by_rate(rate: float, n: int, probability: float) -> Status:
    if rate < probability:
        return Status.FAIL
    return Status.MET_BY_RATE if n >= min_cases_for_rate(probability) else Status.INSUFFICIENT


def _complete_columns(frame: pd.DataFrame, verdict: Verdict) -> pd.DataFrame:
    """Add the columns of a requirement that are missing because no case finished; their values are missing."""
    if frame.empty or not populations.engine_failed(frame).all():
        return frame
    flags = [name for name in verdict.population.split(" and ") if name not in ("all", "completed", "valid")]
    missing = [name for name in (*verdict.metric.split(" + "), *flags) if name not in frame]
    return frame.reindex(columns=[*frame.columns, *dict.fromkeys(missing)])


def _describe_problem(frame: pd.DataFrame, verdict: Verdict) -> str:
    """Describe why a requirement cannot be evaluated; empty if it can."""
    for name in ("probability", "confidence"):
        value = getattr(verdict, name)
        if not 0.0 < value < 1.0:
            return f"The requirement's {name} is {value}; it must lie between 0 and 1, both excluded."
    return _describe_missing_column(frame, verdict)


def _describe_missing_column(frame: pd.DataFrame, verdict: Verdict) -> str:
    """Describe which column of the requirement's metric is missing or unsuitable; empty if there is none."""
    missing_column = next((part for part in verdict.metric.split(" + ") if part not in frame), None)
    if missing_column is not None:
        return f"The rows have no column '{missing_column}', which is the requirement's metric."
    if not math.isfinite(verdict.bound) and not populations.is_flag(frame, verdict.metric):
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
