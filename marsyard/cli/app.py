"""The command line `marsyard`: its commands, and the options that precede them.

A command is imported when it is used, so that it does not wait for the imports of the others.
"""

import importlib
import os
import sys
import traceback
import warnings
from typing import Annotated, Any, Literal

import typer
from typer import Option
from typer.core import TyperCommand, TyperGroup

from marsyard.cli.errors import Exit, handle_user_errors

#: Environment variable of the option `--render-device`.
DEVICE_VARIABLE = "MARSYARD_RENDER_DEVICE"
#: Commands by help panel: their names, and their functions as ``module:function`` of this package.
PANELS = {
    "Run campaigns": {
        "list": "catalogue:list_campaigns",
        "show": "catalogue:show",
        "run": "campaign:run",
        "resume": "campaign:resume",
        "append": "campaign:append",
        "merge": "campaign:merge",
        "replay": "replay:replay",
        "rare": "studies:rare",
        "search": "studies:search",
        "budget": "studies:budget",
        "robust": "studies:robust",
        "nightly": "nightly:nightly",
    },
    "Results": {
        "report": "report:report",
        "confirmations": "report:confirmations",
        "compare": "report:compare",
        "dashboard": "publishing:dashboard",
        "assure": "publishing:assure",
    },
    "Worlds and images": {
        "render": "images:render",
        "gallery": "images:gallery",
        "dataset": "images:dataset",
        "terrain": "terrain:app",
    },
    "Custom campaigns and algorithms": {
        "new": "new:new",
        "ingest": "ingest:ingest",
        "conformance": "conformance:conformance",
        "export": "export:export",
        "score": "export:score",
    },
    "Housekeeping": {
        "doctor": "housekeeping:doctor",
        "compile": "housekeeping:compile_kernels",
        "clean": "housekeeping:clean",
    },
}


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


class _CommandTable(_Group):
    """The commands of `PANELS`; each is imported when it is used, an unknown name imports all to find a similar one."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of all commands in the order of the help."""
        return [name for commands in PANELS.values() for name in commands]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return the command with a name; None if there is none."""
        names = self.list_commands(ctx)
        for name in [cmd_name] if cmd_name in names else names:
            if name not in self.commands:
                self.commands[name] = _import_command(name)
        return self.commands.get(cmd_name)


def _import_command(name: str) -> Any:
    """Import the command, or the group of commands, with a name in `PANELS`."""
    panel, path = next((panel, commands[name]) for panel, commands in PANELS.items() if name in commands)
    module, _, attribute = path.partition(":")
    target = getattr(importlib.import_module(f"marsyard.cli.{module}"), attribute)
    owner = typer.Typer(add_completion=False)
    if isinstance(target, typer.Typer):
        for registered in target.registered_commands:
            registered.cls = _Command
        owner.add_typer(target, name=name, cls=_Group, rich_help_panel=panel)
        return typer.main.get_group(owner).commands[name]
    owner.command(name=name, cls=_Command, rich_help_panel=panel)(target)
    return typer.main.get_command(owner)


app = typer.Typer(
    name="marsyard",
    cls=_CommandTable,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Run vision software on simulated Mars images with ground truth, and report whether it meets its requirements "
    "at a stated confidence level.",
    epilog="Exit status: 0 all requirements met, or no requirements; 1 a requirement failed, or a case crashed; "
    "2 the command or a file is invalid; 3 no verdict: too few or unfinished cases, cases that are not independent "
    "random draws, or requirements that are met by rate only; "
    "4 all requirements met, but a person must judge the evidence; 130 interrupted.",
)


def _print_version(is_requested: bool) -> None:
    if is_requested:
        from importlib.metadata import version

        typer.echo(f"marsyard {version('marsyard')}")
        raise typer.Exit


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


def main() -> None:
    """Run the command line; an unexpected error prints a traceback and exits with status 2 (1 is for verdicts)."""
    # if `pgrep` is not installed, loky prints a needless warning at the end of each worker
    warnings.filterwarnings("ignore", message="Failed to kill subprocesses")
    try:
        app()
    except Exception:
        traceback.print_exc()
        sys.exit(Exit.INVALID)
