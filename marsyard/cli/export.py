"""Commands `marsyard export` and `score`: export data of cases, and score answers computed elsewhere."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from marsyard.cli import options
from marsyard.cli.errors import Exit, handle_user_errors
from marsyard.cli.execution import default_directory, make_executor, run_and_evaluate, show_progress

TruthOption = Annotated[
    Path | None, Option(metavar="TRUTH", help="Folder of the ground truth; by default DIR-truth next to DIR.")
]


@handle_user_errors
def export(
    campaign: options.CampaignArgument,
    out: Annotated[Path, Option(metavar="DIR", help="Folder of the exported cases, without ground truth.")],
    cases: options.CasesOption = None,
    seed: options.SeedOption = None,
    truth: TruthOption = None,
    jobs: options.JobsOption = None,
    cluster: options.ClusterOption = None,
    override: options.SetOption = None,
) -> None:
    """Export images, measurements and camera models for an external algorithm. Cases already exported are kept."""
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.campaigns.running.export_scoring import export_campaign, truth_folder
    from marsyard.campaigns.store import record
    from marsyard.reports.wording import count
    from marsyard.scenarios.offline_algorithms import EXPORT

    truth = truth_folder(out) if truth is None else truth
    no_products = ["retain.products=none", "retain.showcase=none"]
    # the "algorithm" of an export writes the cases to the folder
    algorithms = [f"{EXPORT}{out.resolve()}"]
    export_definition = load_campaign(campaign, [*(override or []), *no_products], cases, seed, algorithms)
    command = ["marsyard", "export", campaign, "--out", str(out), "--truth", str(truth)]
    command += [] if cases is None else ["-n", str(cases)]
    command += [] if seed is None else ["--seed", str(seed)]
    command += [word for value in override or [] for word in ("--set", value)]
    export_definition = replace(export_definition, command=tuple(command))
    with show_progress(truth, f"the same command again ({out})") as observer:
        export_campaign(export_definition, out, truth, make_executor(jobs, cluster), observer)
    crashes = int(record.read(truth)["cases_crashed"])
    total = export_definition.definition.total_cases
    typer.echo(f"exported {total - crashes} of {count(total, 'case')} to {out}")
    typer.echo(f"ground truth (do not distribute with the cases): {truth}")
    typer.echo(f"to score the results: marsyard score {out} ANSWERS.csv")
    if crashes:
        typer.echo(f"{count(crashes, 'case')} not exported; for the reasons: marsyard report {truth}", err=True)
        raise typer.Exit(Exit.FAILED)


@handle_user_errors
def score(
    directory: Annotated[Path, Argument(metavar="DIR", help="Folder written by `marsyard export`.")],
    answers: Annotated[
        Path,
        Argument(
            metavar="ANSWERS", help="CSV file with the answers of the external algorithm (docs/custom-algorithms.md)."
        ),
    ],
    truth: TruthOption = None,
    out: options.OutOption = None,
    jobs: options.JobsOption = None,
    cluster: options.ClusterOption = None,
    trust: options.TrustOption = False,
) -> None:
    """Score the answers of an external algorithm; write verdicts and report."""
    from marsyard.campaigns.running.engine import run_campaign
    from marsyard.campaigns.running.export_scoring import (
        create_scoring_campaign,
        find_cases_with_changed_images,
        truth_folder,
    )
    from marsyard.campaigns.running.progress import ProgressObserver
    from marsyard.campaigns.store.origin import adopt
    from marsyard.reports.wording import count

    truth = truth_folder(directory) if truth is None else truth
    if trust:
        adopt(truth)
    command = ("marsyard", "score", str(directory), str(answers), "--truth", str(truth))
    campaign = replace(create_scoring_campaign(directory, truth, answers), command=command)
    target = out if out is not None else default_directory(campaign.definition.name)

    def run(observer: ProgressObserver) -> None:
        run_campaign(campaign, target, make_executor(jobs, cluster), observer)
        changed_cases = find_cases_with_changed_images(truth, target)
        if changed_cases:
            observer.note(
                f"the images of {count(len(changed_cases), 'case')} (first: case {changed_cases[0]}) "
                "differ from the export"
            )

    run_and_evaluate(target, run)
