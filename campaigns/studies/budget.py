"""Study `budget`: contribution of each source of error and of each dispersion to the error of a campaign.

Each base case runs with all sources of error, without any, without each one, and with each one alone, with the same
dispersions and random streams.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from SALib.analyze import sobol as sobol_indices
from SALib.sample import sobol as sobol_design
from scipy.special import ndtri

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import Requirement
from marsyard.campaigns.definition.margins import compute_margin
from marsyard.campaigns.definition.parameter_paths import paths_overlap, value_at
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.running.progress import ProgressObserver
from marsyard.campaigns.sampling.correlation import MAX_DRAW, MIN_DRAW
from marsyard.campaigns.sampling.study_points import StudyPoint
from marsyard.campaigns.store.rows import Row
from marsyard.campaigns.studies.contributions import MIN_COMMON, compute_budget
from marsyard.campaigns.studies.point_runner import CaseLimitError, PointRunner
from marsyard.campaigns.studies.results import BUDGET, BudgetParameters, BudgetResult, SobolIndex
from marsyard.campaigns.studies.runner import StudySession, check_margin, find_requirement, start_study
from marsyard.scenarios.error_sources import ScenarioSource, error_sources
from marsyard.sim.streams import Streams

#: Name of the variable of the random streams among Sobol's indices.
STREAMS = "random streams"
#: Number of base cases that are evaluated together.
_BATCH = 8
#: Minimum number of complete base samples for Sobol's indices, and number of resamples for their intervals.
_MIN_SAMPLES, _RESAMPLES = 8, 500


@dataclass(frozen=True)
class Variant:
    """A variant of the base cases: the sources of error that act in them.

    - name: `all`, `none`, `without SOURCE`, or `only SOURCE`; removed: names of the sources that do not act
    """

    name: str
    removed: tuple[str, ...]


def start_budget(
    campaign: Campaign,
    parameters: BudgetParameters,
    directory: Path,
    executor: ExecutorConfig,
    observer: ProgressObserver,
) -> BudgetResult:
    """Run the study in a new folder.

    Raises CampaignError for an unsuitable campaign, requirement or folder. On KeyboardInterrupt all finished rows are
    stored, and `runner.continue_study` continues.
    """
    check_margin(find_requirement(campaign, parameters.requirement))
    sources, _ = active_sources(campaign)
    if not sources and not parameters.sobol:
        scenario = campaign.definition.scenario
        reason = "has no active source of error"
        if not error_sources(scenario):
            reason = f"has the scenario '{scenario}', which names no sources of error"
        raise CampaignError(f"campaign '{campaign.definition.name}' {reason}; allowed: --sobol N")
    n_cases = parameters.cases * len(list_variants(sources)) if sources else 0
    n_cases += parameters.sobol * _cases_per_sample(len(_list_variables(campaign)))
    session = StudySession(BUDGET, parameters, BudgetStudy, executor, observer)
    return start_study(campaign, n_cases, directory, session)


def _list_variables(campaign: Campaign) -> list[str]:
    """List the variables of Saltelli's design: the dispersions and the random streams."""
    return [*campaign.drawn_paths, STREAMS]


def _cases_per_sample(variables: int) -> int:
    """Return the number of cases per base sample of Saltelli's design without second order (SALib's layout)."""
    return variables + 2


def active_sources(campaign: Campaign) -> tuple[tuple[ScenarioSource, ...], tuple[str, ...]]:
    """Return the sources of error that act in the campaign, and the titles of the other sources.

    A source acts if one of its parameters is dispersed, alone or in a table, or differs from its value without the
    error.
    """
    parameters = campaign.definition.parameters

    def is_dispersed(path: str) -> bool:
        return any(paths_overlap(path, name) for name in campaign.definition.dispersions)

    active: list[ScenarioSource] = []
    inactive: list[str] = []
    for source in error_sources(campaign.definition.scenario):
        exact = source.exact_values(parameters)
        is_active = any(is_dispersed(path) or value_at(parameters, path) != value for path, value in exact.items())
        if is_active:
            active.append(source)
        else:
            inactive.append(source.title)
    return tuple(active), tuple(inactive)


def list_variants(sources: Sequence[ScenarioSource]) -> list[Variant]:
    """List the variants of an error budget: all sources, none, without each one, and each one alone."""
    names = tuple(source.name for source in sources)
    return [
        Variant("all", ()),
        Variant("none", names),
        *(Variant(f"without {name}", (name,)) for name in names),
        *(Variant(f"only {name}", tuple(other for other in names if other != name)) for name in names),
    ]


