"""Requests to external programs and their answers: one JSON object per line, with the version of the exchange format.

A persistent program (`serve:`) is started once per worker process, answers many cases, and ends with the worker. An
`exec:` program is started for each target, stream or case. For a case it writes no greeting line: its last argument is
the case's folder, and its complete output is the answer.
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

from marsyard.algorithms.exchange.files import ANSWER_VERSIONS, write_case
from marsyard.algorithms.exchange.process import (
    Command,
    ExecutableLimits,
    Output,
    RunningProgram,
    shorten,
    temporary_folder,
)
from marsyard.algorithms.faults import AlgorithmError, Fault, bad_answer
from marsyard.sim.measurements import DescentMeasurements, LandingMeasurements

Member = TypeVar("Member", bound=Enum)
Answer = TypeVar("Answer")


@dataclass(frozen=True)
class ProgramDetails:
    """Standard error and wall-clock time of a program's answer."""

    stderr: str
    time_s: float


#: Function that decodes an answer from its JSON object; the details become part of the decoded answer.
AnswerReader = Callable[[Mapping[str, Any], ProgramDetails], Answer]


def parse_object(output: Output) -> Mapping[str, Any]:
    """Parse the JSON object of an output; raises AlgorithmError (BAD_ANSWER). Keys are not checked."""
    message = f"its output is not one JSON object: {shorten(output.stdout)}"
    try:
        # NaN and Infinity become floats; `read_numbers` rejects them with a message that names the key
        answer = json.loads(output.stdout.decode("utf-8"), parse_constant=float)
    except (ValueError, RecursionError) as error:
        raise AlgorithmError(Fault.BAD_ANSWER, f"{message} ({error})", output.stderr) from error
    if not isinstance(answer, dict):
        raise AlgorithmError(Fault.BAD_ANSWER, message, output.stderr)
    return answer


def check_keys(answer: Mapping[str, Any], allowed: set[str]) -> None:
    """Raise AlgorithmError (BAD_ANSWER) for an unsupported version of the exchange format or an unknown key."""
    if type(answer.get("exchange")) is not int or answer["exchange"] not in ANSWER_VERSIONS:
        versions = ", ".join(map(str, ANSWER_VERSIONS))
        raise bad_answer(f"the answer's exchange is {answer.get('exchange')!r}; allowed: {versions}")
    keys = allowed | {"exchange"}
    if unknown := sorted(set(answer) - keys):
        raise bad_answer(f"the answer has an unknown key '{unknown[0]}'; allowed: {', '.join(sorted(keys))}")


def read_member(label: str, name: object, enumeration: type[Member]) -> Member:
    """Look up a member of the `enumeration` by name; raises AlgorithmError (BAD_ANSWER). `label` is the key."""
    if not isinstance(name, str) or name not in enumeration.__members__:
        raise bad_answer(f"{label} is {name!r}; allowed: {', '.join(enumeration.__members__)}")
    return enumeration[name]


