"""A scenario with faults of a custom algorithm that damage the process or other cases; used by the soak test."""

import ctypes
import os
import re
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from benchmarks.validation.chaos import WithoutSharedInputs
from marsyard.scenarios.input_copies import InputCopy
from marsyard.scenarios.interface import CaseResult
from marsyard.sim.streams import Streams

#: `FE_UPWARD` of the C library on x86.
_ROUND_UPWARD = 0x800
#: Objects that remain in the worker process after the end of a case.
_remaining_objects: list[Any] = []


class HostileParameters(BaseModel):
    """Parameter of the fault injection."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    misbehaving: float = Field(default=0.0, ge=0.0, le=1.0, description="fraction of cases that misbehave")


def _leave_thread() -> None:
    """Leave a thread that sleeps after the end of the case."""
    threading.Thread(target=time.sleep, args=(3600,)).start()


def _leave_pool() -> None:
    """Leave the processes of a pool."""
    pool = ProcessPoolExecutor(2, mp_context=get_context("fork"))
    pool.submit(time.sleep, 0.0).result()
    _remaining_objects.append(pool)


def _leave_fork() -> None:
    """Leave a forked process in a separate session."""
    if os.fork() == 0:
        os.setsid()
        time.sleep(3600)


def _leave_orphan() -> None:
    """Leave a process whose parent has ended."""
    parent = os.fork()
    if parent == 0:
        _leave_fork()
        os._exit(0)
    os.waitpid(parent, 0)


def _leave_session() -> subprocess.Popen[bytes]:
    """Leave a child process in a separate session."""
    child = subprocess.Popen(["sleep", "3600"], start_new_session=True, close_fds=False)
    _remaining_objects.append(child)
    return child


def _stop_supervisor() -> None:
    """Leave a process and stop the parent of the worker process by SIGSTOP."""
    _leave_fork()
    os.kill(os.getppid(), signal.SIGSTOP)
    time.sleep(3600)


def _kill_supervisor() -> None:
    """Leave a process and kill the parent of the worker process."""
    _leave_fork()
    os.kill(os.getppid(), signal.SIGKILL)
    time.sleep(60)


def _loop_in_c() -> None:
    """Match a regular expression that backtracks 2^64 times in C."""
    re.match("(a+)+$", "a" * 64 + "b")


def _print_endlessly() -> None:
    while True:
        os.write(1, b"and so on\n" * 1000)


def _allocate_endlessly() -> None:
    arrays = []
    while True:
        arrays.append(np.ones(4_000_000))


def _change_state() -> None:
    """Change OpenCV, rounding, folder, environment, NumPy, warnings and recursion limit of the process."""
    import cv2

    cv2.setUseOptimized(False)
    ctypes.CDLL("libm.so.6").fesetround(_ROUND_UPWARD)
    os.chdir("/")
    os.environ["LEFT_BEHIND"] = "1"
    np.seterr(all="raise")
    np.random.seed(0)  # noqa: NPY002
    warnings.simplefilter("error")
    sys.setrecursionlimit(200)


def _raise_long_message() -> None:
    raise RuntimeError("a long text " * 20_000)


def _close_stream() -> None:
    """Close standard output."""
    sys.stdout.close()


def _change_inputs() -> None:
    """Change the inputs of an algorithm although they are read-only."""
    input_copy = InputCopy([np.ones(9)])
    input_copy.inputs[0].flags.writeable = True
    input_copy.inputs[0][:] = 0.0
    input_copy.check()


#: Marker in `_remaining_objects`, a state of the process that the engine does not compare: a later case that finds the
#: marker fails.
_CHANGED_STATE = "changed state"

#: Faults of misbehaving cases and their expected outcomes; a VALID case must have the row of a healthy case.
FAULTS: Mapping[str, tuple[Callable[[], object], str]] = {
    "leave a thread": (_leave_thread, "VALID"),
    "leave a pool of processes": (_leave_pool, "VALID"),
    "leave a forked child": (_leave_fork, "VALID"),
    "leave a process in a new session": (_leave_session, "VALID"),
    "leave an orphan": (_leave_orphan, "VALID"),
    "wait for a process in a new session": (lambda: _leave_session().wait(), "TIMED_OUT"),
    "loop in C": (_loop_in_c, "TIMED_OUT"),
    "sleep": (lambda: time.sleep(3600), "TIMED_OUT"),
    "stop the supervisor": (_stop_supervisor, "TIMED_OUT"),
    "kill itself": (lambda: os.kill(os.getpid(), signal.SIGKILL), "CRASHED"),
    "kill its group": (lambda: os.killpg(0, signal.SIGKILL), "CRASHED"),
    "kill the supervisor": (_kill_supervisor, "CRASHED"),
    "abort": (os.abort, "CRASHED"),
    "exit": (lambda: os._exit(0), "CRASHED"),
    "raise with a long message": (_raise_long_message, "CRASHED"),
    "close all files": (lambda: os.closerange(3, 1024), "CRASHED"),
    "close standard output": (_close_stream, "VALID"),
    "change the process state": (_change_state, "VALID"),
    "change state that is not compared": (lambda: _remaining_objects.append(_CHANGED_STATE), "VALID"),
    "handle signals": (lambda: signal.signal(signal.SIGTERM, signal.SIG_IGN), "VALID"),
    "print without end": (_print_endlessly, "TOO_MUCH_OUTPUT"),
    "allocate without end": (_allocate_endlessly, "OUT_OF_MEMORY"),
    "answer with an array": (lambda: {"number": np.zeros(3)}, "CRASHED"),
    "answer with an integer of 5000 digits": (lambda: {"number": 10**5000}, "CRASHED"),
    "answer with text in a metric": (lambda: {"number": "far"}, "CRASHED"),
    "change its inputs": (_change_inputs, "CRASHED"),
}


def draw_fault(parameters: Any, streams: Streams) -> str:
    """Draw the fault of a case; empty for a case without fault."""
    rng = streams.generator("deed")
    return str(rng.choice(list(FAULTS))) if rng.random() < parameters.misbehaving else ""


class HostileScenario(WithoutSharedInputs):
    """Scenario that computes numbers from the process state, then executes the fault of the case."""

    name = "hostile"
    parameters_type = HostileParameters

    def run(self, parameters: HostileParameters, streams: Streams) -> CaseResult:
        if _CHANGED_STATE in _remaining_objects:
            raise RuntimeError("an earlier case has changed the state of this process")
        time.sleep(0.02)
        row = _compute_numbers(streams)
        faulty_row = FAULTS[fault][0]() if (fault := draw_fault(parameters, streams)) else None
        return CaseResult("VALID", True, {**row, **(faulty_row if isinstance(faulty_row, dict) else {})})


def _compute_numbers(streams: Streams) -> dict[str, float | str | bool]:
    """Compute random numbers and values that depend on the state of the process."""
    import cv2

    rng = streams.generator("number")
    counts = rng.normal(size=(64, 64)).astype(np.float32)
    return {
        "number": float(rng.normal()),
        "sum": float(np.cumsum(rng.normal(size=1000))[-1] / 3.0),
        "global": float(np.random.random_sample()),  # noqa: NPY002
        "filtered": float(cv2.GaussianBlur(counts, (5, 5), 1.0).sum()),
        "folder": Path.cwd() == Path("/"),
        "optimised": cv2.useOptimized(),
        "left": os.environ.get("LEFT_BEHIND", ""),
        "errors": str(np.geterr()),
    }
