"""Run the command line in the process of a test."""

import io
import re
import sys
from contextlib import redirect_stderr, redirect_stdout
from typing import NamedTuple

from marsyard.cli import app as cli


class Output(NamedTuple):
    """Exit status and texts of a command."""

    status: int
    out: str
    err: str

    @property
    def text(self) -> str:
        """Both texts without line breaks and the boxes of usage errors."""
        return re.sub(r"[\s│]+", " ", self.out + self.err)


def marsyard(*arguments: object) -> Output:
    """Run ``marsyard ARGUMENTS``."""
    out, err, argv = io.StringIO(), io.StringIO(), sys.argv
    sys.argv = ["marsyard", *map(str, arguments)]
    try:
        with redirect_stdout(out), redirect_stderr(err):
            cli.main()
    except SystemExit as error:
        return Output(int(error.code or 0), out.getvalue(), err.getvalue())
    finally:
        sys.argv = argv
    raise AssertionError("the command did not exit")


def run_command(*arguments: object) -> tuple[int, str]:
    """Run ``marsyard ARGUMENTS``; return the exit status and both texts."""
    status, out, err = marsyard(*arguments)
    return status, out + err
