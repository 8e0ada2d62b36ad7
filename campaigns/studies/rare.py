"""Study `rare`: probability that a case violates a requirement, with an interval and a verdict on its limit.

The margin g of a case is its signed distance from the bound of the requirement; a violation is g < 0. Random cases of
the nominal distribution give the exact bounds of Clopper and Pearson (`studies.counting`): PASS rests on them alone.

Subset simulation (`studies.subset`; Au & Beck 2001) computes the probability as a product of conditional probabilities,
P(g < 0) = P(g <= b1) P(g <= b2 | g <= b1) ... P(g < 0 | g <= bm). Each threshold b is the quantile `LEVEL_FRACTION` of
the margins of a level; Markov chains draw the next level from the cases below it. A simulation is a coroutine: it
yields `Proposals`, receives their margins as `Evaluated`, and returns its estimate. This study runs several independent
simulations (replicates) at once; their spread gives the interval (`studies.interval`). Importance sampling
(`studies.importance`; Melchers 1989) can refine the estimate with cases drawn around the violations that were found.

A case is a point: a standard normal number per dispersion, and a blend, a weighted sum of numbered random streams that
give the noise of the instruments. `NEW_STREAM` is the stream that the case creates; its number is that of the case.
`studies.rare_decision` derives the verdict from all cases.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import Requirement
from marsyard.campaigns.definition.margins import compute_margin, describe_margin
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.outcomes import ENGINE_FAILURES
from marsyard.campaigns.running.progress import ProgressObserver
from marsyard.campaigns.sampling.study_points import StudyPoint, number_blend
from marsyard.campaigns.studies import subset
from marsyard.campaigns.studies.importance import fit_density
from marsyard.campaigns.studies.point_runner import CaseLimitError, PointRunner
from marsyard.campaigns.studies.rare_decision import Basis, Decision, RareSample, RareVerdict, decide_rare
from marsyard.campaigns.studies.results import RARE, RareParameters, RareResult, Replicate
from marsyard.campaigns.studies.runner import StudySession, check_margin, continue_study, find_requirement, start_study
from marsyard.sim.streams import Streams

#: Subset simulation stops at levels less likely than this fraction of the limit, which cannot change the verdict.
MIN_PROBABILITY_FRACTION = 0.01
#: Number of importance samples, and of random cases, that are evaluated together.
_IMPORTANCE_BATCH, _RANDOM_BATCH = 100, 1000


def start_rare(
    campaign: Campaign,
    parameters: RareParameters,
    max_cases: int,
    directory: Path,
    executor: ExecutorConfig,
    observer: ProgressObserver,
) -> RareResult:
    """Run the study in a new folder; `max_cases` limits the cases without the random ones.

    Raises CampaignError for an unsuitable campaign, requirement or folder. On KeyboardInterrupt all finished rows are
    stored, and `continue_rare` continues.
    """
    check_margin(find_requirement(campaign, parameters.requirement))
    session = StudySession(RARE, parameters, _RareStudy, executor, observer)
    total_cases = max_cases + sum(parameters.random_cases)
    return start_study(campaign, total_cases, directory, session)


def continue_rare(
    directory: Path, executor: ExecutorConfig, observer: ProgressObserver, replicates: int = 0, random_cases: int = 0
) -> RareResult:
    """Continue an interrupted study, or add replicates or random cases to a finished one.

    replicates, random_cases: numbers to add; the result is evaluated again if one of them is not 0
    Raises CampaignError if the folder contains no such study, or the program has changed.
    """
    parameters = RARE.read_parameters(directory)
    if replicates and parameters.method == "importance":
        raise CampaignError(
            f"{directory}: no replicates can be added to a study with importance sampling; start a new study with more"
        )
    if replicates or random_cases:
        parameters = replace(
            parameters,
            replicates=(*parameters.replicates, replicates),
            random_cases=(*parameters.random_cases, random_cases),
        )
    session = StudySession(RARE, parameters, _RareStudy, executor, observer)
    return continue_study(directory, session, random_cases)


class _RareStudy:
    """A running study.

    - violations: number of violations among all cases
    - repeated: number of finished cases that were run more than once
    - is_violation, terrains: violation and terrain of each independent case of the nominal distribution
    - reserved_cases: number of random cases, out of the limit of cases, that are not yet run
    """

    def __init__(self, campaign: Campaign, parameters: RareParameters, runner: PointRunner) -> None:
        self._campaign, self._parameters, self._runner = campaign, parameters, runner
        self._requirement: Requirement = find_requirement(campaign, parameters.requirement)
        self._violations = self._repeated = 0
        self._is_violation: list[bool] = []
        self._terrains: list[str | None] = []
        self._reserved_cases = sum(parameters.random_cases)

    def run(self, observer: ProgressObserver) -> RareResult:
        """Run random cases, replicates and importance sampling; estimate the probability and decide."""
        parameters = self._parameters
        results: list[subset.SubsetResult] = []
        violation_weights: list[float] | None = None
        shortfall = ""
        for block, (replicates, random_cases) in enumerate(
            zip(parameters.replicates, parameters.random_cases, strict=True)
        ):
            observer.begin("cases", random_cases + self._max_cases(replicates))
            self._run_random(block, random_cases)
            first = sum(parameters.replicates[:block])
            try:
                results += self._run_replicates(range(first, first + replicates))
                if parameters.method == "importance" and block == 0:
                    observer.begin("cases", parameters.importance_cases)
                    violation_weights = self._run_importance(results)
                    if not violation_weights:
                        shortfall = "The replicates found too few violations to fit a density for importance sampling."
            except CaseLimitError as error:
                shortfall = f"The limit of cases was reached: {error}."
        decision = self._decide(results, violation_weights, shortfall)
        replicates_run = tuple(
            Replicate(
                item.probability,
                item.reached,
                item.end.value,
                item.thresholds,
                tuple(level.probability for level in item.levels[1:]),
            )
            for item in results
        )
        return RareResult(
            verdict=decision.verdict,
            decision=decision,
            cases=self._runner.n_cases,
            violations=self._violations,
            replicates=replicates_run,
            margin_text=describe_margin(self._requirement),
        )

    def _max_cases(self, replicates: int) -> int:
        """Compute the number of cases of replicates that reach their least likely level."""
        min_probability = MIN_PROBABILITY_FRACTION * self._parameters.max_probability
        levels = math.ceil(math.log(min_probability) / math.log(subset.LEVEL_FRACTION))
        return math.ceil(replicates * self._parameters.samples * (1.0 + (1.0 - subset.LEVEL_FRACTION) * levels))

    def _run_random(self, block: int, count: int) -> None:
        """Run independent cases of the nominal distribution."""
        rng = self._generator(f"random cases {block}")
        coordinates = rng.standard_normal((count, len(self._campaign.drawn_paths)))
        for first in range(0, count, _RANDOM_BATCH):
            batch = coordinates[first : first + _RANDOM_BATCH]
            self._reserved_cases -= len(batch)
            self._evaluate([subset.Proposals(batch, [subset.new_blend()] * len(batch), is_independent=True)])

    def _run_replicates(self, numbers: range) -> list[subset.SubsetResult]:
        """Run subset simulations in parallel: the next cases of all of them are evaluated together."""
        parameters, dimension = self._parameters, len(self._campaign.drawn_paths)
        min_probability = MIN_PROBABILITY_FRACTION * parameters.max_probability
        simulations = {
            number: subset.subset_simulation(
                dimension, parameters.samples, min_probability, self._generator(f"subset simulation {number}")
            )
            for number in numbers
        }
        pending = {number: next(simulation) for number, simulation in simulations.items()}
        results: dict[int, subset.SubsetResult] = {}
        while pending:
            evaluated_groups = self._evaluate(list(pending.values()))
            next_pending: dict[int, subset.Proposals] = {}
            for number, evaluated in zip(pending, evaluated_groups, strict=True):
                try:
                    next_pending[number] = simulations[number].send(evaluated)
                except StopIteration as stop:
                    results[number] = stop.value
            pending = next_pending
        return [results[number] for number in numbers]

    def _run_importance(self, results: Sequence[subset.SubsetResult]) -> list[float]:
        """Sample cases around the violations of the replicates, from a fitted density.

        Returns the importance weight of each case that is a violation, and 0 for each other case. The mean of these
        numbers estimates the probability of a violation. The list is empty if there are too few violations to fit the
        density.
        """
        density = fit_density(np.concatenate([result.violations for result in results]))
        if density is None:
            return []
        case_count = self._parameters.importance_cases
        coordinates, weights = density.draw(case_count, self._generator("importance sampling"))
        violation_weights: list[float] = []
        for first in range(0, case_count, _IMPORTANCE_BATCH):
            batch = slice(first, first + _IMPORTANCE_BATCH)
            proposal = subset.Proposals(coordinates[batch], [subset.new_blend()] * len(coordinates[batch]))
            (evaluated,) = self._evaluate([proposal])
            violation_weights += (weights[batch] * (evaluated.margins < 0.0)).tolist()
        return violation_weights

    def _evaluate(self, proposals: Sequence[subset.Proposals]) -> list[subset.Evaluated]:
        """Evaluate several groups of proposed cases together; return the margins of each group.

        Counts the violations, and records the independent cases for the counting bound.
        """
        coordinates = np.concatenate([group.coordinates for group in proposals])
        blends = [blend for group in proposals for blend in group.blends]
        first = self._runner.n_cases
        points = [
            StudyPoint(tuple(point.tolist()), blend=blend) for point, blend in zip(coordinates, blends, strict=True)
        ]
        rows = self._runner.run(points, self._reserved_cases)
        margins = np.array([compute_margin(row, self._requirement) for row in rows])
        self._violations += int(np.sum(margins < 0.0))
        finished = [row for row in rows if row["outcome"] not in ENGINE_FAILURES]
        self._repeated += sum(int(row.get("case_attempts", 1)) > 1 for row in finished)
        numbered = [number_blend(blend, case) for case, blend in enumerate(blends, start=first)]
        ends = np.cumsum([len(group.blends) for group in proposals])
        evaluated: list[subset.Evaluated] = []
        for group, start, end in zip(proposals, [0, *ends[:-1]], ends, strict=True):
            if group.is_independent:
                self._is_violation += (margins[start:end] < 0.0).tolist()
                self._terrains += [
                    None if (name := row.get("terrain")) is None else str(name) for row in rows[start:end]
                ]
            evaluated.append(subset.Evaluated(numbered[start:end], margins[start:end]))
        return evaluated

    def _generator(self, name: str) -> np.random.Generator:
        """Create a random generator of the study, which does not depend on the cases."""
        return Streams(self._campaign.definition.seed, self._campaign.definition.name, 0).generator(name)

    def _decide(
        self, results: Sequence[subset.SubsetResult], violation_weights: Sequence[float] | None, shortfall: str
    ) -> Decision:
        """Decide the verdict.

        A PASS becomes INSUFFICIENT on a seed from which the algorithm's options were set, and with repeated cases: the
        cases of a subset simulation depend on each other, so the effect of a hidden failure is unknown.
        """
        parameters, evidence = self._parameters, self._runner.evidence
        sample = RareSample(
            results, np.array(self._is_violation, dtype=bool), self._terrains, violation_weights, shortfall
        )
        evaluations = len(parameters.replicates)
        decision = decide_rare(sample, parameters.max_probability, parameters.confidence, evaluations)
        repeated = f"{self._repeated:,} cases finished only in a second attempt." if self._repeated else ""
        obstacle = evidence.text if evidence.excludes_pass else repeated
        if decision.verdict is RareVerdict.PASS and obstacle:
            reason = f"The verdict would be PASS. {obstacle}"
            decision = replace(decision, verdict=RareVerdict.INSUFFICIENT, basis=Basis.NONE, reason=reason)
        return decision