def read_numbers(answer: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> np.ndarray | None:
    """Read an array from the answer; None if it is null or absent. Raises AlgorithmError (BAD_ANSWER)."""
    value = answer.get(name)
    if value is None:
        return None
    if not _has_shape(value, shape):
        value_text = shorten(json.dumps(value).encode())
        raise bad_answer(f"{name} is {value_text}; allowed: numbers in the shape {list(shape)}")
    return np.array(value, dtype=np.float64)


def _has_shape(value: Any, shape: tuple[int, ...]) -> bool:
    """Whether a value is a finite number (empty shape) or a nested list of finite numbers of this shape."""
    if not shape:
        return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300
    return isinstance(value, list) and len(value) == shape[0] and all(_has_shape(item, shape[1:]) for item in value)


def read_answer(answer: Mapping[str, Any], output: Output, read: AnswerReader[Answer]) -> Answer:
    """Decode an answer of a program; an AlgorithmError is raised again with the program's standard error."""
    try:
        return read(answer, ProgramDetails(output.stderr, output.time_s))
    except AlgorithmError as error:
        raise AlgorithmError(error.fault, str(error), output.stderr) from error


@dataclass
class Server:
    """Running program that has written its greeting line.

    - version: Version of the exchange format in the greeting, one of `ANSWER_VERSIONS`
    - request_count: Number of requests sent, which is the `id` of the last request
    """

    child: RunningProgram
    version: int
    request_count: int = 0

    def send_request(self, request: Mapping[str, Any], time_s: float | None = None) -> tuple[Mapping[str, Any], Output]:
        """Send one request; return the program's answer without its `id`, and its raw output.

        `time_s` is the limit of the time for the answer; None: the limit of the program.
        If the program fails, its answer is not one JSON object, or the answer belongs to another request, the program
        is ended and AlgorithmError raised.
        """
        self.request_count += 1
        id_field = {"id": self.request_count} if self.version > 1 else {}
        line = json.dumps({"exchange": self.version, **id_field, **request}, allow_nan=False)
        output = self.child.read_line(line, time_s)
        try:
            answer = parse_object(output)
            for key, expected in {"exchange": self.version, **id_field}.items():
                if type(answer.get(key)) is not int or answer[key] != expected:
                    message = f"the answer's {key} is {answer.get(key)!r}; allowed: {expected}, as in the request"
                    raise AlgorithmError(Fault.BAD_ANSWER, message, output.stderr)
        except AlgorithmError:
            self.child.stop()
            raise
        return {key: value for key, value in answer.items() if key not in id_field}, output


#: Idle persistent programs by command and limits.
_idle: dict[tuple[Command, ExecutableLimits], Server] = {}


def acquire_server(command: Command, limits: ExecutableLimits) -> Server:
    """Return an idle persistent program that still runs, or start a new program and check its greeting line.

    The caller must pass it to `release_server` afterwards.
    """
    if command.persistent and (idle := _idle.pop((command, limits), None)) is not None and idle.child.is_running():
        idle.child.left_s = limits.total_s
        return idle
    child = command.start(limits)
    output = child.read_line(time_s=child.loading_s)
    try:
        greeting = dict(parse_object(output))
        version = greeting.get("exchange")
        is_ready = greeting == {"exchange": version, "ready": True}
        if type(version) is not int or version not in ANSWER_VERSIONS or not is_ready:
            expected = f'{{"exchange": {ANSWER_VERSIONS[-1]}, "ready": true}}'
            message = f"its first line is {shorten(output.stdout)}; expected {expected}"
            raise AlgorithmError(Fault.BAD_ANSWER, message, output.stderr)
    except AlgorithmError:
        child.stop()
        raise
    return Server(child, version)


def release_server(command: Command, limits: ExecutableLimits, server: Server) -> None:
    """Store a persistent program for the next case; end a program that is not persistent or already stored."""
    if command.persistent and (command, limits) not in _idle:
        _idle[command, limits] = server
    else:
        server.child.stop()


def idle_processes() -> set[int]:
    """Process ids of the idle persistent programs."""
    return {server.child.process_id for server in _idle.values()}


@atexit.register
def end_idle_programs() -> None:
    """End the idle persistent programs of this process; also called when the process exits."""
    while _idle:
        _idle.popitem()[1].child.stop()


class Session:
    """Connection of one algorithm to a program: one JSON line per request. The first request starts the program.

    The session's `folder` is removed with the session.
    """

    def __init__(self, command: Command, limits: ExecutableLimits) -> None:
        self._command, self._limits = command, limits
        self._server: Server | None = None
        # releases the program when this session is deleted
        self._release: weakref.finalize[Any, Any] | None = None
        self._folder: Path | None = None

    @property
    def folder(self) -> Path:
        """Folder of the input files, in the temporary folder of the program."""
        if self._folder is None:
            self._folder = Path(tempfile.mkdtemp(prefix="session-", dir=self._acquire().child.folder))
            weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        return self._folder

    def _acquire(self) -> Server:
        """Return the program of this session; start it if necessary."""
        if self._server is None:
            self._server = acquire_server(self._command, self._limits)
            self._release = weakref.finalize(self, release_server, self._command, self._limits, self._server)
        return self._server

    def send_request(
        self,
        action: str,
        values: Mapping[str, Any],
        parse: AnswerReader[Answer],
        files: Mapping[str, Callable[[Path], None]] | None = None,
    ) -> Answer:
        """Send the request `action` with `values` and return the program's answer, decoded by `parse`.

        `files` maps request keys to functions that write the files of a folder; the request contains the folder's path.
        The folders are removed after the answer.
        """
        request, server = {"do": action, **values}, self._acquire()
        with tempfile.TemporaryDirectory(prefix=f"{action}-", dir=self.folder) as request_folder:
            for key, write in (files or {}).items():
                folder = Path(request_folder) / key
                folder.mkdir()
                write(folder)
                request[key] = str(folder)
            try:
                answer, output = server.send_request(request)
            except AlgorithmError:
                # the program has ended: do not return it to the idle programs
                if self._release is not None:
                    self._release.detach()
                raise
        return read_answer(answer, output, parse)


def run_case(
    command: Command,
    limits: ExecutableLimits,
    measurements: DescentMeasurements | LandingMeasurements,
    read: AnswerReader[Answer],
) -> Answer:
    """Run a program on one case and return its answer, decoded by `read`.

    A persistent program that fails is ended; the next case starts it again.
    """
    if command.persistent:
        server = acquire_server(command, limits)
        with tempfile.TemporaryDirectory(prefix="case-", dir=server.child.folder) as folder:
            write_case(Path(folder), measurements)
            answer, output = server.send_request({"case": folder})
        release_server(command, limits, server)
    else:
        temporary = temporary_folder()
        case = temporary / "case"
        case.mkdir()
        write_case(case, measurements)
        output = RunningProgram((*command.words, str(case)), limits, temporary).read_all()
        answer = parse_object(output)
    return read_answer(answer, output, read)
