"""`marsyard export` and `score`: cases for algorithms that are run elsewhere, and their answers judged."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from marsyard.cli.campaign import (
    CampaignArgument,
    CasesOption,
    ClusterOption,
    Exit,
    JobsOption,
    SeedOption,
    SetOption,
    carry_out,
    default_directory,
    make_crew,
    says_what_is_wrong,
    shown_progress,
)

TruthOption = Annotated[
    Path | None, typer.Option("--truth", metavar="TRUTH", help="Folder of the truth; by default DIR-truth beside DIR.")
]


@says_what_is_wrong
def export(
    campaign: CampaignArgument,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the cases, without their truth.")],
    cases: CasesOption = None,
    seed: SeedOption = None,
    truth: TruthOption = None,
    jobs: JobsOption = None,
    cluster: ClusterOption = None,
    override: SetOption = None,
) -> None:
    """Write a campaign's pictures, measurements and cameras for others to answer; again to go on where it stopped."""
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.campaigns.running.offline import Exported, export_campaign, truth_folder
    from marsyard.campaigns.store import record
    from marsyard.reports.wording import count
    from marsyard.scenarios.offline import EXPORT

    exported = Exported(out, truth if truth is not None else truth_folder(out))
    kept = ["retain.products=none", "retain.showcase=none"]
    loaded = load_campaign(campaign, [*(override or []), *kept], cases, seed, [f"{EXPORT}{out.resolve()}"])
    words = ["marsyard", "export", campaign, "--out", str(out), "--truth", str(exported.truth)]
    words += [] if cases is None else ["-n", str(cases)]
    words += [] if seed is None else ["--seed", str(seed)]
    words += [word for value in override or [] for word in ("--set", value)]
    loaded = replace(loaded, command=tuple(words))
    with shown_progress(exported.truth, f"the same command again ({out})") as watch:
        export_campaign(loaded, exported, make_crew(jobs, cluster), watch)
    crashed = int(record.read(exported.truth)["cases_crashed"])
    total = loaded.configuration.total_cases
    typer.echo(f"{total - crashed} of {count(total, 'case')}: {out}")
    typer.echo(f"their truth, not to be handed away: {exported.truth}")
    typer.echo(f"once they are answered: marsyard score {out} ANSWERS.csv")
    if crashed:
        typer.echo(f"{count(crashed, 'case')} could not be written; why: marsyard report {exported.truth}", err=True)
        raise typer.Exit(Exit.FAILED)


@says_what_is_wrong
def score(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="A folder that `marsyard export` wrote.")],
    answers: Annotated[Path, typer.Argument(metavar="ANSWERS", help="The answers: a table with commas, .csv.")],
    truth: TruthOption = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="RUN", help="Folder; by default runs/<campaign>-<UTC time>.")
    ] = None,
    jobs: JobsOption = None,
    cluster: ClusterOption = None,
) -> None:
    """Score answers that were made elsewhere: the scoring, the verdicts and the report of a run."""
    from marsyard.campaigns.running.engine import Watch, run_campaign
    from marsyard.campaigns.running.offline import Exported, other_pictures, scored_campaign, truth_folder
    from marsyard.reports.wording import count

    exported = Exported(directory, truth if truth is not None else truth_folder(directory))
    words = ("marsyard", "score", str(directory), str(answers), "--truth", str(exported.truth))
    campaign = replace(scored_campaign(exported, answers), command=words)
    target = out if out is not None else default_directory(campaign.configuration.name)

    def run(watch: Watch) -> None:
        run_campaign(campaign, target, make_crew(jobs, cluster), watch)
        other = other_pictures(exported.truth, target)
        if other:
            watch.note(
                f"other pictures here than were exported: {count(len(other), 'case')}, the first case {other[0]}"
            )

    carry_out(target, run)
