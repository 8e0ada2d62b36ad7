"""The command line. What a command needs is imported by the command, so that ``--help`` answers at once."""

from __future__ import annotations

import functools
import signal
import sys
import traceback
import warnings
from collections.abc import Callable
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ParamSpec

import typer

from marsyard.gallery_command import gallery
from marsyard.render_command import render
from marsyard.terrain_command import app as terrain

if TYPE_CHECKING:
    from rich.console import Console

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="A virtual Mars Yard: runs vision software through rendered, truth-known cases and says whether its "
    "requirements are met, with a stated confidence.",
    epilog="Exit status: 0 every requirement met, or none asked; 1 a requirement failed, or a case crashed; "
    "2 the command or a file is wrong; 3 not enough cases to say.",
)
app.add_typer(terrain, name="terrain")
app.command()(render)
app.command()(gallery)


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
DirectoryArgument = Annotated[Path, typer.Argument(metavar="DIR", help="The folder of a campaign that was run.")]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Instead of the file's value, for example render.backend=egl; a parameter set so is not dispersed.",
    ),
]

Parameters = ParamSpec("Parameters")


def _says_what_is_wrong(command: Callable[Parameters, None]) -> Callable[Parameters, None]:
    """A command that ends with one message and status 2 where the user has something to mend."""

    @functools.wraps(command)
    def guarded(*args: Parameters.args, **kwargs: Parameters.kwargs) -> None:
        # here, so that `doctor` starts, and says so, where another package stands in for ours
        from campaigns.errors import CampaignError

        try:
            command(*args, **kwargs)
        except CampaignError as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(Exit.WRONG) from None

    return guarded


@app.command()
@_says_what_is_wrong
def run(
    campaign: CampaignArgument,
    cases: Annotated[int | None, typer.Option("-n", "--cases", metavar="N", help="Number of cases.")] = None,
    seed: Annotated[int | None, typer.Option("--seed", metavar="S", help="Root seed.")] = None,
    jobs: Annotated[
        int | None, typer.Option("--jobs", metavar="J", help="Worker processes; by default one a core.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder; by default runs/<campaign>-<UTC time>.")
    ] = None,
    override: SetOption = None,
) -> None:
    """Run a campaign, judge its requirements, and write its report."""
    from campaigns.engine import run_campaign
    from campaigns.errors import CampaignError
    from campaigns.loading import load_campaign
    from campaigns.workers import available_cores
    from marsyard.outcome import conclude
    from marsyard.progress import campaign_progress

    if jobs is not None and jobs < 1:
        raise CampaignError(f"--jobs {jobs}: at least one worker process is needed")
    loaded = load_campaign(campaign, override or [], cases, seed)
    directory = out if out is not None else _default_directory(loaded.configuration.name)
    errors = _console(stderr=True)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with campaign_progress(errors) as progress:
            run_campaign(loaded, directory, jobs or available_cores(), progress)
    except KeyboardInterrupt:
        typer.echo(f"interrupted; the rows so far are in {directory}", err=True)
        raise typer.Exit(Exit.INTERRUPTED) from None
    raise typer.Exit(conclude(directory, _console()))


@app.command()
@_says_what_is_wrong
def report(directory: DirectoryArgument) -> None:
    """Judge a campaign that was run, and write its report, from the stored rows alone."""
    from marsyard.outcome import conclude

    raise typer.Exit(conclude(directory, _console()))


@app.command()
@_says_what_is_wrong
def replay(
    directory: DirectoryArgument,
    case: Annotated[int, typer.Argument(metavar="CASE", help="The case's number, from 0.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder for its products; by default DIR/cases/CASE.")
    ] = None,
) -> None:
    """Run one case again, keep and draw its intermediate results, and compare its row with the stored one."""
    from campaigns.replay import case_directory, save_replay
    from campaigns.replay import replay as run_again
    from reports.dimes_figures import write_case_figures

    replayed = run_again(directory, case)
    target = out if out is not None else case_directory(directory, case)
    save_replay(target, replayed)
    typer.echo(f"case {case}: {replayed.row['outcome']}")
    if replayed.row["error"]:
        typer.echo(replayed.row["traceback"] or replayed.row["error"])
    typer.echo(f"products: {target}")
    figure = write_case_figures(target, replayed.products)
    if figure is not None:
        typer.echo(f"figure: {figure}")
    if replayed.stored is None:
        typer.echo("the campaign has no row of this case to compare with")
    elif replayed.differing:
        typer.echo(f"the row differs from the stored one in: {', '.join(replayed.differing)}")
        for column in replayed.differing:
            typer.echo(f"  {column}: {replayed.stored.get(column)!r} stored, {replayed.row.get(column)!r} now")
        raise typer.Exit(Exit.FAILED)
    else:
        typer.echo("the row equals the stored one")


@app.command(name="list")
@_says_what_is_wrong
def list_campaigns() -> None:
    """List the campaigns of the catalogue."""
    from campaigns.loading import catalogue
    from marsyard.showing import catalogue_table

    _console().print(catalogue_table(catalogue()))


@app.command()
@_says_what_is_wrong
def show(campaign: CampaignArgument, override: SetOption = None) -> None:
    """Show a campaign: its parameters, its dispersions with their sources, and its requirements."""
    from campaigns.loading import load_campaign
    from marsyard.showing import show_campaign

    show_campaign(load_campaign(campaign, override or []).configuration, _console())


@app.command()
def doctor() -> None:
    """Examine the machine and the installation, and say how to mend what is amiss."""
    from marsyard.doctor import run as examine

    raise typer.Exit(examine(_console()))


def _version(asked: bool) -> None:
    """Prints the version and ends, where asked to."""
    if asked:
        from importlib.metadata import version

        typer.echo(f"marsyard {version('marsyard')}")
        raise typer.Exit


@app.callback()
def _marsyard(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


def _console(*, stderr: bool = False) -> Console:
    from rich.console import Console

    return Console(stderr=stderr)


def _default_directory(name: str) -> Path:
    """A folder that is not there yet: ``runs/<campaign>-<UTC time>``, with a number behind it in a busy second."""
    from datetime import UTC, datetime

    base = Path("runs") / f"{name}-{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
    directory, number = base, 1
    while directory.exists():
        number += 1
        directory = base.with_name(f"{base.name}-{number}")
    return directory


def main() -> None:
    """Entry point of the program. A defect ends with a traceback, and not with the status 1 of a verdict."""
    # Where `pgrep` is missing loky says so at length each time it clears up after a worker, and manages without.
    warnings.filterwarnings("ignore", message="Failed to kill subprocesses")
    try:
        app()
    except Exception:
        traceback.print_exc()
        sys.exit(Exit.WRONG)
