"""State of a worker process by which a case could affect later cases (environment variables, signal handlers, ...).

After each case the state is compared with a reference, changes are reported, and the state is restored. If a change
cannot be restored (a thread, a child process, a signal handler), the next case runs in a fresh worker. The global
random generators of Python, NumPy and OpenCV are seeded before each case.
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
from functools import partial
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from marsyard.algorithms.processes import children

#: Maximum seconds to wait for threads and processes to end.
_MAX_END_WAIT_S = 0.2
#: Device and inode of an open file; None for a closed descriptor.
FileIdentity = tuple[int, int] | None
#: Numbers of the standard signals, without real-time signals.
_SIGNALS = tuple(range(1, signal.SIGSYS + 1))


class _StatePart(NamedTuple):
    """A part of the state: its name, a function that reads it, and a function that sets it."""

    name: str
    read: Callable[[], Any]
    set: Callable[[Any], object]


def _read_working_folder() -> str:
    try:
        return str(Path.cwd())
    except FileNotFoundError:
        return ""


#: Variable that is set when the first image is rendered; it is not compared.
_OPENGL_VARIABLE = b"PYOPENGL_PLATFORM"


def _read_environment() -> dict[bytes, bytes]:
    # read the undecoded mapping inside `os.environ`, which is ten times as fast
    variables: dict[bytes, bytes] = dict(os.environ._data)  # type: ignore[attr-defined]
    variables.pop(_OPENGL_VARIABLE, None)
    return variables


def _set_environment(saved: dict[bytes, bytes]) -> None:
    for name in set(os.environb) - {*saved, _OPENGL_VARIABLE}:
        del os.environb[name]
    os.environb.update(saved)


def _set_filters(saved: list[Any]) -> None:
    # `resetwarnings` also clears the cache of the previous filters
    warnings.resetwarnings()
    warnings.filters[:] = saved  # type: ignore[index]


def _read_umask() -> int:
    mask = os.umask(0o077)
    os.umask(mask)
    return mask


def _read_decimal_context() -> tuple[Any, ...]:
    context = decimal.getcontext()
    enabled_traps = [kind for kind, is_enabled in context.traps.items() if is_enabled]
    return (
        context.prec,
        context.rounding,
        context.Emin,
        context.Emax,
        context.capitals,
        context.clamp,
        [],  # flags of earlier operations are not restored
        enabled_traps,
    )


def _read_opencv() -> tuple[bool, int]:
    """Return OpenCV's optimisation flag and number of threads; those of a fresh worker if OpenCV is not loaded."""
    cv2: Any = sys.modules.get("cv2")
    return (True, 1) if cv2 is None else (cv2.useOptimized(), cv2.getNumThreads())


def _set_opencv(saved: tuple[bool, int]) -> None:
    cv2: Any = sys.modules["cv2"]
    cv2.setUseOptimized(saved[0])
    cv2.setNumThreads(saved[1])


def _read_arithmetic() -> tuple[bool, ...]:
    """Determine the rounding mode of floating-point numbers, and whether subnormal numbers are flushed to zero."""
    # the rounding mode determines whether adding less than half the distance to the next float changes the number 1;
    # `float("1")` prevents the compiler from computing the sums
    unit, increment, min_normal = float("1"), 2.0**-60, sys.float_info.min
    return unit + increment == unit, -unit - increment == -unit, unit - increment == unit, min_normal * 0.5 > 0.0


def _set_arithmetic(_: object) -> None:
    import ctypes
    import ctypes.util

    # FE_DFL_ENV of the C library: round to nearest, with subnormal numbers
    ctypes.CDLL(ctypes.util.find_library("m") or None).fesetenv(ctypes.c_void_p(-1))


_PARTS = (
    _StatePart("the working folder", _read_working_folder, os.chdir),
    _StatePart("environment variables", _read_environment, _set_environment),
    _StatePart("sys.path", lambda: list(sys.path), lambda saved: sys.path.__setitem__(slice(None), saved)),
    _StatePart("the warning filters", lambda: list(warnings.filters), _set_filters),
    _StatePart("NumPy's error handling (numpy.seterr)", np.geterr, lambda saved: np.seterr(**saved)),
    _StatePart("the locale", partial(locale.setlocale, locale.LC_ALL), partial(locale.setlocale, locale.LC_ALL)),
    _StatePart("the file mode mask (umask)", _read_umask, os.umask),
    _StatePart("the recursion limit", sys.getrecursionlimit, sys.setrecursionlimit),
    _StatePart("the decimal context", _read_decimal_context, lambda saved: decimal.setcontext(decimal.Context(*saved))),
    _StatePart("OpenCV's settings (optimised code, threads)", _read_opencv, _set_opencv),
    _StatePart("the floating-point rounding mode", _read_arithmetic, _set_arithmetic),
    _StatePart("garbage collection", gc.isenabled, lambda enabled: (gc.enable if enabled else gc.disable)()),
)
#: Indices in `_PARTS` of the parts that an import may change: environment variables, `sys.path`, warning filters.
_CHANGED_BY_IMPORTS = (1, 2, 3)


