"""Commands `marsyard run`, `resume`, `append` and `merge`: run or continue campaigns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from marsyard.cli import options
from marsyard.cli.errors import handle_user_errors
from marsyard.cli.execution import default_directory, make_executor, run_and_evaluate, show_progress

if TYPE_CHECKING:
    from marsyard.campaigns.definition.campaign import Campaign
    from marsyard.campaigns.execution.executors import ExecutorConfig
    from marsyard.campaigns.running.progress import ProgressObserver


@handle_user_errors
def run(
    campaign: options.CampaignArgument,
    cases: options.CasesOption = None,
    seed: options.SeedOption = None,
    jobs: options.JobsOption = None,
    cluster: options.ClusterOption = None,
    case_time: options.CaseTimeOption = None,
    out: options.OutOption = None,
    dry_run: Annotated[
        bool, Option("--dry-run", help="Only estimate time and disk space, and name what excludes PASS.")
    ] = False,
    until_decided: Annotated[
        bool, Option("--until-decided", help="Stop as soon as the verdicts are decided; --cases is the maximum.")
    ] = False,
    override: options.SetOption = None,
    algorithm: options.AlgorithmOption = None,
    confirm: Annotated[
        bool,
        Option(
            "--confirm",
            help="Evaluate a frozen algorithm on unseen cases: derive a new seed, and record the run before it starts.",
        ),
    ] = False,
    confirmations: options.ConfirmationsOption = options.CONFIRMATIONS,
    shard: Annotated[
        str | None,
        Option(
            metavar="K/N", help="Run only shard K of N, on one of N machines; `marsyard merge` combines the shards."
        ),
    ] = None,
) -> None:
    """Run a campaign, evaluate its requirements, and write its report."""
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.campaigns.errors import CampaignError

    changes = list(override or [])
    if case_time is not None:
        changes.append(f"limits.case_time_s={case_time}")
    selected = load_campaign(campaign, changes, cases, seed, algorithm or [])
    selected = replace(selected, confirmations=confirmations)
    if shard is not None and (confirm or until_decided):
        raise CampaignError("--shard cannot be combined with --confirm or --until-decided")
    if confirm and seed is not None:
        raise CampaignError("--confirm and --seed cannot be combined: a confirmation draws its seed")
    # imported after loading, so that an error in the file is reported without delay
    from marsyard.campaigns.running.engine import run_campaign
    from marsyard.campaigns.running.shards import Shard
    from marsyard.campaigns.store.confirmations import select_confirmation_seed
    from marsyard.cli.estimate import print_estimate, print_limits
    from marsyard.cli.progress import RunLog

    if confirm:
        selected = select_confirmation_seed(selected)
    executor = make_executor(jobs, cluster)
    if dry_run:
        print_estimate(selected, executor)
        looks = {"max_cases": selected.definition.total_cases if until_decided else None}
        print_limits(replace(selected, definition=selected.definition.model_copy(update=looks)))
        return
    directory = out if out is not None else default_directory(selected.definition.name)
    if shard is not None:
        part = Shard.parse(shard)
        with show_progress(directory) as progress, RunLog(directory, progress) as log:
            run_campaign(selected, directory, executor, log, part)
        typer.echo(f"shard {part}: the rows are in {directory}; to combine all shards: marsyard merge DIR... --out DIR")
        return
    run_cases = run_until_decided if until_decided else run_campaign
    run_and_evaluate(directory, lambda observer: run_cases(selected, directory, executor, observer))


def run_until_decided(
    campaign: Campaign, directory: Path, executor: ExecutorConfig, observer: ProgressObserver
) -> None:
    """Run a campaign until its verdicts are decided, with at most the configured number of cases.

    See `marsyard.reports.statistics.sequential`. Raises CampaignError for dependent draws, or if no requirement has a
    confidence level.
    """
    from marsyard.campaigns.errors import CampaignError
    from marsyard.campaigns.running.engine import run_campaign
    from marsyard.reports.sampling_design import read_sampling_design
    from marsyard.reports.statistics.sequential import planned_looks
    from marsyard.reports.verdicts import ESTIMATE

    definition = campaign.definition
    design = read_sampling_design(definition.model_dump(mode="json"))
    if not design.independent:
        raise CampaignError(f"--until-decided: {design.no_probability_reason}")
    if all(requirement.decide_by == ESTIMATE for requirement in definition.requirements):
        raise CampaignError("--until-decided: the campaign has no requirement with a confidence level")
    max_cases = definition.total_cases
    first_block = definition.model_copy(
        update={"cases": planned_looks(max_cases)[0].cases, "appended": (), "max_cases": max_cases}
    )
    command = (*campaign.command, "--until-decided")
    run_campaign(replace(campaign, definition=first_block, command=command), directory, executor, observer)
    _continue_until_decided(directory, executor, observer)


def _continue_until_decided(directory: Path, executor: ExecutorConfig, observer: ProgressObserver) -> None:
    """Append cases at the planned interim evaluations until the campaign is decided."""
    from marsyard.campaigns.running.engine import append_cases
    from marsyard.campaigns.store.record import stored_definition
    from marsyard.reports.evaluation import evaluate_run, next_look
    from marsyard.reports.wording import count

    while True:
        definition = stored_definition(directory)
        if definition.max_cases is None:
            return
        evaluation, cases = evaluate_run(directory), definition.total_cases
        # a decided verdict that is withheld for its kind of evidence needs no further cases
        verdicts = [replace(item, status=item.withheld_status or item.status) for item in evaluation.verdicts]
        next_cases = next_look(verdicts, evaluation.sampling, cases)
        if next_cases is None:
            observer.note(f"stopped after {cases} of at most {count(definition.max_cases, 'case')}")
            return
        append_cases(directory, next_cases - cases, executor, observer)


@handle_user_errors
def merge(
    directories: Annotated[list[Path], Argument(metavar="DIR...", help="Folders of all shards of a campaign.")],
    out: Annotated[Path, Option(metavar="DIR", help="Folder of the merged campaign.")],
    jobs: options.JobsOption = None,
    allow_changed: options.ChangedOption = False,
    trust: options.TrustOption = False,
) -> None:
    """Combine all shards of a campaign (`run --shard`) into one campaign, evaluate it, and write its report."""
    from marsyard.campaigns.running.engine import finish_campaign
    from marsyard.campaigns.running.shards import merge_shards
    from marsyard.campaigns.store.origin import adopt

    merge_shards(directories, out, allow_changed=allow_changed)
    if trust:
        adopt(out)
    executor = make_executor(jobs, None)
    run_and_evaluate(out, lambda observer: finish_campaign(out, executor, observer))


@handle_user_errors
def resume(
    directory: options.DirectoryArgument,
    retry: Annotated[
        list[str] | None,
        Option(
            "--retry",
            metavar="OUTCOME",
            help="Run these cases again as well: crashed, timed-out, out-of-memory, too-much-output, bad-answer, or "
            "all of them.",
        ),
    ] = None,
    jobs: options.JobsOption = None,
    cluster: options.ClusterOption = None,
    case_time: options.CaseTimeOption = None,
    allow_changed: options.ChangedOption = False,
    trust: options.TrustOption = False,
) -> None:
    """Run the remaining cases of an interrupted or killed campaign, and evaluate it."""
    from marsyard.campaigns.errors import CampaignError, unknown_name_message
    from marsyard.campaigns.outcomes import RETRYABLE
    from marsyard.campaigns.running.engine import resume_campaign
    from marsyard.campaigns.store.origin import adopt
    from marsyard.cli.studies import contains_study, continue_study_and_exit

    if trust:
        adopt(directory)
    if contains_study(directory):
        given = {"--retry": bool(retry), "--case-time": case_time is not None, "--allow-changed": allow_changed}
        _reject_study_options(directory, given)
        continue_study_and_exit(directory, jobs, cluster)
    executor, allowed = make_executor(jobs, cluster), [*RETRYABLE, "all"]
    for name in retry or []:
        if name not in allowed:
            raise CampaignError(f"--retry: {unknown_name_message('outcome', name, allowed)}")
    outcomes = list(RETRYABLE) if "all" in (retry or []) else retry or []

    def continue_campaign(observer: ProgressObserver) -> None:
        resume_campaign(
            directory, executor, observer, retry=outcomes, case_time_s=case_time, allow_changed=allow_changed
        )
        _continue_until_decided(directory, executor, observer)

    run_and_evaluate(directory, continue_campaign)


def _reject_study_options(directory: Path, given: Mapping[str, bool]) -> None:
    """Raise CampaignError if an option of campaigns is given for a study; `given`: whether each option is."""
    from marsyard.campaigns.errors import CampaignError

    if options_given := [option for option, is_given in given.items() if is_given]:
        raise CampaignError(f"{', '.join(options_given)}: not for studies; {directory} contains a study")


@handle_user_errors
def append(
    directory: options.DirectoryArgument,
    cases: Annotated[
        int,
        Argument(metavar="N", help="Number of cases to add, or of replicates for a study of `marsyard rare`.", min=1),
    ],
    jobs: options.JobsOption = None,
    cluster: options.ClusterOption = None,
    allow_changed: options.ChangedOption = False,
    random: Annotated[
        bool, Option("--random", help="For a study of `marsyard rare`: N are random cases instead of replicates.")
    ] = False,
    trust: options.TrustOption = False,
) -> None:
    """Add cases to a finished campaign (or replicates or cases to a study of rare violations), and evaluate all."""
    from marsyard.campaigns.errors import CampaignError
    from marsyard.campaigns.running.engine import append_cases, campaign_with_block
    from marsyard.campaigns.store.origin import adopt
    from marsyard.campaigns.store.record import stored_definition
    from marsyard.cli.estimate import print_limits
    from marsyard.cli.studies import contains_study, continue_study_and_exit

    if trust:
        adopt(directory)
    if contains_study(directory):
        _reject_study_options(directory, {"--allow-changed": allow_changed})
        continue_study_and_exit(directory, jobs, cluster, cases, is_random=random)
    if random:
        raise CampaignError(f"--random is for studies of `marsyard rare`; {directory} contains a campaign")
    if stored_definition(directory).max_cases is not None:
        raise CampaignError(f"{directory} was run with --until-decided: cases added afterwards would bias the verdict")
    print_limits(campaign_with_block(directory, cases))
    executor = make_executor(jobs, cluster)
    run_and_evaluate(directory, lambda log: append_cases(directory, cases, executor, log, allow_changed=allow_changed))
