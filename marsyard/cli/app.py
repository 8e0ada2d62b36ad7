"""The command line. Commands import their dependencies when they run, so that ``--help`` is fast."""

from __future__ import annotations

import json
import sys
import tomllib
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Option
from typer.core import TyperCommand, TyperGroup

from marsyard.cli.campaign import append, replay, resume, run
from marsyard.cli.housekeeping import clean, compile_kernels
from marsyard.cli.new import ingest, new
from marsyard.cli.offline import conformance, dataset, export, score
from marsyard.cli.options import CampaignArgument, Exit, JsonOption, SetOption, console, handle_user_errors
from marsyard.cli.report import compare, dashboard, nightly, report
from marsyard.cli.terrain import app as terrain
from marsyard.cli.terrain import gallery, render


class _PlainFlags:
    """Hides the value type of flags in the help of a command or group."""

    def get_params(self, ctx: Any) -> list[Any]:
        """The parameters, flags without a type."""
        parameters: list[Any] = super().get_params(ctx)  # type: ignore[misc]
        for one in parameters:
            if getattr(one, "is_flag", False):
                one.metavar = ""
        return parameters


class _Command(_PlainFlags, TyperCommand):
    pass


class _Group(_PlainFlags, TyperGroup):
    pass


app = typer.Typer(
    cls=_Group,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="A virtual Mars Yard: runs vision software through rendered, truth-known cases and reports whether its "
    "requirements are met, with a stated confidence.",
    epilog="Exit status: 0 every requirement met, or none asked; 1 a requirement failed, or a case crashed; "
    "2 the command or a file is wrong; 3 not enough cases for a verdict, or no independent random draws.",
)


@handle_user_errors
def list_campaigns(as_json: JsonOption = False) -> None:
    """List the campaigns of the catalogue."""
    from rich.table import Table
    from rich.text import Text

    from marsyard.campaigns.definition.loading import catalogue
    from marsyard.scenarios.systems import problems

    for problem in problems():
        typer.echo(f"warning: {problem}", err=True)
    keys = ("scenario", "cases", "description")
    rows, table = [], Table()
    for heading in ("campaign", *keys):
        table.add_column(heading, overflow="fold")
    for name, path in catalogue().items():
        try:
            stated = tomllib.loads(path.read_text(encoding="utf-8"))  # not validated: `run` reports errors
        except (OSError, ValueError) as error:
            stated = {"description": f"cannot be read: {error}"}
        rows.append({"name": name, "file": str(path), **{key: stated.get(key) for key in keys}})
        table.add_row(Text(name), *(Text(str(stated.get(key, ""))) for key in keys))
    if as_json:
        typer.echo(json.dumps(rows, indent=2))
    else:
        console().print(table)


@handle_user_errors
def show(
    campaign: CampaignArgument,
    override: SetOption = None,
    draw: Annotated[int | None, Option(metavar="N", help="Show the draws of the first N cases.")] = None,
    figure: Annotated[
        Path | None, Option(metavar="FILE", help="With --draw: write marginals and pairs as .svg or .png.")
    ] = None,
    as_json: Annotated[bool, Option("--json", help="Print JSON, with all draws.")] = False,
) -> None:
    """Show a campaign: parameters, dispersions with their sources, requirements; or the draws of its cases."""
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.campaigns.errors import CampaignError
    from marsyard.cli.showing import describe_campaign, show_campaign, show_draws, write_draws_figure

    if figure is not None and draw is None:
        raise CampaignError("--figure shows draws: give the number of cases with --draw N")
    loaded = load_campaign(campaign, override or [])
    if figure is not None and draw is not None:
        write_draws_figure(loaded, draw, figure)
    if as_json:
        typer.echo(json.dumps(describe_campaign(loaded, draw), indent=2))
    elif draw is None:
        show_campaign(loaded, console())
    else:
        show_draws(loaded, draw, console())
    if figure is not None:
        typer.echo(f"figure: {figure}", err=as_json)


def doctor(as_json: JsonOption = False) -> None:
    """Check the machine and the installation, with a fix for each problem."""
    from marsyard.doctor import run as examine

    raise typer.Exit(examine(console(), as_json=as_json))


def _print_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        typer.echo(f"marsyard {version('marsyard')}")
        raise typer.Exit


@app.callback()
def _marsyard(
    version: Annotated[
        bool, Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


#: Commands by the panels of the help; the first word of a function's name is that of its command.
PANELS: dict[str, tuple[Callable[..., None], ...]] = {
    "Run campaigns": (list_campaigns, show, run, resume, append, replay, nightly),
    "Results": (report, compare, dashboard),
    "Worlds and pictures": (render, gallery, dataset),
    "Your own campaigns and algorithms": (new, ingest, conformance, export, score),
    "Housekeeping": (doctor, compile_kernels, clean),
}
for panel, commands in PANELS.items():
    for command in commands:
        app.command(name=command.__name__.partition("_")[0], cls=_Command, rich_help_panel=panel)(command)
    if panel == "Worlds and pictures":
        app.add_typer(terrain, name="terrain", cls=_Group, rich_help_panel=panel)


_format_usual = warnings.formatwarning


def _format_warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
) -> str:
    from marsyard.sim.parameters import RenamedWarning

    if issubclass(category, RenamedWarning):
        return f"warning: {message}\n"
    return _format_usual(message, category, filename, lineno, line)


def main() -> None:
    """Entry point of the program. A defect ends with a traceback and status 2, not with a verdict's status 1."""
    # without `pgrep` loky warns at each worker's end, and works all the same
    warnings.filterwarnings("ignore", message="Failed to kill subprocesses")
    warnings.formatwarning = _format_warning
    if not {"--help", "--version"}.issuperset(sys.argv[1:]):  # these answer before NumPy is imported
        from marsyard.sim.parameters import current_options

        sys.argv[1:] = current_options(sys.argv[1:])
    try:
        app()
    except Exception:
        traceback.print_exc()
        sys.exit(Exit.WRONG)