def _read_signals() -> tuple[Any, ...]:
    """Return signal handlers, blocked signals and timers; `_signal` is faster since it builds no enumerations."""
    handlers = tuple(_signal.getsignal(number) for number in _SIGNALS)
    return handlers, _signal.pthread_sigmask(_signal.SIG_BLOCK, ()), _signal.getitimer(_signal.ITIMER_REAL)


def _read_streams() -> tuple[Any, ...]:
    """Return standard output and error, whether they are closed, and the identities of their files."""
    objects = [(stream, getattr(stream, "closed", True)) for stream in (sys.stdout, sys.stderr)]
    return (*objects, file_identity(1), file_identity(2))


class ProcessState:
    """Reference state of this process; an import hook adds the changes by imports of modules to the reference."""

    def __init__(self) -> None:
        self._parts = [part.read() for part in _PARTS]
        self._signals_and_streams = (_read_signals(), _read_streams())
        self._threads = set(threading.enumerate())
        self._importing = False
        sys.meta_path[:] = [self, *(finder for finder in sys.meta_path if not isinstance(finder, ProcessState))]

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Find a module with the other finders; changes by its import are added to the reference state."""
        if self._importing:
            return None
        finders = [finder for finder in sys.meta_path if finder is not self and hasattr(finder, "find_spec")]
        specs = (finder.find_spec(fullname, path, target) for finder in finders)
        spec = next((candidate for candidate in specs if candidate is not None), None)
        # loaders of built-in modules are classes, shared by all modules
        if spec is not None and spec.loader is not None and not isinstance(spec.loader, type):
            spec.loader.exec_module = partial(self._import, spec.loader.exec_module)  # type: ignore[method-assign]
        return spec

    def _import(self, execute: Callable[[ModuleType], None], module: ModuleType) -> None:
        """Execute an imported module; add its changes of environment, `sys.path` and warning filters to the reference.

        A module is imported once per process, in the first case that needs it. The case has not caused its changes.
        """
        states_before = {index: _PARTS[index].read() for index in _CHANGED_BY_IMPORTS}
        self._importing = True
        try:
            execute(module)
        finally:
            self._importing = False
            for index, old in states_before.items():
                new, saved = _PARTS[index].read(), self._parts[index]
                if isinstance(saved, dict):
                    remaining = {name: value for name, value in saved.items() if name in new or name not in old}
                    changed_values = {name: value for name, value in new.items() if old.get(name) != value}
                    self._parts[index] = remaining | changed_values
                elif saved == old:
                    self._parts[index] = new

    def restore(self) -> tuple[list[str], list[str]]:
        """Restore all changed parts; return the names of the restored parts, and of changes that cannot be restored."""
        restored: list[str] = []
        unrestorable = self._list_unrestorable_changes()
        for part, reference in zip(_PARTS, self._parts, strict=True):
            if part.read() == reference:
                continue
            with suppress(Exception):
                part.set(reference)
            (restored if part.read() == reference else unrestorable).append(part.name)
        return restored, unrestorable

    def _list_unrestorable_changes(self) -> list[str]:
        """List changes that cannot be restored: signals, streams, non-daemon threads, and child processes."""
        signals, streams = self._signals_and_streams
        names = ["handlers of signals, or timers"] if _read_signals() != signals else []
        if _read_streams() != streams:
            names.append("standard output or error")
        deadline = time.monotonic() + _MAX_END_WAIT_S
        while True:
            threads = [item.name for item in threading.enumerate() if item not in self._threads and not item.daemon]
            running = {"threads": threads, "child processes": _list_child_processes()}
            if not any(running.values()) or time.monotonic() >= deadline:
                running_texts = {kind: ", ".join(sorted(set(items))) for kind, items in running.items() if items}
                return [*names, *(f"{kind} that are still running ({items})" for kind, items in running_texts.items())]
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


def generators_were_used(seed: int) -> bool:
    """Whether Python's or NumPy's generator was used after seeding with `seed`; the generators are seeded again."""
    numbers = random.random(), np.random.random_sample()  # noqa: NPY002, S311
    seed_generators(seed)
    return numbers != (random.random(), np.random.random_sample())  # noqa: NPY002, S311


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
