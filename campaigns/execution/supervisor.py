"""The process between the parent and a worker: it outlives the worker, and leaves nothing of what the worker started.

A worker may end at any moment, and so may the parent. The supervisor runs no code of cases, adopts whatever loses its
parent below it, and ends only after it has killed all of that. The parent signals the supervisor alone, whose number it
knows from the executor.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
from pathlib import Path
from typing import NoReturn

from marsyard.campaigns.execution.process_tree import adopt_orphans, end_with_parent, kill_descendants

#: Makes a worker write down where it stands; the supervisor passes it on.
DUMP_SIGNAL = signal.SIGUSR2

#: Has the supervisor kill everything and end.
END_SIGNAL = signal.SIGTERM

#: Sent by Linux where the parent ends; it also wakes a supervisor that a case has stopped.
_PARENT_SIGNAL = signal.SIGCONT


def become_supervised(parent: int, folder: Path) -> None:
    """Divides this process into a supervisor, which does not return, and a worker, which does.

    Parameters
    ----------
    parent
        The process that started this one: where it ends, all ends.
    folder
        Of all workers of the parent; removed where the parent ended before it could do so.
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
    """Waits for the worker's end, or for the signal to end it; then kills what is left and ends as the worker did."""
    status: int | None = None
    while status is None:
        number = signal.sigwait(handled)
        if number == DUMP_SIGNAL:
            os.kill(worker, DUMP_SIGNAL)
        elif number == END_SIGNAL or os.getppid() != parent:
            status = -signal.SIGKILL
        else:
            status = _exit_status(worker)
    kill_descendants()
    if os.getppid() != parent:
        shutil.rmtree(folder, ignore_errors=True)
    if status < 0:
        signal.pthread_sigmask(signal.SIG_SETMASK, ())
        _end_by(-status)
    os._exit(status)


def _exit_status(worker: int) -> int | None:
    """How the worker ended, None while it has not; other children that have ended are reaped."""
    found = None
    try:
        while (ended := os.waitpid(-1, os.WNOHANG))[0]:
            if ended[0] == worker:
                found = os.waitstatus_to_exitcode(ended[1])
    except ChildProcessError:
        pass
    return found


def _end_by(number: int) -> None:
    """Ends this process by a signal, without a dump of its memory."""
    import resource

    resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
    if number not in (signal.SIGKILL, signal.SIGSTOP):
        signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)
    os._exit(128 + number)
