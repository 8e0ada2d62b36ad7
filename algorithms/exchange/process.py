"""Execution of external programs under test within limits (time, memory, output, files).

Each program has its own process group and temporary folder. Its child processes are killed with it, and the folder is
removed. On Linux it is killed when its parent process ends.
"""

import os
import selectors
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO

from marsyard.algorithms.exchange.limits import ExecutableLimits
from marsyard.algorithms.exchange.sandbox import sandbox_words
from marsyard.algorithms.faults import AlgorithmError, Fault
from marsyard.algorithms.processes import descendants, end_with_parent, kill, resident_bytes
from marsyard.algorithms.worker_device import worker_device

#: Maximum time between two readings of an `AwakeClock` that is counted, s.
_MAX_STEP_S = 1.0
#: Interval of the checks of time, memory and output, and of the files' size, seconds.
_POLL_S, _FILES_POLL_S = 0.02, 0.5
#: Number of characters stored from the end of standard error.
MAX_STDERR_CHARACTERS = 4000
#: Time for a persistent program to exit after its input is closed, seconds.
_EXIT_GRACE_S = 0.5
#: Maximum number of bytes in one read or write of a pipe.
_CHUNK_BYTES = 1 << 16
#: Unit of a file's `st_blocks`, bytes.
_BLOCK_BYTES = 512
#: Environment variable: device that a program may use.
DEVICE_VARIABLE = "MARSYARD_DEVICE"


class AwakeClock:
    """Clock that counts only the time during which this process reads it at least once a second.

    If this process is suspended, together with the process that it monitors, the time of the suspension is not counted.
    """

    def __init__(self) -> None:
        self._elapsed_s, self._last_s = 0.0, time.monotonic()

    def elapsed_s(self) -> float:
        """Return the counted time since the creation of the clock."""
        now_s = time.monotonic()
        self._elapsed_s += min(now_s - self._last_s, _MAX_STEP_S)
        self._last_s = now_s
        return self._elapsed_s


@dataclass(frozen=True)
class Output:
    """Output of a program for one case or request, and its wall-clock time."""

    stdout: bytes
    stderr: str
    time_s: float


