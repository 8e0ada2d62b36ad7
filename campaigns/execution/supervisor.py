"""Supervisor process between the parent and a worker: it kills all descendants of the worker when the worker ends.

The parent is the program that runs the campaign; a worker runs its cases. Both may end at any moment. The supervisor
runs no code of cases. It becomes the parent of orphaned descendants, and ends after it has killed all of them. The
parent sends signals only to the supervisor.
"""

import os
import shutil
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import NoReturn

from marsyard.algorithms.processes import adopt_orphans, descendants, end_with_parent, kill

#: Signal on which a worker writes its stack trace; the supervisor forwards it.
DUMP_SIGNAL = signal.SIGUSR2
#: Signal on which the supervisor kills all descendants and ends.
END_SIGNAL = signal.SIGTERM
#: Sent by Linux when the parent ends; it also resumes a supervisor that a case has stopped.
_PARENT_SIGNAL = signal.SIGCONT
#: Maximum seconds of repeated killing, since processes may start other processes meanwhile.
_KILLING_S = 10.0
#: Seconds between two rounds of killing.
_PAUSE_S = 0.005


def become_supervised(parent: int, folder: Path) -> None:
    """Fork into a supervisor, which does not return, and a worker, which returns.

    - parent: process that started this process; supervisor and worker end when the parent ends
    - folder: folder of all workers of the parent; the supervisor removes it if the parent ended without removing it
    """
    if sys.platform != "linux":
        return
    adopt_orphans()
    # a process-group leader sends SIGHUP when it ends
    handled_signals = {DUMP_SIGNAL, END_SIGNAL, _PARENT_SIGNAL, signal.SIGCHLD, signal.SIGHUP}
    previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, handled_signals)
    end_with_parent(parent, _PARENT_SIGNAL)
    supervisor = os.getpid()
    worker = os.fork()
    if worker:
        _supervise(worker, parent, folder, handled_signals)
    signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)
    end_with_parent(supervisor, signal.SIGKILL)
    adopt_orphans()


def _supervise(worker: int, parent: int, folder: Path, handled_signals: set[signal.Signals]) -> NoReturn:
    """Wait for the worker's end or the end signal; then kill all descendants and end with the worker's status."""
    import resource

    # exit status of the worker; minus the signal number if a signal ended the worker
    status: int | None = None
    while status is None:
        received_signal = signal.sigwait(handled_signals)
        if received_signal == DUMP_SIGNAL:
            os.kill(worker, DUMP_SIGNAL)
        elif received_signal == END_SIGNAL or os.getppid() != parent:
            status = -signal.SIGKILL
        else:
            with suppress(ChildProcessError):
                while (wait_result := os.waitpid(-1, os.WNOHANG))[0]:
                    process, wait_status = wait_result
                    if process == worker:
                        status = os.waitstatus_to_exitcode(wait_status)
    deadline = time.monotonic() + _KILLING_S
    with suppress(ChildProcessError):
        # `waitpid` raises ChildProcessError as soon as this process has no children
        while time.monotonic() < deadline:
            kill(descendants(os.getpid()))
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
            time.sleep(_PAUSE_S)
    if os.getppid() != parent:
        shutil.rmtree(folder, ignore_errors=True)
    if status >= 0:
        os._exit(status)
    # end by the same signal as the worker, without a core dump
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
    if -status not in (signal.SIGKILL, signal.SIGSTOP):
        signal.signal(-status, signal.SIG_DFL)
    os.kill(os.getpid(), -status)
    os._exit(128 - status)  # as shells report a signal: 128 plus its number


def find_marked_processes(mark: str) -> list[int]:
    """Find processes with a variable (`NAME=value`) in the environment with which they were started.

    This also finds descendants without a supervisor, but not processes that were started with another environment.
    """
    processes = []
    pattern = mark.encode() + b"\0"
    for process in Path("/proc").glob("[1-9]*"):
        with suppress(OSError):
            if pattern in (process / "environ").read_bytes():
                processes.append(int(process.name))
    return processes


def is_stopped(process: int) -> bool:
    """Whether a process is stopped by a signal or a debugger (states T and t of Linux); False if it has ended."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] in "Tt"
    except (OSError, IndexError):
        return False
