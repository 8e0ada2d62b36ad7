"""Verdicts under other parameters than those of a campaign, from the studies `robust` in the folder of its run.

A study repeats cases of the run in variants (`marsyard.campaigns.studies.robust`). A case represents several cases of
the run, so that its failures have this weight (`marsyard.reports.statistics.reweighted_rates`). Between the steps of a
parameter, the margin of each case is interpolated.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float64, Int

from marsyard.campaigns.definition.parameter_paths import value_at
from marsyard.campaigns.json_numbers import Number
from marsyard.campaigns.studies.results import ROBUST, ROBUST_FOLDER, RobustVariant
from marsyard.reports import rates
from marsyard.reports.decision import collect_evidence
from marsyard.reports.dispersion_changes import ChangeKind
from marsyard.reports.populations import compute_margins
from marsyard.reports.robustness import ChangeOutcome, Robustness
from marsyard.reports.robustness_evaluation import select_met
from marsyard.reports.sampling_design import INDEPENDENT
from marsyard.reports.statistics.clustered_cases import ClusteredCases
from marsyard.reports.statistics.reweighted_rates import ROUNDING, find_crossing, weighted_rates
from marsyard.reports.stored import RECORD_FILE, TABLE_FILE, StoredRun, read_run
from marsyard.reports.verdicts import ESTIMATE, Status, Verdict
from marsyard.reports.wording import count
from marsyard.scenarios.columns import split_unit

#: Number of evaluated values between the assumed and the farthest value of a parameter.
_STEPS = 61
#: Margin that replaces infinite ones, which cannot be interpolated.
_LARGE = 1e9
#: Smallest divisor, instead of zero.
_TINY = 1e-300


@dataclass(frozen=True)
class VariantVerdict:
    """Verdict on a requirement in a variant.

    - estimate, lower, upper: failure rate, and its one-sided bounds at the requirement's confidence
    - permitted: failure rate that the requirement permits
    - cases, effective_cases: number of cases that were run, and the equivalent number of random cases
    """

    variant: str
    title: str
    requirement: str
    status: Status
    estimate: Number
    lower: Number
    upper: Number
    permitted: Number
    cases: int
    effective_cases: Number


@dataclass(frozen=True)
class RobustStudy:
    """A finished study: its variants with their rows, the rows of the same cases in the run, and their weights."""

    variants: Sequence[tuple[RobustVariant, pd.DataFrame]]
    base: pd.DataFrame
    weights: Float64[np.ndarray, " n"]


def read_robust_studies(run: StoredRun) -> list[RobustStudy]:
    """Read the finished studies of a run. Raises StoreError if their rows were changed."""
    studies = []
    folder = run.directory / ROBUST_FOLDER
    for directory in sorted(folder.iterdir()) if folder.is_dir() else ():
        if not (directory / RECORD_FILE).is_file() or not (directory / TABLE_FILE).is_file():
            continue
        stored = read_run(directory)
        if (study := ROBUST.read(stored.record)) is None or "case" not in run.all_cases:
            continue
        parameters, _ = study
        rows, n_variants = run.all_cases.set_index("case", drop=False), len(parameters.variants)
        if len(stored.all_cases) != n_variants * len(parameters.cases):
            continue
        # the variants of a case follow each other
        frames = [stored.all_cases.iloc[index::n_variants].reset_index(drop=True) for index in range(n_variants)]
        base = rows.loc[list(parameters.cases)].reset_index(drop=True)
        studies.append(
            RobustStudy(list(zip(parameters.variants, frames, strict=True)), base, np.array(parameters.weights))
        )
    return studies


def evaluate_variants(studies: Sequence[RobustStudy], verdicts: Sequence[Verdict]) -> tuple[VariantVerdict, ...]:
    """Evaluate each requirement in each named variant, and in the campaign itself for the same cases.

    Titles contain the number of cases if studies differ in it.
    """
    results: list[VariantVerdict] = []
    named_by_study = [[item for item in study.variants if not item[0].parameter] for study in studies]
    sizes = [len(study.base) for study, named in zip(studies, named_by_study, strict=True) if named]
    assumed = RobustVariant("as assumed", "the campaign's own values", {})
    for study, named in zip(studies, named_by_study, strict=True):
        for variant, frame in [(assumed, study.base), *named] if named else ():
            title = f"{variant.title}, {count(len(frame), 'case')}" if len(set(sizes)) > 1 else variant.title
            titled = replace(variant, title=title)
            results += filter(None, (_evaluate(study, titled, frame, verdict) for verdict in verdicts))
    return tuple(results)


def _evaluate(
    study: RobustStudy, variant: RobustVariant, frame: pd.DataFrame, verdict: Verdict
) -> VariantVerdict | None:
    """Evaluate a requirement on the rows of a variant; None if no case belongs to its population."""
    names = ("metric", "bound", "probability", "confidence", "population", "scale")
    requirement = {"id": verdict.requirement_id} | {name: getattr(verdict, name) for name in names}
    evidence = collect_evidence(frame, requirement, INDEPENDENT, has_own_terrains=True)
    if evidence is None or not evidence.with_unfinished.n:
        return None
    member, success = evidence.with_unfinished.member, evidence.with_unfinished.success
    groups, confidences = _groups(frame, member), _confidences(verdict)
    result = weighted_rates(study.weights[None, member], ~success[member], groups, confidences)
    estimate, lower, upper = (float(values[0]) for values in (result.estimate, result.lower, result.upper))
    lower_factor, upper_factor = _widen(success[member], groups, confidences)
    lower, upper = lower * lower_factor, min(upper * upper_factor, 1.0)
    permitted = 1.0 - verdict.probability
    status = Status.PASS if upper <= permitted else Status.FAIL if lower > permitted else Status.INSUFFICIENT
    if verdict.decide_by == ESTIMATE and status is not Status.PASS:
        status = Status.MET_BY_RATE if estimate <= permitted + ROUNDING else Status.FAIL
    return VariantVerdict(
        variant=variant.name,
        title=variant.title,
        requirement=verdict.requirement_id,
        status=status,
        estimate=estimate,
        lower=lower,
        upper=upper,
        permitted=permitted,
        cases=int(member.sum()),
        effective_cases=float(result.effective_units[0]),
    )


def _confidences(verdict: Verdict) -> tuple[float, float]:
    """Return the confidences of lower and upper bounds of failure rates: those of the verdict if it has bounds."""
    bounds = verdict.upper_confidence, verdict.bounds_confidence
    lower, upper = (verdict.confidence if math.isnan(value) else value for value in bounds)
    return lower, upper


def _widen(
    success: Bool[np.ndarray, " m"], groups: Int[np.ndarray, " m"] | None, confidences: tuple[float, float]
) -> tuple[float, float]:
    """Return factors of lower and upper bound, with which they hold for any correlation within terrains.

    The factors are those of equal weights; 1 without shared terrains.
    """
    if groups is None:
        return 1.0, 1.0
    exact = ClusteredCases.of(success, groups)
    equal = weighted_rates(np.ones((1, groups.size)), ~success, groups, confidences)
    lower, upper = exact.min_failure_rate(1.0 - confidences[0]), exact.max_failure_rate(1.0 - confidences[1])
    return min(lower / max(float(equal.lower[0]), _TINY), 1.0), max(upper / float(equal.upper[0]), 1.0)


def _groups(frame: pd.DataFrame, member: Bool[np.ndarray, " n"]) -> Int[np.ndarray, " m"] | None:
    """Return the terrains of the members; None if no terrain is shared."""
    groups = rates.terrain_groups(frame)
    return None if groups is None or np.unique(groups).size == groups.size else groups[member]


def evaluate_steps(
    run: StoredRun, studies: Sequence[RobustStudy], verdicts: Sequence[Verdict]
) -> tuple[Robustness, ...]:
    """Find the change to FAIL of each requirement of `select_met`, for each parameter that a study changes in steps."""
    columns = {str(item.get("id")): item.get("margin") for item in run.requirements}
    met = select_met(verdicts)
    records = []
    for study in studies:
        for path in dict.fromkeys(variant.parameter for variant, _ in study.variants if variant.parameter):
            assumed = float(value_at(run.definition["parameters"], path))
            frames = {assumed: study.base} | {
                float(variant.values[path]): frame for variant, frame in study.variants if variant.parameter == path
            }
            for verdict in met:
                margins = [
                    compute_margins(frame, verdict, columns.get(verdict.requirement_id)) for frame in frames.values()
                ]
                known = [item for item in margins if item is not None]
                if len(known) == len(frames):
                    records.append(_find_step(study, verdict, path, list(frames), np.array(known)))
    return tuple(records)


def _find_step(
    study: RobustStudy, verdict: Verdict, path: str, values: Sequence[float], margins: Float64[np.ndarray, "steps n"]
) -> Robustness:
    """Find the value of a parameter at which PASS turns into FAIL.

    - values: assumed value, and the others in the order of their distance from it
    - margins: margins of the cases at these values; infinite outside the population
    """
    assumed, farthest = values[0], values[-1]
    positions = np.abs(np.array(values) - assumed)
    grid = np.linspace(0.0, positions[-1], _STEPS)
    finite = np.clip(margins, -_LARGE, _LARGE)
    failure = np.array([np.interp(grid, positions, column) < 0.0 for column in finite.T]).T
    # a case has a weight where it belongs to the population at the nearest value, or violates the requirement
    nearest = np.abs(grid[:, None] - positions).argmin(axis=1)
    weights = study.weights * ((margins[nearest] < math.inf) | failure)
    groups, confidences = _groups(study.base, np.ones(len(study.base), dtype=np.bool_)), _confidences(verdict)
    result = weighted_rates(weights, failure, groups, confidences)
    # the widest bounds of both ends and of the middle of the range
    factors = [_widen(~failure[step], groups, confidences) for step in (0, _STEPS // 2, _STEPS - 1)]
    lower_factors, upper_factors = zip(*factors, strict=True)
    result = replace(result, lower=result.lower * min(lower_factors), upper=result.upper * max(upper_factors))
    spread = abs(assumed) or abs(farthest)
    by_rate = verdict.decide_by == ESTIMATE
    crossing = find_crossing(grid / spread, result, 1.0 - verdict.probability, decides_by_rate=by_rate)
    step = math.copysign(spread, farthest - assumed)
    return Robustness(
        verdict.requirement_id, path, ChangeKind.VALUE, split_unit(path)[1], assumed=assumed, spread=spread,
        passes_at=assumed + step * crossing.lower, fails_at=assumed + step * crossing.change,
        confidence=verdict.confidence, outcome=ChangeOutcome.of(crossing, is_complete=False), **asdict(crossing),
    )  # fmt: skip
