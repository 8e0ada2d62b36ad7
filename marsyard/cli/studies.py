"""Commands `marsyard rare`, `search`, `budget` and `robust`: start or continue studies that choose their cases."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from typer import Option

from marsyard.cli import options
from marsyard.cli.errors import handle_user_errors
from marsyard.cli.execution import default_directory, make_executor, show_progress
from marsyard.cli.terminal import create_console

if TYPE_CHECKING:
    from marsyard.campaigns.studies.results import SearchResult

MaxCasesOption = Annotated[int, Option(metavar="N", min=100, help="Maximum number of cases of the study.")]
RequirementOption = Annotated[str, Option(metavar="ID", help="Requirement of the campaign that is analysed.")]
StudyAlgorithmOption = Annotated[
    list[str] | None,
    Option(
        "--algorithm",
        metavar="NAME",
        help="The algorithm that the study analyses: a name, module:Class, exec:PROGRAM (started per case) or "
        "serve:PROGRAM (one process for all cases). Further algorithms run on the same cases; their results are "
        "stored, but do not influence the study.",
    ),
]


@handle_user_errors
def rare(
    campaign: options.CampaignArgument,
    requirement: RequirementOption,
    seed: options.SeedOption = None,
    jobs: options.JobsOption = None,
    cluster: options.ClusterOption = None,
    out: options.OutOption = None,
    override: options.SetOption = None,
    algorithm: StudyAlgorithmOption = None,
    max_probability: Annotated[
        float, Option(metavar="P", help="Maximum probability of a violation per case, such as 1e-4.")
    ] = 1e-4,
    method: Annotated[
        str,
        Option(
            metavar="METHOD",
            help="`subset`: subset simulation. `importance`: the same, followed by importance sampling.",
        ),
    ] = "subset",
    samples: Annotated[int, Option(metavar="N", help="Cases per level of a subset simulation.")] = 200,
    replicates: Annotated[int, Option(metavar="N", help="Number of independent subset simulations, at least 2.")] = 6,
    random_cases: Annotated[
        int,
        Option(
            metavar="N",
            help="Independent random cases. PASS rests on them and on the first level of each replicate. They do not "
            "count for --max-cases.",
        ),
    ] = 600,
    importance_cases: Annotated[
        int, Option(metavar="N", help="Cases of importance sampling, for --method importance.")
    ] = 600,
    confidence: Annotated[
        float, Option(metavar="C", help="Two-sided confidence: PASS and FAIL are each wrong at most with (1 - C) / 2.")
    ] = 0.9,
    max_cases: MaxCasesOption = 20_000,
) -> None:
    """Compare the probability of a rare violation of a requirement with a limit, by counting and by subset simulation.

    Exit status: 0 if the probability is below the limit by counting, 1 if it is above, 3 if undecided.
    """
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.campaigns.studies.rare import start_rare
    from marsyard.campaigns.studies.results import RareParameters

    parameters = RareParameters(
        requirement=requirement,
        max_probability=max_probability,
        method=method,
        samples=samples,
        replicates=(replicates,),
        random_cases=(random_cases,),
        importance_cases=importance_cases,
        confidence=confidence,
    )
    studied = load_campaign(campaign, override or [], None, seed, algorithm or [])
    executor, directory = make_executor(jobs, cluster), out or default_directory(f"{studied.definition.name}-rare")
    with show_progress(directory) as progress:
        result = start_rare(studied, parameters, max_cases, directory, executor, progress)
    _finish_study(directory, result.exit_code)


@handle_user_errors
def search(
    campaign: options.CampaignArgument,
    requirement: RequirementOption,
    seed: options.SeedOption = None,
    jobs: options.JobsOption = None,
    cluster: options.ClusterOption = None,
    out: options.OutOption = None,
    override: options.SetOption = None,
    algorithm: StudyAlgorithmOption = None,
    cases: Annotated[
        int,
        Option(
            "-n",
            "--cases",
            metavar="N",
            help="Cases of the search; the reduction of each violation takes further cases.",
        ),
    ] = 300,
    restarts: Annotated[
        int, Option(metavar="N", help="Number of optimizer (CMA-ES) runs from different starting cases.")
    ] = 3,
    failures: Annotated[
        int, Option(metavar="N", help="Maximum number of violations whose causes are reduced to a few parameters.")
    ] = 5,
    max_cases: MaxCasesOption = 5_000,
) -> None:
    """Search for violations of a requirement, and reduce each to the few parameters that cause it.

    Exit status: 1 if violations are found, otherwise 0.
    """
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.campaigns.studies.results import SearchParameters
    from marsyard.campaigns.studies.search import start_search

    parameters = SearchParameters(requirement=requirement, cases=cases, restarts=restarts, max_failures=failures)
    studied = load_campaign(campaign, override or [], None, seed, algorithm or [])
    executor, directory = make_executor(jobs, cluster), out or default_directory(f"{studied.definition.name}-search")
    with show_progress(directory) as progress:
        result = start_search(studied, parameters, max_cases, directory, executor, progress)
    _finish_search(directory, result)


@handle_user_errors
def budget(
    campaign: options.CampaignArgument,
    requirement: RequirementOption,
    seed: options.SeedOption = None,
    jobs: options.JobsOption = None,
    cluster: options.ClusterOption = None,
    out: options.OutOption = None,
    override: options.SetOption = None,
    algorithm: StudyAlgorithmOption = None,
    cases: Annotated[
        int, Option("-n", "--cases", metavar="N", help="Base cases. Each runs 2 k + 2 times for k sources of error.")
    ] = 100,
    sobol: Annotated[
        int,
        Option(
            metavar="N",
            help="Base samples for Sobol indices of d dispersions and the random streams, a power of 2: N (d + 3) "
            "more cases. 0: none.",
        ),
    ] = 0,
    confidence: Annotated[float, Option(metavar="C", help="Two-sided confidence of the intervals.")] = 0.9,
) -> None:
    """Compute the error budget: run the same cases without each source of error, and with each one alone.

    Sources of error are those of the scenario, such as attitude, altitude or detector noise (docs/error-budget.md).
    """
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.campaigns.studies.budget import start_budget
    from marsyard.campaigns.studies.results import BudgetParameters

    parameters = BudgetParameters(requirement=requirement, cases=cases, sobol=sobol, confidence=confidence)
    studied = load_campaign(campaign, override or [], None, seed, algorithm or [])
    executor, directory = make_executor(jobs, cluster), out or default_directory(f"{studied.definition.name}-budget")
    with show_progress(directory) as progress:
        result = start_budget(studied, parameters, directory, executor, progress)
    _finish_study(directory, result.exit_code)


@handle_user_errors
def robust(
    directory: options.DirectoryArgument,
    parameter: Annotated[
        list[str] | None,
        Option(
            metavar="PATH=VALUE",
            help="Run cases with other values of a parameter that the campaign does not disperse, up to VALUE.",
        ),
    ] = None,
    variant: Annotated[
        list[str] | None,
        Option(metavar="NAME", help="Run cases with an alternative model of the system; `all`: with each of them."),
    ] = None,
    cases: Annotated[
        int, Option("-n", "--cases", metavar="N", help="Cases of the run, at least 60, for each value and model.")
    ] = 100,
    jobs: options.JobsOption = None,
    cluster: options.ClusterOption = None,
) -> None:
    """Show which changes of the assumptions turn PASS into FAIL, from the stored cases of a campaign.

    Cases are run only for parameters that the campaign does not disperse, and for other models.
    """
    from marsyard.campaigns.definition.variants import system_variants
    from marsyard.campaigns.errors import CampaignError, unknown_name_message
    from marsyard.campaigns.store.record import stored_definition
    from marsyard.campaigns.studies.results import ROBUST_FOLDER
    from marsyard.campaigns.studies.robust import start_robust

    run, farthest = directory, _read_farthest(parameter or [])
    available = {item.name: item for item in system_variants(stored_definition(run).scenario)}
    if variant and not available:
        raise CampaignError(f"--variant: the scenario '{stored_definition(run).scenario}' has no variants")
    for name in variant or ():
        if name not in available and name != "all":
            raise CampaignError(f"--variant: {unknown_name_message('variant', name, ['all', *available])}")
    variants = [item for name, item in available.items() if {name, "all"} & {*(variant or ())}]
    if farthest or variant:
        directory = default_directory(ROBUST_FOLDER, run / ROBUST_FOLDER)
        executor = make_executor(jobs, cluster)
        with show_progress(directory) as progress:
            start_robust(run, farthest, variants, cases, directory, executor, progress)
    _finish_robust(run)


def _read_farthest(texts: Sequence[str]) -> dict[str, float]:
    """Read the values of the option `--parameter`. Raises CampaignError for another text."""
    from marsyard.campaigns.errors import CampaignError

    farthest = {}
    for text in texts:
        path, separator, value = text.partition("=")
        try:
            farthest[path.strip()] = float(value)
        except ValueError:
            farthest[path.strip()] = math.nan
        if not separator or not math.isfinite(farthest[path.strip()]):
            raise CampaignError(f"--parameter {text}: allowed: PATH=NUMBER, such as imu.gyro_scale_ppm=300")
    return farthest


def _finish_robust(run: Path) -> NoReturn:
    """Write the report of a run, print its robustness, and exit."""
    from marsyard.cli.outcome import evaluate_and_store
    from marsyard.cli.terminal import grid_table
    from marsyard.reports.robustness_section import change_grid, variant_grid
    from marsyard.reports.robustness_wording import robustness_text

    evaluation, page = evaluate_and_store(run)
    console = create_console()
    lines = []
    for verdict in evaluation.verdicts:
        records = [item for item in evaluation.robustness if item.requirement == verdict.requirement_id]
        if records:
            console.print(grid_table(f"Change to FAIL: {verdict.requirement_id}", change_grid(records)))
            lines.append(f"{verdict.requirement_id}: {robustness_text(verdict, records)}")
        else:
            lines.append(f"{verdict.requirement_id}: {verdict.status}, which no change is computed for")
    if evaluation.variants:
        grid, bands = variant_grid(evaluation.variants)
        console.print(grid_table("Other models", grid))
        lines.append(f"verdicts under other models: {bands}")
    for line in (*lines, f"report: {page}"):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    raise typer.Exit


def contains_study(directory: Path) -> bool:
    """Whether the folder contains a study, not an ordinary campaign."""
    from marsyard.campaigns.studies.study_record import read_study

    return read_study(directory) is not None


def continue_study_and_exit(
    directory: Path, jobs: int | None, cluster: str | None, additional: int = 0, *, is_random: bool = False
) -> NoReturn:
    """Continue the study in a folder, and exit with the status of its verdict.

    additional: number of replicates to add, or of random cases if `is_random`
    """
    from marsyard.campaigns.errors import CampaignError
    from marsyard.campaigns.studies.budget import BudgetStudy
    from marsyard.campaigns.studies.rare import continue_rare
    from marsyard.campaigns.studies.results import BUDGET, ROBUST, SEARCH
    from marsyard.campaigns.studies.robust import RobustCasesStudy
    from marsyard.campaigns.studies.runner import StudySession, continue_study
    from marsyard.campaigns.studies.search import SearchStudy
    from marsyard.campaigns.studies.study_record import StudyKind, read_study

    executor, name = make_executor(jobs, cluster), (read_study(directory) or {}).get("kind")
    kinds: list[tuple[StudyKind[Any, Any], Any]]
    kinds = [(SEARCH, SearchStudy), (BUDGET, BudgetStudy), (ROBUST, RobustCasesStudy)]
    others = {kind.name: (kind, study) for kind, study in kinds}
    with show_progress(directory) as progress:
        if name not in others:
            replicates, random_cases = (0, additional) if is_random else (additional, 0)
            result: Any = continue_rare(directory, executor, progress, replicates, random_cases)
        else:
            kind, study = others[name]
            if additional:
                raise CampaignError(f"{directory} contains {kind.title}, which cannot be extended; start a new one")
            session = StudySession(kind, kind.read_parameters(directory), study, executor, progress)
            result = continue_study(directory, session)
    if name == SEARCH.name:
        _finish_search(directory, result)
    if name == ROBUST.name:  # it is in a subfolder of the campaign's folder `ROBUST_FOLDER`
        _finish_robust(directory.resolve().parent.parent)
    _finish_study(directory, result.exit_code)


def _finish_search(directory: Path, result: SearchResult) -> NoReturn:
    """Store files and images of the reduced violations, write the report, print the result, and exit."""
    from marsyard.campaigns.running.replay import replay
    from marsyard.campaigns.running.stored_campaign import load_stored_campaign
    from marsyard.campaigns.store.products import case_directory, save_packed
    from marsyard.campaigns.store.record import stored_definition
    from marsyard.campaigns.studies.regression_campaigns import write_regression_campaigns

    campaign = load_stored_campaign(directory, stored_definition(directory))
    files = write_regression_campaigns(campaign, result, directory)
    for failure in result.failures:
        rerun = replay(directory, failure.case)
        if rerun.products is not None:
            save_packed(case_directory(directory, failure.case), rerun.products, rerun.row)
    _finish_study(directory, result.exit_code, [f"campaign: {path}" for path in files])


def _finish_study(directory: Path, exit_code: int, files: Sequence[str] = ()) -> NoReturn:
    """Write the report of a study, print its sentences, `files`, and the path of the report, and exit."""
    from marsyard.campaigns.errors import report_write_errors
    from marsyard.campaigns.store.record import read
    from marsyard.reports.campaign_report import study_sentences, write_report

    with report_write_errors("the report"):
        page = write_report(directory)
    console = create_console()
    for line in (*study_sentences(read(directory)), *files, f"report: {page}"):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    raise typer.Exit(exit_code)
