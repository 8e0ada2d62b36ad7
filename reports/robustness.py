"""Robust verdicts: the smallest change of the dispersions that turns PASS of a requirement into FAIL.

Each random dispersion is a function of a standard normal variable z (`marsyard.campaigns.sampling.study_points`). A
change replaces the distribution of z for one dispersion; the distribution of all other random numbers, given this one,
stays as declared. The stored cases are weighted by the ratio of the two densities, so that no case is run:

- mean up, mean down: N(d, 1) and N(-d, 1). A normal dispersion is shifted by d standard deviations; the values of a
  bounded one stay within its range, where cases exist.
- wider, narrower: N(0, s^2). The standard deviation of a normal dispersion is multiplied by s.
- more frequent: the probability P of a value of `choice` becomes P + a (1 - P).
- all dispersions: any distribution of all random numbers whose Kullback-Leibler divergence from the declared one is at
  most r. The largest failure rate q then has the binary divergence r from the failure rate p of the declared
  distribution, q log(q / p) + (1 - q) log((1 - q) / (1 - p)) = r, in any dimension.

The verdict under a change is that of its own rule: PASS while the upper bound of the failure rate
(`marsyard.reports.statistics.weighted`) is at most the permitted rate, FAIL if the lower bound is above it. The change
to FAIL is where the estimated rate reaches the permitted rate. PASS is lost before, and FAIL shown after: these two
changes are the interval, each with the confidence of the requirement. Weights say nothing where they are equivalent to
fewer than 30 cases.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from jaxtyping import Float64
from scipy.special import ndtr, ndtri, rel_entr

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import CampaignDefinition
from marsyard.campaigns.json_numbers import Number
from marsyard.campaigns.sampling.correlation import MAX_DRAW, MIN_DRAW
from marsyard.campaigns.sampling.dispersions import Choice
from marsyard.reports.case_evidence import CaseEvidence
from marsyard.reports.decision import collect_evidence
from marsyard.reports.sampling_design import SamplingDesign
from marsyard.reports.statistics.weighted import (
    MIN_EFFECTIVE,
    Changes,
    Crossing,
    WeightedRates,
    find_crossing,
    weighted_rates,
)
from marsyard.reports.stored import StoredRun
from marsyard.reports.verdicts import ESTIMATE, Verdict
from marsyard.reports.wording import format_fraction, number, percent
from marsyard.scenarios.columns import split_unit, to_words

if TYPE_CHECKING:
    from marsyard.scenarios.interface import Scenario

#: Name of the parameter of a change of all dispersions at once.
ALL_DISPERSIONS = "all dispersions"
#: Number of evaluated sizes of a change; between them, rates are interpolated.
_STEPS = 41
#: Nodes of the quadrature of means and standard deviations of dispersions.
_NODES, _NODE_WEIGHTS = np.polynomial.hermite_e.hermegauss(31)


class Kind(StrEnum):
    """Kind of a change, see above; VALUE: another value of a parameter that the campaign does not disperse."""

    MEAN_UP = "mean up"
    MEAN_DOWN = "mean down"
    WIDER = "wider"
    NARROWER = "narrower"
    MORE_FREQUENT = "more frequent"
    DIVERGENCE = "divergence"
    VALUE = "value"


class Outcome(StrEnum):
    """What the cases say about a change to FAIL."""

    FOUND = "found"
    #: Fewer than 30 effective cases before the estimated rate reaches the permitted one.
    REFUSED = "refused"
    #: The estimated rate stays below the permitted one for all changes of this kind.
    NONE = "none"

    @classmethod
    def of(cls, crossing: Crossing, *, is_complete: bool) -> Outcome:
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
    - change: change to FAIL in assumed spreads
    - lower, upper: PASS holds below the change `lower`, FAIL is shown above `upper`, each at `confidence`
    - reach: largest change about which the cases say something
    - effective_cases: effective number of cases (terrains if they are shared) at `change`, or at `reach` without it
    """

    requirement: str
    parameter: str
    kind: Kind
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
    outcome: Outcome
    value: str = ""

    @property
    def name(self) -> str:
        """The quantity that changes, in words."""
        words = f"{to_words(split_unit(self.parameter)[0])}{f' = {self.value}' if self.value else ''}"
        if self.kind in (Kind.MEAN_UP, Kind.MEAN_DOWN):
            return f"mean of {words}"
        return f"standard deviation of {words}" if self.kind in (Kind.WIDER, Kind.NARROWER) else words

    def format_value(self, value: float, change: float) -> str:
        """Format the quantity after a change, or the change in assumed spreads if the quantity has no number."""
        if self.kind is Kind.MORE_FREQUENT:
            return percent(value)
        if math.isnan(value) or self.kind is Kind.DIVERGENCE:
            sign = "−" if self.kind in (Kind.MEAN_DOWN, Kind.NARROWER) else "+"
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
        if self.outcome is not Outcome.FOUND or math.isnan(self.upper):
            return ""
        passes = "not shown" if math.isnan(self.lower) else f"up to {self.format_value(self.passes_at, self.lower)}"
        return self._describe(self.fails_at, self.change, f"PASS {passes}")

    def _describe(self, value: float, change: float, addition: str = "") -> str:
        if self.kind is Kind.DIVERGENCE:
            return f"any change of {self.name} up to a divergence of {number(value)} nat"
        assumed = "" if math.isnan(self.assumed) else f"{self.format_value(self.assumed, 0.0)} assumed"
        notes = "; ".join(filter(None, (assumed, addition)))
        return f"{self.name} {self.format_value(value, change)}{f' ({notes})' if notes else ''}"


