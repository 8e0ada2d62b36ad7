"""How a program under test is named."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Mapping

from marsyard.algorithms.exchange.process import Command

#: How a program is named: whether one process answers many cases, and whether it gets pictures one by one.
PREFIXES: Mapping[str, tuple[bool, bool]] = {
    "exec:": (False, False),
    "serve:": (True, False),
    "exec-stream:": (False, True),
    "serve-stream:": (True, True),
}


def command_of(text: str) -> Command | None:
    """The program that a text names (`exec:./mine --flag`); None where it names none.

    Raises
    ------
    ValueError
        Where it names one that is not there, or its quotes do not close.
    """
    prefix = next((one for one in PREFIXES if text.startswith(one)), None)
    if prefix is None:
        return None
    try:
        words = shlex.split(text.removeprefix(prefix))
    except ValueError as error:
        raise ValueError(f"'{text}' cannot be read: {error}") from error
    if not words:
        raise ValueError(f"'{text}' names no program; expected {prefix}PROGRAM, with arguments behind it")
    if shutil.which(words[0]) is None:
        where = "is not there, or may not be run" if "/" in words[0] else "is not on the PATH; write ./ before your own"
        raise ValueError(f"no program for '{text}': {words[0]} {where}")
    return Command(tuple(words), *PREFIXES[prefix])
