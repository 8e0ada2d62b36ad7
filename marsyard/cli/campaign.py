"""`marsyard run`, `resume`, `append` and `replay`: campaigns and their folders."""

from __future__ import annotations

import errno
import functools
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ParamSpec

import typer

if TYPE_CHECKING:
    from rich.console import Console

    from marsyard.campaigns.definition.campaign import Campaign
    from marsyard.campaigns.execution.crew import Crew
    from marsyard.campaigns.running.engine import Watch
    from marsyard.campaigns.running.replay import Replay


class Exit(IntEnum):
    """Exit status of the program; where several apply 2 goes before 1 before 3."""

    MET = 0
    FAILED = 1
    WRONG = 2
    INSUFFICIENT = 3
    INTERRUPTED = 130


CampaignArgument = Annotated[
    str, typer.Argument(metavar="CAMPAIGN", help="A name from `marsyard list`, or the path of a TOML file.")
]
SiteArgument = Annotated[
    str, typer.Argument(metavar="SITE", help="A site from `marsyard terrain list`, or a DTM: .tif or .npz.")
]
MaxHolesOption = Annotated[
    float | None,
    typer.Option(
        "--max-holes", metavar="F", min=0.0, max=0.99, help="Of a DTM: fraction of posts without height allowed."
    ),
]
CasesOption = Annotated[int | None, typer.Option("-n", "--cases", metavar="N", help="Number of cases.")]
SeedOption = Annotated[int | None, typer.Option("--seed", metavar="S", help="Root seed.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]
DirectoryArgument = Annotated[Path, typer.Argument(metavar="DIR", help="The folder of a campaign that was run.")]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Instead of the file's value, for example render.backend=egl; a parameter set so is not dispersed.",
    ),
]
AlgorithmOption = Annotated[
    list[str] | None,
    typer.Option(
        "--algorithm",
        metavar="NAME",
        help="The algorithm under test: a name, module:Class, exec:PROGRAM or serve:PROGRAM. Given several times, all "
        "run on the same cases and are compared; the first is judged.",
    ),
]
JobsOption = Annotated[int | None, typer.Option("--jobs", metavar="J", help="Worker processes; by default one a core.")]
ClusterOption = Annotated[
    str | None,
    typer.Option(
        "--cluster", metavar="ADDRESS", help="Run on Dask: a scheduler as tcp://HOST:PORT, or local:N made here."
    ),
]
CaseTimeOption = Annotated[
    float | None,
    typer.Option("--case-time", metavar="S", help="Seconds that a case may take (limits.case_time_s of the file)."),
]
ChangedOption = Annotated[
    bool,
    typer.Option("--allow-changed", help="Go on although code or versions have changed; the record then says so."),
]

Parameters = ParamSpec("Parameters")


def says_what_is_wrong(command: Callable[Parameters, None]) -> Callable[Parameters, None]:
    """A command that ends with one message and status 2 where the user has something to mend."""

    @functools.wraps(command)
    def guarded(*args: Parameters.args, **kwargs: Parameters.kwargs) -> None:
        # here, so that `doctor` starts, and says so, where another package stands in for ours
        from marsyard.campaigns.errors import CampaignError

        try:
            command(*args, **kwargs)
        except CampaignError as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(Exit.WRONG) from None
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EROFS):
                raise
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(Exit.WRONG) from None

    return guarded


@says_what_is_wrong
def run(
    campaign: CampaignArgument,
    cases: CasesOption = None,
    seed: SeedOption = None,
    jobs: JobsOption = None,
    cluster: ClusterOption = None,
    case_time: CaseTimeOption = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder; by default runs/<campaign>-<UTC time>.")
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Estimate time and disk from a few trial cases, and run nothing else.")
    ] = False,
    until_decided: Annotated[
        bool,
        typer.Option(
            "--until-decided",
            help="Take the number of cases as the most: look at the verdicts on the way, and stop when decided.",
        ),
    ] = False,
    override: SetOption = None,
    algorithm: AlgorithmOption = None,
) -> None:
    """Run a campaign, judge its requirements, and write its report."""
    from marsyard.campaigns.definition.loading import load_campaign

    limits = [] if case_time is None else [f"limits.case_time_s={case_time}"]
    loaded = load_campaign(campaign, [*(override or []), *limits], cases, seed, algorithm or [])
    # only now, so that a file that is wrong is told of at once
    from marsyard.campaigns.running.engine import run_campaign
    from marsyard.cli.deciding import run_until_decided

    crew = make_crew(jobs, cluster)
    if dry_run:
        _print_estimate(loaded, crew)
        _print_limits(loaded)
        return
    directory = out if out is not None else default_directory(loaded.configuration.name)
    start = run_until_decided if until_decided else run_campaign
    carry_out(directory, lambda watch: start(loaded, directory, crew, watch))