class BudgetStudy:
    """A running error budget."""

    def __init__(self, campaign: Campaign, parameters: BudgetParameters, runner: PointRunner) -> None:
        self._campaign, self._parameters, self._runner = campaign, parameters, runner
        self._requirement: Requirement = find_requirement(campaign, parameters.requirement)
        self._sources, self._inactive = active_sources(campaign)

    def run(self, observer: ProgressObserver) -> BudgetResult:
        """Evaluate all variants and Saltelli's design; compute contributions and indices."""
        parameters = self._parameters
        variants = list_variants(self._sources) if self._sources else []
        n = len(variants)
        errors = np.full((n, parameters.cases), np.nan)
        groups = np.arange(parameters.cases)
        violations, reason, index_samples = 0, "", 0
        indices: tuple[SobolIndex, ...] = ()
        try:
            if n:
                observer.begin("cases", n * parameters.cases)
                errors, groups, violations = self._run_variants(variants)
            if parameters.sobol:
                cases = parameters.sobol * _cases_per_sample(len(_list_variables(self._campaign)))
                observer.begin("cases of Saltelli's design", cases)
                indices, index_samples = self._run_design()
        except CaseLimitError as error:
            reason = f"The limit of cases was reached: {error}."
        budget = compute_budget(
            errors, groups, [item.source for item in self._sources], self._is_centred, parameters.confidence
        )
        if budget is None and n and not reason:
            reason = (
                f"No budget: fewer than {MIN_COMMON} base cases were answered in every variant, all are on one "
                "terrain, or all errors are equal."
            )
        return BudgetResult(
            quantity=self._quantity,
            centred=self._is_centred,
            inactive=self._inactive,
            budget=budget,
            cases=parameters.cases if n else 0,
            violations=violations,
            indices=indices,
            index_samples=index_samples,
            evaluated=self._runner.n_cases,
            reason=reason,
        )

    @property
    def _is_centred(self) -> bool:
        """Whether the mean square is taken about the mean: for a margin, not for an error."""
        return self._requirement.bound is None

    @property
    def _quantity(self) -> str:
        return str(self._requirement.margin if self._is_centred else self._requirement.metric)

    def _error(self, row: Row) -> float:
        """Return the error of a case; NaN outside of the population, or without a value."""
        margin = compute_margin(row, self._requirement)
        if not math.isfinite(margin):
            return math.nan
        return margin if self._requirement.bound is None else self._requirement.bound - margin

    def _generator(self, name: str) -> np.random.Generator:
        """Create a random generator of the study, which does not depend on the cases."""
        definition = self._campaign.definition
        return Streams(definition.seed, definition.name, 0).generator(f"budget: {name}")

    def _run_variants(self, variants: Sequence[Variant]) -> tuple[Float64[np.ndarray, "variants n"], np.ndarray, int]:
        """Evaluate the base cases in all variants; return errors, terrain groups, and number of violations."""
        n, dimension = self._parameters.cases, len(self._campaign.drawn_paths)
        points = self._generator("base cases").standard_normal((n, dimension))
        errors = np.full((len(variants), n), np.nan)
        terrains: list[str] = []
        violations = 0
        for first in range(0, n, _BATCH):
            cases = range(first, min(first + _BATCH, n))
            candidates = [
                StudyPoint(tuple(points[case].tolist()), case, (), variant.removed)
                for case in cases
                for variant in variants
            ]
            rows = self._runner.run(candidates)
            errors[:, list(cases)] = np.reshape([self._error(row) for row in rows], (len(cases), -1)).T
            # the first variant is that with all sources
            rows_all_sources = rows[:: len(variants)]
            violations += sum(compute_margin(row, self._requirement) < 0.0 for row in rows_all_sources)
            names = [str(row.get("terrain", f"case {case}")) for case, row in zip(cases, rows_all_sources, strict=True)]
            terrains += names
        return errors, np.unique(terrains, return_inverse=True)[1], violations

    def _run_design(self) -> tuple[tuple[SobolIndex, ...], int]:
        """Evaluate Saltelli's design, and compute Sobol's indices of the base samples without a missing error.

        The random streams are one variable: a uniform number selects their number.
        """
        paths = _list_variables(self._campaign)
        problem = {"num_vars": len(paths), "names": paths, "bounds": [[0.0, 1.0]] * len(paths)}
        seed = int(self._generator("Saltelli's design").integers(2**31))
        uniform = sobol_design.sample(problem, self._parameters.sobol, calc_second_order=False, seed=seed)
        coordinates = ndtri(np.clip(uniform[:, :-1], MIN_DRAW, MAX_DRAW))
        streams = np.minimum(uniform[:, -1] * 2.0**31, 2.0**31 - 1.0).astype(np.int64)
        errors: list[float] = []
        block = _cases_per_sample(len(paths))
        for first in range(0, len(uniform), block):
            cases = range(first, first + block)
            rows = self._runner.run([StudyPoint(tuple(coordinates[i].tolist()), int(streams[i])) for i in cases])
            errors += [self._error(row) for row in rows]
        return compute_indices(np.array(errors), problem, self._parameters.confidence, seed)


def compute_indices(
    errors: Float64[np.ndarray, "n"], problem: Mapping[str, Any], confidence: float, seed: int
) -> tuple[tuple[SobolIndex, ...], int]:
    """Compute Sobol's indices from Saltelli's design without second order; also return the number of complete samples.

    Base samples with a missing error in any of their cases are omitted. No indices for fewer than 8 samples, or if all
    errors are equal.
    """
    blocks = errors.reshape(-1, _cases_per_sample(problem["num_vars"]))
    complete = blocks[np.isfinite(blocks).all(axis=1)]
    if len(complete) < _MIN_SAMPLES or np.ptp(complete) == 0.0:
        return (), len(complete)
    values = sobol_indices.analyze(
        problem, complete.ravel(), calc_second_order=False, conf_level=confidence, num_resamples=_RESAMPLES, seed=seed
    )
    indices = [
        SobolIndex(name, *(float(values[key][index]) for key in ("S1", "S1_conf", "ST", "ST_conf")))
        for index, name in enumerate(problem["names"])
    ]
    return tuple(sorted(indices, key=lambda item: -item.total)), len(complete)
