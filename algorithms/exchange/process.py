"""Programs under test: how they are named, and how one runs within limits on time, memory and output.

A program leads a process group of its own, which is ended as a whole, and ends with the process that started it.
"""

from __future__ import annotations

import ctypes
import os
import selectors
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from marsyard.algorithms.faults import AlgorithmError, Fault
from marsyard.algorithms.processes import descendants, resident_bytes

#: Seconds between two looks at the memory that a program has.
_LOOK_S = 0.02
#: Characters of standard error that are kept: the last ones.
KEPT_STDERR = 4000
#: Seconds that a persistent program has to end by itself once its input is closed.
_LEAVE_S = 0.5

_PR_SET_PDEATHSIG = 1
_libc = ctypes.CDLL(None)


class ExecutableLimits(BaseModel):
    """What a program under test may use for one case."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    time_s: Annotated[float, Field(gt=0.0, le=86400.0, description="wall-clock time of an answer, s")] = 60.0
    memory_gb: Annotated[float, Field(gt=0.0, le=4096.0, description="resident memory of it and its children")] = 2.0
    output_mb: Annotated[float, Field(gt=0.0, le=1000.0, description="what it may write to its output and error")] = 1.0


@dataclass(frozen=True)
class Command:
    """A program under test.

    Attributes
    ----------
    words
        The program and its arguments.
    persistent
        Whether one process answers many cases.
    stream
        Whether it is given a descent's pictures one by one.
    """

    words: tuple[str, ...]
    persistent: bool
    stream: bool = False


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


@dataclass(frozen=True)
class Said:
    """What a program wrote in answer to one case, and the wall-clock seconds that it took."""

    output: bytes
    stderr: str
    time_s: float


@dataclass
class Child:
    """A program that runs.

    Raises
    ------
    AlgorithmError
        From every method, once the program breaks a limit, ends too early or cannot be started; it is ended then.
    """

    words: tuple[str, ...]
    limits: ExecutableLimits
    _process: subprocess.Popen[bytes] = field(init=False)
    _output: bytearray = field(init=False, default_factory=bytearray)
    _stderr: bytearray = field(init=False, default_factory=bytearray)
    _deadline_s: float = field(init=False, default=0.0)

    def __post_init__(self) -> None:
        try:
            self._process = subprocess.Popen(  # noqa: S603 (running the user's program is the purpose)
                self.words,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                process_group=0,
                preexec_fn=_go_with_parent if sys.platform == "linux" else None,
            )
        except OSError as error:
            message = f"{self.words[0]} cannot be started: {error.strerror or error}"
            raise AlgorithmError(Fault.CRASHED, message) from error
        self._reset()

    @property
    def process(self) -> int:
        """Its process id."""
        return self._process.pid

    def answer(self) -> Said:
        """All that the program writes until it ends by itself, with status 0."""
        started = time.perf_counter()
        self._close_input()
        self._read(lambda: False)
        self._wait()
        said = self._said(bytes(self._output), started)
        self._kill()
        return said

    def line(self, asked: str | None = None) -> Said:
        """The next line that the program writes, after a line that it is given.

        A program that has written something since its last answer is ended (BAD_ANSWER): a late second line would be
        taken as the answer to the next case.
        """
        started = time.perf_counter()
        self._reset()
        if asked is not None:
            self._refuse_unasked_output()
            self._tell(asked)
        self._read(lambda: b"\n" in self._output)
        if b"\n" not in self._output:
            self._wait()
            raise self._ended(Fault.CRASHED, "its output ended before it had answered")
        first, _, rest = bytes(self._output).partition(b"\n")
        if rest:
            raise self._ended(Fault.BAD_ANSWER, "it wrote more than the one line of its answer")
        return self._said(first, started)

    def leave(self) -> None:
        """Ends the program: its input is closed, and if that is not enough it is killed."""
        self._close_input()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_LEAVE_S)
        self._kill()

    def _reset(self) -> None:
        self._output.clear()
        self._stderr.clear()
        self._deadline_s = time.monotonic() + self.limits.time_s

    def _tell(self, line: str) -> None:
        stdin = self._process.stdin
        try:
            if stdin is None or stdin.closed:
                raise BrokenPipeError
            stdin.write(f"{line}\n".encode())
            stdin.flush()
        except BrokenPipeError:
            self._wait()
            raise self._ended(Fault.CRASHED, "it reads no more cases") from None

    def _refuse_unasked_output(self) -> None:
        stdout = self._process.stdout
        if stdout is None or stdout.closed:
            return
        with selectors.DefaultSelector() as selector:
            selector.register(stdout, selectors.EVENT_READ)
            # an empty read is the end of its output, which is reported when it is asked
            if selector.select(0.0) and (unasked := os.read(stdout.fileno(), 1 << 16)):
                message = f"before it was asked it wrote {shortened(unasked)}; expected one line for each request"
                raise self._ended(Fault.BAD_ANSWER, message)

    def _close_input(self) -> None:
        if self._process.stdin is not None:
            with suppress(BrokenPipeError):
                self._process.stdin.close()

    def _read(self, enough: Callable[[], bool]) -> None:
        """Reads both streams until they end or there is enough, while watching time, memory and size."""
        streams = {self._process.stdout: self._output, self._process.stderr: self._stderr}
        with selectors.DefaultSelector() as selector:
            for stream, kept in streams.items():
                if stream is not None:
                    selector.register(stream, selectors.EVENT_READ, kept)
            while selector.get_map() and not enough():
                self._check()
                for key, _ in selector.select(_LOOK_S):
                    read = os.read(key.fd, 1 << 16)
                    if read:
                        key.data.extend(read)
                    else:
                        selector.unregister(key.fileobj)

    def _check(self) -> None:
        if time.monotonic() > self._deadline_s:
            raise self._ended(Fault.TIMED_OUT, f"no answer within {self.limits.time_s:g} s")
        if len(self._output) + len(self._stderr) > self.limits.output_mb * 1e6:
            raise self._ended(Fault.TOO_MUCH_OUTPUT, f"it wrote more than {self.limits.output_mb:g} MB")
        if resident_bytes([self._process.pid, *descendants(self._process.pid)]) > self.limits.memory_gb * 1e9:
            raise self._ended(Fault.OUT_OF_MEMORY, f"it took more than {self.limits.memory_gb:g} GB of memory")

    def _wait(self) -> None:
        """Waits for the program's end; one that ends badly is a fault."""
        while True:
            self._check()
            with suppress(subprocess.TimeoutExpired):
                status = self._process.wait(_LOOK_S)
                break
        if status < 0:
            raise self._ended(Fault.CRASHED, f"it was ended by {_signal_name(-status)}")
        if status > 0:
            raise self._ended(Fault.CRASHED, f"it ended with status {status}")

    def _ended(self, fault: Fault, message: str) -> AlgorithmError:
        """Ends the program, and gives what is said of it."""
        self._kill()
        return AlgorithmError(fault, message, _text(self._stderr))

    def _kill(self) -> None:
        """Ends the program and all that it started in its group."""
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
            if stream is not None:
                with suppress(BrokenPipeError):
                    stream.close()

    def _said(self, output: bytes, started: float) -> Said:
        """The answer, with what stands in the pipe of standard error by now."""
        stream = self._process.stderr
        if stream is not None and not stream.closed:
            with selectors.DefaultSelector() as selector:
                selector.register(stream, selectors.EVENT_READ)
                while selector.select(0.0) and (read := os.read(stream.fileno(), 1 << 16)):
                    self._stderr.extend(read)
        return Said(output, _text(self._stderr), time.perf_counter() - started)


def _go_with_parent() -> None:
    """Between fork and exec: has Linux end the program when the thread that started it ends."""
    _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def shortened(raw: bytes) -> str:
    """The first 200 bytes that a program wrote, as text in quotes."""
    text = raw[:200].decode("utf-8", errors="replace")
    return repr(text + ("..." if len(raw) > 200 else ""))


def _text(raw: bytearray) -> str:
    """The last of what a program wrote, as text that any file takes."""
    text = bytes(raw[-4 * KEPT_STDERR :]).decode("utf-8", errors="replace")[-KEPT_STDERR:]
    return "".join(letter if letter.isprintable() or letter in "\n\t" else "�" for letter in text)
