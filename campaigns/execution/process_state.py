"""State of a worker process by which a case could affect later cases (environment variables, signal handlers, ...).

After each case the state is compared with a reference. If it differs, the difference is reported, and the next case
runs in a fresh worker. The global random generators of Python, NumPy and OpenCV are seeded before each case.
The worker also compares the files that it needs (`list_open_files`) after each case.
"""

import _signal  # type: ignore[import-not-found]
import decimal
import gc
import locale
import os
import random
import sys
import threading
import time
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from marsyard.algorithms.processes import children

#: Maximum seconds to wait for threads and processes to end.
_MAX_END_WAIT_S = 0.2
#: Device and inode of an open file; None for a closed descriptor.
FileIdentity = tuple[int, int] | None
#: Numbers of the standard signals, without real-time signals.
_SIGNALS = tuple(range(1, _signal.SIGSYS + 1))


def _read_working_folder() -> str:
    try:
        return str(Path.cwd())
    except FileNotFoundError:
        return ""


def _read_opencv() -> tuple[bool, int]:
    """Return OpenCV's optimisation flag and number of threads; those of a fresh worker if OpenCV is not loaded."""
    cv2: Any = sys.modules.get("cv2")
    return (True, 1) if cv2 is None else (cv2.useOptimized(), cv2.getNumThreads())


def _read_arithmetic() -> tuple[bool, ...]:
    """Determine the rounding mode of floating-point numbers, and whether subnormal numbers are flushed to zero."""
    # the rounding mode determines whether adding less than half the distance to the next float changes the number 1;
    # `float("1")` prevents the compiler from computing the sums
    unit, increment, min_normal = float("1"), 2.0**-60, sys.float_info.min
    return unit + increment == unit, -unit - increment == -unit, unit - increment == unit, min_normal * 0.5 > 0.0


def _read_signals() -> tuple[Any, ...]:
    """Return signal handlers, blocked signals and timers; `_signal` is faster since it builds no enumerations."""
    handlers = tuple(_signal.getsignal(number) for number in _SIGNALS)
    return handlers, _signal.pthread_sigmask(_signal.SIG_BLOCK, ()), _signal.getitimer(_signal.ITIMER_REAL)


def _read_streams() -> tuple[Any, ...]:
    """Return standard output and error, whether they are closed, and the identities of their files."""
    objects = [(stream, getattr(stream, "closed", True)) for stream in (sys.stdout, sys.stderr)]
    return (*objects, file_identity(1), file_identity(2))


#: Functions that read the parts of the state, by the names of the parts.
_PARTS: Mapping[str, Callable[[], object]] = {
    # the undecoded mapping inside `os.environ` is ten times as fast
    "environment variables": lambda: dict(os.environ._data),  # type: ignore[attr-defined]
    "sys.path": lambda: list(sys.path),
    "the warning filters": lambda: list(warnings.filters),
    "the working folder": _read_working_folder,
    "NumPy's error handling (numpy.seterr)": np.geterr,
    "the locale": partial(locale.setlocale, locale.LC_ALL),
    "the recursion limit": sys.getrecursionlimit,
    "the decimal context": lambda: (decimal.getcontext().prec, decimal.getcontext().rounding),
    "OpenCV's state (optimised code, threads)": _read_opencv,
    "the floating-point rounding mode": _read_arithmetic,
    "handlers of signals, or timers": _read_signals,
    "standard output or error": _read_streams,
}
#: Parts that the import of a module may change. The case has not caused this change, since a module is imported once in
#: a process, by the first case that needs it.
_CHANGED_BY_IMPORTS = ("environment variables", "sys.path", "the warning filters")


class ProcessState:
    """Reference state of this process: that at its creation, with later changes by imports of modules."""

    def __init__(self) -> None:
        self._values = {name: read() for name, read in _PARTS.items()}
        self._modules, self._threads = len(sys.modules), set(threading.enumerate())

    def list_changes(self) -> tuple[str, ...]:
        """List the changed parts of the state, and threads and child processes that are still running."""
        present = {name: read() for name, read in _PARTS.items()}
        if len(sys.modules) != self._modules:
            self._modules = len(sys.modules)
            self._values |= {name: present[name] for name in _CHANGED_BY_IMPORTS}
        changed_names = (name for name, value in present.items() if value != self._values[name])
        return (*changed_names, *self._list_running())

    def _list_running(self) -> list[str]:
        """List non-daemon threads and child processes that do not end soon."""
        deadline = time.monotonic() + _MAX_END_WAIT_S
        while True:
            threads = [item.name for item in threading.enumerate() if item not in self._threads and not item.daemon]
            running = {"threads": threads, "child processes": _list_child_processes()}
            if not any(running.values()) or time.monotonic() >= deadline:
                running_texts = {kind: ", ".join(sorted(set(items))) for kind, items in running.items() if items}
                return [f"{kind} that are still running ({items})" for kind, items in running_texts.items()]
            # finalizers of unreferenced objects can end their child processes
            gc.collect()
            time.sleep(0.01)


def _list_child_processes() -> list[str]:
    """List the names of running child processes, except idle programs under test; collect ended child processes."""
    try:
        # fast path: without child processes this call raises after a microsecond
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:
        return []
    serving: Any = sys.modules.get("marsyard.algorithms.exchange.serving")
    idle = serving.idle_processes() if serving is not None else ()
    names = []
    for child in children(os.getpid()):
        if child in idle:
            continue
        with suppress(OSError):
            if os.waitpid(child, os.WNOHANG)[0] == 0:
                names.append(Path(f"/proc/{child}/comm").read_text().strip())
    return names


def seed_generators(seed: int) -> None:
    """Seed the global random generators with a case number, so that a case does not depend on earlier cases."""
    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002 (for cases, not for the engine)
    if "cv2" in sys.modules:
        # OpenCV's initial state
        sys.modules["cv2"].setRNGSeed(0)


def list_open_files() -> dict[int, FileIdentity]:
    """List the open descriptors except the standard streams: the worker's output and the pipes to its parent."""
    numbers = [int(path.name) for path in Path("/proc/self/fd").glob("*")]
    identities = {number: file_identity(number) for number in numbers if number > 2}
    # without the descriptor of the listing itself
    return {number: identity for number, identity in identities.items() if identity is not None}


def file_identity(number: int) -> FileIdentity:
    """Return device and inode of a file descriptor; None if it is closed."""
    try:
        status = os.fstat(number)
    except OSError:
        return None
    return status.st_dev, status.st_ino
