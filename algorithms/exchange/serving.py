"""Programs that are asked line by line: started once in a process, asked for many cases, ended with it."""

from __future__ import annotations

import atexit
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from marsyard.algorithms.exchange.files import ANSWER_VERSIONS
from marsyard.algorithms.exchange.process import Child, Command, ExecutableLimits, Said, shortened
from marsyard.algorithms.exchange.replies import table_of
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


def taken(command: Command, limits: ExecutableLimits) -> Server:
    """A program that reads lines: a persistent one that waits, else one that is started now. It is the caller's."""
    waiting = _waiting.pop((command, limits), None) if command.persistent else None
    return waiting or _greeted(command, limits)


def given_back(command: Command, limits: ExecutableLimits, server: Server) -> None:
    """Takes a program that has answered all that it was asked: a persistent one waits, another ends."""
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


def _greeted(command: Command, limits: ExecutableLimits) -> Server:
    """A program that was started and has said that it is ready, in one of the exchange's versions."""
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
