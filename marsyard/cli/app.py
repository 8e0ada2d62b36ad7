"""The command line `marsyard`: registers all commands; defines `doctor`.

Commands import their dependencies when they run, so that ``--help`` is fast.
"""

import importlib
import os
import sys
import traceback
import warnings
from collections.abc import Callable
from typing import Annotated, Any, Literal

import typer
from typer import Option
from typer.core import TyperCommand, TyperGroup

from marsyard.cli.assure import assure
from marsyard.cli.campaign import append, merge, resume, run
from marsyard.cli.catalogue import list_campaigns, show
from marsyard.cli.compilation import compile_kernels
from marsyard.cli.conformance import conformance
from marsyard.cli.console import create_console
from marsyard.cli.dashboard import dashboard
from marsyard.cli.dataset import dataset
from marsyard.cli.errors import Exit, handle_user_errors
from marsyard.cli.export import export, score
from marsyard.cli.housekeeping import clean
from marsyard.cli.ingest import ingest
from marsyard.cli.new import new
from marsyard.cli.nightly import nightly
from marsyard.cli.options import JsonOption
from marsyard.cli.render import gallery, render
from marsyard.cli.replay import replay
from marsyard.cli.report import compare, confirmations, report
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
