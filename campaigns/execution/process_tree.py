"""Processes that a process has started: who they are, what memory they take, and how all of them are killed."""

from __future__ import annotations

import ctypes
import os
import re
import signal
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

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


def children(process: int) -> list[int]:
    """Children of all threads of a process; none where it is gone, or Linux does not list them."""
    found: list[int] = []
    with suppress(OSError):
        for thread in Path(f"/proc/{process}/task").iterdir():
            with suppress(OSError):
                found += map(int, (thread / "children").read_text().split())
    return found


def descendants(process: int) -> list[int]:
    """Children of a process, their children, and so on."""
    found = children(process)
    for child in found:
        found += children(child)
    return found


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


def used_memory(processes: Sequence[int], worth_knowing: float = 0.0) -> float:
    """Bytes that processes have to themselves; 0 for those that are gone.

    Pages of mapped files are not among them: workers share those of a terrain, and Linux takes them back as needed.
    Pages that forked processes share count once.

    Parameters
    ----------
    processes
        Of one tree.
    worth_knowing
        Where the memory is at most this, counted with shared pages in each process, that figure is returned: counting
        shared pages once is slow.
    """
    counted = sum(_kilobytes(process, "status", r"Rss(?:Anon|Shmem)") for process in processes) * 1024.0
    if len(processes) < 2 or counted <= worth_knowing:
        return counted
    return sum(_kilobytes(process, "smaps_rollup", r"Pss_(?:Anon|Shmem)") for process in processes) * 1024.0


def _kilobytes(process: int, file: str, fields: str) -> float:
    """Sum of fields of a file of Linux about a process."""
    try:
        text = Path(f"/proc/{process}/{file}").read_text()
    except OSError:
        return 0.0
    return sum(float(size) for size in re.findall(rf"^{fields}:\s+(\d+) kB", text, re.MULTILINE))
