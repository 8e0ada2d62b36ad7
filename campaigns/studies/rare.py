"""Study `rare`: probability that a case violates a requirement, with an interval and a verdict on its limit."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from scipy.special import ndtri

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.configuration import Requirement
from marsyard.campaigns.definition.margins import compute_margin, describe_margin
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.workers import ExecutorConfig
from marsyard.campaigns.running.engine import ProgressObserver
from marsyard.campaigns.studies.importance import fit_density
from marsyard.campaigns.studies.interval import (
    ProbabilityInterval,
    RareVerdict,
    additional_replicates,
    decide,
    effective_number,
    enclose,
    replicate_interval,
    weighted_interval,
)
from marsyard.campaigns.studies.runner import (
    Candidate,
    CaseLimitError,
    PointRunner,
    StudySession,
    check_margin,
    continue_study,
    find_requirement,
    read_study,
    start_study,
)
from marsyard.campaigns.studies.subset import (
    LEVEL_FRACTION,
    NEW_STREAM,
    Evaluated,
    Proposals,
    SubsetResult,
    new_blend,
    subset_simulation,
)
from marsyard.sim.streams import Streams

#: Value of the key `kind` in the settings of this study.
KIND = "rare"
#: Subset simulation alone, or with importance sampling around the violations that it found.
METHODS = ("subset", "importance")
#: Subset simulation stops at levels less likely than this fraction of the limit, which cannot change the verdict.
_MIN_PROBABILITY_FRACTION = 0.01
#: Minimum number of effective violations (Kish) at which the interval of importance sampling is used.
MIN_EFFECTIVE_VIOLATIONS = 30.0
#: Number of importance samples that are evaluated together.
_IMPORTANCE_BATCH = 100


@dataclass(frozen=True)
class RareSettings:
    """Settings of the study.

    - requirement: id of the requirement; max_probability: limit of the probability that a case violates it
    - method: see `METHODS`
    - samples: cases per level of one subset simulation
    - replicates: numbers of replicates that run together: those of the first run, and of each continuation
    - importance_cases: cases of importance sampling
    - confidence: two-sided confidence of the interval
    """

    requirement: str
    max_probability: float
    method: str = "subset"
    samples: int = 200
    replicates: tuple[int, ...] = (6,)
    importance_cases: int = 600
    confidence: float = 0.9

    def __post_init__(self) -> None:
        problems = {
            f"--max-probability {self.max_probability}: allowed: above 0 and below 1": 0.0 < self.max_probability < 1.0,
            f"--method {self.method}: allowed: {', '.join(METHODS)}": self.method in METHODS,
            f"--samples {self.samples}: at least 50": self.samples >= 50,
            f"--replicates {self.replicates[0]}: at least 2": self.replicates[0] >= 2,
            f"--importance-cases {self.importance_cases}: at least 50": self.importance_cases >= 50,
            f"--confidence {self.confidence}: allowed: 0.5 to 0.999": 0.5 <= self.confidence <= 0.999,
        }
        for message, is_met in problems.items():
            if not is_met:
                raise CampaignError(message)


@dataclass(frozen=True)
class Replicate:
    """One subset simulation: estimated probability, whether a violation was reached, and margin threshold per level."""

    probability: float
    reached: bool
    thresholds: tuple[float, ...]


@dataclass(frozen=True)
class RareResult:
    """Result of the study.

    - verdict, interval: verdict, and estimate with the interval on which it rests
    - cases, violations: numbers of evaluated cases, and of those that violate the requirement
    - replicates: subset simulations; subset_interval: their interval
    - effective_violations: effective number of violations of importance sampling; NaN without it
    - additional_cases: estimated number of further cases until the verdict is decided; None if decided or unknown
    - counting_cases: number of independent cases that would give an interval of the same relative width
    - margin_text: definition of the margin; reason: why the verdict is INSUFFICIENT; may be empty
    """

    verdict: RareVerdict
    interval: ProbabilityInterval
    cases: int
    violations: int
    replicates: tuple[Replicate, ...]
    subset_interval: ProbabilityInterval
    effective_violations: float
    additional_cases: int | None
    counting_cases: float
    margin_text: str
    reason: str = ""

    @property
    def exit_code(self) -> int:
        """Exit status of the verdict."""
        return {RareVerdict.PASS: 0, RareVerdict.FAIL: 1, RareVerdict.INSUFFICIENT: 3}[self.verdict]


def start_rare(
    campaign: Campaign,
    settings: RareSettings,
    max_cases: int,
    directory: Path,
    executor: ExecutorConfig,
    observer: ProgressObserver,
) -> RareResult:
    """Run the study in a new folder.

    Raises CampaignError for an unsuitable campaign, requirement or folder. On KeyboardInterrupt all finished rows are
    stored, and `continue_rare` continues.
    """
    check_margin(find_requirement(campaign, settings.requirement))
    session = StudySession(
        executor, observer, lambda campaign, runner: _Study(campaign, settings, runner).run(observer)
    )
    return start_study(campaign, max_cases, directory, session, {"kind": KIND, **asdict(settings)})


def continue_rare(
    directory: Path, executor: ExecutorConfig, observer: ProgressObserver, additional: int = 0
) -> RareResult:
    """Continue an interrupted study, or add replicates to a finished one.

    additional: number of replicates to add; at least 1 if the study is finished
    Raises CampaignError if the folder contains no such study, or the program has changed.
    """
    study = read_study(directory) or {}
    if study.get("kind") != KIND:
        raise CampaignError(f"{directory} does not contain a study of rare violations (marsyard rare)")
    values = {name: study[name] for name in RareSettings.__dataclass_fields__}
    settings = RareSettings(**{**values, "replicates": tuple(values["replicates"])})
    if additional and settings.method == "importance":
        raise CampaignError(f"{directory}: importance sampling cannot be extended; start a new study with more cases")
    if additional:
        settings = replace(settings, replicates=(*settings.replicates, additional))
    session = StudySession(
        executor, observer, lambda campaign, runner: _Study(campaign, settings, runner).run(observer)
    )
    return continue_study(directory, session, {"kind": KIND, **asdict(settings)})


class _Study:
    """State of a running study: its cases so far, and the violations among them."""

    def __init__(self, campaign: Campaign, settings: RareSettings, runner: PointRunner) -> None:
        self._campaign, self._settings, self._runner = campaign, settings, runner
        self._requirement: Requirement = find_requirement(campaign, settings.requirement)
        self._violations = 0

    def run(self, observer: ProgressObserver) -> RareResult:
        """Run all replicates and the importance sampling; estimate the probability and decide."""
        settings = self._settings
        results: list[SubsetResult] = []
        reason, violation_weights = "", list[float]()
        try:
            for block in settings.replicates:
                observer.begin("cases", self._max_cases(block))
                results += self._run_replicates(range(len(results), len(results) + block))
            if settings.method == "importance":
                observer.begin("cases", settings.importance_cases)
                violation_weights = self._run_importance(results)
                if not violation_weights:
                    reason = "The replicates found too few violations to fit a density for importance sampling."
        except CaseLimitError as error:
            reason = f"The limit of cases was reached: {error}."
        if len(results) < 2:
            unknown_interval = ProbabilityInterval(math.nan, 0.0, 1.0, settings.confidence, math.nan)
            return self._finish(
                RareVerdict.INSUFFICIENT, unknown_interval, results, unknown_interval, math.nan, None, reason
            )
        estimates, reached = [item.probability for item in results], [item.reached for item in results]
        # each evaluation after the first uses half of the risk of the previous one: the sum of all risks is below twice
        # the first, so each one-sided bound has at most the risk 1 - confidence over all evaluations
        confidence = 1.0 - (1.0 - settings.confidence) / 2.0 ** (len(settings.replicates) - 1)
        subset_interval = replicate_interval(estimates, reached, confidence)
        interval, n_effective = subset_interval, math.nan
        if violation_weights:
            n_effective = effective_number(violation_weights)
            # alone, the interval of importance sampling covers the probability too rarely (docs/validation.md)
            interval = enclose(weighted_interval(violation_weights, settings.confidence), subset_interval)
            if n_effective < MIN_EFFECTIVE_VIOLATIONS:
                reason = (
                    f"Importance sampling has only {n_effective:.0f} effective violations, fewer than "
                    f"{MIN_EFFECTIVE_VIOLATIONS:.0f}: its interval is not reliable. Use more cases, or --method subset."
                )
        verdict = RareVerdict.INSUFFICIENT if reason else decide(interval, settings.max_probability)
        evidence = self._runner.evidence
        if verdict is RareVerdict.PASS and evidence.excludes_pass:
            verdict, reason = RareVerdict.INSUFFICIENT, f"The verdict would be PASS. {evidence.text}"
        additional = None
        if verdict is RareVerdict.INSUFFICIENT and not violation_weights:
            next_interval = replace(subset_interval, confidence=0.5 * (1.0 + confidence))
            replicates_needed = additional_replicates(next_interval, len(results), settings.max_probability)
            cases_per_replicate = self._runner.n_cases / len(results)
            additional = None if replicates_needed is None else math.ceil(replicates_needed * cases_per_replicate)
        return self._finish(verdict, interval, results, subset_interval, n_effective, additional, reason)

    def _finish(
        self,
        verdict: RareVerdict,
        interval: ProbabilityInterval,
        results: Sequence[SubsetResult],
        subset_interval: ProbabilityInterval,
        n_effective: float,
        additional: int | None,
        reason: str,
    ) -> RareResult:
        """Create the result; compute the number of independent cases for an interval of the same relative width."""
        # the rate of n independent cases has the interval p exp(+-z sqrt((1 - p) / (n p)))
        width = math.log(interval.upper / interval.lower) if interval.lower > 0.0 else math.inf
        p = interval.estimate
        z = float(ndtri(0.5 * (1.0 + interval.confidence)))
        counting_cases = (2.0 * z / width) ** 2 * (1.0 - p) / p if 0.0 < width < math.inf and p > 0.0 else math.nan
        replicates = tuple(Replicate(item.probability, item.reached, item.thresholds) for item in results)
        return RareResult(
            verdict,
            interval,
            self._runner.n_cases,
            self._violations,
            replicates,
            subset_interval,
            n_effective,
            additional,
            counting_cases,
            describe_margin(self._requirement),
            reason,
        )

    def _max_cases(self, replicates: int) -> int:
        """Compute the number of cases of replicates that reach their least likely level."""
        min_probability = _MIN_PROBABILITY_FRACTION * self._settings.max_probability
        levels = math.ceil(math.log(min_probability) / math.log(LEVEL_FRACTION))
        return math.ceil(replicates * self._settings.samples * (1.0 + (1.0 - LEVEL_FRACTION) * levels))

    def _generator(self, name: str) -> np.random.Generator:
        """Create a random generator of the study, which does not depend on the cases."""
        return Streams(self._campaign.configuration.seed, self._campaign.configuration.name, 0).generator(name)

    def _run_replicates(self, numbers: range) -> list[SubsetResult]:
        """Run subset simulations in parallel: the next cases of all of them are evaluated together."""
        settings, dimension = self._settings, len(self._campaign.drawn_paths)
        min_probability = _MIN_PROBABILITY_FRACTION * settings.max_probability
        simulations = {
            number: subset_simulation(
                dimension, settings.samples, min_probability, self._generator(f"subset simulation {number}")
            )
            for number in numbers
        }
        pending = {number: next(simulation) for number, simulation in simulations.items()}
        results: dict[int, SubsetResult] = {}
        while pending:
            evaluated_groups = self._evaluate(list(pending.values()))
            next_pending: dict[int, Proposals] = {}
            for number, evaluated in zip(pending, evaluated_groups, strict=True):
                try:
                    next_pending[number] = simulations[number].send(evaluated)
                except StopIteration as stop:
                    results[number] = stop.value
            pending = next_pending
        return [results[number] for number in numbers]

    def _evaluate(self, proposals: Sequence[Proposals]) -> Iterator[Evaluated]:
        """Evaluate several groups of proposed cases together."""
        coordinates = np.concatenate([group.coordinates for group in proposals])
        blends = [blend for group in proposals for blend in group.blends]
        first = self._runner.n_cases
        candidates = [
            Candidate(tuple(point.tolist()), blend=blend if len(blend) > 1 else ())
            for point, blend in zip(coordinates, blends, strict=True)
        ]
        rows = self._runner.run(candidates)
        margins = np.array([compute_margin(row, self._requirement) for row in rows])
        self._violations += int(np.sum(margins < 0.0))
        numbered = [
            tuple((case if number == NEW_STREAM else number, weight) for number, weight in blend)
            for case, blend in enumerate(blends, start=first)
        ]
        ends = np.cumsum([len(group.blends) for group in proposals])
        for start, end in zip([0, *ends[:-1]], ends, strict=True):
            yield Evaluated(numbered[start:end], margins[start:end])

    def _run_importance(self, results: Sequence[SubsetResult]) -> list[float]:
        """Sample cases around the violations of the replicates, from a fitted density.

        Returns the importance weight of each case that is a violation, and 0 for each other case. The mean of these
        numbers estimates the probability of a violation. The list is empty if there are too few violations to fit the
        density.
        """
        density = fit_density(np.concatenate([result.violations for result in results]))
        if density is None:
            return []
        case_count = self._settings.importance_cases
        coordinates, weights = density.draw(case_count, self._generator("importance sampling"))
        violation_weights: list[float] = []
        for first in range(0, case_count, _IMPORTANCE_BATCH):
            batch = slice(first, first + _IMPORTANCE_BATCH)
            proposal = Proposals(coordinates[batch], [new_blend()] * len(coordinates[batch]))
            (evaluated,) = self._evaluate([proposal])
            violation_weights += (weights[batch] * (evaluated.margins < 0.0)).tolist()
        return violation_weights
