"""Supervisor process between the parent and a worker: it outlives the worker and kills all that the worker started.

A worker and the parent may end at any moment. The supervisor runs no code of cases, adopts orphaned processes below it,
and ends only after it has killed them all. The parent signals only the supervisor, whose number it knows from the
executor.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import sys
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import NoReturn

from marsyard.algorithms.processes import descendants

#: Makes a worker write its stack trace; the supervisor forwards it.
DUMP_SIGNAL = signal.SIGUSR2
#: Makes the supervisor kill everything and end.
END_SIGNAL = signal.SIGTERM
#: Sent by Linux when the parent ends; it also wakes a supervisor that a case has stopped.
_PARENT_SIGNAL = signal.SIGCONT


def become_supervised(parent: int, folder: Path) -> None:
    """Fork into a supervisor, which does not return, and a worker, which does.

    parent: the process that started this one; when it ends, all end.
    folder: of all workers of the parent; removed where the parent ended without doing so.
    """
    if sys.platform != "linux":
        return
    adopt_orphans()
    # SIGHUP comes with the end of a parent that led the process group
    handled = {DUMP_SIGNAL, END_SIGNAL, _PARENT_SIGNAL, signal.SIGCHLD, signal.SIGHUP}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, handled)
    end_with_parent(parent, _PARENT_SIGNAL)
    supervisor = os.getpid()
    worker = os.fork()
    if worker:
        _supervise(worker, parent, folder, handled)
    signal.pthread_sigmask(signal.SIG_SETMASK, before)
    end_with_parent(supervisor, signal.SIGKILL)
    adopt_orphans()


def _supervise(worker: int, parent: int, folder: Path, handled: set[signal.Signals]) -> NoReturn:
    """Wait for the worker's end or the signal to end it; then kill all descendants and end with the worker's status."""
    import resource

    status: int | None = None
    while status is None:
        number = signal.sigwait(handled)
        if number == DUMP_SIGNAL:
            os.kill(worker, DUMP_SIGNAL)
        elif number == END_SIGNAL or os.getppid() != parent:
            status = -signal.SIGKILL
        else:
            with suppress(ChildProcessError):
                while (ended := os.waitpid(-1, os.WNOHANG))[0]:
                    if ended[0] == worker:
                        status = os.waitstatus_to_exitcode(ended[1])
    end = time.monotonic() + _KILLING_S
    with suppress(ChildProcessError):
        # until this process has no children
        while time.monotonic() < end:
            kill(descendants(os.getpid()))
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
            time.sleep(_PAUSE_S)
    if os.getppid() != parent:
        shutil.rmtree(folder, ignore_errors=True)
    if status >= 0:
        os._exit(status)
    # end by the worker's signal, without a core dump
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
    if -status not in (signal.SIGKILL, signal.SIGSTOP):
        signal.signal(-status, signal.SIG_DFL)
    os.kill(os.getpid(), -status)
    os._exit(128 - status)


#: Options of Linux's `prctl`: signal at the parent's death, and adoption of orphaned descendants.
_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36
#: Seconds during which killing is repeated, since processes may start others meanwhile.
_KILLING_S = 10.0
#: Seconds between two checks of killed processes.
_PAUSE_S = 0.005


def adopt_orphans() -> None:
    """Make this process the parent of every orphaned descendant, in any session."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1)


def end_with_parent(parent: int, number: int) -> None:
    """Request a signal when the parent ends; end now where it has ended already."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)
        if os.getppid() != parent:
            os._exit(1)


def kill(processes: Iterable[int]) -> None:
    """Kill processes; never the first process, and no process group."""
    for process in processes:
        if process > 1:
            with suppress(ProcessLookupError, PermissionError):
                os.kill(process, signal.SIGKILL)


def marked_processes(mark: str) -> list[int]:
    """Processes with a variable (`NAME=value`) in their environment, and processes forked from them.

    Finds those that lost their supervisor, but none that was started with another environment.
    """
    processes = []
    wanted = mark.encode() + b"\0"
    for process in Path("/proc").glob("[1-9]*"):
        with suppress(OSError):
            if wanted in (process / "environ").read_bytes():
                processes.append(int(process.name))
    return processes
