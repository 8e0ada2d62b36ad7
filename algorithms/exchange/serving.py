"""Programs that are asked line by line, and the one exchange of question and answer that all programs take part in.

A persistent program (`serve:`) is started once in a process, asked for many cases, and ended with it. One that is not
(`exec:`) is a server of a single run: of one target, one stream, or one case. For one case it needs no greeting: the
case's folder is its last argument, and its answer all that it writes until it ends.
"""

from __future__ import annotations

import atexit
import json
import shutil
import tempfile
import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marsyard.algorithms.exchange.files import ANSWER_VERSIONS
from marsyard.algorithms.exchange.process import Child, Command, ExecutableLimits, Said, shortened
from marsyard.algorithms.exchange.replies import ProgramDetails, table_of
from marsyard.algorithms.faults import AlgorithmError, Fault


@dataclass
class Server:
    """A program that has reported that it is ready.

    Attributes
    ----------
    child
        Its process.
    version
        The exchange's version in its first line, one of `ANSWER_VERSIONS`.
    requests
        How many it was asked: the `id` of the last one.
    """

    child: Child
    version: int
    requests: int = 0

    def ask(self, request: Mapping[str, Any]) -> tuple[Mapping[str, Any], Said]:
        """Return the program's answer to one request without its `id`, and what it wrote.

        Raises AlgorithmError where it fails, where its answer is not one JSON object, and where that answers another
        request; the program is ended then.
        """
        self.requests += 1
        identity = {"id": self.requests} if self.version > 1 else {}
        said = self.child.line(json.dumps({"exchange": self.version, **identity, **request}, allow_nan=False))
        try:
            answer = table_of(said)
            for key, expected in {"exchange": self.version, **identity}.items():
                if type(answer.get(key)) is not int or answer[key] != expected:
                    message = f"the answer's {key} is {answer.get(key)!r}; allowed: {expected}, that of the request"
                    raise AlgorithmError(Fault.BAD_ANSWER, message, said.stderr)
        except AlgorithmError:
            self.child.leave()
            raise
        return {key: value for key, value in answer.items() if key not in identity}, said


#: Programs that wait for a case, by their command and limits.
_waiting: dict[tuple[Command, ExecutableLimits], Server] = {}


def acquire(command: Command, limits: ExecutableLimits) -> Server:
    """A program that reads lines: a persistent one that waits, else one that is started now. It is the caller's."""
    waiting = _waiting.pop((command, limits), None) if command.persistent else None
    return waiting or _start(command, limits)


def release(command: Command, limits: ExecutableLimits, server: Server) -> None:
    """Keep a persistent program that has answered all requests for the next case; end another."""
    if command.persistent and (command, limits) not in _waiting:
        _waiting[command, limits] = server
    else:
        server.child.leave()


def waiting_processes() -> set[int]:
    """Process ids of the persistent programs that wait for a case."""
    return {server.child.process for server in _waiting.values()}


@atexit.register
def end_persistent() -> None:
    """Ends the persistent programs of this process."""
    while _waiting:
        _waiting.popitem()[1].child.leave()


def _start(command: Command, limits: ExecutableLimits) -> Server:
    """Start a program and read its greeting, in one of the exchange's versions."""
    child = Child(command.words, limits)
    said = child.line()
    try:
        greeting = dict(table_of(said))
        version = greeting.get("exchange")
        if (
            type(version) is not int
            or version not in ANSWER_VERSIONS
            or greeting != {"exchange": version, "ready": True}
        ):
            expected = f'{{"exchange": {ANSWER_VERSIONS[-1]}, "ready": true}}'
            message = f"its first line is {shortened(said.output)}; expected {expected}"
            raise AlgorithmError(Fault.BAD_ANSWER, message, said.stderr)
    except AlgorithmError:
        child.leave()
        raise
    return Server(child, version)


class Session:
    """One algorithm's exchange with a program that is asked line by line, started when it is first asked.

    Attributes
    ----------
    folder
        Where its input files are written; removed with the session.
    """

    def __init__(self, command: Command, limits: ExecutableLimits) -> None:
        self._command, self._limits = command, limits
        self._server: Server | None = None
        self._release: weakref.finalize[Any, Any] | None = None
        self.folder = Path(tempfile.mkdtemp(prefix="marsyard-talk-"))
        weakref.finalize(self, shutil.rmtree, self.folder, ignore_errors=True)

    def ask(
        self, do: str, values: Mapping[str, Any], files: Mapping[str, Callable[[Path], None]] | None = None
    ) -> tuple[Mapping[str, Any], ProgramDetails]:
        """The program's answer to one line, read but not checked.

        Parameters
        ----------
        do, values
            The request, and what else stands in the line.
        files
            By the key that names the folder in the line: what writes it. It is there until the program has answered.
        """
        request = {"do": do, **values}
        if self._server is None:
            self._server = acquire(self._command, self._limits)
            self._release = weakref.finalize(self, release, self._command, self._limits, self._server)
        with tempfile.TemporaryDirectory(prefix=f"{do}-", dir=self.folder) as below:
            for key, write in (files or {}).items():
                folder = Path(below) / key
                folder.mkdir()
                write(folder)
                request[key] = str(folder)
            try:
                answer, said = self._server.ask(request)
            except AlgorithmError:
                # it is ended already, and is not to be asked by others
                if self._release is not None:
                    self._release.detach()
                raise
        return answer, ProgramDetails(said.stderr, said.time_s)


def ask_case(
    command: Command, limits: ExecutableLimits, write: Callable[[Path], None]
) -> tuple[Mapping[str, Any], ProgramDetails]:
    """A program's answer to one case, read but not checked; `write` writes the case into a folder.

    A persistent program that fails is ended, and started again for the next case.
    """
    with tempfile.TemporaryDirectory(prefix="marsyard-case-") as folder:
        write(Path(folder))
        if command.persistent:
            server = acquire(command, limits)
            answer, said = server.ask({"case": folder})
            release(command, limits, server)
        else:
            said = Child((*command.words, folder), limits).answer()
            answer = table_of(said)
    return answer, ProgramDetails(said.stderr, said.time_s)
