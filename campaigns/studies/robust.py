"""Study `robust`: cases of a stored run, repeated with other values of parameters that its campaign does not disperse.

Each variant runs the same cases, with the same dispersions and random streams, so that only its values differ. The
cases are those nearest to a violation, and a random sample of the others; each of the sample represents several. The
study is stored in the folder `robust` of the run, whose report evaluates it (`marsyard.reports.variants`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int
from pydantic import ValidationError
from scipy.special import ndtri
from scipy.stats import rankdata

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import CampaignDefinition, Requirement
from marsyard.campaigns.definition.margins import compute_margin
from marsyard.campaigns.definition.parameter_paths import value_at
from marsyard.campaigns.definition.variants import SystemVariant
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.running.progress import ProgressObserver
from marsyard.campaigns.running.stored_campaign import load_stored_campaign
from marsyard.campaigns.sampling.dispersions import Derived, Fixed
from marsyard.campaigns.sampling.study_points import StudyPoint
from marsyard.campaigns.store import record
from marsyard.campaigns.store.origin import check_rows
from marsyard.campaigns.store.rows import Row
from marsyard.campaigns.store.table import TABLE_FILE, read_rows
from marsyard.campaigns.studies.point_runner import PointRunner
from marsyard.campaigns.studies.results import ROBUST, RobustParameters, RobustResult, RobustVariant
from marsyard.campaigns.studies.runner import StudySession, check_identity, start_study
from marsyard.campaigns.studies.study_record import STUDY_KEY
from marsyard.sim.streams import Streams

#: Number of steps from the assumed value of a parameter to the farthest one.
STEPS = 3
#: Minimum number of cases: their effective number is at least half of them, of which verdicts need 30.
MIN_CASES = 60
#: Number of cases that are evaluated together.
_BATCH = 8


def start_robust(
    run: Path,
    farthest: Mapping[str, float],
    variants: Sequence[SystemVariant],
    cases: int,
    directory: Path,
    executor: ExecutorConfig,
    observer: ProgressObserver,
) -> RobustResult:
    """Run cases of a stored run with other parameters, in a new folder.

    - farthest: value of each parameter up to which it is changed, by path
    - variants: named variants; those with the values of the campaign are omitted
    - cases: number of cases; those of the run if it has fewer
    Raises CampaignError for an unsuitable run, parameter or folder. On KeyboardInterrupt all finished rows are stored,
    and `runner.continue_study` continues.
    """
    if cases < MIN_CASES:
        raise CampaignError(f"--cases {cases}: at least {MIN_CASES}, so that the effective number of cases is 30")
    definition = record.stored_definition(run)
    campaign = _load_run(run, definition)
    steps = [step for path, value in farthest.items() for step in _list_steps(campaign, path, value)]
    named = [
        RobustVariant(item.name, item.title, values, factors=factors)
        for item in variants
        for values, factors in [item.changes(campaign)]
        if values or factors
    ]
    if not (steps or named):
        reason = "all variants have the values of the campaign, or change parameters that it lacks"
        raise CampaignError(f"{run}: there is nothing to change: {reason}")
    rows = read_rows(run / TABLE_FILE)
    if definition.design.nominal:
        rows = rows[1:]  # the first case is no random draw
    chosen, weights = choose_cases(rows, definition.requirements, cases, _generator(definition))
    parameters = RobustParameters((*steps, *named), tuple(chosen.tolist()), tuple(weights.tolist()))
    for variant in parameters.variants:
        _check_values(campaign, variant, parameters.cases)
    session = StudySession(ROBUST, parameters, RobustCasesStudy, executor, observer)
    n_cases = len(parameters.variants) * len(parameters.cases)
    return start_study(campaign, n_cases, directory, session, streams=definition.total_cases)


def choose_cases(
    rows: Sequence[Row], requirements: Sequence[Requirement], count: int, rng: np.random.Generator
) -> tuple[Int[np.ndarray, " count"], Float64[np.ndarray, " count"]]:
    """Choose cases of a run, and the number of its cases that each represents.

    Half of them have the smallest margins of any requirement, and represent themselves. The others are a random sample
    of the remaining cases, which they represent in equal parts.
    """
    numbers = np.array([int(row["case"]) for row in rows])
    if count >= numbers.size:
        return numbers, np.ones(numbers.size)
    margins = np.array([[compute_margin(row, item) for row in rows] for item in requirements])
    # equal margins, such as those of a metric that is only true or false, have the rank of the last one
    ranks = rankdata(margins, method="max", axis=1).min(axis=0)
    order = np.argsort(ranks, kind="stable")
    nearest, others = order[: count // 2], order[count // 2 :]
    sample = rng.choice(others, count - nearest.size, replace=False)
    weights = np.repeat([1.0, others.size / sample.size], [nearest.size, sample.size])
    chosen = np.concatenate([nearest, sample])
    by_number = np.argsort(numbers[chosen])
    return numbers[chosen][by_number], weights[by_number]


def _load_run(run: Path, definition: CampaignDefinition) -> Campaign:
    """Load the campaign of a run. Raises CampaignError if its cases cannot be repeated, or are no random draws."""
    stored = record.read(run)
    if STUDY_KEY in stored or definition.design.kind != "random" or definition.grids:
        reason = "its cases are not independent random draws"
        raise CampaignError(f"{run}: {reason}; allowed: a campaign of `marsyard run` whose simulated cases are random")
    if stored.get("state") != "finished" or not definition.requirements:
        reason = "it has no requirement" if stored.get("state") == "finished" else "it is not finished"
        raise CampaignError(f"{run}: {reason}; allowed: a finished campaign with requirements")
    campaign = load_stored_campaign(run, definition)
    check_rows(run)
    check_identity(campaign, run)
    return campaign


def _list_steps(campaign: Campaign, path: str, farthest: float) -> list[RobustVariant]:
    """List the steps of a parameter from its value in the campaign, excluded, to the farthest value."""
    option = f"--parameter {path}={farthest:g}"
    dispersion = campaign.definition.dispersions.get(path)
    if isinstance(dispersion, Fixed | Derived):
        raise CampaignError(
            f"{option}: dispersions.{path} of the campaign is '{dispersion.distribution}'; allowed: parameters without "
            "a dispersion. Run the campaign with the value under [parameters] instead"
        )
    if dispersion is not None:
        raise CampaignError(
            f"{option}: the parameter is dispersed, so that the stored cases give its robustness; to exceed its "
            "distribution, run the campaign with another one"
        )
    try:
        assumed = value_at(campaign.definition.parameters, path)
    except ValueError as error:
        raise CampaignError(f"{option}: {error}") from error
    if isinstance(assumed, bool) or not isinstance(assumed, int | float):
        raise CampaignError(f"{option}: its value in the campaign is {assumed!r}; allowed: parameters with a number")
    if isinstance(assumed, int) and not float(farthest).is_integer():
        raise CampaignError(f"{option}: its value in the campaign is {assumed}; allowed: whole numbers")
    if farthest == assumed:
        raise CampaignError(f"{option}: this is its value in the campaign; give the farthest value to be examined")
    values = [assumed + (farthest - assumed) * step / STEPS for step in range(1, STEPS + 1)]
    if isinstance(assumed, int):
        values = [float(value) for value in sorted({round(value) for value in values} - {assumed})]
        values = values if farthest > assumed else values[::-1]
    typed = [type(assumed)(value) for value in values]
    return [RobustVariant(f"{path} = {value:g}", f"{path} = {value:g}", {path: value}, path) for value in typed]


def _check_values(campaign: Campaign, variant: RobustVariant, cases: Sequence[int]) -> None:
    """Raise CampaignError if the scenario rejects the values of a variant, or sampled tables would replace them."""
    for path in (*variant.values, *variant.factors):
        table = next((name for name in campaign.definition.dispersions if path.startswith(f"{name}.")), None)
        if table is not None:
            raise CampaignError(f"{variant.name}: its table '{table}' is dispersed as a whole")
    for case in cases:
        try:
            point = _create_point(campaign, case, variant)
            changed = campaign.at(point)
            changed.with_values(changed.draws_at(point))
        except (ValidationError, ValueError, KeyError, TypeError) as error:
            reason = error.errors()[0]["msg"] if isinstance(error, ValidationError) else str(error)
            raise CampaignError(f"{variant.name}: {reason} (case {case})") from error


def _create_point(campaign: Campaign, case: int, variant: RobustVariant) -> StudyPoint:
    """Create the point of a stored case with the values of a variant."""
    uniform = campaign.draw_uniform(case)
    point = StudyPoint(tuple(ndtri([uniform[path] for path in campaign.drawn_paths]).tolist()), case)
    sampled = campaign.draws_at(point) if variant.factors else {}
    values = variant.values | {path: factor * sampled[path] for path, factor in variant.factors.items()}
    return replace(point, values=tuple(values.items()))


def _generator(definition: CampaignDefinition) -> np.random.Generator:
    return Streams(definition.seed, definition.name, 0).generator("robust: cases")


class RobustCasesStudy:
    """Running study `robust`: the chosen cases, each in all variants, run in batches."""

    def __init__(self, campaign: Campaign, parameters: RobustParameters, runner: PointRunner) -> None:
        self._campaign, self._parameters, self._runner = campaign, parameters, runner

    def run(self, observer: ProgressObserver) -> RobustResult:
        """Run all cases in all variants; the variants of a case follow each other."""
        variants, cases = self._parameters.variants, self._parameters.cases
        observer.begin("cases", len(variants) * len(cases))
        for first in range(0, len(cases), _BATCH):
            batch = cases[first : first + _BATCH]
            self._runner.run([_create_point(self._campaign, case, variant) for case in batch for variant in variants])
        return RobustResult(self._runner.n_cases)