@dataclass(frozen=True)
class _Change:
    """Changes of one kind: sizes in assumed spreads, from 0, and the weights of the cases.

    - efficiency: expected effective number of cases per case; that of a sample is too large for heavy-tailed weights
    - max_weights: largest possible weight; 0 if it is infinite
    - value: index of the value of `choice`
    """

    kind: Kind
    sizes: Changes
    weights: Float64[np.ndarray, "changes n"]
    efficiency: Changes
    max_weights: Changes | float = 0.0
    value: int = 0


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
    records = [_divergence(verdict) for verdict in met]
    if campaign is not None and campaign.drawn_paths:
        coordinates = draw_coordinates(campaign, frame["case"].to_numpy(dtype=np.int64))
        for index, path in enumerate(campaign.drawn_paths):
            dispersion = campaign.marginals[path]
            for change in _list_changes(dispersion, coordinates[:, index]):
                records += [_find_change(path, dispersion, change, *item) for item in evidence]
    order = {verdict.requirement_id: index for index, verdict in enumerate(met)}
    return tuple(sorted(records, key=lambda item: (order[item.requirement], sort_key(item))))


def select_met(verdicts: Sequence[Verdict]) -> list[Verdict]:
    """Select the requirements that the rate of the cases meets, also if the cases are too few or exclude PASS.

    Campaigns that are not finished have no bounds and are omitted.
    """
    return [item for item in verdicts if item.estimate >= item.probability and not math.isnan(item.lower)]


def sort_key(item: Robustness) -> tuple[int, float]:
    """Sort changes of parameters that show FAIL first, by their size, then the others by that for which PASS holds."""
    if item.fail_text or item.kind is Kind.VALUE:
        return 0 if item.kind is Kind.VALUE else 1, item.change
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


def draw_coordinates(
    campaign: Campaign, cases: Float64[np.ndarray, " n"] | Any
) -> Float64[np.ndarray, "n dispersions"]:
    """Compute the standard normal variables of the random dispersions of cases, after the correlation of groups."""
    draws = (campaign.probabilities(int(case)) or {} for case in cases)
    uniform = np.array([[values[path] for path in campaign.drawn_paths] for values in draws])
    return np.asarray(ndtri(np.clip(uniform, MIN_DRAW, MAX_DRAW)))


def _rates(verdict: Verdict, cases: CaseEvidence, change: _Change) -> WeightedRates:
    """Compute the failure rates of a requirement under changes, with the confidence of the bounds of its verdict."""
    member = cases.member
    groups = cases.groups[member] if cases.groups is not None and cases.clustered else None
    largest = 1 if groups is None else int(np.bincount(groups).max())
    return weighted_rates(
        change.weights[:, member],
        ~cases.success[member],
        groups,
        (verdict.upper_confidence, verdict.bounds_confidence),
        change.max_weights * largest,
        change.efficiency,
    )


