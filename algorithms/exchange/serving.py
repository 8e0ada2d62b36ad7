"""Commands of external programs under test, requests to them and their answers: one JSON object per line.

Each line contains the version of the exchange format. A persistent program (`serve:`) is started once per worker
process, answers many cases, and ends with the worker. An `exec:` program is started for each target, stream or case.
For a case it writes no greeting line: its last argument is the case's folder, and its complete output is the answer.
"""

import atexit
import json
import shlex
import shutil
import tempfile
import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marsyard.algorithms.exchange.files import EXCHANGE_VERSION
from marsyard.algorithms.exchange.limits import ExecutableLimits
from marsyard.algorithms.exchange.process import Output, RunningProgram, shorten, temporary_folder
from marsyard.algorithms.faults import AlgorithmError, Fault


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


@dataclass(frozen=True)
class KeptFolder:
    """Folder of files that a program can read during the whole session; written again only for another object."""

    content: Any
    write: Callable[[Path, Any], None]


def parse_object(output: Output) -> Mapping[str, Any]:
    """Parse the JSON object of an output; raises AlgorithmError (BAD_ANSWER). Keys are not checked."""
    message = f"its output is not one JSON object: {shorten(output.stdout)}"
    try:
        # NaN and Infinity become floats; `read_numbers` rejects them with a message that names the key
        answer = json.loads(output.stdout.decode("utf-8"), parse_constant=float, object_pairs_hook=_create_table)
    except (ValueError, RecursionError) as error:
        raise AlgorithmError(Fault.BAD_ANSWER, f"{message} ({error})", output.stderr) from error
    if not isinstance(answer, dict):
        raise AlgorithmError(Fault.BAD_ANSWER, message, output.stderr)
    return answer


def _create_table(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Create the table of a JSON object. Raises ValueError if it contains a key twice: its value is ambiguous."""
    table = dict(pairs)
    if len(table) < len(pairs):
        raise ValueError("it contains a key twice")
    return table


@dataclass
class Server:
    """Running program that has written its greeting line.

    - request_count: Number of requests sent, which is the `id` of the last request
    """

    child: RunningProgram
    request_count: int = 0

    def send_request(
        self, request: Mapping[str, Any], start_up_s: float | None = None
    ) -> tuple[Mapping[str, Any], Output]:
        """Send one request; return the program's answer without its `id`, and its raw output.

        `start_up_s` is the limit of the time for a request of the start-up; None: the request belongs to the present
        case, see `RunningProgram.read_line`.
        If the program fails, its answer is not one JSON object, or the answer belongs to another request, the program
        is ended and AlgorithmError raised.
        """
        self.request_count += 1
        header = {"exchange": EXCHANGE_VERSION, "id": self.request_count}
        line = json.dumps({**header, **request}, allow_nan=False)
        output = self.child.read_line(line, start_up_s)
        try:
            answer = parse_object(output)
            for key, expected in header.items():
                if type(answer.get(key)) is not int or answer[key] != expected:
                    message = f"the answer's {key} is {answer.get(key)!r}; allowed: {expected}, as in the request"
                    raise AlgorithmError(Fault.BAD_ANSWER, message, output.stderr)
        except AlgorithmError:
            self.child.stop()
            raise
        return {key: value for key, value in answer.items() if key != "id"}, output


#: Idle persistent programs by command and limits.
_idle: dict[tuple[Command, ExecutableLimits], Server] = {}


def acquire_server(command: Command, limits: ExecutableLimits) -> Server:
    """Return an idle persistent program that still runs, or start a new program and check its greeting line.

    The caller must pass it to `release_server` afterwards.
    """
    idle = _idle.pop((command, limits), None)
    if idle is not None:
        if idle.child.is_running():
            idle.child.begin_case()
            return idle
        # also removes its folder and its child processes
        idle.child.stop()
    child = command.start(limits)
    output = child.read_line(start_up_s=child.max_greeting_s)
    try:
        expected = {"exchange": EXCHANGE_VERSION, "ready": True}
        if parse_object(output) != expected:
            message = f"its first line is {shorten(output.stdout)}; expected {json.dumps(expected)}"
            raise AlgorithmError(Fault.BAD_ANSWER, message, output.stderr)
    except AlgorithmError:
        child.stop()
        raise
    return Server(child)


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

    The session's `folder` is removed with the session. After an AlgorithmError the session has ended.
    """

    def __init__(self, command: Command, limits: ExecutableLimits) -> None:
        self._command, self._limits = command, limits
        self._server: Server | None = None
        # releases the program when this session is deleted
        self._release: weakref.finalize[Any, Any] | None = None
        self._folder: Path | None = None
        self._kept: KeptFolder | None = None
        self._kept_path = Path()
        self._has_ended = False

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

    def send_request(self, action: str, values: Mapping[str, Any]) -> tuple[Mapping[str, Any], Output]:
        """Send the request `action` with `values`; return the program's answer without its `id`, and its raw output.

        A value that is a function writes the files of a folder, which is removed after the answer. A value can also be
        a `KeptFolder`. The request contains the paths of the folders. Raises AlgorithmError if the program fails, and
        for every later request.
        """
        if self._has_ended:
            raise AlgorithmError(Fault.CRASHED, "its process ended after an earlier fault")
        server = self._acquire()
        with tempfile.TemporaryDirectory(prefix=f"{action}-", dir=self.folder) as request_folder:
            request = {key: self._write(Path(request_folder, key), value) for key, value in values.items()}
            try:
                return server.send_request({"do": action, **request})
            except AlgorithmError:
                # the program has ended: do not return it to the idle programs
                self._has_ended = True
                if self._release is not None:
                    self._release.detach()
                raise

    def _write(self, folder: Path, value: Any) -> Any:
        """Write the files of a value and return the path of their folder; return other values unchanged."""
        if isinstance(value, KeptFolder):
            if self._kept is None or self._kept.content is not value.content:
                self._kept, self._kept_path = value, Path(tempfile.mkdtemp(dir=self.folder))
                value.write(self._kept_path, value.content)
            return str(self._kept_path)
        if not callable(value):
            return value
        folder.mkdir()
        value(folder)
        return str(folder)


def run_once(
    command: Command, limits: ExecutableLimits, write: Callable[[Path], None]
) -> tuple[Mapping[str, Any], Output]:
    """Run a program on the files of one case, with their folder as its last argument; return answer and raw output."""
    temporary = temporary_folder()
    case = temporary / "case"
    case.mkdir()
    write(case)
    output = RunningProgram((*command.words, str(case)), limits, temporary).read_all()
    return parse_object(output), output
