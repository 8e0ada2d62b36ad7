"""Bounds of the success rate of a requirement, and the additional cases that it needs, with regard to repeated looks.

A look is one evaluation of the verdict. Each planned look uses a fraction of the risk of a wrong verdict. Looks at a
campaign with appended cases use `SequentialTest`. If cases share terrains, its events are terrains with a failure, and
its number of cases is the number of terrains whose first case belongs to the population. A terrain has a failure at
least as often as its first case, so this is conservative.
"""

from dataclasses import dataclass, replace

import numpy as np

from marsyard.reports.case_evidence import Mask
from marsyard.reports.statistics import proportions
from marsyard.reports.statistics.clustered_cases import ClusteredCases
from marsyard.reports.statistics.clusters import attainable_risk, count_sizes, select_counted
from marsyard.reports.statistics.sequential import SequentialTest, confidence_at
from marsyard.reports.verdicts import Verdict


@dataclass(frozen=True)
class Looks:
    """Earlier and planned looks (evaluations) of a campaign.

    - in_first_look: mask of the cases that an earlier first look used; None at the first look
    - risk_fraction: fraction of the risk of a wrong verdict that this look may use; 1 if no looks were planned
    """

    in_first_look: Mask | None = None
    risk_fraction: float = 1.0


def add_independent_bounds(verdict: Verdict, success: Mask, member: Mask, looks: Looks) -> Verdict:
    """Add the bounds of the success rate of a population (`member`) of independent cases, at least one."""
    n, failures = int(member.sum()), int((member & ~success).sum())
    first_n = n if looks.in_first_look is None else int((member & looks.in_first_look).sum())
    risk = 1.0 - verdict.confidence
    # PASS shows that failures are rare enough, FAIL that successes are
    pass_test, fail_test = (
        SequentialTest(rate, risk, first_n) for rate in (1.0 - verdict.probability, verdict.probability)
    )
    if looks.in_first_look is not None:
        confidences = 1.0 - pass_test.significance_level(n), 1.0 - fail_test.significance_level(n)
    else:
        confidences = (confidence_at(verdict.confidence, looks.risk_fraction),) * 2
    if looks.in_first_look is None and looks.risk_fraction < 1.0:
        additional = proportions.additional_cases_needed(n, failures, verdict.probability, confidences[0])
    else:
        additional = pass_test.cases_needed(n, failures) - n
        verdict = replace(verdict, first_look_n=first_n)
    return _add_binomial_bounds(verdict, n, (n - failures, n - failures), confidences, additional)


def add_clustered_bounds(verdict: Verdict, cases: ClusteredCases, looks: Looks) -> Verdict:
    """Add the bounds of the success rate of a population of cases that share terrains, at least one case."""
    evidence, max_failure_rate = cases.count_terrains(), 1.0 - verdict.probability
    if looks.in_first_look is not None:
        return _add_bounds_at_later_look(verdict, cases, looks.in_first_look)
    confidence = confidence_at(verdict.confidence, looks.risk_fraction)
    risk = 1.0 - confidence
    if looks.risk_fraction < 1.0:
        additional = cases.additional_cases_needed(max_failure_rate, risk)
    else:
        # these cases would be evaluated at a later look
        terrains = int((cases.is_first_on_terrain & cases.member).sum())
        pass_test = _clustered_test(cases, np.ones_like(cases.member), max_failure_rate, 1.0 - verdict.confidence)
        additional = pass_test.cases_needed(terrains, min(evidence.failed_terrains, terrains)) - terrains
    return replace(
        verdict,
        lower=1.0 - cases.max_failure_rate(risk),
        upper=1.0 - cases.min_failure_rate(risk),
        bounds_confidence=confidence,
        upper_confidence=confidence,
        consumer_risk=cases.consumer_risk(max_failure_rate, risk),
        additional_cases=additional,
        clustered=evidence,
    )


def _add_bounds_at_later_look(verdict: Verdict, cases: ClusteredCases, in_first_look: Mask) -> Verdict:
    """Add the bounds at a look after the first: terrains are counted instead of cases."""
    evidence = cases.count_terrains()
    terrains = int((cases.is_first_on_terrain & cases.member).sum())
    failed = min(evidence.failed_terrains, terrains)
    pass_test, fail_test = (
        _clustered_test(cases, in_first_look, rate, 1.0 - verdict.confidence)
        for rate in (1.0 - verdict.probability, verdict.probability)
    )
    confidences = 1.0 - pass_test.significance_level(terrains), 1.0 - fail_test.significance_level(terrains)
    successes = terrains - failed, min(evidence.successful_terrains, terrains)
    additional = pass_test.cases_needed(terrains, failed) - terrains
    return replace(_add_binomial_bounds(verdict, terrains, successes, confidences, additional), clustered=evidence)


def _clustered_test(cases: ClusteredCases, in_first_look: Mask, rate: float, risk: float) -> SequentialTest:
    """Create the test at looks after the first, for a rate of failures (PASS) or of successes (FAIL)."""
    index = cases.index[in_first_look]
    sizes = count_sizes(np.bincount(index[select_counted(index)]))
    first_n = int((cases.is_first_on_terrain & cases.member & in_first_look).sum())
    first_risk = attainable_risk(sizes, rate, risk)
    # this risk is known only if all cases belong to the population; otherwise it is at most the permitted risk
    return SequentialTest(rate, risk, first_n, first_risk if cases.member.all() or first_risk == 0.0 else risk)


def _add_binomial_bounds(
    verdict: Verdict, n: int, successes: tuple[int, int], confidences: tuple[float, float], additional: int | None
) -> Verdict:
    """Add the bounds of n independent cases.

    - successes, confidences: those of the lower and of the upper bound
    - additional: additional cases for PASS
    """
    return replace(
        verdict,
        lower=proportions.proportion_lower(successes[0], n, confidences[0]),
        upper=proportions.proportion_upper(successes[1], n, confidences[1]),
        bounds_confidence=confidences[0],
        upper_confidence=confidences[1],
        consumer_risk=proportions.consumer_risk(successes[0], n, verdict.probability),
        additional_cases=additional,
    )
