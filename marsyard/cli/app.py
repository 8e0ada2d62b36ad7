"""The command line `marsyard`: registers all commands; defines `list`, `show` and `doctor`.

Commands import their dependencies when they run, so that ``--help`` is fast.
"""

import importlib
import json
import os
import sys
import tomllib
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer import Option
from typer.core import TyperCommand, TyperGroup

from marsyard.cli.assure import assure
from marsyard.cli.campaign import append, merge, resume, run
from marsyard.cli.conformance import conformance
from marsyard.cli.console import create_console
from marsyard.cli.errors import Exit, handle_user_errors
from marsyard.cli.export import dataset, export, score
from marsyard.cli.housekeeping import clean, compile_kernels
from marsyard.cli.new import ingest, new
from marsyard.cli.options import CampaignArgument, JsonOption, SetOption
from marsyard.cli.render import gallery, render
from marsyard.cli.replay import replay
from marsyard.cli.report import compare, confirmations, dashboard, nightly, report
from marsyard.cli.studies import budget, rare, robust, search
from marsyard.cli.terrain import app as terrain


class _FlagsWithoutType:
    """Mixin that hides the value type of flags (options without a value) in the help of a command or group."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the parameters; the value type of flags is removed."""
        parameters: list[Any] = super().get_params(ctx)  # type: ignore[misc]
        for parameter in parameters:
            if getattr(parameter, "is_flag", False):
                parameter.metavar = ""
        return parameters


class _Command(_FlagsWithoutType, TyperCommand):
    pass


class _Group(_FlagsWithoutType, TyperGroup):
    pass


app = typer.Typer(
    name="marsyard",
    cls=_Group,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Run vision software on simulated Mars images with ground truth, and report whether it meets its requirements "
    "at a stated confidence level.",
    epilog="Exit status: 0 all requirements met, or no requirements; 1 a requirement failed, or a case crashed; "
    "2 the command or a file is invalid; 3 no verdict: too few cases, or cases that are not independent random draws; "
    "4 all requirements met, but a person must judge the evidence; 130 interrupted.",
)


@handle_user_errors
def list_campaigns(as_json: JsonOption = False) -> None:
    """List the built-in campaigns."""
    from rich.table import Table
    from rich.text import Text

    from marsyard.scenarios.systems import catalogue, problems

    for problem in problems():
        typer.echo(f"warning: {problem}", err=True)
    keys = ("scenario", "cases", "description")
    rows, table = [], Table()
    for heading in ("campaign", *keys):
        table.add_column(heading, overflow="fold")
    for name, path in catalogue().items():
        try:
            definition = tomllib.loads(path.read_text(encoding="utf-8"))  # not validated: `run` reports errors
        except (OSError, ValueError) as error:
            definition = {"description": f"cannot be read: {error}"}
        rows.append({"name": name, "file": str(path), **{key: definition.get(key) for key in keys}})
        table.add_row(Text(name), *(Text(str(definition.get(key, ""))) for key in keys))
    if as_json:
        typer.echo(json.dumps(rows, indent=2))
    else:
        create_console().print(table)


@handle_user_errors
def show(
    campaign: CampaignArgument,
    override: SetOption = None,
    draw: Annotated[
        int | None, Option(metavar="N", help="Show the drawn parameter values of the first N cases.")
    ] = None,
    figure: Annotated[
        Path | None,
        Option(metavar="FILE", help="With --draw: write histograms and pairwise scatter plots (.svg, .png)."),
    ] = None,
    as_json: Annotated[bool, Option("--json", help="Print JSON, with all draws.")] = False,
) -> None:
    """Show a campaign: parameters, dispersions with their sources, requirements; with --draw its random values."""
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.campaigns.errors import CampaignError
    from marsyard.cli.showing import describe_campaign, show_campaign, show_draws, write_draws_figure

    if figure is not None and draw is None:
        raise CampaignError("--figure plots draws: give the number of cases with --draw N")
    definition = load_campaign(campaign, override or [])
    if figure is not None and draw is not None:
        write_draws_figure(definition, draw, figure)
    if as_json:
        typer.echo(json.dumps(describe_campaign(definition, draw), indent=2))
    elif draw is None:
        show_campaign(definition, create_console())
    else:
        show_draws(definition, draw, create_console())
    if figure is not None:
        typer.echo(f"figure: {figure}", err=as_json)


def doctor(as_json: JsonOption = False) -> None:
    """Check the machine and the installation, and print a remedy for each problem."""
    from marsyard.doctor import run as run_checks

    raise typer.Exit(run_checks(create_console(), as_json=as_json))


def _print_version(is_requested: bool) -> None:
    if is_requested:
        from importlib.metadata import version

        typer.echo(f"marsyard {version('marsyard')}")
        raise typer.Exit


#: Environment variable of the option `--render-device`.
DEVICE_VARIABLE = "MARSYARD_RENDER_DEVICE"


@app.callback()
def _define_global_options(
    version: Annotated[
        bool, Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
    render_device: Annotated[
        Literal["llvm", "cuda"] | None,
        Option(
            envvar=DEVICE_VARIABLE,
            help="Device that computes images: the processor (llvm, the default), or a graphics processor of NVIDIA.",
        ),
    ] = None,
) -> None:
    if render_device is not None:
        _select_device(render_device)


@handle_user_errors
def _select_device(device: str) -> None:
    """Select the device for this process and its workers, and check that it works."""
    os.environ[DEVICE_VARIABLE] = device
    from marsyard.campaigns.errors import CampaignError

    try:
        importlib.import_module("marsyard.sim.render.device")
    except RuntimeError as error:  # its `RenderingError`, which cannot be imported if the device does not work
        raise CampaignError(str(error)) from None


#: Commands by help panel; the first word of a function's name is the command's name.
PANELS: dict[str, tuple[Callable[..., None], ...]] = {
    "Run campaigns": (list_campaigns, show, run, resume, append, merge, replay, rare, search, budget, robust, nightly),
    "Results": (report, confirmations, compare, dashboard, assure),
    "Worlds and images": (render, gallery, dataset),
    "Custom campaigns and algorithms": (new, ingest, conformance, export, score),
    "Housekeeping": (doctor, compile_kernels, clean),
}
for panel, commands in PANELS.items():
    for command in commands:
        app.command(name=command.__name__.partition("_")[0], cls=_Command, rich_help_panel=panel)(command)
    if panel == "Worlds and images":
        for registered in terrain.registered_commands:
            registered.cls = _Command
        app.add_typer(terrain, name="terrain", cls=_Group, rich_help_panel=panel)


def main() -> None:
    """Run the command line; an unexpected error prints a traceback and exits with status 2 (1 is for verdicts)."""
    # if `pgrep` is not installed, loky prints a needless warning at the end of each worker
    warnings.filterwarnings("ignore", message="Failed to kill subprocesses")
    try:
        app()
    except Exception:
        traceback.print_exc()
        sys.exit(Exit.INVALID)
