"""Programs that answer many cases: started once in a process, asked line by line, ended with it."""

from __future__ import annotations

import atexit
from collections.abc import Mapping
from typing import Any

from algorithms.exchange.files import EXCHANGE
from algorithms.exchange.process import Child, Command, ExecutableLimits
from algorithms.exchange.replies import shortened, table_of
from algorithms.faults import AlgorithmError, Fault

#: Programs that wait for a case, by their command and limits.
_waiting: dict[tuple[Command, ExecutableLimits], Child] = {}


def taken(command: Command, limits: ExecutableLimits) -> Child:
    """A program that reads lines: a persistent one that waits, else one that is started now. It is the caller's."""
    waiting = _waiting.pop((command, limits), None) if command.persistent else None
    return waiting or _greeted(command, limits)


def given_back(command: Command, limits: ExecutableLimits, child: Child) -> None:
    """Takes a program that has answered all that it was asked: a persistent one waits, another ends."""
    if command.persistent and (command, limits) not in _waiting:
        _waiting[command, limits] = child
    else:
        child.leave()


def waiting_processes() -> set[int]:
    """Process ids of the persistent programs that wait for a case."""
    return {child.process for child in _waiting.values()}


@atexit.register
def end_persistent() -> None:
    """Ends the persistent programs of this process."""
    while _waiting:
        _waiting.popitem()[1].leave()


def _greeted(command: Command, limits: ExecutableLimits) -> Child:
    """A program that was started and has said that it is ready, in the exchange's version."""
    child = Child(command.words, limits)
    said = child.line()
    greeting: Mapping[str, Any] | None = None
    try:
        greeting = table_of(said)
    finally:
        if greeting is None:
            child.leave()
    if dict(greeting) != {"exchange": EXCHANGE, "ready": True}:
        child.leave()
        message = f'its first line is {shortened(said.output)}; expected {{"exchange": {EXCHANGE}, "ready": true}}'
        raise AlgorithmError(Fault.BAD_ANSWER, message, said.stderr)
    return child
