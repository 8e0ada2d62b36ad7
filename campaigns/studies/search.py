"""Study `search`: look for violations of a requirement with a limited number of cases, and reduce them.

1. Half of the cases explore the dispersions by a scrambled Sobol sequence.
2. Evolution strategies (CMA-ES; Hansen 2016, arXiv:1604.00772) minimise the margin from the best explored cases.
3. The most likely violation is reduced. Groups of dispersions are reset to the campaign's parameter, and the groups are
   halved (delta debugging; Zeller & Hildebrandt 2002, IEEE Trans. Softw. Eng. 28, 183-200). The remaining coordinates
   are then bisected towards their median. A change is kept only if the case still violates the requirement with the
   same random streams.
4. Violations that are close to a reduced one in its remaining dispersions have the same cause. Step 3 is repeated with
   the other violations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import cma
import numpy as np
from scipy.special import ndtri
from scipy.stats import qmc

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import Requirement
from marsyard.campaigns.definition.margins import compute_margin, describe_margin
from marsyard.campaigns.definition.parameter_paths import value_at
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.running.progress import ProgressObserver
from marsyard.campaigns.sampling.study_points import POINT_COLUMN, StudyPoint
from marsyard.campaigns.studies.point_runner import CaseLimitError, PointRunner
from marsyard.campaigns.studies.results import SEARCH, FoundFailure, SearchParameters, SearchResult
from marsyard.campaigns.studies.runner import StudySession, find_requirement, start_study
from marsyard.sim.streams import Streams

#: Fraction of the cases that are used for exploration.
_EXPLORATION_FRACTION = 0.5
#: Initial step of an evolution strategy, and limit of its coordinates, standard deviations.
_STEP, _MAX_COORDINATE = 0.5, 4.0
#: Distance between the starts of two evolution strategies per square root of the dimension, standard deviations.
_MIN_START_DISTANCE = 0.5
#: Maximum distance of violations with the same cause, standard deviations, in the dispersions of the reduced one.
_MAX_CAUSE_DISTANCE = 1.5
#: Usual number of cases of one reduction, for the progress report.
_REDUCTION_CASES = 25
#: Steps of the bisection of a coordinate.
_BISECTION_STEPS = 4


@dataclass(frozen=True)
class _EvaluatedPoint:
    """An evaluated case: its number, point, margin and outcome."""

    case: int
    point: StudyPoint
    margin: float
    outcome: str


class _Cause(NamedTuple):
    """Dispersions that remain in a reduced violation, and their independent coordinates (`_find_directions`)."""

    paths: list[str]
    coordinates: np.ndarray

    def is_similar(self, other: _Cause) -> bool:
        """Whether another reduced violation has the same dispersions, with similar coordinates."""
        distance = np.linalg.norm(self.coordinates - other.coordinates) if self.paths == other.paths else math.inf
        return float(distance) <= _MAX_CAUSE_DISTANCE


def start_search(
    campaign: Campaign,
    parameters: SearchParameters,
    max_cases: int,
    directory: Path,
    executor: ExecutorConfig,
    observer: ProgressObserver,
) -> SearchResult:
    """Run the study in a new folder.

    Raises CampaignError for an unsuitable campaign, requirement or folder. On KeyboardInterrupt all finished rows are
    stored, and `runner.continue_study` continues.
    """
    find_requirement(campaign, parameters.requirement)
    session = StudySession(SEARCH, parameters, SearchStudy, executor, observer)
    return start_study(campaign, max_cases, directory, session)


class SearchStudy:
    """A running search."""

    def __init__(self, campaign: Campaign, parameters: SearchParameters, runner: PointRunner) -> None:
        self.campaign, self.parameters, self.runner = campaign, parameters, runner
        self._requirement: Requirement = find_requirement(campaign, parameters.requirement)
        self._evaluated: list[_EvaluatedPoint] = []

    def run(self, observer: ProgressObserver) -> SearchResult:
        """Search and reduce; a limit of cases ends the study with the failures so far."""
        observer.begin("search", self.parameters.cases)
        failures: list[FoundFailure] = []
        reason = ""
        n_searched: int | None = None
        try:
            self._explore()
            self._evolve()
            n_searched = len(self._evaluated)
            violating_cases = [item for item in self._evaluated if item.margin < 0.0]
            observer.begin("reduction", _REDUCTION_CASES * min(len(violating_cases), self.parameters.max_failures))
            self._reduce_all(violating_cases, failures)
        except CaseLimitError as error:
            reason = f"The limit of cases was reached: {error}."
        searched_cases = self._evaluated[:n_searched]  # all if the limit ended the search itself
        violation_numbers = [index + 1 for index, item in enumerate(searched_cases) if item.margin < 0.0]
        return SearchResult(
            failures=tuple(sorted(failures, key=lambda failure: failure.distance)),
            search_cases=len(searched_cases),
            cases=self.runner.n_cases,
            violations=len(violation_numbers),
            min_margin=min((item.margin for item in searched_cases), default=math.nan),
            first_violation=violation_numbers[0] if violation_numbers else None,
            margin_text=describe_margin(self._requirement),
            reason=reason,
        )

    def _evaluate(self, points: Sequence[StudyPoint]) -> list[_EvaluatedPoint]:
        """Run cases, and add them to the evaluated cases of the study."""
        first = self.runner.n_cases
        rows = self.runner.run(points)
        new_cases = [
            _EvaluatedPoint(
                first + index,
                StudyPoint.read(str(row[POINT_COLUMN])),
                compute_margin(row, self._requirement),
                str(row["outcome"]),
            )
            for index, row in enumerate(rows)
        ]
        self._evaluated += new_cases
        return new_cases

    def _seed(self, name: str) -> int:
        """Derive the seed of one part of the study from the seed of the campaign."""
        definition = self.campaign.definition
        generator = Streams(definition.seed, definition.name, 0).generator(f"search: {name}")
        return int(generator.integers(1, 2**31))

    def _explore(self) -> None:
        """Evaluate a Sobol sequence, the largest power of 2 within half of the cases."""
        dimension = len(self.campaign.drawn_paths)
        exponent = int(math.log2(max(_EXPLORATION_FRACTION * self.parameters.cases, 2.0)))
        sequence = qmc.Sobol(dimension, rng=np.random.default_rng(self._seed("exploration"))).random_base2(exponent)
        coordinates = np.clip(ndtri(sequence), -_MAX_COORDINATE, _MAX_COORDINATE)
        self._evaluate([StudyPoint(tuple(point.tolist())) for point in coordinates])

    def _evolve(self) -> None:
        """Run evolution strategies in parallel until the cases are used."""
        parameters = self.parameters
        options = {
            "bounds": [-_MAX_COORDINATE, _MAX_COORDINATE],
            "verbose": -9,  # no output
            "verb_log": 0,  # no log files
            # margins are noisy, and equal margins are usual
            "tolfun": 0.0,
            "tolfunhist": 0.0,
            "tolflatfitness": 10**6,
        }
        if len(self.campaign.drawn_paths) == 1:
            options["maxstd_boundrange"] = math.inf  # `cma` raises an exception at this limit in one dimension
        strategies = [
            cma.CMAEvolutionStrategy(list(start), _STEP, {"seed": self._seed(f"strategy {number}"), **options})
            for number, start in enumerate(self._select_starts())
        ]
        size = strategies[0].popsize
        while self.runner.n_cases + size * len(strategies) <= parameters.cases:
            populations = [strategy.ask() for strategy in strategies]
            candidates = [StudyPoint(tuple(map(float, point))) for points in populations for point in points]
            margins = _replace_infinite(np.array([item.margin for item in self._evaluate(candidates)]))
            for number, (strategy, points) in enumerate(zip(strategies, populations, strict=True)):
                strategy.tell(points, margins[number * size : (number + 1) * size].tolist())

    def _select_starts(self) -> list[tuple[float, ...]]:
        """Select the best explored cases that differ from each other."""
        sorted_cases = sorted(self._evaluated, key=lambda item: item.margin)
        starts: list[tuple[float, ...]] = []
        for item in sorted_cases:
            point = np.array(item.point.coordinates)
            min_distance = _MIN_START_DISTANCE * math.sqrt(point.size)
            if all(np.linalg.norm(point - np.array(other)) >= min_distance for other in starts):
                starts.append(item.point.coordinates)
            if len(starts) == self.parameters.restarts:
                break
        return starts

    def _reduce_all(self, violating_cases: list[_EvaluatedPoint], failures: list[FoundFailure]) -> None:
        """Reduce the most likely violation, remove those with the same cause, and repeat with the others.

        failures: receives the reduced violations, also those before a CaseLimitError
        """
        remaining = sorted(violating_cases, key=lambda item: float(np.linalg.norm(item.point.coordinates)))
        causes: list[_Cause] = []
        while remaining and len(failures) < self.parameters.max_failures:
            first = remaining[0]
            reduction = self._shrink(self._remove_dispersions(first))
            paths = [path for path in self.campaign.drawn_paths if path not in reduction.point.nominal]
            directions = self._find_directions(paths)
            cause = _Cause(paths, directions @ np.array(reduction.point.coordinates))
            coordinates = np.array([item.point.coordinates for item in remaining]) @ directions.T
            has_same_cause = np.linalg.norm(coordinates - coordinates[0], axis=1) <= _MAX_CAUSE_DISTANCE
            remaining = [item for item, is_similar in zip(remaining, has_same_cause, strict=True) if not is_similar]
            known = next((index for index, other in enumerate(causes) if cause.is_similar(other)), None)
            if known is not None:
                similar = failures[known].similar + int(has_same_cause.sum())
                failures[known] = replace(failures[known], similar=similar)
                continue
            causes.append(cause)
            repetition = StudyPoint(reduction.point.coordinates, nominal=reduction.point.nominal)
            repetitions = self._evaluate([repetition] * self.parameters.repetitions)
            failures.append(
                FoundFailure(
                    case=reduction.case,
                    original_case=first.case,
                    margin=reduction.margin,
                    values=self._changed_values(reduction.point),
                    distance=float(np.linalg.norm(cause.coordinates)),
                    similar=int(has_same_cause.sum()),
                    repeated=sum(item.margin < 0.0 for item in repetitions),
                    repetitions=len(repetitions),
                    outcome=reduction.outcome,
                )
            )

    def _changed_values(self, point: StudyPoint) -> dict[str, Any]:
        """Return the values of the dispersions, by path, that replace the campaign's parameters in a case."""
        values, parameters = self.campaign.draws_at(point), self.campaign.definition.parameters
        drawn = (*self.campaign.drawn_paths, *self.campaign.cyclic_paths)
        # fixed and derived values, which are in every case
        others = (path for path in values if path not in drawn and values[path] != value_at(parameters, path))
        return {path: values[path] for path in (*drawn, *others) if path not in point.nominal}

    def _remove_dispersions(self, failure: _EvaluatedPoint) -> _EvaluatedPoint:
        """Reset groups of dispersions to the campaign's parameters, as long as the case remains a violation."""
        paths = [path for path in self.campaign.drawn_paths if path not in failure.point.nominal]
        group_count = 2
        while paths:
            size = math.ceil(len(paths) / group_count)
            groups = [paths[start : start + size] for start in range(0, len(paths), size)]
            candidates = [
                StudyPoint(failure.point.coordinates, failure.point.stream, (*failure.point.nominal, *group))
                for group in groups
            ]
            trials = self._evaluate(candidates)
            removed_group = next((index for index, item in enumerate(trials) if item.margin < 0.0), None)
            if removed_group is not None:
                failure = trials[removed_group]
                paths = [path for path in paths if path not in groups[removed_group]]
                group_count = max(group_count - 1, 2)
            elif size == 1:
                break
            else:
                group_count = min(2 * group_count, len(paths))
        return failure

    def _find_directions(self, paths: Sequence[str]) -> np.ndarray:
        """Find the directions in standard normal space on which the values of dispersions depend.

        Returns orthonormal rows, as many as `paths`. Their products with a point are independent standard normal
        numbers, which determine the values. The norm of these numbers is the smallest distance from the origin of a
        point with the same values. Without correlation the numbers are the coordinates of `paths`.
        """
        drawn_paths = self.campaign.drawn_paths
        factor = np.eye(len(drawn_paths))
        for group in self.campaign.definition.correlations:
            members = [drawn_paths.index(path) for path in group.parameters]
            factor[np.ix_(members, members)] = group.factor
        rows = factor[[drawn_paths.index(path) for path in paths]]
        return np.asarray(np.linalg.solve(np.linalg.cholesky(rows @ rows.T), rows))

    def _shrink(self, failure: _EvaluatedPoint) -> _EvaluatedPoint:
        """Bisect each remaining coordinate towards its median, as long as the case remains a violation."""
        nominal = failure.point.nominal
        directions = self._find_directions([path for path in self.campaign.drawn_paths if path not in nominal])
        coordinates = directions @ np.array(failure.point.coordinates)
        for index, start in enumerate(coordinates.tolist()):
            inner, outer = 0.0, start  # the median, and a violation
            for _ in range(_BISECTION_STEPS):
                middle = 0.5 * (inner + outer)
                coordinates[index] = middle
                point = tuple((coordinates @ directions).tolist())
                (trial,) = self._evaluate([StudyPoint(point, failure.point.stream, nominal)])
                if trial.margin < 0.0:
                    failure, outer = trial, middle
                else:
                    inner = middle
            coordinates[index] = outer
        return failure


def _replace_infinite(margins: np.ndarray) -> np.ndarray:
    """Replace infinite margins by numbers beyond the finite ones, which an evolution strategy can rank."""
    finite = margins[np.isfinite(margins)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    width = max(high - low, 1.0)
    return np.asarray(np.clip(margins, low - width, high + width))
