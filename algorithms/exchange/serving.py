"""Requests to programs and their replies: one JSON object a line, with the exchange's version and known keys.

A persistent program (`serve:`) is started once in a process, answers many cases, and ends with the process. An `exec:`
program serves a single target, stream or case. For one case it needs no greeting: the case's folder is its last
argument, and its answer is its whole output.
"""

from __future__ import annotations

import atexit
import json
import shutil
import tempfile
import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from marsyard.algorithms.answers import AlgorithmError, Fault, bad_answer
from marsyard.algorithms.exchange.files import ANSWER_VERSIONS, write_case
from marsyard.algorithms.exchange.process import Command, ExecutableLimits, Output, RunningProgram, shorten
from marsyard.sim.measurements import DescentMeasurements, LandingMeasurements

Member = TypeVar("Member", bound=Enum)
Answer = TypeVar("Answer")


@dataclass(frozen=True)
class ProgramDetails:
    """Standard error and wall-clock time of a program's answer."""

    stderr: str
    time_s: float


#: A function that reads an answer of the program: its table, and the details to attach.
AnswerReader = Callable[[Mapping[str, Any], ProgramDetails], Answer]


def parse_table(output: Output) -> Mapping[str, Any]:
    """Parse the JSON object of an output, keys unchecked; raises AlgorithmError (BAD_ANSWER)."""
    message = f"its output is not one JSON object: {shorten(output.stdout)}"
    try:
        answer = json.loads(output.stdout.decode("utf-8"), parse_constant=float)
    except (ValueError, RecursionError) as error:
        raise AlgorithmError(Fault.BAD_ANSWER, f"{message} ({error})", output.stderr) from error
    if not isinstance(answer, dict):
        raise AlgorithmError(Fault.BAD_ANSWER, message, output.stderr)
    return answer


def check_keys(answer: Mapping[str, Any], allowed: set[str]) -> None:
    """Raise AlgorithmError (BAD_ANSWER) for another version of the exchange or an unknown key."""
    if type(answer.get("exchange")) is not int or answer["exchange"] not in ANSWER_VERSIONS:
        versions = ", ".join(map(str, ANSWER_VERSIONS))
        raise bad_answer(f"the answer's exchange is {answer.get('exchange')!r}; allowed: {versions}")
    keys = allowed | {"exchange"}
    if unknown := sorted(set(answer) - keys):
        raise bad_answer(f"the answer has an unknown key '{unknown[0]}'; allowed: {', '.join(sorted(keys))}")


def read_member(label: str, name: object, kinds: type[Member]) -> Member:
    """The member of an enumeration by name."""
    if not isinstance(name, str) or name not in kinds.__members__:
        raise bad_answer(f"{label} is {name!r}; allowed: {', '.join(kinds.__members__)}")
    return kinds[name]