class RunningProgram:
    """A running external program under test.

    If the program exceeds a limit, ends early or cannot be started, methods end it and raise AlgorithmError. Its
    temporary folder is `folder`, which is removed at its end; the variable TMPDIR contains its path.
    """

    def __init__(
        self,
        words: Sequence[str],
        limits: ExecutableLimits,
        folder: Path | None = None,
        *,
        working_folder: Path | None = None,
        readable: Sequence[Path] = (),
        descriptors: Sequence[int] = (),
    ) -> None:
        """Start the program.

        - folder: existing temporary folder; None for a new one
        - working_folder: None for the current folder
        - readable: files and folders that it can read in a sandbox, in addition to those named in its command line
        - descriptors: file descriptors that it inherits
        """
        self.limits = limits
        self.folder = folder or temporary_folder()
        self._stdout, self._stderr = bytearray(), bytearray()
        environment = {**os.environ, "TMPDIR": str(self.folder), DEVICE_VARIABLE: worker_device(limits.devices)}
        if limits.sandbox:
            readable = [*readable, *map(Path, limits.visible)]
            words = sandbox_words(words, environment, self.folder, working_folder or Path.cwd(), readable)
        try:
            self._process = subprocess.Popen(  # noqa: S603 (running the user's program is the purpose)
                words,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                cwd=working_folder,
                env=environment,
                pass_fds=descriptors,
                process_group=0,
                preexec_fn=partial(end_with_parent, os.getpid(), signal.SIGKILL),
            )
        except OSError as error:
            shutil.rmtree(self.folder, ignore_errors=True)
            message = f"{words[0]} cannot be started: {error.strerror or error}"
            raise AlgorithmError(Fault.CRASHED, message) from error
        #: time that is left for the answers to the present case, s
        self._left_s = limits.total_s
        #: whether the present line is an answer to a case, not a line of the start-up
        self._is_answer = True
        self._clock, self._time_s = AwakeClock(), min(limits.time_s, self._left_s)
        self._checked_s = self._files_checked_s = 0.0

    @property
    def max_greeting_s(self) -> float:
        """Limit of the time until the greeting line of a program with requests.

        An external program has the time of one answer. `marsyard.scenarios.isolation.remote.PythonProgram` has another
        limit.
        """
        return self.limits.time_s

    @property
    def process_id(self) -> int:
        """Process id of the program."""
        return self._process.pid

    def is_running(self) -> bool:
        """Whether the program has not ended."""
        return self._process.poll() is None

    def begin_case(self) -> None:
        """Reset the time for all answers to one case; a new program is at the beginning of a case."""
        self._left_s = self.limits.total_s

    def read_all(self) -> Output:
        """Read the output of the program until it exits with status 0."""
        start_s = time.perf_counter()
        self._close_input()
        self._read(lambda: False)
        self._wait()
        output = self._collect_output(bytes(self._stdout), start_s)
        self._kill()
        return output

    def read_line(self, request: str | None = None, start_up_s: float | None = None) -> Output:
        """Send an optional request line and read one output line.

        - start_up_s: limit of the time for a line of the start-up, which is not part of the time for a case; None: the
          line is an answer to the present case, and has the limits of the answers

        Output before the request is a fault (BAD_ANSWER): it could be a second line for the previous case.
        """
        start_s = time.perf_counter()
        self._stdout.clear()
        self._stderr.clear()
        self._is_answer = start_up_s is None
        self._clock = AwakeClock()
        self._time_s = min(self.limits.time_s, self._left_s) if start_up_s is None else start_up_s
        if request is not None and (early_output := _read_pending(self._process.stdout)):
            message = f"it wrote {shorten(early_output)} before the request; expected one line per request"
            raise self._end_with_fault(Fault.BAD_ANSWER, message)
        try:
            self._read(lambda: b"\n" in self._stdout, b"" if request is None else f"{request}\n".encode())
        except BrokenPipeError:
            self._wait()
            raise self._end_with_fault(Fault.CRASHED, "it closed its input") from None
        if b"\n" not in self._stdout:
            self._wait()
            raise self._end_with_fault(Fault.CRASHED, "its output ended without an answer")
        first_line, _, extra_output = bytes(self._stdout).partition(b"\n")
        if extra_output:
            raise self._end_with_fault(Fault.BAD_ANSWER, "it wrote more than one line")
        if self._is_answer:
            self._left_s -= self._clock.elapsed_s()
        return self._collect_output(first_line, start_s)

    def stop(self) -> None:
        """End the program: close its input, then kill it if it does not exit."""
        self._close_input()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_EXIT_GRACE_S)
        self._kill()

    def _close_input(self) -> None:
        if self._process.stdin is not None:
            with suppress(BrokenPipeError):
                self._process.stdin.close()

    def _read(self, is_complete: Callable[[], bool], request: bytes = b"") -> None:
        """Send a request and read standard output and error until they end or `is_complete()` is true.

        The limits on time, memory and size also hold while a program does not read its input. Raises BrokenPipeError
        if the program has closed its input.
        """
        with selectors.DefaultSelector() as selector:
            if request:
                if self._process.stdin is None or self._process.stdin.closed:
                    raise BrokenPipeError
                os.set_blocking(self._process.stdin.fileno(), False)
                selector.register(self._process.stdin, selectors.EVENT_WRITE)
            for stream, buffer in ((self._process.stdout, self._stdout), (self._process.stderr, self._stderr)):
                if stream is not None:
                    selector.register(stream, selectors.EVENT_READ, buffer)
            while selector.get_map() and (request or not is_complete()):
                self._check_limits()
                for key, _ in selector.select(_POLL_S):
                    if key.fileobj is self._process.stdin:
                        request = request[os.write(key.fd, request[:_CHUNK_BYTES]) :]
                        if not request:
                            selector.unregister(key.fileobj)
                    elif data := os.read(key.fd, _CHUNK_BYTES):
                        key.data.extend(data)
                    else:
                        selector.unregister(key.fileobj)

    def _check_limits(self) -> None:
        """Kill the program and raise AlgorithmError if it exceeds a limit."""
        elapsed_s, now_s = self._clock.elapsed_s(), time.monotonic()
        if elapsed_s > self._time_s:
            message = f"no answer within {self._time_s:g} s"
            if self._is_answer and self._time_s == self._left_s:
                message = f"no answers to the case within {self.limits.total_s:g} s"
            raise self._end_with_fault(Fault.TIMED_OUT, message)
        if len(self._stdout) + len(self._stderr) > self.limits.output_mb * 1e6:
            raise self._end_with_fault(Fault.TOO_MUCH_OUTPUT, f"it wrote more than {self.limits.output_mb:g} MB")
        if now_s - self._checked_s < _POLL_S:
            return
        self._checked_s = now_s
        if resident_bytes([self._process.pid, *descendants(self._process.pid)]) > self.limits.memory_gb * 1e9:
            raise self._end_with_fault(Fault.OUT_OF_MEMORY, f"it used more than {self.limits.memory_gb:g} GB of memory")
        if now_s - self._files_checked_s >= _FILES_POLL_S:
            self._files_checked_s = now_s
            self._check_files()

    def _check_files(self) -> None:
        """Kill the program and raise AlgorithmError if the files in its temporary folder are too large."""
        if _folder_bytes(self.folder) > self.limits.files_mb * 1e6:
            message = f"its temporary folder contained more than {self.limits.files_mb:g} MB"
            raise self._end_with_fault(Fault.TOO_MUCH_OUTPUT, message)

    def _wait(self) -> None:
        """Wait until the program exits; raise AlgorithmError unless its exit status is 0."""
        while True:
            self._check_limits()
            with suppress(subprocess.TimeoutExpired):
                status = self._process.wait(_POLL_S)
                break
        if status < 0:
            name = next((member.name for member in signal.Signals if member == -status), f"signal {-status}")
            raise self._end_with_fault(Fault.CRASHED, f"it was ended by {name}")
        if status > 0:
            raise self._end_with_fault(Fault.CRASHED, f"it ended with status {status}")

    def _end_with_fault(self, fault: Fault, message: str) -> AlgorithmError:
        """Kill the program; return the error to raise."""
        self._kill()
        return AlgorithmError(fault, message, _decode_tail(self._stderr))

    def _kill(self) -> None:
        """Kill the program with all its descendants, close its pipes and remove its folder."""
        processes = descendants(self._process.pid)
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        kill(processes)
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
            if stream is not None:
                with suppress(BrokenPipeError):
                    stream.close()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _collect_output(self, output: bytes, start_s: float) -> Output:
        """Build the output, including pending data of standard error. Raises AlgorithmError if it exceeds a limit."""
        self._check_files()
        while pending := _read_pending(self._process.stderr):
            self._stderr.extend(pending)
            self._check_limits()
        return Output(output, _decode_tail(self._stderr), time.perf_counter() - start_s)


