"""Number of additional cases that would decide the undecided requirements of a campaign."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from marsyard.reports.statistics.proportions import minimum_sample_size, proportion_lower
from marsyard.reports.verdicts import ESTIMATE, Verdict
from marsyard.reports.wording import count

#: Confidence of the lower bound of the fraction of the cases that belong to a population; high, so that the stated
#: number of cases is sufficient.
_FRACTION_CONFIDENCE = 0.99


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
    return Remedy(number, f"{text}.{_new_campaign_text(populated, cases, cases + number)}")


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