@says_what_is_wrong
def resume(
    directory: DirectoryArgument,
    retry: Annotated[
        list[str] | None,
        typer.Option(
            "--retry",
            metavar="OUTCOME",
            help="Run these cases again as well: crashed, timed-out, out-of-memory, too-much-output, bad-answer, or "
            "all of them.",
        ),
    ] = None,
    jobs: JobsOption = None,
    cluster: ClusterOption = None,
    case_time: CaseTimeOption = None,
    allow_changed: ChangedOption = False,
) -> None:
    """Run the cases that an interrupted or killed campaign still lacks, and judge it; finished cases stay."""
    from marsyard.campaigns.running.engine import resume_campaign
    from marsyard.cli.deciding import go_on_until_decided

    crew, words = make_crew(jobs, cluster), _outcomes(retry or [])

    def go_on(watch: Watch) -> None:
        resume_campaign(directory, crew, watch, retry=words, case_time_s=case_time, allow_changed=allow_changed)
        go_on_until_decided(directory, crew, watch)

    carry_out(directory, go_on)


@says_what_is_wrong
def append(
    directory: DirectoryArgument,
    cases: Annotated[int, typer.Argument(metavar="N", help="Number of cases to add.", min=1)],
    jobs: JobsOption = None,
    cluster: ClusterOption = None,
    allow_changed: ChangedOption = False,
) -> None:
    """Add a block of cases to a finished campaign, run them, and judge all; the cases that are there stay."""
    from marsyard.campaigns.errors import CampaignError
    from marsyard.campaigns.running.engine import append_cases, with_block
    from marsyard.campaigns.store.record import stored_configuration

    if stored_configuration(directory).most_cases is not None:
        raise CampaignError(f"{directory} stopped itself (--until-decided): more cases would buy a second chance")
    _print_limits(with_block(directory, cases))
    crew = make_crew(jobs, cluster)
    carry_out(directory, lambda watch: append_cases(directory, cases, crew, watch, allow_changed=allow_changed))


@says_what_is_wrong
def replay(
    directory: DirectoryArgument,
    case: Annotated[int, typer.Argument(metavar="CASE", help="The case's number, from 0.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder for its products; by default DIR/cases/CASE.")
    ] = None,
    step: Annotated[
        bool, typer.Option("--step", help="Write each stage's product as well, as pictures and files, into steps/.")
    ] = False,
) -> None:
    """Run one case again, keep and draw its intermediate results, and compare its row with the stored one."""
    from marsyard.campaigns.running.replay import replay as run_again
    from marsyard.campaigns.store.retention import case_directory

    replayed = run_again(directory, case)
    target = out if out is not None else case_directory(directory, case)
    if (replayed.failed or replayed.products is None) and (target / "products.json").exists():
        written = [f"{target} keeps the products that it had: this time the case delivered none to replace them"]
    else:
        written = _write_products(target, replayed, step=step)
    typer.echo(f"case {case}: {replayed.row['outcome']}")
    for line in (replayed.row["error"] and (replayed.row["traceback"] or replayed.row["error"]), replayed.note):
        if line:
            typer.echo(line)
    typer.echo("\n".join(written))
    _compare(replayed)


def _write_products(target: Path, replayed: Replay, *, step: bool) -> list[str]:
    """Writes the products, stages and figures of a replayed case, all of them or none; returns lines that name them."""
    from marsyard.campaigns.store.products import PackedProducts, replaced_files, unpack_products, write_packed
    from marsyard.cli.steps import write_steps
    from marsyard.reports.cases import write_case_figures

    packed = replayed.products or PackedProducts.nothing()
    products = unpack_products(packed)
    with replaced_files(target) as folder:
        write_packed(folder, packed, replayed.row)
        stages = write_steps(folder / "steps", products) if step else 0
        figures = [target / path.relative_to(folder) for path in write_case_figures(folder, products)]
    lines = [f"stages: {stages} files in {target / 'steps'}"] if step else []
    return [f"products: {target}", *lines, *(f"figure: {figure}" for figure in figures)]


def _compare(replayed: Replay) -> None:
    """Says in what a replayed row differs from the stored one; ends with status 1 where it does."""
    if replayed.changed:
        typer.echo(f"since the campaign ran this has changed: {'; '.join(replayed.changed)}")
    if replayed.stored is None:
        typer.echo("the campaign has no row of this case to compare with")
    elif replayed.differing:
        typer.echo(f"the row differs from the stored one in: {', '.join(replayed.differing)}")
        for column in replayed.differing:
            typer.echo(f"  {column}: {replayed.stored.get(column)!r} stored, {replayed.row.get(column)!r} now")
        raise typer.Exit(Exit.FAILED)
    else:
        typer.echo("the row equals the stored one")


def console(*, stderr: bool = False) -> Console:
    """Where a command prints."""
    from rich.console import Console

    return Console(stderr=stderr)


