"""State of a worker process that one case could leave to the next: compared after each case, restored, and reported.

Changes that cannot be restored (a thread, a child process, a signal handler) cost the worker: the next case runs in a
fresh one. The global random generators of Python, NumPy and OpenCV are seeded before each case.
"""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]
import decimal
import gc
import locale
import os
import random
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from marsyard.algorithms.processes import children

#: Seconds to wait for threads and processes to end.
_ENDING_S = 0.2

_SIGNALS = tuple(range(1, signal.SIGSYS + 1))


@dataclass(frozen=True)
class Differences:
    """Changes of the process state: parts that were restored, and parts that cannot be."""

    restored: tuple[str, ...] = ()
    lasting: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Part:
    """A part of the state: its name, a function that reads it, and one that sets it."""

    name: str
    read: Callable[[], Any]
    set: Callable[[Any], object]


def _folder() -> str:
    try:
        return str(Path.cwd())
    except FileNotFoundError:
        return ""


#: Variable that the first picture sets for the rest of the process.
_OPENGL = b"PYOPENGL_PLATFORM"


def _environment() -> dict[bytes, bytes]:
    # the mapping behind `os.environ`: ten times as fast, since nothing is decoded
    variables: dict[bytes, bytes] = dict(os.environ._data)  # type: ignore[attr-defined]
    variables.pop(_OPENGL, None)
    return variables


def _set_environment(saved: dict[bytes, bytes]) -> None:
    for name in set(os.environb) - {*saved, _OPENGL}:
        del os.environb[name]
    os.environb.update(saved)


def _set_filters(saved: list[Any]) -> None:
    # clears the module's cache of the former filters
    warnings.resetwarnings()
    warnings.filters[:] = saved  # type: ignore[index]


def _umask() -> int:
    mask = os.umask(0o077)
    os.umask(mask)
    return mask


def _decimals() -> tuple[Any, ...]:
    context = decimal.getcontext()
    traps = tuple(kind for kind, wanted in context.traps.items() if wanted)
    return context.prec, context.rounding, context.Emin, context.Emax, context.capitals, context.clamp, (), traps


def _set_decimals(saved: tuple[Any, ...]) -> None:
    prec, rounding, e_min, e_max, capitals, clamp, flags, traps = saved
    decimal.setcontext(decimal.Context(prec, rounding, e_min, e_max, capitals, clamp, list(flags), list(traps)))


def _opencv() -> tuple[bool, int]:
    """OpenCV's optimisation flag and threads; those of a fresh worker where it is not loaded."""
    cv2: Any = sys.modules.get("cv2")
    return (True, 1) if cv2 is None else (cv2.useOptimized(), cv2.getNumThreads())


def _set_opencv(saved: tuple[bool, int]) -> None:
    cv2: Any = sys.modules["cv2"]
    cv2.setUseOptimized(saved[0])
    cv2.setNumThreads(saved[1])


#: Less than half a unit in the last place of 1: sums with it show how the processor rounds.
_BELOW_HALF_ULP, _SMALLEST_NORMAL = 2.0**-60, sys.float_info.min


def _arithmetic() -> tuple[bool, ...]:
    """How floating-point numbers are rounded, and whether subnormal ones are flushed to zero."""
    one, little, small = float("1"), _BELOW_HALF_ULP, _SMALLEST_NORMAL
    return one + little == one, -one - little == -one, one - little == one, small * 0.5 > 0.0


def _set_arithmetic(_: object) -> None:
    import ctypes
    import ctypes.util

    # FE_DFL_ENV of the C library: round to nearest, with subnormal numbers
    ctypes.CDLL(ctypes.util.find_library("m") or None).fesetenv(ctypes.c_void_p(-1))


_PARTS = (
    _Part("the working folder", _folder, os.chdir),
    _Part("environment variables", _environment, _set_environment),
    _Part("sys.path", lambda: list(sys.path), lambda saved: sys.path.__setitem__(slice(None), saved)),
    _Part("the filters of warnings", lambda: list(warnings.filters), _set_filters),
    _Part("NumPy's handling of errors (numpy.seterr)", np.geterr, lambda saved: np.seterr(**saved)),
    _Part(
        "the locale",
        lambda: locale.setlocale(locale.LC_ALL),
        lambda saved: locale.setlocale(locale.LC_ALL, saved),
    ),
    _Part("the mask of new files (umask)", _umask, os.umask),
    _Part("the limit of recursion", sys.getrecursionlimit, sys.setrecursionlimit),
    _Part("the context of decimal numbers", _decimals, _set_decimals),
    _Part("OpenCV's settings (optimised code, threads)", _opencv, _set_opencv),
    _Part("the arithmetic of floating-point numbers (rounding)", _arithmetic, _set_arithmetic),
    _Part("the collection of garbage", gc.isenabled, lambda enabled: (gc.enable if enabled else gc.disable)()),
)


#: Indices of the parts that imports of modules change.
_IMPORT_NAMES = ("environment variables", "sys.path", "the filters of warnings")
_CHANGED_BY_IMPORTS = tuple(index for index, part in enumerate(_PARTS) if part.name in _IMPORT_NAMES)


def _signals() -> tuple[Any, ...]:
    """Handlers, blocked signals and timers; `_signal` avoids building enumerations, which takes most of the time."""
    handlers = tuple(_signal.getsignal(number) for number in _SIGNALS)
    return handlers, _signal.pthread_sigmask(_signal.SIG_BLOCK, ()), _signal.getitimer(_signal.ITIMER_REAL)


