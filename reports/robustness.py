"""Robust verdicts: the smallest change of the dispersions that turns PASS of a requirement into FAIL.

A change of one dispersion (`marsyard.reports.dispersion_changes`) weights the stored cases by the ratio of two
densities, so that no case is run. A change of all dispersions is any distribution of all random numbers whose
Kullback-Leibler divergence from the declared one is at most r. The largest failure rate q then has the binary
divergence r from the failure rate p of the declared distribution, q log(q / p) + (1 - q) log((1 - q) / (1 - p)) = r, in
any dimension. For a population with the rate m among all cases, the smallest divergence of all cases is
r = -log(1 - m + m exp(-r')), with the divergence r' of the two failure rates in the population.

The verdict under a change is that of its own rule: PASS while the upper bound of the failure rate
(`marsyard.reports.statistics.reweighted_rates`) is at most the permitted rate, FAIL if the lower bound is above it.
Both are at least as wide as the bounds of the verdict, in proportion, which are wider for shared terrains, for example.
The change to FAIL is where the estimated rate reaches the permitted rate. PASS is lost before, and FAIL shown after:
these two changes are the interval, each with the confidence of the requirement. Weights say nothing where they are
equivalent to fewer than 30 cases.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, cast

import numpy as np

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import CampaignDefinition
from marsyard.campaigns.json_numbers import Number
from marsyard.campaigns.sampling.dispersions import Choice
from marsyard.reports.case_evidence import CaseEvidence
from marsyard.reports.decision import collect_evidence
from marsyard.reports.dispersion_changes import (
    Change,
    ChangeKind,
    DispersedQuantity,
    draw_coordinates,
    list_changes,
    sign_of,
)
from marsyard.reports.sampling_design import SamplingDesign
from marsyard.reports.statistics.reweighted_rates import (
    Crossing,
    WeightedRates,
    find_crossing,
    population_divergence,
    weighted_rates,
)
from marsyard.reports.stored import StoredRun
from marsyard.reports.verdicts import ESTIMATE, Verdict
from marsyard.reports.wording import number, percent
from marsyard.scenarios.columns import split_unit, to_words

if TYPE_CHECKING:
    from marsyard.scenarios.interface import Scenario

#: Name of the parameter of a change of all dispersions at once.
ALL_DISPERSIONS = "all dispersions"


class ChangeOutcome(StrEnum):
    """What the cases say about a change to FAIL."""

    FOUND = "found"
    #: Fewer than 30 effective cases before the estimated rate reaches the permitted one.
    REFUSED = "refused"
    #: The estimated rate stays below the permitted one for all changes of this kind.
    NONE = "none"

    @classmethod
    def of(cls, crossing: Crossing, *, is_complete: bool) -> ChangeOutcome:
        """Return the outcome of a change; `is_complete`: whether the cases cover all changes of this kind."""
        if not math.isnan(crossing.change):
            return cls.FOUND
        return cls.NONE if is_complete else cls.REFUSED


@dataclass(frozen=True)
class Robustness:
    """Smallest change of one kind that turns PASS of a requirement into FAIL; unknown numbers are NaN.

    - parameter: path of the parameter; `value` in addition for a value of `choice`; `ALL_DISPERSIONS`
    - unit: unit of `assumed`, `spread`, `passes_at` and `fails_at`
    - assumed: declared mean, standard deviation (wider, narrower), probability (more frequent) or value
    - spread: assumed spread, the unit of the changes, in this unit: the declared standard deviation, that of the
      indicator of a value of `choice`, or the magnitude of the value of a parameter that is not dispersed. A
      divergence r is expressed by the shift sqrt(2 r) of one normal dispersion, which has this divergence
    - passes_at, fails_at: `assumed` after the changes `lower` and `change`
    - change: change to FAIL in assumed spreads; in standard deviations of z if mean or variance can be infinite
    - lower, upper: PASS holds below the change `lower`, FAIL is shown above `upper`, each at `confidence`
    - reach: largest change about which the cases say something
    - effective_cases: effective number of cases (terrains if they are shared) at `change`, or at `reach` without it
    """

    requirement: str
    parameter: str
    kind: ChangeKind
    unit: str
    assumed: Number
    spread: Number
    passes_at: Number
    fails_at: Number
    change: Number
    lower: Number
    upper: Number
    reach: Number
    effective_cases: Number
    confidence: Number
    outcome: ChangeOutcome
    value: str = ""

    @property
    def name(self) -> str:
        """The quantity that changes, in words."""
        words = f"{to_words(split_unit(self.parameter)[0])}{f' = {self.value}' if self.value else ''}"
        if self.kind in (ChangeKind.MEAN_UP, ChangeKind.MEAN_DOWN):
            return f"mean of {words}"
        return f"standard deviation of {words}" if self.kind in (ChangeKind.WIDER, ChangeKind.NARROWER) else words

    def format_value(self, value: float, change: float) -> str:
        """Format the quantity after a change, or the change in assumed spreads if the quantity has no number."""
        if self.kind is ChangeKind.MORE_FREQUENT:
            return percent(value)
        if math.isnan(value) or self.kind is ChangeKind.DIVERGENCE:
            sign = "−" if self.kind in (ChangeKind.MEAN_DOWN, ChangeKind.NARROWER) else "+"
            return f"{sign}{number(change)} spreads"
        return f"{number(value)} {self.unit}".rstrip()

    @property
    def pass_text(self) -> str:
        """The largest change for which PASS holds, in words; empty if it is not shown for any."""
        return "" if math.isnan(self.lower) else self._describe(self.passes_at, self.lower)

    @property
    def fail_text(self) -> str:
        """The estimated change to FAIL in words, with that for which PASS holds.

        Empty if no change shows FAIL: the estimate can then be due to chance.
        """
        if self.outcome is not ChangeOutcome.FOUND or math.isnan(self.upper):
            return ""
        passes = "not shown" if math.isnan(self.lower) else f"up to {self.format_value(self.passes_at, self.lower)}"
        return self._describe(self.fails_at, self.change, f"PASS {passes}")

    def _describe(self, value: float, change: float, addition: str = "") -> str:
        if self.kind is ChangeKind.DIVERGENCE:
            return f"any change of {self.name} up to a divergence of {number(value)} nat"
        assumed = "" if math.isnan(self.assumed) else f"{self.format_value(self.assumed, 0.0)} assumed"
        notes = "; ".join(filter(None, (assumed, addition)))
        return f"{self.name} {self.format_value(value, change)}{f' ({notes})' if notes else ''}"


def evaluate_robustness(
    run: StoredRun, verdicts: Sequence[Verdict], sampling: SamplingDesign
) -> tuple[Robustness, ...]:
    """Compute the robustness of each requirement that is met by the rate of the cases (`select_met`).

    Empty for cases that are not independent random draws. Above 50,000 cases, the first 20,000 are used.
    """
    met = select_met(verdicts)
    frame = sampling.exclude_nominal_case(run.frame)
    if not met or not sampling.independent or "case" not in frame:
        return ()
    campaign = read_campaign(run)
    requirements = {str(item.get("id")): item for item in run.requirements}
    # unfinished cases count as failures, also in populations of answers
    evidence = [
        (item, cases.with_unfinished)
        for item in met
        if (cases := collect_evidence(frame, requirements[item.requirement_id], sampling, has_own_terrains=True))
    ]
    records = [_divergence(*item) for item in evidence]
    if campaign is not None and campaign.drawn_paths:
        case_numbers = frame["case"].to_numpy(dtype=np.int64)
        coordinates = draw_coordinates(campaign, case_numbers)
        for index, path in enumerate(campaign.drawn_paths):
            quantity = DispersedQuantity.of(campaign, path, int(case_numbers[0]))
            for change in list_changes(quantity.dispersion, coordinates[:, index]):
                if (sizes := quantity.sizes(change)) is not None:
                    scaled = replace(change, sizes=sizes)
                    records += [_find_change(path, quantity, scaled, *item) for item in evidence]
    order = {verdict.requirement_id: index for index, verdict in enumerate(met)}
    return tuple(sorted(records, key=lambda item: (order[item.requirement], sort_key(item))))


def select_met(verdicts: Sequence[Verdict]) -> list[Verdict]:
    """Select the requirements that the rate of the cases meets, also if the cases are too few or exclude PASS.

    Campaigns that are not finished have no bounds and are omitted.
    """
    return [item for item in verdicts if item.estimate >= item.probability and not math.isnan(item.lower)]


def sort_key(item: Robustness) -> tuple[int, float]:
    """Sort changes of parameters that show FAIL first, by their size, then the others by that for which PASS holds."""
    if item.fail_text or item.kind is ChangeKind.VALUE:
        return 0 if item.kind is ChangeKind.VALUE else 1, item.change
    sizes = (size for size in (item.lower, item.change, math.inf) if not math.isnan(size))
    return 2, next(sizes)


def read_campaign(run: StoredRun) -> Campaign | None:
    """Read the campaign of a stored run for its draws; None if its definition is invalid, or its rows have other draws.

    The scenario, which may be code of the folder's author, is not imported: draws do not need it.
    """
    try:
        campaign = Campaign(CampaignDefinition.model_validate(run.definition), cast("Scenario", None))
        for _, row in run.frame.iloc[[0, -1]].iterrows():
            for path, value in campaign.draws(int(row["case"])).items():
                stored = row.get(path)
                if isinstance(value, float) and isinstance(stored, float) and not math.isclose(value, stored):
                    return None
    except (ValueError, IndexError):
        return None
    return campaign


def change_rates(verdict: Verdict, cases: CaseEvidence, change: Change) -> WeightedRates:
    """Compute failure rates of a requirement under changes, with bounds at least as wide as those of its verdict."""
    member = cases.member
    groups = cases.groups[member] if cases.groups is not None and cases.clustered else None
    largest = 1 if groups is None else int(np.bincount(groups).max())
    rates = weighted_rates(
        change.weights[:, member],
        ~cases.success[member],
        groups,
        (verdict.upper_confidence, verdict.bounds_confidence),
        change.max_weights * largest,
        change.efficiency,
    )
    lower, upper = 1.0 - verdict.upper, 1.0 - verdict.lower
    return replace(
        rates,
        lower=rates.lower * min(lower / rates.lower[0], 1.0) if rates.lower[0] > 0.0 else rates.lower,
        upper=np.minimum(rates.upper * max(upper / rates.upper[0], 1.0), 1.0),
    )


def _find_change(
    path: str, quantity: DispersedQuantity, change: Change, verdict: Verdict, cases: CaseEvidence
) -> Robustness:
    """Find the smallest change of one kind of a dispersion that turns PASS into FAIL."""
    rates, by_rate = change_rates(verdict, cases, change), verdict.decide_by == ESTIMATE
    crossing = find_crossing(change.sizes, rates, 1.0 - verdict.probability, decides_by_rate=by_rate)
    dispersion, is_choice = quantity.dispersion, isinstance(quantity.dispersion, Choice)
    if is_choice:
        weights = dispersion.weights or [1.0] * len(dispersion.values)
        assumed = weights[change.value] / sum(weights)
        spread = math.sqrt(assumed * (1.0 - assumed))
    else:
        mean, spread = quantity.declared if quantity.is_absolute else (math.nan, math.nan)
        assumed = mean if change.kind in (ChangeKind.MEAN_UP, ChangeKind.MEAN_DOWN) else spread
    step = sign_of(change.kind) * spread
    is_complete = is_choice and crossing.reach == float(change.sizes[-1])
    unit = "" if is_choice else split_unit(path)[1] if dispersion.unit is None else dispersion.unit
    return Robustness(
        verdict.requirement_id, path, change.kind, unit, assumed=assumed, spread=spread,
        passes_at=assumed + step * crossing.lower, fails_at=assumed + step * crossing.change,
        confidence=verdict.confidence, outcome=ChangeOutcome.of(crossing, is_complete=is_complete),
        value=str(dispersion.values[change.value]) if is_choice else "", **asdict(crossing),
    )  # fmt: skip


def _divergence(verdict: Verdict, cases: CaseEvidence) -> Robustness:
    """Find the divergence of all dispersions that turns PASS into FAIL, from the bounds without a change."""
    none = Change(ChangeKind.DIVERGENCE, np.zeros(1), np.ones((1, cases.member.size)), np.ones(1))
    rates, permitted = change_rates(verdict, cases, none), 1.0 - verdict.probability
    groups = cases.groups if cases.clustered else None
    # rate of the population among all cases, of which each bound is the worse one
    confidences = verdict.bounds_confidence, verdict.upper_confidence
    members = weighted_rates(none.weights, cases.member, groups, confidences)
    if verdict.population == "all":
        members = WeightedRates(*(np.ones(1),) * 4)
    pairs = ((rates.estimate, members.estimate), (rates.upper, members.lower), (rates.lower, members.upper))
    radii = [population_divergence(permitted, float(rate[0]), float(member[0])) for rate, member in pairs]
    change, lower, upper = (math.sqrt(2.0 * radius) if math.isfinite(radius) else math.nan for radius in radii)
    lower = change if verdict.decide_by == ESTIMATE else lower or math.nan  # 0 without PASS
    crossing = Crossing(change, lower, upper, math.nan, float(rates.effective_units[0]))
    outcome = ChangeOutcome.of(crossing, is_complete=False)
    return Robustness(
        verdict.requirement_id, ALL_DISPERSIONS, ChangeKind.DIVERGENCE, "nat", assumed=0.0, spread=1.0,
        passes_at=0.5 * lower**2, fails_at=0.5 * change**2, confidence=verdict.confidence, outcome=outcome,
        **asdict(crossing),
    )  # fmt: skip
