"""Verdict of a campaign with several requirements: overall verdict, exit status, and joint risk of false PASSes.

An undecided campaign also has a remedy: the additional cases that would decide it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import pandas as pd

from marsyard.campaigns.definition.evidence import Evidence, EvidenceKind
from marsyard.reports.populations import engine_failed, repeated_mask
from marsyard.reports.sampling_design import INDEPENDENT, SamplingDesign
from marsyard.reports.statistics.proportions import minimum_sample_size, proportion_lower
from marsyard.reports.statistics.sequential import SequentialTest
from marsyard.reports.verdicts import ESTIMATE, Status, Verdict
from marsyard.reports.wording import count, format_fraction, percent

#: Confidence of the lower bound of the fraction of the cases that belong to a population; high, so that the stated
#: number of cases is sufficient.
_FRACTION_CONFIDENCE = 0.99
#: Rate of failures, as a fraction of the permitted rate, above which the number of cases for PASS is not stated: it
#: grows without limit as the fraction approaches 1.
_NEAR_LIMIT = 0.95


@dataclass(frozen=True)
class Remedy:
    """Additional cases that decide all undecided requirements without a failure.

    - cases: number of cases to append; None if more cases do not help, or their number is unknown
    - text: explanation; may be empty
    """

    cases: int | None = None
    text: str = ""


def find_remedy(verdicts: Sequence[Verdict], cases: int) -> Remedy:
    """Find how many additional cases would decide all requirements, or why more cases cannot.

    The number accounts for cases outside of the population of a requirement (cases without an answer, for example).
    cases: number of cases of the campaign
    """
    verdict_with_advice = next((verdict for verdict in verdicts if verdict.advice), None)
    if verdict_with_advice is not None:
        return Remedy(None, verdict_with_advice.advice)
    undecided_verdicts = [verdict for verdict in verdicts if verdict.additional_cases is not None]
    if not undecided_verdicts:
        return Remedy()
    populated = [verdict for verdict in undecided_verdicts if verdict.n]
    if len(populated) < len(undecided_verdicts):
        largest = max(undecided_verdicts, key=lambda verdict: verdict.additional_cases or 0)
        return Remedy(None, f"{_needed_text(largest)}, all without a failure, would be enough.")
    numbers = [_cases_for(verdict, verdict.additional_cases or 0, cases) for verdict in populated]
    number, largest = max(numbers), populated[numbers.index(max(numbers))]
    text = f"{_needed_text(largest)}, all without a failure, would be enough"
    if largest.population != "all":
        text += f": about {count(number, 'case')}, of which some do not belong to the population"
    at_rate = "".join(_text_at_observed_rate(verdict) for verdict in populated)
    return Remedy(number, f"{text}.{at_rate}{_new_campaign_text(populated, cases, cases + number)}")


def _text_at_observed_rate(verdict: Verdict) -> str:
    """State the cases that lead to PASS if failures continue at their rate so far; empty if unknown, or without any."""
    if not verdict.failures or verdict.clustered is not None or verdict.decide_by == ESTIMATE:
        return ""
    if verdict.first_look_n is None:
        return ""
    rate, allowed = verdict.failures / verdict.n, 1.0 - verdict.probability
    text = f" If failures of {verdict.requirement_id} continue at their rate so far ({percent(rate)})"
    if rate > _NEAR_LIMIT * allowed:
        return f"{text}, more cases are not expected to lead to PASS: it permits {percent(allowed)}."
    test = SequentialTest(allowed, 1.0 - verdict.confidence, verdict.first_look_n)
    return f"{text}, about {test.cases_needed(verdict.n, verdict.failures, rate) - verdict.n:,} more are needed."


def _needed_text(verdict: Verdict) -> str:
    """Describe the additional cases of the population of a requirement."""
    population = f" of the population of {verdict.requirement_id}" if verdict.population != "all" else ""
    terrain_text = "" if verdict.clustered is None else ", each on a new terrain"
    return f"{count(verdict.additional_cases or 0, 'additional case')}{population}{terrain_text}"


def _cases_for(verdict: Verdict, needed: int, cases: int) -> int:
    """Compute the cases that contain `needed` cases of a population, from the lower bound of its fraction so far."""
    if verdict.population == "all":
        return needed
    return math.ceil(needed / proportion_lower(verdict.n, cases, _FRACTION_CONFIDENCE))


def _new_campaign_text(verdicts: Sequence[Verdict], cases: int, total: int) -> str:
    """State the cases of a new campaign with one look, if it needs fewer than `total`.

    Empty after a failure, because a new campaign would discard it.
    """
    if any(verdict.failures or verdict.decide_by == ESTIMATE for verdict in verdicts):
        return ""
    needed = max(
        _cases_for(verdict, minimum_sample_size(verdict.probability, verdict.confidence), cases) for verdict in verdicts
    )
    if needed >= total:
        return ""
    design = "a new seed"
    if any(verdict.clustered is not None for verdict in verdicts):
        design += ", and a terrain for each case,"
    needed_text = f"{count(needed, 'case')} (-n {needed})"
    return f" A new campaign with {design} needs only {needed_text}, because it has one look."


#: Headline of an exploration that meets all requirements: it is no confirmation.
EXPLORATORY_PASS = "PASS (exploration)"  # noqa: S105  (a verdict, not a password)
#: Exit status of PASS with a qualification.
QUALIFIED_EXIT_CODE = 4


def describe_status(status: Status, *, is_exploration: bool) -> str:
    """Return the word for a status; PASS of an exploration is marked."""
    return EXPLORATORY_PASS if status is Status.PASS and is_exploration else str(status)


@dataclass(frozen=True)
class OverallVerdict:
    """Verdict of a campaign.

    - status: worst status of the requirements, or status of a study; None without requirements or without a verdict
    - crashed: number of crashed cases
    - sentence: explanation
    - without_status: headline if `status` is None
    - is_exploration: whether the run is an exploration, which the headline of PASS states
    - additional_cases: additional cases, all without a failure, that would decide the campaign; None if unknown
    - repeated: number of cases that finished only in a second attempt
    """

    status: Status | None
    crashed: int
    sentence: str
    without_status: str = "NO REQUIREMENT"
    is_exploration: bool = False
    additional_cases: int | None = None
    repeated: int = 0

    @property
    def word(self) -> str:
        """The headline."""
        if self.status is None:
            return self.without_status
        return describe_status(self.status, is_exploration=self.is_exploration)


def combine_verdicts(
    verdicts: Sequence[Verdict],
    frame: pd.DataFrame,
    sampling: SamplingDesign = INDEPENDENT,
    evidence: Evidence | None = None,
) -> OverallVerdict:
    """Return the worst of the verdicts: FAIL, INSUFFICIENT, MET BY RATE, PASS with a qualification, PASS."""
    overall = _combine_verdicts(verdicts, frame, sampling, evidence)
    repeated = int(repeated_mask(frame).sum())
    text = f" {count(repeated, 'case')} finished only in a second attempt." if repeated else ""
    return replace(overall, sentence=overall.sentence + text, repeated=repeated)


def _combine_verdicts(
    verdicts: Sequence[Verdict], frame: pd.DataFrame, sampling: SamplingDesign, evidence: Evidence | None
) -> OverallVerdict:
    """Combine the verdicts, without the number of repeated cases."""
    crashed = int(engine_failed(frame).sum())
    statuses = [verdict.status for verdict in verdicts]
    crash_text = f" {count(crashed, 'case')} crashed." if crashed else ""
    if not statuses:
        return OverallVerdict(None, crashed, "The campaign has no requirement." + crash_text)
    worst = next(status for status in Status if status in statuses)
    if not sampling.independent:
        rate_statuses = [verdict.status for verdict in verdicts if verdict.decide_by == ESTIMATE and verdict.n]
        met_text = f"{rate_statuses.count(Status.MET_BY_RATE)} of {count(len(rate_statuses), 'requirement')}"
        rate_text = f"{met_text} met by the rate of these cases. " if rate_statuses else ""
        return OverallVerdict(worst, crashed, rate_text + sampling.no_probability_reason + crash_text)
    n_withheld = sum(verdict.withheld_status is not None for verdict in verdicts)
    if n_withheld and worst is Status.INSUFFICIENT:
        would_be_met = f"{n_withheld} of {count(len(statuses), 'requirement')} would be met."
        reason = "" if evidence is None else f" {evidence.text}"
        return OverallVerdict(worst, crashed, f"{would_be_met}{reason}{crash_text}")
    worst_count, total = statuses.count(worst), count(len(statuses), "requirement")
    fraction = f"{worst_count} of {total}"
    undecided = fraction if worst_count < len(statuses) else f"any of the {total}"
    undecided = "the requirement" if len(statuses) == 1 else undecided
    n_undecided = statuses.count(Status.INSUFFICIENT)
    undecided_text = f", {n_undecided} undecided" if n_undecided else ""
    decided = "".join(
        f" {verdict.requirement_id} is {verdict.status}." for verdict in verdicts if verdict.status.is_met
    )
    remedy = find_remedy(verdicts, len(frame))
    remedy_text = f" {remedy.text}" if remedy.text else ""
    if sampling.max_cases is not None:
        # appended cases would be a look that was not planned
        limit = count(sampling.max_cases, "case")
        remedy_text = f" Looks are planned up to {limit}; a new campaign, with a new seed, can permit more."
    sentence = {
        Status.PASS: f"{count(len(statuses), 'requirement')} met.",
        Status.MET_BY_RATE: f"{fraction} met by the rate only, not at the required confidence.",
        Status.UNVERIFIED: f"{fraction} met, but the rows are not verified: the folder has no cases.sqlite.",
        Status.UNREGISTERED: f"{fraction} met, but no registered record shows the earlier runs.",
        Status.OTHER_CLAIMS: f"{fraction} met, after other claims about this campaign that did not pass.",
        Status.FAIL: f"{fraction} not met{undecided_text}.",
        Status.INSUFFICIENT: f"{count(len(frame), 'case')} are too few to decide {undecided}.{decided}{remedy_text}",
    }[worst]
    is_exploration = evidence is not None and evidence.kind is EvidenceKind.EXPLORATION
    additional_cases = remedy.cases if worst is Status.INSUFFICIENT and sampling.max_cases is None else None
    return OverallVerdict(
        worst, crashed, sentence + crash_text, is_exploration=is_exploration, additional_cases=additional_cases
    )


def compute_exit_code(verdicts: Sequence[Verdict], crashed: bool) -> int:
    """Return the exit code: 1 for a failed requirement or a crashed case, 3 for an undecided one, 0 otherwise.

    MET BY RATE results in 3, unless the requirement has `accept_rate`; PASS with a qualification results in 4.
    """
    if crashed or any(verdict.status is Status.FAIL for verdict in verdicts):
        return 1
    has_rate_verdict = any(verdict.status is Status.MET_BY_RATE and not verdict.accept_rate for verdict in verdicts)
    if has_rate_verdict or any(verdict.status is Status.INSUFFICIENT for verdict in verdicts):
        return 3
    return QUALIFIED_EXIT_CODE if any(verdict.status.is_qualified for verdict in verdicts) else 0


def multiplicity_text(verdicts: Sequence[Verdict]) -> str:
    """State the expected number of false PASSes and the joint confidence; empty for fewer than two requirements.

    A requirement that is not met gets PASS with a probability of at most 1 - confidence (consumer's risk). The expected
    number of false PASSes is at most the sum of these risks, for any dependence between the requirements; by Boole's
    inequality this sum also bounds the probability of at least one false PASS.
    """
    risks = [1.0 - item.confidence for item in verdicts if item.n and item.decide_by != ESTIMATE]
    # NaN and confidences outside of 0 to 1 are invalid requirements, whose verdict is not PASS
    risks = [risk for risk in risks if 0.0 < risk < 1.0]
    expected = sum(risks)
    if len(risks) < 2:
        return ""
    text = (
        f"{len(risks):,} requirements are decided at a confidence: if none is met, up to {expected:.2g} false "
        "PASSes are expected among them"
    )
    if expected >= 1.0 - 1e-9:
        return f"{text}. A single PASS of these is weak evidence."
    return f"{text}. Their PASSes hold together with at least {format_fraction(1.0 - expected)} confidence."