def _streams() -> tuple[Any, ...]:
    """Standard output and error, whether they are closed, and the files behind them."""
    objects = [(stream, getattr(stream, "closed", True)) for stream in (sys.stdout, sys.stderr)]
    return (*objects, _identity(1), _identity(2))


class _ImportRecorder(MetaPathFinder):
    """Import hook that passes each top-level import to a `ProcessState`."""

    def __init__(self, state: ProcessState) -> None:
        self._state = state
        self._nested = False

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Find a module by the other finders, and let the state execute it."""
        if self._nested:
            return None
        specs = (
            finder.find_spec(fullname, path, target)
            for finder in sys.meta_path
            if finder is not self and hasattr(finder, "find_spec")
        )
        spec = next((one for one in specs if one is not None), None)
        # loaders of built-in modules are classes, shared by all modules
        if spec is not None and spec.loader is not None and not isinstance(spec.loader, type):
            spec.loader.exec_module = partial(self._execute, spec.loader.exec_module)  # type: ignore[method-assign]
        return spec

    def _execute(self, execute: Callable[[ModuleType], None], module: ModuleType) -> None:
        self._nested = True
        try:
            self._state.execute(module, execute)
        finally:
            self._nested = False


class ProcessState:
    """State of this process at a moment, as a reference."""

    def __init__(self) -> None:
        self._parts = [part.read() for part in _PARTS]
        self._lasting = (_signals(), _streams())
        self._threads = set(threading.enumerate())
        sys.meta_path[:] = [finder for finder in sys.meta_path if not isinstance(finder, _ImportRecorder)]
        sys.meta_path.insert(0, _ImportRecorder(self))

    def differences(self) -> Differences:
        """Changes since then; those that can be restored are."""
        restored: list[str] = []
        lasting = list(self._leftovers())
        for part, before in zip(_PARTS, self._parts, strict=True):
            if part.read() == before:
                continue
            with suppress(Exception):
                part.set(before)
            (restored if part.read() == before else lasting).append(part.name)
        return Differences(tuple(restored), tuple(lasting))

    def execute(self, module: ModuleType, execute: Callable[[ModuleType], None]) -> None:
        """Execute an imported module and accept its changes to the environment, `sys.path` and warning filters.

        An import happens once per process, in whichever case comes first: its changes are not attributed to the case.
        """
        before = {index: _PARTS[index].read() for index in _CHANGED_BY_IMPORTS}
        try:
            execute(module)
        finally:
            for index, old in before.items():
                new, saved = _PARTS[index].read(), self._parts[index]
                if isinstance(saved, dict):
                    self._parts[index] = {
                        name: value for name, value in saved.items() if name in new or name not in old
                    } | {name: value for name, value in new.items() if old.get(name) != value}
                elif saved == old:
                    self._parts[index] = new

    def _leftovers(self) -> list[str]:
        """Lasting changes: signals, streams, threads and child processes."""
        signals, streams = self._lasting
        names = ["handlers of signals, or timers"] if _signals() != signals else []
        if _streams() != streams:
            names.append("standard output or error")
        end = time.monotonic() + _ENDING_S
        while (left := self._left_running()) and time.monotonic() < end:
            # finalizers of unreferenced objects end their processes
            gc.collect()
            time.sleep(0.01)
        return [*names, *left]

    def _left_running(self) -> list[str]:
        """Threads that keep a process from ending, and child processes."""
        threads = [one for one in threading.enumerate() if one not in self._threads and not one.daemon]
        names = [f"threads that it left running ({_names(one.name for one in threads)})"] if threads else []
        processes = _other_children()
        return [*names, f"child processes that it left running ({_names(processes)})"] if processes else names


def _names(names: Any) -> str:
    return ", ".join(sorted(set(names)))


def _other_children() -> list[str]:
    """Names of the child processes, except idle programs under test; ended ones are reaped."""
    try:
        # a microsecond where there are none
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:
        return []
    serving: Any = sys.modules.get("marsyard.algorithms.exchange.serving")
    waiting = serving.waiting_processes() if serving is not None else ()
    names = []
    for child in children(os.getpid()):
        if child in waiting:
            continue
        with suppress(OSError):
            if os.waitpid(child, os.WNOHANG)[0] == 0:
                names.append(Path(f"/proc/{child}/comm").read_text().strip())
    return names


def seed_generators(item: int) -> None:
    """Seed the global random generators: a case draws the same numbers from them, whatever ran before it."""
    random.seed(item)
    np.random.seed(item % 2**32)  # noqa: NPY002 (for cases, not for the engine)
    if "cv2" in sys.modules:
        # OpenCV's initial state
        sys.modules["cv2"].setRNGSeed(0)


def generators_were_used(item: int) -> bool:
    """Whether Python's or NumPy's generator was used since it was seeded; seeds them again."""
    drawn = _drawn()
    seed_generators(item)
    return drawn != _drawn()


def _drawn() -> tuple[float, float]:
    return random.random(), np.random.random_sample()  # noqa: NPY002, S311


class OpenFiles:
    """Files that a worker needs: its output, and the pipes to its parent."""

    def __init__(self) -> None:
        numbers = [int(one.name) for one in Path("/proc/self/fd").glob("*")]
        # without the standard streams and the listing itself
        self._needed = [(one, _identity(one)) for one in numbers if one > 2 and _identity(one) is not None]

    def intact(self) -> bool:
        """Whether all of them are still open."""
        return all(_identity(number) == identity for number, identity in self._needed)


def _identity(number: int) -> tuple[int, int] | None:
    """Device and inode behind a file descriptor; None where it is closed."""
    try:
        status = os.fstat(number)
    except OSError:
        return None
    return status.st_dev, status.st_ino
