"""The command line. What a command needs is imported by the command, so that ``--help`` answers at once."""

from __future__ import annotations

import json
import sys
import traceback
import warnings
from pathlib import Path
from typing import Annotated

import typer

from marsyard.cli.campaign import (
    CampaignArgument,
    Exit,
    JsonOption,
    SetOption,
    append,
    console,
    replay,
    resume,
    run,
    says_what_is_wrong,
)
from marsyard.cli.clean import clean
from marsyard.cli.compile import compile_kernels
from marsyard.cli.conformance import conformance
from marsyard.cli.dashboard import dashboard
from marsyard.cli.dataset import dataset
from marsyard.cli.gallery import gallery
from marsyard.cli.ingest import ingest
from marsyard.cli.new import new
from marsyard.cli.nightly import nightly
from marsyard.cli.offline import export, score
from marsyard.cli.render import render
from marsyard.cli.report import compare, report
from marsyard.cli.terrain import app as terrain

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="A virtual Mars Yard: runs vision software through rendered, truth-known cases and says whether its "
    "requirements are met, with a stated confidence.",
    epilog="Exit status: 0 every requirement met, or none asked; 1 a requirement failed, or a case crashed; "
    "2 the command or a file is wrong; 3 not enough cases to say, or no independent random draws.",
)
app.add_typer(terrain, name="terrain")
for command in (run, resume, append, report, compare, replay, nightly, dashboard):
    app.command()(command)
app.command()(render)
app.command()(gallery)
app.command()(new)
app.command()(ingest)
app.command()(clean)
app.command(name="compile")(compile_kernels)
app.command()(dataset)
app.command()(conformance)
for offline in (export, score):
    app.command()(offline)


@app.command(name="list")
@says_what_is_wrong
def list_campaigns(
    as_json: JsonOption = False,
) -> None:
    """List the campaigns of the catalogue."""
    from marsyard.campaigns.definition.catalogue import catalogue
    from marsyard.cli.listing import catalogue_data, catalogue_table
    from marsyard.scenarios.systems import problems

    for problem in problems():
        typer.echo(f"warning: {problem}", err=True)
    if as_json:
        typer.echo(json.dumps(catalogue_data(catalogue()), indent=2))
        return
    console().print(catalogue_table(catalogue()))


@app.command()
@says_what_is_wrong
def show(
    campaign: CampaignArgument,
    override: SetOption = None,
    draw: Annotated[
        int | None, typer.Option("--draw", metavar="N", help="Show what the first N cases draw; nothing is run.")
    ] = None,
    figure: Annotated[
        Path | None,
        typer.Option("--figure", metavar="FILE", help="With --draw: marginals and pairs as a picture, .svg or .png."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, with every value that was drawn.")] = False,
) -> None:
    """Show a campaign: its parameters, its dispersions with their sources, and its requirements; or what it draws."""
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.campaigns.errors import CampaignError
    from marsyard.cli.showing import described, show_campaign, show_draws, write_draws_figure

    if figure is not None and draw is None:
        raise CampaignError("--figure shows draws: say of how many cases with --draw N")
    loaded = load_campaign(campaign, override or [])
    if figure is not None and draw is not None:
        write_draws_figure(loaded, draw, figure)
    if as_json:
        typer.echo(json.dumps(described(loaded, draw), indent=2))
    elif draw is None:
        show_campaign(loaded, console())
    else:
        show_draws(loaded, draw, console())
    if figure is not None:
        typer.echo(f"figure: {figure}", err=as_json)


@app.command()
def doctor(
    as_json: JsonOption = False,
) -> None:
    """Examine the machine and the installation, and say how to mend what is amiss."""
    from marsyard.doctor import run as examine

    raise typer.Exit(examine(console(), as_json=as_json))


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


def main() -> None:
    """Entry point of the program. A defect ends with a traceback, and not with the status 1 of a verdict."""
    # Where `pgrep` is missing loky says so at length each time it clears up after a worker, and manages without.
    warnings.filterwarnings("ignore", message="Failed to kill subprocesses")
    try:
        app()
    except Exception:
        traceback.print_exc()
        sys.exit(Exit.WRONG)
