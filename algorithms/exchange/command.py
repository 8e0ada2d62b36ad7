"""Commands of external programs under test: prefix, program and arguments."""

import shlex
import shutil
from collections.abc import Mapping
from dataclasses import dataclass

from marsyard.algorithms.exchange.limits import ExecutableLimits
from marsyard.algorithms.exchange.process import RunningProgram


@dataclass(frozen=True)
class Command:
    """Command line of an external program under test; a hashable key of its idle processes.

    - words: The program and its arguments
    - persistent: Whether one process of the program answers many cases
    - stream: Whether the program receives a descent's images one by one
    """

    words: tuple[str, ...]
    persistent: bool
    stream: bool = False

    def start(self, limits: ExecutableLimits) -> RunningProgram:
        """Start a program that receives requests. Raises AlgorithmError if it cannot be started."""
        return RunningProgram(self.words, limits)


#: Prefixes of commands, with `Command.persistent` and `Command.stream`.
PREFIXES: Mapping[str, tuple[bool, bool]] = {
    "exec:": (False, False),
    "serve:": (True, False),
    "exec-stream:": (False, True),
    "serve-stream:": (True, True),
}


def parse_command(text: str) -> Command | None:
    """Parse a command (for example `exec:./program --flag`); None for a text without one of `PREFIXES`.

    Raises ValueError if the program does not exist or a quote is not closed.
    """
    prefix = next((prefix for prefix in PREFIXES if text.startswith(prefix)), None)
    if prefix is None:
        return None
    try:
        words = shlex.split(text.removeprefix(prefix))
    except ValueError as error:
        raise ValueError(f"'{text}' cannot be parsed: {error}") from error
    if not words:
        raise ValueError(f"'{text}' contains no program; expected {prefix}PROGRAM, followed by its arguments")
    if shutil.which(words[0]) is None:
        path_problem = "is not on the PATH; for a program in this folder write ./ in front of its name"
        problem = "does not exist or is not executable" if "/" in words[0] else path_problem
        raise ValueError(f"no program for '{text}': {words[0]} {problem}")
    return Command(tuple(words), *PREFIXES[prefix])
