"""Processes that a process has started: adopted, found by a mark, and killed."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from marsyard.algorithms.processes import descendants

#: Of Linux's `prctl`: the signal that a process gets when its parent dies, and that orphans below a process become its
#: children.
_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36

#: Seconds for which processes are killed again where killed ones have started others meanwhile.
_KILLING_S = 10.0

#: Seconds between two looks at processes that were killed.
_PAUSE_S = 0.005


def adopt_orphans() -> None:
    """Makes this process the parent of every descendant whose own parent ends: none leaves the tree, by any session."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1)


def end_with_parent(parent: int, number: int) -> None:
    """Has this process get a signal when its parent ends; ends it where the parent is gone by now."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)
        if os.getppid() != parent:
            os._exit(1)


def kill(processes: Iterable[int]) -> None:
    """Kills processes; never the first process, and no group of processes."""
    for process in processes:
        if process > 1:
            with suppress(ProcessLookupError, PermissionError):
                os.kill(process, signal.SIGKILL)


def kill_descendants() -> None:
    """Kills all that this process and its descendants have started, and waits until it has no children."""
    end = time.monotonic() + _KILLING_S
    while time.monotonic() < end:
        kill(descendants(os.getpid()))
        try:
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        except ChildProcessError:
            return
        time.sleep(_PAUSE_S)


def marked_processes(mark: str) -> list[int]:
    """Processes that were started with a variable in their environment (`NAME=value`), or forked from such ones.

    Finds those that lost their supervisor; one that was started with another environment is not found.
    """
    found = []
    wanted = mark.encode() + b"\0"
    for process in Path("/proc").glob("[1-9]*"):
        with suppress(OSError):
            if wanted in (process / "environ").read_bytes():
                found.append(int(process.name))
    return found
