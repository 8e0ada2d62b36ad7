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
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import CampaignDefinition
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
from marsyard.reports.robustness import ALL_DISPERSIONS, ChangeOutcome, Robustness, sort_key
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
from marsyard.scenarios.columns import split_unit

if TYPE_CHECKING:
    from marsyard.scenarios.interface import Scenario


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
        (verdict, part.with_unfinished)
        for verdict in met
        if (part := collect_evidence(frame, requirements[verdict.requirement_id], sampling, has_own_terrains=True))
    ]
    records = [_find_divergence(verdict, cases) for verdict, cases in evidence]
    if campaign is not None and campaign.drawn_paths:
        case_numbers = frame["case"].to_numpy(dtype=np.int64)
        coordinates = draw_coordinates(campaign, case_numbers)
        for index, path in enumerate(campaign.drawn_paths):
            if path.rpartition(".")[2] == "terrain":
                continue  # the number of a terrain is a name, which has neither mean nor standard deviation
            quantity = DispersedQuantity.of(campaign, path, int(case_numbers[0]))
            for change in list_changes(quantity.dispersion, coordinates[:, index]):
                if (sizes := quantity.sizes(change)) is not None:
                    scaled = replace(change, sizes=sizes)
                    records += [_find_change(path, quantity, scaled, verdict, cases) for verdict, cases in evidence]
    order = {verdict.requirement_id: index for index, verdict in enumerate(met)}
    return tuple(sorted(records, key=lambda item: (order[item.requirement], sort_key(item))))


def select_met(verdicts: Sequence[Verdict]) -> list[Verdict]:
    """Select the requirements that the rate of the cases meets, also if the cases are too few or exclude PASS.

    Campaigns that are not finished have no bounds and are omitted.
    """
    return [item for item in verdicts if item.estimate >= item.probability and not math.isnan(item.lower)]


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
    # the first change has the size 0: its bounds are compared with those of the verdict
    verdict_lower, unchanged_lower = 1.0 - verdict.upper, rates.lower[0]
    verdict_upper, unchanged_upper = 1.0 - verdict.lower, rates.upper[0]
    lower_factor = min(verdict_lower / unchanged_lower, 1.0) if unchanged_lower > 0.0 else 1.0
    upper_factor = max(verdict_upper / unchanged_upper, 1.0)
    return replace(rates, lower=rates.lower * lower_factor, upper=np.minimum(rates.upper * upper_factor, 1.0))


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


class _FailureAndMembership(NamedTuple):
    """Failure rate in the population of a requirement, and the rate of this population among all cases."""

    failure_rate: float
    member_rate: float

    def shift_to(self, failure_rate: float) -> float:
        """Return the shift of one normal dispersion with the divergence that leads to a failure rate; NaN if none."""
        divergence = population_divergence(failure_rate, self.failure_rate, self.member_rate)
        return math.sqrt(2.0 * divergence) if math.isfinite(divergence) else math.nan


def _find_divergence(verdict: Verdict, cases: CaseEvidence) -> Robustness:
    """Find the divergence of all dispersions that turns PASS into FAIL, from the bounds without a change.

    The divergence is small for a large failure rate and for a small population, so that each of its bounds is computed
    from opposite bounds of these two rates.
    """
    unchanged = Change(ChangeKind.DIVERGENCE, np.zeros(1), np.ones((1, cases.member.size)), np.ones(1))
    failures, members = change_rates(verdict, cases, unchanged), _member_rates(verdict, cases, unchanged)
    estimated = _FailureAndMembership(float(failures.estimate[0]), float(members.estimate[0]))
    nearest = _FailureAndMembership(float(failures.upper[0]), float(members.lower[0]))
    farthest = _FailureAndMembership(float(failures.lower[0]), float(members.upper[0]))
    permitted = 1.0 - verdict.probability
    change, lower, upper = (rates.shift_to(permitted) for rates in (estimated, nearest, farthest))
    if verdict.decide_by == ESTIMATE:
        lower = change
    elif lower == 0.0:  # the upper bound of the failure rate is above the permitted rate: no PASS to lose
        lower = math.nan
    crossing = Crossing(change, lower, upper, math.nan, float(failures.effective_units[0]))
    outcome = ChangeOutcome.of(crossing, is_complete=False)
    return Robustness(
        verdict.requirement_id, ALL_DISPERSIONS, ChangeKind.DIVERGENCE, "nat", assumed=0.0, spread=1.0,
        passes_at=0.5 * lower**2, fails_at=0.5 * change**2, confidence=verdict.confidence, outcome=outcome,
        **asdict(crossing),
    )  # fmt: skip


def _member_rates(verdict: Verdict, cases: CaseEvidence, change: Change) -> WeightedRates:
    """Compute the rate of the requirement's population among all cases; exactly 1 for the population of all cases."""
    if verdict.population == "all":
        one = np.ones(1)
        return WeightedRates(estimate=one, lower=one, upper=one, effective_units=one)
    groups = cases.groups if cases.clustered else None
    # the lower bound belongs to the upper bound of the failure rate, and has its confidence; likewise the upper one
    confidences = verdict.bounds_confidence, verdict.upper_confidence
    return weighted_rates(change.weights, cases.member, groups, confidences)
