"""State of a worker process that one case could hand on to the next: compared after each, restored, and reported.

What can be set back is set back. What cannot (a thread, a child process, a handler of a signal) costs the worker: the
next case runs in a fresh one. The global random generators of Python, NumPy and OpenCV are set before each case.
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

#: Seconds for threads and processes that are about to end.
_ENDING_S = 0.2

_SIGNALS = tuple(range(1, signal.SIGSYS + 1))


@dataclass(frozen=True)
class Differences:
    """In what a process differs from what it was before.

    Attributes
    ----------
    restored
        What was set back.
    lasting
        What cannot be set back.
    """

    restored: tuple[str, ...] = ()
    lasting: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """All of them."""
        return (*self.restored, *self.lasting)


@dataclass(frozen=True)
class _Part:
    """A part of the state: its name, how it is read, and how it is set."""

    name: str
    read: Callable[[], Any]
    set: Callable[[Any], object]


def _folder() -> str:
    try:
        return str(Path.cwd())
    except FileNotFoundError:
        return ""


#: Variable that the first picture sets, for the whole life of its process.
_OPENGL = b"PYOPENGL_PLATFORM"


def _environment() -> dict[bytes, bytes]:
    # the mapping below `os.environ`: reading through it decodes each variable, which takes ten times as long
    variables: dict[bytes, bytes] = dict(os.environ._data)  # type: ignore[attr-defined]
    variables.pop(_OPENGL, None)
    return variables


def _set_environment(saved: dict[bytes, bytes]) -> None:
    for name in set(os.environb) - {*saved, _OPENGL}:
        del os.environb[name]
    os.environb.update(saved)


def _set_path(saved: list[str]) -> None:
    sys.path[:] = saved


def _set_filters(saved: list[Any]) -> None:
    # has warnings forget what it derived from the former filters
    warnings.resetwarnings()
    warnings.filters[:] = saved  # type: ignore[index]


def _umask() -> int:
    mask = os.umask(0o077)
    os.umask(mask)
    return mask


def _decimals() -> tuple[Any, ...]:
    own = decimal.getcontext()
    traps = tuple(kind for kind, wanted in own.traps.items() if wanted)
    return own.prec, own.rounding, own.Emin, own.Emax, own.capitals, own.clamp, (), traps


def _opencv() -> tuple[bool, int]:
    """Whether OpenCV's fast code is on, and its threads; where it is not loaded, what it has in a fresh worker."""
    cv2: Any = sys.modules.get("cv2")
    return (True, 1) if cv2 is None else (cv2.useOptimized(), cv2.getNumThreads())


def _set_opencv(saved: tuple[bool, int]) -> None:
    cv2: Any = sys.modules["cv2"]
    cv2.setUseOptimized(saved[0])
    cv2.setNumThreads(saved[1])


#: Half a unit in the last place of 1 and less: what these sums give says how the processor rounds.
_LITTLE, _SMALLEST_NORMAL = 2.0**-60, sys.float_info.min


def _arithmetic() -> tuple[bool, ...]:
    """How floating-point numbers are rounded, and whether the smallest ones are flushed to zero."""
    one, little, small = float("1"), _LITTLE, _SMALLEST_NORMAL
    return one + little == one, -one - little == -one, one - little == one, small * 0.5 > 0.0


def _set_arithmetic(_: object) -> None:
    import ctypes
    import ctypes.util

    # FE_DFL_ENV of the C library: to the nearest, with small numbers
    ctypes.CDLL(ctypes.util.find_library("m") or None).fesetenv(ctypes.c_void_p(-1))


def _set_collection(wanted: bool) -> None:
    (gc.enable if wanted else gc.disable)()


_PARTS = (
    _Part("the working folder", _folder, os.chdir),
    _Part("environment variables", _environment, _set_environment),
    _Part("sys.path", lambda: list(sys.path), _set_path),
    _Part("the filters of warnings", lambda: list(warnings.filters), _set_filters),
    _Part("NumPy's handling of errors (numpy.seterr)", np.geterr, lambda saved: np.seterr(**saved)),
    _Part(
        "the locale",
        lambda: locale.setlocale(locale.LC_ALL),
        lambda saved: locale.setlocale(locale.LC_ALL, saved),
    ),
    _Part("the mask of new files (umask)", _umask, os.umask),
    _Part("the limit of recursion", sys.getrecursionlimit, sys.setrecursionlimit),
    _Part(
        "the context of decimal numbers", _decimals, lambda saved: decimal.setcontext(decimal.Context(*_ordered(saved)))
    ),
    _Part("OpenCV's settings (optimised code, threads)", _opencv, _set_opencv),
    _Part("the arithmetic of floating-point numbers (rounding)", _arithmetic, _set_arithmetic),
    _Part("the collection of garbage", gc.isenabled, _set_collection),
)


#: Parts that modules change as they are imported.
_CHANGED_BY_IMPORTS = tuple(
    place
    for place, part in enumerate(_PARTS)
    if part.name in ("environment variables", "sys.path", "the filters of warnings")
)


def _ordered(saved: tuple[Any, ...]) -> tuple[Any, ...]:
    """The fields of a decimal context in the order of its constructor."""
    prec, rounding, least, most, capitals, clamp, flags, traps = saved
    return prec, rounding, least, most, capitals, clamp, list(flags), list(traps)


def _signals() -> tuple[Any, ...]:
    """Handlers, blocked signals and timers.

    The functions below `signal` make no enumerations of what they return, which would take most of the time.
    """
    handlers = tuple(_signal.getsignal(number) for number in _SIGNALS)
    return handlers, _signal.pthread_sigmask(_signal.SIG_BLOCK, ()), _signal.getitimer(_signal.ITIMER_REAL)


