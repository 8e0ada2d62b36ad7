"""A velocity estimator with the misbehaviour that a file names; the variable MISBEHAVIOUR points to the file."""

import builtins
import ctypes
import gc
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome
from marsyard.sim.measurements import DescentMeasurements

VALID = VelocityEstimate(VelocityOutcome.VALID, np.zeros(2))


def _raise(error: BaseException) -> None:
    raise error


def _allocate_endlessly() -> None:
    arrays = []
    while True:
        arrays.append(np.ones(4_000_000))


def _print_endlessly() -> None:
    while True:
        print("and so on" * 1000)


def _loop() -> None:
    while True:
        pass


def _recurse() -> None:
    _recurse()


def _kill_parent() -> None:
    os.kill(os.getppid(), signal.SIGKILL)
    time.sleep(60)


def _fill_temporary_folder() -> None:
    Path(os.environ["TMPDIR"], "large").write_bytes(b"1" * 300_000_000)


def _close_descriptors() -> None:
    os.closerange(0, 1024)


def _trace_calls() -> None:
    """Trace all calls of this process, as a debugger does."""
    sys.settrace(lambda *_: None)
    sys.setprofile(lambda *_: None)


def _patch_libraries() -> None:
    """Replace functions that the evaluation uses: those of Marsyard, NumPy, the clock and Python."""
    import marsyard.algorithms.answers

    replaced: Any = lambda *_, **__: 0.0  # noqa: E731
    marsyard.algorithms.answers.check_velocity = replaced
    np.hypot = replaced
    time.process_time = replaced
    builtins.abs = replaced


def _change_state() -> None:
    os.chdir("/")
    os.environ.clear()
    os.umask(0o777)
    np.seterr(all="raise")
    sys.setrecursionlimit(100)
    ctypes.CDLL("libm.so.6").fesetround(0x800)
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM, signal.SIGCHLD})


def _replace_clock() -> None:
    """Set the clock of this process's own measurements back by an hour."""
    start_s = time.time()
    time.time = time.monotonic = time.perf_counter = lambda: start_s - 3600.0


def _leave_thread() -> None:
    threading.Thread(target=time.sleep, args=(3600,)).start()


def _leave_session() -> None:
    subprocess.Popen(["sleep", "7211"], start_new_session=True)


def _leave_orphan() -> None:
    if os.fork() == 0:
        if os.fork() == 0:
            os.setsid()
            os.execvp("sleep", ["sleep", "7212"])  # noqa: S606
        os._exit(0)


def _answer_twice() -> None:
    os.fork()


def _write_to_all_files() -> None:
    for descriptor in range(3, 64):
        try:
            os.write(descriptor, b'{"exchange": 3, "id": 2, "value": null}\n')
        except OSError:
            continue


def _remove_folder() -> None:
    shutil.rmtree(os.environ["TMPDIR"])


def _forget_objects() -> None:
    """Clear the dictionaries of all modules of the exchange that this process holds."""
    for item in gc.get_objects():
        if isinstance(item, dict) and item.get("__name__", "").startswith("marsyard.scenarios.isolation"):
            item.clear()


class RunsCode:
    """Executes a function when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch {os.environ['UNPICKLED']}",)


class _SaysItIsVelocity:
    outcome = VelocityOutcome.VALID
    velocity_m_s = np.zeros(2)

    @property  # type: ignore[misc]
    def __class__(self) -> Any:
        return VelocityEstimate


#: Functions that run before a valid answer is returned, with the expected outcome.
ACTIONS: Mapping[str, tuple[Callable[[], object], str]] = {
    "raise": (lambda: _raise(RuntimeError("no")), "CRASHED"),
    "exit": (lambda: sys.exit(0), "CRASHED"),
    "interrupt": (lambda: _raise(KeyboardInterrupt()), "CRASHED"),
    "exit at once": (lambda: os._exit(0), "CRASHED"),
    "kill itself": (lambda: os.kill(os.getpid(), signal.SIGKILL), "CRASHED"),
    "kill its parent": (_kill_parent, "CRASHED"),
    "kill its group": (lambda: os.killpg(0, signal.SIGKILL), "CRASHED"),
    "stop its parent": (lambda: os.kill(os.getppid(), signal.SIGSTOP), "VALID"),
    "stop itself": (lambda: os.kill(os.getpid(), signal.SIGSTOP), "TIMED_OUT"),
    "abort": (os.abort, "CRASHED"),
    "close all descriptors": (_close_descriptors, "CRASHED"),
    "loop": (_loop, "TIMED_OUT"),
    "loop in C": (lambda: re.match("(a+)+$", "a" * 64 + "b"), "TIMED_OUT"),
    "recurse": (_recurse, "CRASHED"),
    "allocate": (_allocate_endlessly, "OUT_OF_MEMORY"),
    "print": (_print_endlessly, "TOO_MUCH_OUTPUT"),
    "fill its temporary folder": (_fill_temporary_folder, "TOO_MUCH_OUTPUT"),
    "trace": (_trace_calls, "VALID"),
    "patch libraries": (_patch_libraries, "VALID"),
    "change the process state": (_change_state, "VALID"),
    "replace the clock": (_replace_clock, "VALID"),
    "leave a thread": (_leave_thread, "VALID"),
    "leave a process in a new session": (_leave_session, "VALID"),
    "leave an orphan": (_leave_orphan, "VALID"),
    "answer twice": (_answer_twice, "VALID"),
    "write to all files": (_write_to_all_files, "BAD_ANSWER"),
    "remove its folder": (_remove_folder, "VALID"),
    "clear the modules of the exchange": (_forget_objects, "CRASHED"),
}

#: Answers that do not conform to the interface.
ANSWERS: Mapping[str, Callable[[], object]] = {
    "valid without a velocity": lambda: VelocityEstimate(VelocityOutcome.VALID, None),
    "not finite": lambda: VelocityEstimate(VelocityOutcome.VALID, np.array([np.nan, 0.0])),
    "an integer of 5000 digits": lambda: 10**5000,
    "an object that runs code": RunsCode,
    "an array of objects": lambda: VelocityEstimate(VelocityOutcome.VALID, np.array([RunsCode(), None])),
    "an object of another class": _SaysItIsVelocity,
    "a nested list": lambda: _nest(100_000),
}


def _nest(depth: int) -> list[Any]:
    nested: list[Any] = []
    for _ in range(depth):
        nested = [nested]
    return nested


NAME_FILE = Path(os.environ.get("MISBEHAVIOUR", "misbehaviour"))


class Misbehaving:
    """Velocity estimator that misbehaves in each case."""

    def estimate(self, measurements: DescentMeasurements) -> Any:
        name = NAME_FILE.read_text()
        if name in ANSWERS:
            return ANSWERS[name]()
        if name == "change its inputs":
            measurements.images[0].counts[:] = 0
        elif name in ACTIONS:
            ACTIONS[name][0]()
        return VALID
