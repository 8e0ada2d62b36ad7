"""Command `marsyard rare`: studies that choose their cases."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Option

from marsyard.cli import options
from marsyard.cli.campaign import default_directory, make_executor, show_progress

if TYPE_CHECKING:
    from marsyard.campaigns.studies.rare import RareResult

MaxCasesOption = Annotated[int, Option(metavar="N", min=100, help="Maximum number of cases of the study.")]


@dataclass(frozen=True)
class RareOptions:
    """Arguments and options of `marsyard rare`."""

    campaign: options.CampaignArgument
    requirement: Annotated[str, Option(metavar="ID", help="Requirement of the campaign whose violations are rare.")]
    at_most: Annotated[
        float, Option(metavar="P", help="Maximum probability of a violation per case, such as 1e-4.")
    ] = 1e-4
    method: Annotated[
        str, Option(metavar="METHOD", help="subset, or importance: importance sampling after the subset simulations.")
    ] = "subset"
    samples: Annotated[int, Option(metavar="N", help="Cases per level of a subset simulation.")] = 200
    replicates: Annotated[int, Option(metavar="N", help="Number of independent subset simulations, from 2.")] = 6
    importance_cases: Annotated[int, Option(metavar="N", help="Cases of importance sampling.")] = 600
    confidence: Annotated[float, Option(metavar="C", help="Two-sided confidence of the interval.")] = 0.9
    max_cases: MaxCasesOption = 20_000
    seed: options.SeedOption = None
    jobs: options.JobsOption = None
    cluster: options.ClusterOption = None
    out: options.OutOption = None
    override: options.SetOption = None
    algorithm: options.AlgorithmOption = None


@options.handle_user_errors
@options.with_options(RareOptions)
def rare(arguments: RareOptions) -> None:
    """Estimate the probability of a rare violation of a requirement by subset simulation, and compare with a limit."""
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.campaigns.studies.rare import RareSettings, start_rare

    settings = RareSettings(
        arguments.requirement,
        arguments.at_most,
        arguments.method,
        arguments.samples,
        (arguments.replicates,),
        arguments.importance_cases,
        arguments.confidence,
    )
    campaign = load_campaign(
        arguments.campaign, arguments.override or [], None, arguments.seed, arguments.algorithm or []
    )
    executor = make_executor(arguments.jobs, arguments.cluster)
    name = campaign.configuration.name
    directory = arguments.out if arguments.out is not None else default_directory(f"{name}-rare")
    with show_progress(directory, f"marsyard resume {directory}") as progress:
        result = start_rare(campaign, settings, arguments.max_cases, directory, executor, progress)
    finish_rare(directory, result)


def continue_study(directory: Path, jobs: int | None, cluster: str | None, additional: int = 0) -> bool:
    """Continue the study in a folder, and exit with the status of its verdict; return False for a campaign."""
    from marsyard.campaigns.studies.rare import continue_rare
    from marsyard.campaigns.studies.runner import read_study

    if read_study(directory) is None:
        return False
    executor = make_executor(jobs, cluster)
    with show_progress(directory, f"marsyard resume {directory}") as progress:
        result = continue_rare(directory, executor, progress, additional)
    finish_rare(directory, result)
    return True


def finish_rare(directory: Path, result: RareResult) -> None:
    """Write the report of a study, print its result, and exit with the status of its verdict."""
    from marsyard.campaigns.errors import report_write_errors
    from marsyard.reports.campaign import write_report
    from marsyard.reports.rare import describe_result

    with report_write_errors("the report"):
        page = write_report(directory)
    console = options.console()
    for line in (*describe_result(directory), f"report: {page}"):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    raise typer.Exit(result.exit_code)