def make_crew(jobs: int | None, cluster: str | None) -> Crew:
    """Who runs a campaign, as the options say."""
    from marsyard.campaigns.errors import CampaignError
    from marsyard.campaigns.execution.crew import Crew
    from marsyard.campaigns.execution.workers import available_cores

    if jobs is not None and jobs < 1:
        raise CampaignError(f"--jobs {jobs}: at least one worker process is needed")
    if jobs is not None and cluster is not None:
        raise CampaignError("--jobs and --cluster exclude one another: a cluster has its own workers")
    return Crew(jobs or available_cores(), cluster)


def _outcomes(words: Sequence[str]) -> list[str]:
    """What `--retry` asks for."""
    from marsyard.campaigns.errors import CampaignError, not_allowed
    from marsyard.campaigns.outcomes import RETRYABLE

    for word in words:
        if word not in (*RETRYABLE, "all"):
            raise CampaignError(f"--retry: {not_allowed('outcome', word, [*RETRYABLE, 'all'])}")
    return list(RETRYABLE) if "all" in words else list(words)


def carry_out(directory: Path, work: Callable[[Watch], None]) -> None:
    """Does a campaign's work and judges it; where it is interrupted says how to go on."""
    from marsyard.cli.outcome import conclude
    from marsyard.cli.run_log import RunLog

    with shown_progress(directory, f"marsyard resume {directory}") as progress, RunLog(directory, progress) as log:
        work(log)
    raise typer.Exit(conclude(directory, console()))


@contextmanager
def shown_progress(directory: Path, to_go_on: str) -> Iterator[Watch]:
    """Shows how far the work in a folder is; where it is interrupted says how to go on, and ends with status 130."""
    from marsyard.campaigns.errors import CampaignError
    from marsyard.campaigns.store.record import read
    from marsyard.cli.progress import campaign_progress

    try:
        with stopped_by_signals(), campaign_progress(console(stderr=True)) as progress:
            yield progress
    except KeyboardInterrupt:
        try:
            stored = read(directory)
            said = f"the rows so far are in {directory} ({stored['cases_finished']} of {stored['cases']})"
        except CampaignError:
            raise typer.Exit(Exit.INTERRUPTED) from None
        typer.echo(f"interrupted; {said}. To go on: {to_go_on}", err=True)
        raise typer.Exit(Exit.INTERRUPTED) from None


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Has the first Ctrl-C or SIGTERM stop the work in good order, and the second end the program at once."""

    def stop(number: int, _frame: object) -> None:
        for kind in (signal.SIGINT, signal.SIGTERM):
            signal.signal(kind, end_at_once)
        raise KeyboardInterrupt(signal.Signals(number).name)

    def end_at_once(_number: int, _frame: object) -> None:
        # the supervisors of the workers see this process end, kill what is below them and remove the temporary files
        os.write(2, b"\x1b[?25hkilled\n" if os.isatty(2) else b"killed\n")
        os._exit(Exit.INTERRUPTED)

    before = {kind: signal.signal(kind, stop) for kind in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for kind, handler in before.items():
            signal.signal(kind, handler)


def _print_estimate(campaign: Campaign, crew: Crew) -> None:
    """Prints what a campaign would take."""
    from marsyard.campaigns.running.estimate import estimate
    from marsyard.reports.wording import count

    workers = crew.jobs if crew.cluster is None else os.cpu_count() or 1
    found = estimate(campaign, workers)
    total = campaign.configuration.total_cases
    least, most = found.case_range_s
    typer.echo(f"{count(total, 'case')} on {count(workers, 'worker')}: about {_duration(found.time_s)}")
    if found.inputs:
        typer.echo(f"  {count(found.inputs, 'terrain')} (shared inputs) to build, {found.input_s:.3g} s each")
    typer.echo(f"  {found.case_s:.3g} s a case ({least:.3g} to {most:.3g} s in {count(found.trials, 'trial case')})")
    if found.unfinished:
        typer.echo(f"  {found.unfinished} of the trial cases did not come to their end")
    typer.echo(f"disk: {size_text(found.rows_bytes)} of rows, up to {size_text(found.products_bytes)} of products")
    if found.inputs_bytes:
        limit = size_text(found.cache_limit_bytes)
        typer.echo(f"  {size_text(found.inputs_bytes)} of terrains in the cache, which keeps at most {limit}")


def _print_limits(campaign: Campaign) -> None:
    """Prints why the campaign's requirements cannot read PASS, and the change that helps."""
    from marsyard.cli.evidence import evidence_limits

    for limit in evidence_limits(campaign):
        typer.echo(f"note: {limit}")


def _duration(seconds: float) -> str:
    """A time as people say it."""
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"


def size_text(count: float) -> str:
    """A number of bytes as people say it."""
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count:.0f} bytes"


def default_directory(name: str) -> Path:
    """A folder that is not there yet: ``runs/<campaign>-<UTC time>``, with a number behind it in a busy second."""
    from datetime import UTC, datetime

    base = Path("runs") / f"{name}-{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
    directory, number = base, 1
    while directory.exists():
        number += 1
        directory = base.with_name(f"{base.name}-{number}")
    return directory
