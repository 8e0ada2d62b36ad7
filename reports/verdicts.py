"""Verdicts on requirements: status, bounds, number of additional cases needed, and their explanation.

A requirement specifies that `|metric| <= bound`, or a true column, holds for a fraction of a population at a
confidence. Its status follows from one-sided bounds of the success rate, which allow for shared terrains and repeated
evaluations (`marsyard.reports.bounds`). MET BY RATE: the requirement has `decide_by = "estimate"`, and the observed
rate is sufficient, but the lower bound is not. Cases that are not independent random samples (Latin hypercube, Sobol,
grids) have no bounds; requirements with `decide_by = "estimate"` can still be decided.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum

from marsyard.campaigns.json_numbers import Number
from marsyard.reports.statistics.clustered_cases import TerrainEvidence
from marsyard.reports.wording import count, format_fraction, percent, population_text

#: Beginning of the statement of a requirement whose population the flight system cannot know.
GIVEN_TRUTH = "Given truth"
#: Value of a requirement's `decide_by`: compare the observed rate with the required probability.
ESTIMATE = "estimate"


class Status(StrEnum):
    """Result of the evaluation of a requirement, the most severe first."""

    FAIL = "FAIL"
    INSUFFICIENT = "INSUFFICIENT"
    MET_BY_RATE = "MET BY RATE"
    #: PASS of rows without a chain of hashes, which shows whether rows were changed.
    UNVERIFIED = "PASS (unverified)"
    #: PASS of a confirmation whose record of earlier runs is missing, broken or not registered.
    UNREGISTERED = "PASS (unregistered)"
    #: PASS of a confirmation after other claims about the same campaign without PASS.
    OTHER_CLAIMS = "PASS (other claims)"
    PASS = "PASS"  # noqa: S105  (a verdict, not a password)

    @property
    def is_qualified(self) -> bool:
        """Whether it is PASS that needs a decision of a person."""
        return self in (Status.UNVERIFIED, Status.UNREGISTERED, Status.OTHER_CLAIMS)

    @property
    def is_met(self) -> bool:
        """Whether the requirement is met, also if only by the observed rate or with a qualification."""
        return self not in (Status.FAIL, Status.INSUFFICIENT)


@dataclass(frozen=True)
class AllCases:
    """Result of a requirement on all cases instead of its population; the numbers are defined as in `Verdict`.

    Cases without a value of the metric are failures. `configured` are the conditions that remain, because the
    definition of a case determines them; empty for all cases of the campaign.
    """

    status: Status
    n: int
    failures: int
    estimate: Number
    lower: Number
    upper: Number
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
    - n: number of cases of the population
    - failures: cases with a missing, NaN or too large metric, unfinished cases, cases with a missing population flag
    - estimate, lower, upper: success rate and its one-sided bounds; NaN for no cases; no bounds for other designs
    - additional_cases: those without failure for PASS, on new terrains if terrains are shared; None if unknown
    - first_look_n: number of cases of the population at the first look; None if looks are planned
    - consumer_risk: probability of this result or a better one if the true rate equals the required rate
    - reason: why the requirement is not evaluated, or why the verdict is withheld
    - advice: why more cases cannot lead to PASS, and which change of the campaign can
    - scale: factor of the metric before it is compared with the bound
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
    bound: Number
    probability: Number
    confidence: Number
    population: str
    status: Status = Status.INSUFFICIENT
    n: int = 0
    failures: int = 0
    estimate: Number = math.nan
    lower: Number = math.nan
    upper: Number = math.nan
    additional_cases: int | None = None
    first_look_n: int | None = None
    decide_by: str = "confidence"
    reason: str = ""
    terrains: int | None = None
    clustered: TerrainEvidence | None = None
    consumer_risk: Number = math.nan
    plain_lower: Number = math.nan
    plain_upper: Number = math.nan
    bounds_confidence: Number = math.nan
    upper_confidence: Number = math.nan
    advice: str = ""
    accept_rate: bool = False
    withheld_status: Status | None = None
    all_cases: AllCases | None = None
    definitions: str = ""
    joint_text: str = ""
    source: str = ""
    kind: str = ""
    scale: Number = 1.0

    def withhold(self, reason: str) -> Verdict:
        """Return the verdict INSUFFICIENT for a reason that more cases cannot change."""
        return replace(self, status=Status.INSUFFICIENT, reason=reason, additional_cases=None)

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
        failed = "1 has a failure" if evidence.failed_terrains == 1 else f"{evidence.failed_terrains:,} have a failure"
        text = f"The {count(self.n, 'case')} lie on {count(evidence.terrains, 'terrain')}, of which {failed}"
        if evidence.failure_pairs:
            text += f" ({count(evidence.failure_pairs, 'pair')} of failures on one terrain)"
        text += ". The bounds hold for every distribution of failure rates over terrains."
        if evidence.counted:
            first = "first case" if evidence.counted == 1 else f"first {evidence.counted} cases"
            text += f" They use the {first} of each terrain."
        if self.plain_status is not None and self.plain_status is not self.status:
            text += f" For independent cases the lower bound would be {percent(self.plain_lower)}: {self.plain_status}."
        if self.additional_cases and self.decide_by != ESTIMATE:
            cases = count(self.additional_cases, "additional case")
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


def min_cases_for_rate(probability: float) -> int:
    """Minimum number of cases for MET BY RATE: 1 / (1 - probability), of which one may fail."""
    # the tolerance is for rounding errors: 1 / (1 - 0.9) is 10.000000000000002, which must result in 10
    return math.ceil(1.0 / (1.0 - probability) - 1e-9)


def compare_bounds(lower: float, upper: float, probability: float) -> Status:
    """Compare bounds of a success rate with the required rate."""
    if lower >= probability:
        return Status.PASS
    return Status.FAIL if upper < probability else Status.INSUFFICIENT


def find_bound(verdicts: Iterable[Verdict], metric: str | None) -> float | None:
    """Find the bound of the first requirement on a metric that has one, in the unit of the metric's column."""
    bounds = (item.bound / item.scale for item in verdicts if item.metric == metric)
    return next((bound for bound in bounds if math.isfinite(bound)), None)