def _streams() -> tuple[Any, ...]:
    """Standard output and error, whether they can be written, and the files below them."""
    objects = [(stream, getattr(stream, "closed", True)) for stream in (sys.stdout, sys.stderr)]
    return (*objects, _identity(1), _identity(2))


class _ImportRecorder(MetaPathFinder):
    """Lets a state see each module that is executed, other than by an import within another."""

    def __init__(self, state: ProcessState) -> None:
        self._state = state
        self._nested = False

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Find a module by the other finders, and have it executed by the state."""
        if self._nested:
            return None
        found = (
            finder.find_spec(fullname, path, target)
            for finder in sys.meta_path
            if finder is not self and hasattr(finder, "find_spec")
        )
        spec = next((one for one in found if one is not None), None)
        # loaders of built-in modules are classes, without an instance for each module
        if spec is not None and spec.loader is not None and not isinstance(spec.loader, type):
            spec.loader.exec_module = partial(self._execute, spec.loader.exec_module)  # type: ignore[method-assign]
        return spec

    def _execute(self, execute: Callable[[ModuleType], None], module: ModuleType) -> None:
        self._nested = True
        try:
            self._state.execute(module, execute)
        finally:
            self._nested = False


def _record_imports_for(state: ProcessState) -> None:
    sys.meta_path[:] = [finder for finder in sys.meta_path if not isinstance(finder, _ImportRecorder)]
    sys.meta_path.insert(0, _ImportRecorder(state))


class ProcessState:
    """The state of this process as it was at a moment, to compare with."""

    def __init__(self) -> None:
        self._parts = [part.read() for part in _PARTS]
        self._lasting = (_signals(), _streams())
        self._threads = set(threading.enumerate())
        _record_imports_for(self)

    def differences(self) -> Differences:
        """In what the process differs now; what can be set back is."""
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

        An import happens once in a process, whichever case comes first: its changes are not the case's.
        """
        before = {place: _PARTS[place].read() for place in _CHANGED_BY_IMPORTS}
        try:
            execute(module)
        finally:
            for place, old in before.items():
                new, saved = _PARTS[place].read(), self._parts[place]
                if isinstance(saved, dict):
                    self._parts[place] = {
                        name: value for name, value in saved.items() if name in new or name not in old
                    } | {name: value for name, value in new.items() if old.get(name) != value}
                elif saved == old:
                    self._parts[place] = new

    def _leftovers(self) -> list[str]:
        """What the process has too much, or cannot set back."""
        signals, streams = self._lasting
        found = ["handlers of signals, or timers"] if _signals() != signals else []
        if _streams() != streams:
            found.append("standard output or error")
        end = time.monotonic() + _ENDING_S
        while (left := self._left_running()) and time.monotonic() < end:
            # what nothing refers to any more ends its processes as it goes
            gc.collect()
            time.sleep(0.01)
        return [*found, *left]

    def _left_running(self) -> list[str]:
        """Threads that keep a process from its end, and child processes."""
        threads = [one for one in threading.enumerate() if one not in self._threads and not one.daemon]
        found = [f"threads that it left running ({_names(one.name for one in threads)})"] if threads else []
        processes = _other_children()
        return [*found, f"child processes that it left running ({_names(processes)})"] if processes else found


def _names(names: Any) -> str:
    return ", ".join(sorted(set(names)))


def _other_children() -> list[str]:
    """Names of the child processes, but for programs under test that wait for the next case; ended ones are reaped."""
    try:
        # says in a microsecond that there are none
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:
        return []
    serving: Any = sys.modules.get("marsyard.algorithms.exchange.serving")
    waiting = serving.waiting_processes() if serving is not None else ()
    found = []
    for child in children(os.getpid()):
        if child in waiting:
            continue
        with suppress(OSError):
            if os.waitpid(child, os.WNOHANG)[0] == 0:
                found.append(Path(f"/proc/{child}/comm").read_text().strip())
    return found


def seed_generators(item: int) -> None:
    """Sets the global random generators: a case draws the same numbers from them, whatever ran before it."""
    random.seed(item)
    np.random.seed(item % 2**32)  # noqa: NPY002 (what cases may draw from, not what the engine does)
    if "cv2" in sys.modules:
        # the state that OpenCV begins with
        sys.modules["cv2"].setRNGSeed(0)


def generators_were_used(item: int) -> bool:
    """Whether anything was drawn from the generators of Python and NumPy since they were set; sets them again."""
    drawn = _drawn()
    seed_generators(item)
    return drawn != _drawn()


def _drawn() -> tuple[float, float]:
    return random.random(), np.random.random_sample()  # noqa: NPY002, S311


class OpenFiles:
    """The files that a worker needs in order to work: its output, and the pipes to its parent."""

    def __init__(self) -> None:
        numbers = [int(one.name) for one in Path("/proc/self/fd").glob("*")]
        # without standard streams, and without the listing itself, which is gone
        self._needed = [(one, _identity(one)) for one in numbers if one > 2 and _identity(one) is not None]

    def intact(self) -> bool:
        """Whether all of them are open still."""
        return all(_identity(number) == identity for number, identity in self._needed)


def _identity(number: int) -> tuple[int, int] | None:
    """Which file stands behind a number; None where none does."""
    try:
        found = os.fstat(number)
    except OSError:
        return None
    return found.st_dev, found.st_ino
