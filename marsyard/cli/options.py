"""Options, arguments, exit status, error handling and console of several commands of `marsyard`."""

from __future__ import annotations

import errno
import functools
import inspect
from collections.abc import Callable
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, ParamSpec, TypeVar, get_type_hints

import typer
from typer import Argument, Option

if TYPE_CHECKING:
    from rich.console import Console


class Exit(IntEnum):
    """Exit status of the program; if several apply, the order of precedence is 2, 1, 3, 4."""

    MET = 0  #: all requirements are met, or there are none
    FAILED = 1  #: a requirement failed, or a case crashed
    INVALID = 2  #: the command or a file is invalid
    INSUFFICIENT = 3  #: not enough cases for a verdict
    QUALIFIED = 4  #: all requirements are met, but the evidence has a qualification, such as "PASS (unregistered)"
    INTERRUPTED = 130  #: by Ctrl-C or SIGTERM


CampaignArgument = Annotated[
    str, Argument(metavar="CAMPAIGN", help="A name from `marsyard list`, or the path of a TOML file.")
]
SiteArgument = Annotated[
    str,
    Argument(
        metavar="SITE",
        help="A site from `marsyard terrain list`, or a digital terrain model (DTM): .tif, .img, .cub or .npz.",
    ),
]
MaxHolesOption = Annotated[
    float | None,
    Option(
        metavar="F",
        min=0.0,
        max=0.99,
        help="Accept a DTM with up to this fraction of missing elevations, which are filled; by default 0.05.",
    ),
]
CasesOption = Annotated[
    int | None, Option("-n", "--cases", metavar="N", help="Number of cases; by default that of the campaign.")
]
SeedOption = Annotated[
    int | None, Option(metavar="S", help="Root seed of the random draws; by default that of the campaign.")
]
#: Default record of confirmations.
CONFIRMATIONS = Path("confirmations.jsonl")
ConfirmationsOption = Annotated[
    Path, Option(metavar="FILE", help="Record of confirmations; keep it under version control.")
]
JsonOption = Annotated[bool, Option("--json", help="Print JSON.")]
DirectoryArgument = Annotated[Path, Argument(metavar="DIR", help="Folder of a campaign run.")]
BitsOption = Annotated[
    float | None,
    Option(
        metavar="BITS",
        min=0.1,
        max=16.0,
        help="Compress the images with lossy JPEG 2000 to this bit rate, bits per pixel.",
    ),
]
SetOption = Annotated[
    list[str] | None,
    Option(
        "--set",
        metavar="KEY=VALUE",
        help="Override a value, such as render.backend=egl; the parameter is then fixed and not dispersed.",
    ),
]
AlgorithmOption = Annotated[
    list[str] | None,
    Option(
        metavar="NAME",
        help="The algorithm under test: a name, module:Class, exec:PROGRAM (started per case) or serve:PROGRAM "
        "(one process for all cases). If repeated, all algorithms run on the same cases and are compared; the first is "
        "under test.",
    ),
]
JobsOption = Annotated[int | None, Option(metavar="J", help="Worker processes; by default one per core.")]
ClusterOption = Annotated[
    str | None, Option(metavar="ADDRESS", help="Run on Dask: a scheduler at tcp://HOST:PORT, or local:N to start one.")
]
CaseTimeOption = Annotated[
    float | None, Option(metavar="S", help="Time limit of a case in seconds (limits.case_time_s).")
]
ChangedOption = Annotated[
    bool, Option("--allow-changed", help="Continue with changed code or versions; the change is recorded.")
]
TrustOption = Annotated[
    bool,
    Option(
        "--trust",
        help="Accept a folder that was created or changed elsewhere: its rows, and the code that it names. The code is "
        "executed; it must be the recorded code.",
    ),
]

OutOption = Annotated[Path | None, Option(metavar="DIR", help="Output folder; by default runs/<campaign>-<UTC time>.")]
OverwriteOption = Annotated[bool, Option("--overwrite", help="Replace existing files.")]

Parameters = ParamSpec("Parameters")
Options = TypeVar("Options")


def with_options(kind: type[Options]) -> Callable[[Callable[[Options], None]], Callable[..., None]]:
    """Return a decorator that makes the fields of the dataclass `kind` options and passes the command an instance."""
    hints = get_type_hints(kind, include_extras=True)
    fields = [field.replace(annotation=hints[name]) for name, field in inspect.signature(kind).parameters.items()]

    def decorate(command: Callable[[Options], None]) -> Callable[..., None]:
        def call(**values: Any) -> None:
            command(kind(**values))

        call.__name__, call.__doc__ = command.__name__, command.__doc__
        call.__annotations__ = hints
        call.__signature__ = inspect.Signature(fields)  # type: ignore[attr-defined]
        return call

    return decorate


def handle_user_errors(command: Callable[Parameters, None]) -> Callable[Parameters, None]:
    """Decorate a command: on a user error or a full or read-only disk, print one message and exit with status 2."""

    @functools.wraps(command)
    def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> None:
        try:
            # imported here, so that `doctor` can report another package that shadows Marsyard
            from marsyard.campaigns.errors import CampaignError

            command(*args, **kwargs)
        except KeyboardInterrupt:
            typer.echo("interrupted", err=True)
            raise typer.Exit(Exit.INTERRUPTED) from None
        except ImportError:  # `CampaignError` may be undefined
            raise
        except (CampaignError, OSError) as error:
            if isinstance(error, OSError) and error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EROFS):
                raise
            exit_with_error(error)

    return call


def exit_with_error(error: object) -> NoReturn:
    """Print an error message and exit with status 2."""
    typer.echo(f"error: {error}", err=True)
    raise typer.Exit(Exit.INVALID) from None


def console(*, stderr: bool = False) -> Console:
    """Create a console for a command's output."""
    from rich.console import Console

    return Console(stderr=stderr)


def size_text(count: float) -> str:
    """Format a number of bytes with a unit prefix."""
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count:.0f} bytes"