def _list_changes(dispersion: Any, z: Float64[np.ndarray, " n"]) -> Iterator[_Change]:
    """List the changes of a dispersion up to those whose expected number of effective cases is 30."""
    steps, fraction = np.linspace(0.0, 1.0, _STEPS), MIN_EFFECTIVE / z.size
    if fraction >= 1.0:
        return
    if isinstance(dispersion, Choice):
        limits = np.cumsum(dispersion.weights or np.ones(len(dispersion.values)))
        indices = np.minimum(np.searchsorted(limits / limits[-1], ndtr(z), side="right"), limits.size - 1)
        for index, probability in enumerate(np.diff(limits, prepend=0.0) / limits[-1] if limits.size > 1 else ()):
            others, ratio = 1.0 - steps, steps / probability
            weights = others[:, None] + ratio[:, None] * (indices == index)
            # E w^2 = (1 - a)^2 + 2 a (1 - a) + a^2 / P
            efficiency = 1.0 / (1.0 - steps**2 + steps**2 / probability)
            sizes = steps * math.sqrt((1.0 - probability) / probability)
            yield _Change(Kind.MORE_FREQUENT, sizes, weights, efficiency, others + ratio, index)
        return
    shifts = steps * math.sqrt(-math.log(fraction))
    for kind, sign in ((Kind.MEAN_UP, 1.0), (Kind.MEAN_DOWN, -1.0)):
        weights = np.exp(sign * shifts[:, None] * z - 0.5 * shifts[:, None] ** 2)
        yield _Change(kind, shifts, weights, np.exp(-(shifts**2)))
    # E w^2 = 1 / (s sqrt(2 - s^2)), infinite from s^2 = 2
    root = math.sqrt(1.0 - fraction**2)
    for kind, limit in ((Kind.WIDER, math.sqrt(1.0 + root)), (Kind.NARROWER, math.sqrt(1.0 - root))):
        scales = 1.0 + steps * (limit - 1.0)
        weights = np.exp(0.5 * z**2 * (1.0 - scales[:, None] ** -2)) / scales[:, None]
        yield _Change(kind, np.abs(scales - 1.0), weights, scales * np.sqrt(np.maximum(2.0 - scales**2, 0.0)))


def _find_change(path: str, dispersion: Any, change: _Change, verdict: Verdict, cases: CaseEvidence) -> Robustness:
    """Find the smallest change of one kind of a dispersion that turns PASS into FAIL."""
    rates, by_rate = _rates(verdict, cases, change), verdict.decide_by == ESTIMATE
    crossing = find_crossing(change.sizes, rates, 1.0 - verdict.probability, decides_by_rate=by_rate)
    assumed, passes_at, fails_at = (
        _quantity(dispersion, change, size) for size in (0.0, crossing.lower, crossing.change)
    )
    is_choice = isinstance(dispersion, Choice)
    is_complete = is_choice and crossing.reach == float(change.sizes[-1])
    return Robustness(
        verdict.requirement_id,
        path,
        change.kind,
        "" if is_choice else split_unit(path)[1] if dispersion.unit is None else dispersion.unit,
        assumed=assumed,
        spread=math.sqrt(assumed * (1.0 - assumed)) if is_choice else _moments(dispersion, 0.0, 1.0)[1],
        passes_at=passes_at,
        fails_at=fails_at,
        confidence=verdict.confidence,
        outcome=Outcome.of(crossing, is_complete=is_complete),
        value=str(dispersion.values[change.value]) if is_choice else "",
        **asdict(crossing),
    )


def _quantity(dispersion: Any, change: _Change, size: float) -> float:
    """Return mean, standard deviation or probability of a dispersion after a change of a size; NaN if unknown."""
    if isinstance(dispersion, Choice):
        weights = dispersion.weights or [1.0] * len(dispersion.values)
        probability = weights[change.value] / sum(weights)
        return probability + size * math.sqrt(probability * (1.0 - probability))
    signed = -size if change.kind in (Kind.MEAN_DOWN, Kind.NARROWER) else size
    if change.kind in (Kind.MEAN_UP, Kind.MEAN_DOWN):
        return _moments(dispersion, signed, 1.0)[0]
    return _moments(dispersion, 0.0, 1.0 + signed)[1]