def read_numbers(answer: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> np.ndarray | None:
    """An array under a key of the answer; None if it is null or absent."""
    value = answer.get(name)
    if value is None:
        return None
    if not _is_nested(value, shape):
        received = shorten(json.dumps(value).encode())
        raise bad_answer(f"{name} is {received}; allowed: numbers in the shape {list(shape)}")
    return np.array(value, dtype=np.float64)


def _is_nested(value: Any, shape: tuple[int, ...]) -> bool:
    """Whether a value consists of numbers in nested lists of this shape."""
    if not shape:
        return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300
    return isinstance(value, list) and len(value) == shape[0] and all(_is_nested(one, shape[1:]) for one in value)


def read_answer(answer: Mapping[str, Any], output: Output, read: AnswerReader[Answer]) -> Answer:
    """Read an answer of a program; an AlgorithmError gets the program's standard error attached."""
    try:
        return read(answer, ProgramDetails(output.stderr, output.time_s))
    except AlgorithmError as error:
        raise AlgorithmError(error.fault, str(error), output.stderr) from error


@dataclass
class Server:
    """A running program after its greeting.

    - version: The exchange's version in the greeting, one of `ANSWER_VERSIONS`
    - requests: Number of requests so far: the `id` of the last one
    """

    child: RunningProgram
    version: int
    requests: int = 0

    def ask(self, request: Mapping[str, Any]) -> tuple[Mapping[str, Any], Output]:
        """The program's answer to one request, without its `id`, and its raw output.

        Raises AlgorithmError, after ending the program, if it fails, its answer is not one JSON object, or the answer
        belongs to another request.
        """
        self.requests += 1
        identity = {"id": self.requests} if self.version > 1 else {}
        output = self.child.line(json.dumps({"exchange": self.version, **identity, **request}, allow_nan=False))
        try:
            answer = parse_table(output)
            for key, expected in {"exchange": self.version, **identity}.items():
                if type(answer.get(key)) is not int or answer[key] != expected:
                    message = f"the answer's {key} is {answer.get(key)!r}; allowed: {expected}, that of the request"
                    raise AlgorithmError(Fault.BAD_ANSWER, message, output.stderr)
        except AlgorithmError:
            self.child.leave()
            raise
        return {key: value for key, value in answer.items() if key not in identity}, output


#: Idle persistent programs by command and limits.
_waiting: dict[tuple[Command, ExecutableLimits], Server] = {}


def acquire(command: Command, limits: ExecutableLimits) -> Server:
    """A waiting persistent program, or a new one whose greeting is checked; the caller owns it."""
    if command.persistent and (command, limits) in _waiting:
        return _waiting.pop((command, limits))
    child = RunningProgram(command.words, limits)
    output = child.line()
    try:
        greeting = dict(parse_table(output))
        version = greeting.get("exchange")
        ready = greeting == {"exchange": version, "ready": True}
        if type(version) is not int or version not in ANSWER_VERSIONS or not ready:
            expected = f'{{"exchange": {ANSWER_VERSIONS[-1]}, "ready": true}}'
            message = f"its first line is {shorten(output.stdout)}; expected {expected}"
            raise AlgorithmError(Fault.BAD_ANSWER, message, output.stderr)
    except AlgorithmError:
        child.leave()
        raise
    return Server(child, version)


def release(command: Command, limits: ExecutableLimits, server: Server) -> None:
    """Keep a persistent program for the next case; end any other."""
    if command.persistent and (command, limits) not in _waiting:
        _waiting[command, limits] = server
    else:
        server.child.leave()


def waiting_processes() -> set[int]:
    """Process ids of the waiting persistent programs."""
    return {server.child.process for server in _waiting.values()}


@atexit.register
def end_persistent() -> None:
    """End the persistent programs of this process."""
    while _waiting:
        _waiting.popitem()[1].child.leave()


class Session:
    """A dialogue of one algorithm with a program, one JSON line per request; the first request starts the program.

    The session's `folder` holds the input files and is removed with it.
    """

    def __init__(self, command: Command, limits: ExecutableLimits) -> None:
        self._command, self._limits = command, limits
        self._server: Server | None = None
        self._release: weakref.finalize[Any, Any] | None = None
        self.folder = Path(tempfile.mkdtemp(prefix="marsyard-talk-"))
        weakref.finalize(self, shutil.rmtree, self.folder, ignore_errors=True)

    def ask(
        self,
        do: str,
        values: Mapping[str, Any],
        read: AnswerReader[Answer],
        files: Mapping[str, Callable[[Path], None]] | None = None,
    ) -> Answer:
        """The program's answer to the request `do` with `values`.

        `files` maps keys of the request to writers of the folders named there; the folders exist until the answer.
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
                answer, output = self._server.ask(request)
            except AlgorithmError:
                # it has ended already: do not return it to the idle programs
                if self._release is not None:
                    self._release.detach()
                raise
        return read_answer(answer, output, read)


def ask_case(
    command: Command,
    limits: ExecutableLimits,
    measurements: DescentMeasurements | LandingMeasurements,
    read: AnswerReader[Answer],
) -> Answer:
    """A program's answer to one case.

    A persistent program that fails is ended; the next case starts it again.
    """
    with tempfile.TemporaryDirectory(prefix="marsyard-case-") as folder:
        write_case(Path(folder), measurements)
        if command.persistent:
            server = acquire(command, limits)
            answer, output = server.ask({"case": folder})
            release(command, limits, server)
        else:
            output = RunningProgram((*command.words, folder), limits).answer()
            answer = parse_table(output)
    return read_answer(answer, output, read)
