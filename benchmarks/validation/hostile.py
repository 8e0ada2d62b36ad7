"""A scenario whose cases damage their process or other cases, as a custom algorithm may."""

from __future__ import annotations

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

from marsyard.scenarios.algorithm_run import InputCopy
from marsyard.scenarios.interface import CaseResult
from marsyard.sim.streams import Streams

#: Objects that survive the end of a case.
_kept: list[Any] = []


class HostileParameters(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    misbehaving: float = Field(default=0.0, ge=0.0, le=1.0, description="fraction of cases that misbehave")


def _leave_thread() -> None:
    threading.Thread(target=time.sleep, args=(3600,)).start()


def _leave_pool() -> None:
    pool = ProcessPoolExecutor(2, mp_context=get_context("fork"))
    pool.submit(time.sleep, 0.0).result()
    _kept.append(pool)


def _leave_fork() -> None:
    if os.fork() == 0:
        os.setsid()
        time.sleep(3600)


def _leave_orphan() -> None:
    middle = os.fork()
    if middle == 0:
        _leave_fork()
        os._exit(0)
    os.waitpid(middle, 0)


def _session() -> subprocess.Popen[bytes]:
    child = subprocess.Popen(["sleep", "3600"], start_new_session=True, close_fds=False)
    _kept.append(child)
    return child


def _stop_supervisor() -> None:
    _leave_fork()
    os.kill(os.getppid(), signal.SIGSTOP)
    time.sleep(3600)


def _kill_supervisor() -> None:
    _leave_fork()
    os.kill(os.getppid(), signal.SIGKILL)
    time.sleep(60)


def _loop() -> None:
    # backtracks 2^64 times in C
    re.match("(a+)+$", "a" * 64 + "b")


def _flood() -> None:
    while True:
        os.write(1, b"and so on\n" * 1000)


def _swell() -> None:
    hoard = []
    while True:
        hoard.append(np.ones(4_000_000))


def _alter_state() -> None:
    import cv2

    cv2.setUseOptimized(False)
    # rounding upwards on x86
    ctypes.CDLL("libm.so.6").fesetround(0x800)
    os.chdir("/")
    os.environ["LEFT_BEHIND"] = "1"
    np.seterr(all="raise")
    np.random.seed(0)  # noqa: NPY002
    warnings.simplefilter("error")
    sys.setrecursionlimit(200)


def _raise_long() -> None:
    raise RuntimeError("a long text " * 20_000)


def _close_stream() -> None:
    sys.stdout.close()


def _spoil_inputs() -> None:
    input_copy = InputCopy([np.ones(9)])
    input_copy.inputs[0].flags.writeable = True
    input_copy.inputs[0][:] = 0.0
    input_copy.check()


#: Mark of a process whose state a case has changed.
_SPOILED = "spoiled"

#: Faults of misbehaving cases and their expected outcomes; a VALID case must have the row of a healthy case.
DEEDS: Mapping[str, tuple[Callable[[], object], str]] = {
    "leave a thread": (_leave_thread, "VALID"),
    "leave a pool of processes": (_leave_pool, "VALID"),
    "leave a forked child": (_leave_fork, "VALID"),
    "leave a session": (_session, "VALID"),
    "leave an orphan": (_leave_orphan, "VALID"),
    "wait for a session": (lambda: _session().wait(), "TIMED_OUT"),
    "loop in C": (_loop, "TIMED_OUT"),
    "sleep": (lambda: time.sleep(3600), "TIMED_OUT"),
    "stop the supervisor": (_stop_supervisor, "TIMED_OUT"),
    "kill itself": (lambda: os.kill(os.getpid(), signal.SIGKILL), "CRASHED"),
    "kill its group": (lambda: os.killpg(0, signal.SIGKILL), "CRASHED"),
    "kill the supervisor": (_kill_supervisor, "CRASHED"),
    "abort": (os.abort, "CRASHED"),
    "leave by exit": (lambda: os._exit(0), "CRASHED"),
    "raise at length": (_raise_long, "CRASHED"),
    "close all files": (lambda: os.closerange(3, 1024), "CRASHED"),
    "close standard output": (_close_stream, "VALID"),
    "alter the state": (_alter_state, "VALID"),
    "alter what nobody compares": (lambda: _kept.append(_SPOILED), "VALID"),
    "handle signals": (lambda: signal.signal(signal.SIGTERM, signal.SIG_IGN), "VALID"),
    "write at length": (_flood, "TOO_MUCH_OUTPUT"),
    "take all memory": (_swell, "OUT_OF_MEMORY"),
    "answer with an array": (lambda: {"number": np.zeros(3)}, "CRASHED"),
    "answer with a huge integer": (lambda: {"number": 10**5000}, "CRASHED"),
    "answer with text in a metric": (lambda: {"number": "far"}, "CRASHED"),
    "spoil its inputs": (_spoil_inputs, "CRASHED"),
}


def draw_fault(parameters: HostileParameters, streams: Streams) -> str:
    """Fault of a case; empty for a healthy case."""
    rng = streams.generator("deed")
    return str(rng.choice(list(DEEDS))) if rng.random() < parameters.misbehaving else ""


class HostileScenario:
    """Compute numbers that change with any altered process state, then apply the fault of the case."""

    name = "hostile"
    parameters_type = HostileParameters

    def shared_inputs(self, parameters: HostileParameters) -> tuple[int, ...]:
        return ()

    def prepare(self, parameters: HostileParameters, shared_input: int) -> None:
        """There are no shared inputs."""

    def run(self, parameters: HostileParameters, streams: Streams) -> CaseResult:
        if _SPOILED in _kept:
            raise RuntimeError("an earlier case of this process has spoiled it")
        time.sleep(0.02)
        row = _numbers(streams)
        wrong = DEEDS[done][0]() if (done := draw_fault(parameters, streams)) else None
        return CaseResult("VALID", True, {**row, **(wrong if isinstance(wrong, dict) else {})})


def _numbers(streams: Streams) -> dict[str, float | str | bool]:
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