def _moments(dispersion: Any, shift: float, scale: float) -> tuple[float, float]:
    """Compute mean and standard deviation of a dispersion whose standard normal variable is shifted and scaled.

    NaN if its parameters are formulas.
    """
    if dispersion.formulas or math.isnan(shift + scale):
        return math.nan, math.nan
    draws = np.clip(ndtr(shift + scale * _NODES), MIN_DRAW, MAX_DRAW)
    values = np.array([float(dispersion.quantile(draw)) for draw in draws.tolist()])
    weights = _NODE_WEIGHTS / _NODE_WEIGHTS.sum()
    mean = float(weights @ values)
    return mean, math.sqrt(float(weights @ (values - mean) ** 2))


def binary_divergence(rate: float, reference: float) -> float:
    """Compute the Kullback-Leibler divergence of two binary distributions, rate > reference; 0 for other rates."""
    if math.isnan(reference):
        return math.nan
    return 0.0 if rate <= reference else float(rel_entr(rate, reference) + rel_entr(1.0 - rate, 1.0 - reference))


def _divergence(verdict: Verdict) -> Robustness:
    """Find the divergence of all dispersions that turns PASS into FAIL, from the verdict's own bounds."""
    permitted = 1.0 - verdict.probability
    radii = [binary_divergence(permitted, 1.0 - rate) for rate in (verdict.estimate, verdict.lower, verdict.upper)]
    change, lower, upper = (math.sqrt(2.0 * radius) if math.isfinite(radius) else math.nan for radius in radii)
    lower = change if verdict.decide_by == ESTIMATE else lower or math.nan  # 0 without PASS
    crossing = Crossing(change, lower, upper, math.nan, float(verdict.n))
    outcome = Outcome.of(crossing, is_complete=False)
    return Robustness(
        verdict.requirement_id, ALL_DISPERSIONS, Kind.DIVERGENCE, "nat", assumed=0.0, spread=1.0,
        passes_at=0.5 * lower**2, fails_at=0.5 * change**2, confidence=verdict.confidence, outcome=outcome,
        **asdict(crossing),
    )  # fmt: skip


def robustness_text(verdict: Verdict, records: Sequence[Robustness], max_changes: int = 3) -> str:
    """Describe how far the PASS of a requirement reaches, and the nearest changes to FAIL; empty without records."""
    own = [item for item in records if item.requirement == verdict.requirement_id]
    if not own:
        return ""
    shifts = [item.lower for item in own if item.kind in (Kind.MEAN_UP, Kind.MEAN_DOWN) and item.lower > 0.0]
    factors = [item.lower for item in own if item.kind is Kind.WIDER and item.lower > 0.0]
    ball = next(item for item in own if item.kind is Kind.DIVERGENCE)
    ranges = [f"for a shift of any mean by {number(min(shifts))} standard deviations"] if shifts else []
    ranges += [f"for any standard deviation up to + {percent(min(factors))}"] if factors else []
    if ball.lower > 0.0:
        ranges.append(f"for any change of all dispersions up to a divergence of {number(ball.passes_at)} nat")
    nearest: dict[str, Robustness] = {}
    for item in sorted(own, key=sort_key):
        if item.fail_text and item is not ball:
            nearest.setdefault(item.parameter, item)
    changes = "; ".join(item.fail_text for item in [*nearest.values()][:max_changes])
    # a calibration excludes PASS
    word = "PASS holds" if verdict.status.is_met else "PASS would hold for another kind of evidence"
    word = "Met by the rate" if verdict.decide_by == ESTIMATE else word
    reach = f"{word} ({format_fraction(verdict.confidence)} confidence, one change at a time) {', '.join(ranges)}."
    nearest_text = f"Nearest changes to FAIL: {changes or 'unknown, because too few cases fail'}."
    return f"{reach if ranges else 'These cases do not show PASS.'} {nearest_text}"
