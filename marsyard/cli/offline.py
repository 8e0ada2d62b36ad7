"""`marsyard conformance`, `export`, `score`, `dataset`: checks of an algorithm, cases, scores, training data."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from marsyard.cli import options
from marsyard.cli.campaign import default_directory, make_executor, run_and_judge, shown_progress
from marsyard.cli.options import Exit, JsonOption, console, handle_user_errors

TruthOption = Annotated[
    Path | None, Option(metavar="TRUTH", help="Folder of the truth; by default DIR-truth next to DIR.")
]


@options.handle_user_errors
def export(
    campaign: options.CampaignArgument,
    out: Annotated[Path, Option(metavar="DIR", help="Folder of the cases, without truth.")],
    cases: options.CasesOption = None,
    seed: options.SeedOption = None,
    truth: TruthOption = None,
    jobs: options.JobsOption = None,
    cluster: options.ClusterOption = None,
    override: options.SetOption = None,
) -> None:
    """Write a campaign's pictures, measurements and cameras for external algorithms; repeat the command to continue."""
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.campaigns.running.offline import export_campaign, truth_folder
    from marsyard.campaigns.store import record
    from marsyard.reports.wording import count
    from marsyard.scenarios.offline import EXPORT

    truth = truth_folder(out) if truth is None else truth
    kept = ["retain.products=none", "retain.showcase=none"]
    loaded = load_campaign(campaign, [*(override or []), *kept], cases, seed, [f"{EXPORT}{out.resolve()}"])
    words = ["marsyard", "export", campaign, "--out", str(out), "--truth", str(truth)]
    words += [] if cases is None else ["-n", str(cases)]
    words += [] if seed is None else ["--seed", str(seed)]
    words += [word for value in override or [] for word in ("--set", value)]
    loaded = replace(loaded, command=tuple(words))
    with shown_progress(truth, f"the same command again ({out})") as watch:
        export_campaign(loaded, out, truth, make_executor(jobs, cluster), watch)
    crashed = int(record.read(truth)["cases_crashed"])
    total = loaded.configuration.total_cases
    typer.echo(f"{total - crashed} of {count(total, 'case')}: {out}")
    typer.echo(f"their truth, not to be handed away: {truth}")
    typer.echo(f"once they are answered: marsyard score {out} ANSWERS.csv")
    if crashed:
        typer.echo(f"{count(crashed, 'case')} could not be written; why: marsyard report {truth}", err=True)
        raise typer.Exit(options.Exit.FAILED)


@options.handle_user_errors
def score(
    directory: Annotated[Path, Argument(metavar="DIR", help="Folder written by `marsyard export`.")],
    answers: Annotated[Path, Argument(metavar="ANSWERS", help="The answers, a .csv table.")],
    truth: TruthOption = None,
    out: options.OutOption = None,
    jobs: options.JobsOption = None,
    cluster: options.ClusterOption = None,
) -> None:
    """Score external answers: the scores, verdicts and report of a run."""
    from marsyard.campaigns.running.engine import Watch, run_campaign
    from marsyard.campaigns.running.offline import cases_with_changed_pictures, scored_campaign, truth_folder
    from marsyard.reports.wording import count

    truth = truth_folder(directory) if truth is None else truth
    words = ("marsyard", "score", str(directory), str(answers), "--truth", str(truth))
    campaign = replace(scored_campaign(directory, truth, answers), command=words)
    target = out if out is not None else default_directory(campaign.configuration.name)

    def run(watch: Watch) -> None:
        run_campaign(campaign, target, make_executor(jobs, cluster), watch)
        other = cases_with_changed_pictures(truth, target)
        if other:
            cases = f"{count(len(other), 'case')}, the first case {other[0]}"
            watch.note(f"other pictures here than were exported: {cases}")

    run_and_judge(target, run)


@options.handle_user_errors
def dataset(
    campaign: options.CampaignArgument,
    out: Annotated[Path, Option(metavar="DIR", help="Folder of the shards.")],
    cases: options.CasesOption = None,
    seed: options.SeedOption = None,
    shard: Annotated[int, Option(metavar="N", min=1, help="Cases in a shard.")] = 50,
    jobs: Annotated[int, Option(metavar="J", min=1, help="Worker processes.")] = 1,
    override: options.SetOption = None,
) -> None:
    """Write pictures with range, normals, rock masks, hazard maps and poses as WebDataset shards; repeat to continue.

    For campaigns of landings, two pictures a case; existing shards are kept.
    """
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.dataset import write_dataset

    shards = write_dataset(load_campaign(campaign, override or [], cases, seed), out, shard, jobs)
    total = sum(path.stat().st_size for path in shards)
    typer.echo(f"{len(shards)} shards, {options.size_text(total)}: {out}")


@handle_user_errors
def conformance(
    algorithm: Annotated[
        str, Argument(metavar="ALGORITHM", help="A name, module:Class, exec:PROGRAM or serve:PROGRAM.")
    ],
    task: Annotated[
        str | None,
        Option(
            metavar="TASK",
            help="velocity, tracking, landing, dynamics, instrument or score; by default from its methods.",
        ),
    ] = None,
    time_limit: Annotated[float, Option(metavar="S", help="Time limit of one answer in seconds.", min=0.1)] = 60.0,
    as_json: JsonOption = False,
) -> None:
    """Check an algorithm, or a custom motion, instrument or score, against its protocol: types, inputs, time, ..."""
    from marsyard.campaigns.running.replay import create_subject, examine
    from marsyard.scenarios.parts.named import KINDS

    subject = create_subject(algorithm, task, time_limit)
    findings = []
    if not as_json:
        kind = "a part of the kind" if subject.task in KINDS else "an algorithm for"
        typer.echo(f"{algorithm} as {kind} {subject.task}")
    for finding in examine(subject):
        findings.append(finding)
        if as_json:
            continue
        word = "[green]ok  [/]" if finding.passed else "[bold red]FAIL[/]"
        console().print(f"{word} {finding.check:<14}", end="", highlight=False)
        lines = [f"{finding.asked} ({finding.note})" if finding.note else finding.asked]
        if not finding.passed:
            lines += [f"{'':20}{line}" for line in (finding.problem, f"next: {finding.next_step}")]
        for line in lines:
            console().print(line, markup=False, highlight=False, soft_wrap=True)
    failed = sum(not finding.passed for finding in findings)
    if as_json:
        checks = [{**asdict(one), "passed": one.passed} for one in findings]
        data = {"algorithm": subject.spec, "task": subject.task, "passed": not failed, "checks": checks}
        typer.echo(json.dumps(data, indent=2))
    else:
        typer.echo(f"{len(findings) - failed} of {len(findings)} checks passed")
    if failed:
        raise typer.Exit(Exit.FAILED)
