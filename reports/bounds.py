"""Bounds of the success rate of a requirement, and the additional cases that it needs, with regard to repeated looks.

A look is one evaluation of the verdict. Each planned look uses a fraction of the risk of a wrong verdict. Looks at a
campaign with appended cases use `SequentialTest`. If cases share terrains, its events are terrains with a failure, and
its number of cases is the number of terrains whose first case belongs to the population. A terrain has a failure at
least as often as its first case, so this is conservative.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from marsyard.reports.case_evidence import Mask
from marsyard.reports.statistics import proportions
from marsyard.reports.statistics.clusters import ClusteredCases, TerrainEvidence, attainable_risk, count_sizes
from marsyard.reports.statistics.proportions import SequentialTest, confidence_at


@dataclass(frozen=True)
class RequiredRate:
    """Required success rate, and the confidence at which it must be shown."""

    probability: float
    confidence: float

    @property
    def risk(self) -> float:
        """Permitted probability of a wrong verdict."""
        return 1.0 - self.confidence


@dataclass(frozen=True)
class Looks:
    """Earlier and planned looks (evaluations) of a campaign.

    - in_first_look: mask of the cases that an earlier first look used; None at the first look
    - risk_fraction: fraction of the risk of a wrong verdict that this look may use; 1 if no looks were planned
    """

    in_first_look: Mask | None = None
    risk_fraction: float = 1.0


@dataclass(frozen=True)
class RateBounds:
    """Bounds of a success rate.

    - lower, upper: one-sided bounds, with their confidences `lower_confidence` and `upper_confidence`
    - consumer_risk: probability of this result or a better one if the true rate equals the required rate
    - further_cases: additional cases of the population without a failure for PASS; on new terrains if `clustered`
    - clustered: evidence from shared terrains; None if no terrain is shared
    """

    lower: float
    upper: float
    lower_confidence: float
    upper_confidence: float
    consumer_risk: float
    further_cases: int
    clustered: TerrainEvidence | None = None


def independent_bounds(success: Mask, member: Mask, required: RequiredRate, looks: Looks) -> RateBounds:
    """Compute the bounds of the success rate of a population (`member`) of independent cases, at least one."""
    n, failures = int(member.sum()), int((member & ~success).sum())
    if looks.in_first_look is None:
        confidence = confidence_at(required.confidence, looks.risk_fraction)
        bounds = _binomial_bounds(n, failures, required, (confidence, confidence))
        if looks.risk_fraction < 1.0:
            further = proportions.further_cases_needed(n, failures, required.probability, confidence)
            return replace(bounds, further_cases=further)
        first_n = n
    else:
        first_n = int((member & looks.in_first_look).sum())
    pass_test, fail_test = _sequential_tests(required, first_n)
    further = pass_test.cases_needed(n, failures) - n
    if looks.in_first_look is None:
        return replace(bounds, further_cases=further)
    confidences = 1.0 - pass_test.significance_level(n), 1.0 - fail_test.significance_level(n)
    return replace(_binomial_bounds(n, failures, required, confidences), further_cases=further)


def clustered_bounds(cases: ClusteredCases, required: RequiredRate, looks: Looks) -> RateBounds:
    """Compute the bounds of the success rate of a population of cases that share terrains, at least one case."""
    evidence, max_failure_rate = cases.count_terrains(), 1.0 - required.probability
    if looks.in_first_look is not None:
        return _bounds_at_later_look(cases, required, looks.in_first_look)
    confidence = confidence_at(required.confidence, looks.risk_fraction)
    risk = 1.0 - confidence
    if looks.risk_fraction < 1.0:
        further = cases.further_cases_needed(max_failure_rate, risk)
    else:
        # these cases would be evaluated at a later look
        terrains = int((cases.is_first_on_terrain & cases.member).sum())
        pass_test = _clustered_test(cases, np.ones_like(cases.member), max_failure_rate, required.risk)
        further = pass_test.cases_needed(terrains, min(evidence.failed_terrains, terrains)) - terrains
    return RateBounds(
        lower=1.0 - cases.max_failure_rate(risk),
        upper=1.0 - cases.min_failure_rate(risk),
        lower_confidence=confidence,
        upper_confidence=confidence,
        consumer_risk=cases.consumer_risk(max_failure_rate, risk),
        further_cases=further,
        clustered=evidence,
    )


def _bounds_at_later_look(cases: ClusteredCases, required: RequiredRate, in_first_look: Mask) -> RateBounds:
    """Compute the bounds at a look after the first: terrains are counted instead of cases."""
    evidence = cases.count_terrains()
    terrains = int((cases.is_first_on_terrain & cases.member).sum())
    failed = min(evidence.failed_terrains, terrains)
    pass_test, fail_test = (
        _clustered_test(cases, in_first_look, rate, required.risk)
        for rate in (1.0 - required.probability, required.probability)
    )
    confidences = 1.0 - pass_test.significance_level(terrains), 1.0 - fail_test.significance_level(terrains)
    successful = min(evidence.successful_terrains, terrains)
    return RateBounds(
        proportions.proportion_lower(terrains - failed, terrains, confidences[0]),
        proportions.proportion_upper(successful, terrains, confidences[1]),
        *confidences,
        consumer_risk=proportions.consumer_risk(terrains - failed, terrains, required.probability),
        further_cases=pass_test.cases_needed(terrains, failed) - terrains,
        clustered=evidence,
    )


def _clustered_test(cases: ClusteredCases, in_first_look: Mask, rate: float, risk: float) -> SequentialTest:
    """Create the test at looks after the first, for a rate of failures (PASS) or of successes (FAIL)."""
    sizes = count_sizes(np.bincount(cases.index[in_first_look]))
    first_n = int((cases.is_first_on_terrain & cases.member & in_first_look).sum())
    first_risk = attainable_risk(sizes, rate, risk)
    # this risk is known only if all cases belong to the population; otherwise it is at most the permitted risk
    return SequentialTest(rate, risk, first_n, first_risk if cases.member.all() or first_risk == 0.0 else risk)


def _sequential_tests(required: RequiredRate, first_n: int) -> tuple[SequentialTest, SequentialTest]:
    """Create the tests for PASS and for FAIL at looks after the first, for independent cases."""
    return (
        SequentialTest(1.0 - required.probability, required.risk, first_n),
        SequentialTest(required.probability, required.risk, first_n),
    )


def _binomial_bounds(n: int, failures: int, required: RequiredRate, confidences: tuple[float, float]) -> RateBounds:
    """Compute the bounds of n independent cases at the confidences of the lower and of the upper bound."""
    lower = proportions.proportion_lower(n - failures, n, confidences[0])
    upper = proportions.proportion_upper(n - failures, n, confidences[1])
    risk = proportions.consumer_risk(n - failures, n, required.probability)
    return RateBounds(lower, upper, *confidences, consumer_risk=risk, further_cases=0)