def temporary_folder() -> Path:
    """Create the temporary folder of a program."""
    return Path(tempfile.mkdtemp(prefix="marsyard-program-"))


def _folder_bytes(folder: Path) -> int:
    """Sum the sizes of all files in a folder on the disk; files that are removed meanwhile are not counted."""
    total = 0
    for parent, _, names in os.walk(folder):
        for name in names:
            with suppress(OSError):
                total += Path(parent, name).lstat().st_blocks * _BLOCK_BYTES
    return total


def _read_pending(stream: IO[bytes] | None) -> bytes:
    """Read the bytes available in a stream without waiting; empty at its end."""
    if stream is None or stream.closed:
        return b""
    with selectors.DefaultSelector() as selector:
        selector.register(stream, selectors.EVENT_READ)
        return os.read(stream.fileno(), _CHUNK_BYTES) if selector.select(0.0) else b""


def shorten(raw: bytes) -> str:
    """Convert the first 200 bytes of an output to quoted text."""
    text = raw[:200].decode("utf-8", errors="replace")
    return repr(text + ("..." if len(raw) > 200 else ""))


def _decode_tail(raw: bytearray) -> str:
    """Decode the last `MAX_STDERR_CHARACTERS` of an output (at most 4 bytes each in UTF-8) as printable text."""
    text = bytes(raw[-4 * MAX_STDERR_CHARACTERS :]).decode("utf-8", errors="replace")[-MAX_STDERR_CHARACTERS:]
    return "".join(character if character.isprintable() or character in "\n\t" else "�" for character in text)
