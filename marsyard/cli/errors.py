"""Exit status of the program, and errors of the user as one message."""

import errno
import functools
from collections.abc import Callable
from enum import IntEnum
from typing import NoReturn, ParamSpec

import typer

Parameters = ParamSpec("Parameters")


class Exit(IntEnum):
    """Exit status of the program; if several apply, the order of precedence is 2, 1, 3, 4."""

    MET = 0  #: all requirements are met, or there are none
    FAILED = 1  #: a requirement failed, or a case crashed
    INVALID = 2  #: the command or a file is invalid
    INSUFFICIENT = 3  #: not enough cases for a verdict
    QUALIFIED = 4  #: all requirements are met, but the evidence has a qualification, such as "PASS (unregistered)"
    INTERRUPTED = 130  #: by Ctrl-C or SIGTERM


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
