"""Verdict of a study of rare violations, as a pure function of its evaluated cases.

PASS rests on the counting bound alone. A study of n cases whose margin is continuous cannot be distinguished from one
that has, in addition, a violation at random in each case with the probability q, unless such a case is drawn. With the
probability (1 - q)^n none is drawn. A rule with a false PASS rate of at most alpha for all q above the limit therefore
gives PASS for a continuous margin with a probability of at most alpha (1 - limit)^-n: no rule needs fewer cases than
counting (docs/adr/0044-subset-simulation.md). FAIL can rest on either bound.

If the margin falls continuously to a violation, a level of a subset simulation with the probability P contains
violations with the conditional probability p / P. Cases of a level far above the last one therefore violate rarely. A
gross error without intermediate margins occurs in each level at the same rate, so that it produces more such violations
than the estimate p predicts. This check can refute an estimate, but it cannot prove that a margin is continuous
(docs/rare-violations.md).
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from jaxtyping import Bool
from scipy.stats import poisson

from marsyard.campaigns.studies.counting import MAX_UNITS, CountingBound, count_violations, find_units_needed
from marsyard.campaigns.studies.interval import (
    ProbabilityInterval,
    additional_replicates,
    effective_number,
    enclose,
    replicate_interval,
    unknown_interval,
    weighted_interval,
)
from marsyard.campaigns.studies.subset import SubsetEnd, SubsetResult

#: Probability of each side of the check to refute an estimate with a continuous margin.
_RISK = 0.01
#: Number of levels before a violation from which a violation is expected.
_NEAR_LEVELS = 2
#: Minimum number of effective violations (Kish) at which the interval of importance sampling is used.
MIN_EFFECTIVE_VIOLATIONS = 30.0
#: Minimum number of replicates that have an interval.
_MIN_REPLICATES = 2
#: Explanations of the early ends of replicates.
_END_TEXTS = {
    SubsetEnd.UNLIKELY: "reached no violation down to a hundredth of the limit",
    SubsetEnd.PLATEAU: "reached a plateau: nearly all cases of a level have the same margin",
}


class RareVerdict(StrEnum):
    """Verdict on a probability that must not exceed a limit."""

    PASS = "PASS"  # noqa: S105  (a verdict, not a password)
    FAIL = "FAIL"
    INSUFFICIENT = "INSUFFICIENT"


class Basis(StrEnum):
    """Evidence on which a verdict rests."""

    COUNTING = "counting"
    SIMULATION = "simulation"
    NONE = ""


@dataclass(frozen=True)
class ContinuityCheck:
    """Violations that were reached directly: by a random case, or from a level that is at least two before the last.

    - direct: number of these violations
    - expected_lower, expected_upper: numbers that the interval of the subset simulations predicts
    - refuted: whether `direct` is incompatible with the interval
    """

    direct: int
    expected_lower: float
    expected_upper: float
    refuted: bool


def check_continuity(
    replicates: Sequence[SubsetResult], interval: ProbabilityInterval, counting: CountingBound
) -> ContinuityCheck:
    """Compare the number of direct violations with the number that the interval of the replicates predicts.

    The numbers are treated as Poisson distributed. Random cases are the independent units of the counting bound; they
    include the first level of each replicate.
    """
    far_levels = [level for replicate in replicates for level in replicate.levels[1:-_NEAR_LEVELS]]
    direct = counting.first_violations + sum(level.entered for level in far_levels)
    exposure = counting.units + sum(level.drawn / level.probability for level in far_levels)
    expected_lower, expected_upper = interval.lower * exposure, interval.upper * exposure
    is_excess = float(poisson.sf(direct - 1, expected_upper)) < _RISK
    is_deficit = float(poisson.cdf(direct, expected_lower)) < _RISK
    return ContinuityCheck(direct, expected_lower, expected_upper, is_excess or is_deficit)


@dataclass(frozen=True)
class RareSample:
    """Evaluated cases of a study.

    - replicates: finished subset simulations
    - is_violation, terrains: violation and terrain of each independently drawn case (`count_violations`)
    - violation_weights: weights of importance sampling, 0 for a case without a violation; None without the method
    - shortfall: reason why replicates or importance samples are missing; may be empty
    """

    replicates: Sequence[SubsetResult]
    is_violation: Bool[np.ndarray, " n"]
    terrains: Sequence[str | None]
    violation_weights: Sequence[float] | None = None
    shortfall: str = ""

    @property
    def estimates(self) -> list[float]:
        """Estimates of the probability by the replicates."""
        return [item.probability for item in self.replicates]


@dataclass(frozen=True)
class Decision:
    """Verdict with its evidence.

    - verdict, basis: verdict, and the evidence on which it rests
    - counting: counting bound
    - interval: estimate of the simulations with its interval, for a continuous margin; 0 to 1 without an estimate
    - effective_violations: effective number of violations of importance sampling; None without it
    - continuity: check of the estimate; None without an estimate
    - reason: why the verdict is INSUFFICIENT; may be empty
    - additional_random_cases: number of further independent cases without a violation until PASS; None if unsuitable or
      too large
    - additional_replicates: estimated number of further replicates until FAIL; None if unsuitable or unknown
    """

    verdict: RareVerdict
    basis: Basis
    counting: CountingBound
    interval: ProbabilityInterval
    effective_violations: float | None
    continuity: ContinuityCheck | None
    reason: str = ""
    additional_random_cases: int | None = None
    additional_replicates: int | None = None


def decide_rare(sample: RareSample, max_probability: float, confidence: float, evaluations: int = 1) -> Decision:
    """Decide whether the probability of a violation is at most the limit.

    confidence: two-sided; PASS and FAIL of the first evaluation are each wrong with a probability of at most
    (1 - confidence) / 2. Each later evaluation uses half of the risk of the previous one, so that the sum of all risks
    is below 1 - confidence. Both lower bounds share the risk of FAIL.
    """
    risk = _evaluation_risk(confidence, evaluations)
    counting = count_violations(sample.is_violation, sample.terrains, 0.5 * risk, risk)
    interval, effective_violations, reason = _estimate(sample, 1.0 - risk)
    continuity = None
    if not reason:
        continuity = check_continuity(sample.replicates, interval, counting)
        reason = _describe_refutation(continuity)
    evidence = (counting, interval, effective_violations, continuity)
    if counting.upper <= max_probability:
        return Decision(RareVerdict.PASS, Basis.COUNTING, *evidence)
    if counting.lower > max_probability:
        return Decision(RareVerdict.FAIL, Basis.COUNTING, *evidence)
    if interval.lower > max_probability and not reason:
        return Decision(RareVerdict.FAIL, Basis.SIMULATION, *evidence)
    undecided = Decision(RareVerdict.INSUFFICIENT, Basis.NONE, *evidence, reason)
    next_risk = _evaluation_risk(confidence, evaluations + 1)
    if not reason and interval.estimate > max_probability:
        if sample.violation_weights is not None:
            return undecided
        further = additional_replicates(sample.estimates, 1.0 - next_risk, max_probability)
        return replace(undecided, additional_replicates=further)
    needed = find_units_needed(counting.violating_units, max_probability, next_risk)
    return replace(undecided, additional_random_cases=needed - counting.units) if needed < MAX_UNITS else undecided


def _evaluation_risk(confidence: float, evaluation: int) -> float:
    """Compute the one-sided risk of an evaluation, which has the number 1 or above."""
    return 0.5 * (1.0 - confidence) / 2.0 ** (evaluation - 1)


def _estimate(sample: RareSample, confidence: float) -> tuple[ProbabilityInterval, float | None, str]:
    """Estimate the probability from the simulations.

    Returns the interval, the effective number of violations of importance sampling, and the reason why the interval
    cannot be used.
    """
    ends = Counter(item.end for item in sample.replicates)
    problems = [f"{ends[end]} of {ends.total()} replicates {text}." for end, text in _END_TEXTS.items() if ends[end]]
    if sample.shortfall:
        problems.append(sample.shortfall)
    if problems or len(sample.replicates) < _MIN_REPLICATES:
        return unknown_interval(confidence), None, " ".join(problems)
    interval = replicate_interval(sample.estimates, confidence)
    if sample.violation_weights is None:
        return interval, None, ""
    effective = effective_number(sample.violation_weights)
    # alone, the interval of importance sampling covers the probability too rarely (docs/validation.md)
    interval = enclose(weighted_interval(sample.violation_weights, confidence), interval)
    if effective >= MIN_EFFECTIVE_VIOLATIONS:
        return interval, effective, ""
    reason = (
        f"Importance sampling has only {effective:.0f} effective violations, fewer than "
        f"{MIN_EFFECTIVE_VIOLATIONS:.0f}: its interval is not reliable. Use more cases, or --method subset."
    )
    return interval, effective, reason


def _describe_refutation(continuity: ContinuityCheck) -> str:
    """Describe why the estimate is refuted; empty if it is not."""
    if not continuity.refuted:
        return ""
    return (
        f"The estimate of the simulations is refuted: {continuity.direct} violations were reached without intermediate "
        f"margins, and the estimate predicts {continuity.expected_lower:.1f} to {continuity.expected_upper:.1f}."
    )
