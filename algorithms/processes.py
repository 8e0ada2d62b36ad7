"""Other processes: their children, memory, processor time and end, by Linux's /proc (empty or zero elsewhere)."""

import ctypes
import os
import re
import signal
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

#: Options of Linux's `prctl`: send a signal at the parent's end; become the parent of orphaned descendants.
_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36
#: Loaded here, because nothing should be loaded between a fork and the execution of another program.
_libc = ctypes.CDLL(None)


def processor_time_s(process: int) -> float:
    """Return the processor time of all threads of another process. Raises OSError if it has ended."""
    # Linux: clock identifier of a process, see `clock_getcpuclockid` and CPUCLOCK_SCHED
    return time.clock_gettime((~process << 3) | 2)


def adopt_orphans() -> None:
    """Make this process the parent of every orphaned descendant, in any session."""
    if sys.platform == "linux":
        _libc.prctl(_PR_SET_CHILD_SUBREAPER, 1)


def end_with_parent(parent: int, signal_number: int) -> None:
    """Request a signal at the parent's end; end this process now if the parent has already ended."""
    if sys.platform == "linux":
        _libc.prctl(_PR_SET_PDEATHSIG, signal_number)
        if os.getppid() != parent:
            os._exit(1)


def kill(processes: Iterable[int]) -> None:
    """Kill single processes, except process 1; numbers below 1, which mean process groups, are ignored."""
    for process in processes:
        if process > 1:
            with suppress(ProcessLookupError, PermissionError):
                os.kill(process, signal.SIGKILL)


def children(process: int) -> list[int]:
    """Process ids of the children of all threads of a process; empty if it has ended."""
    result: list[int] = []
    with suppress(OSError):
        for thread in Path(f"/proc/{process}/task").iterdir():
            with suppress(OSError):
                result += map(int, (thread / "children").read_text().split())
    return result


def descendants(process: int) -> list[int]:
    """Process ids of the children, grandchildren and so on of a process."""
    result = children(process)
    # the loop also visits the processes that it appends
    for child in result:
        result += children(child)
    return result


def used_memory(processes: Sequence[int], exact_above: float = 0.0) -> float:
    """Bytes of private and shared anonymous memory of the processes of one tree; 0 for ended processes.

    Mapped files are not counted: workers share the files of a terrain, and Linux reclaims their memory. Pages shared by
    forked processes are counted once, which is slow. Therefore a fast upper bound, with shared pages counted in each
    process, is returned if it is at most `exact_above`.
    """
    upper_bound = sum(_read_kilobytes(process, "status", r"Rss(?:Anon|Shmem)") for process in processes) * 1024.0
    if len(processes) < 2 or upper_bound <= exact_above:
        return upper_bound
    return sum(_read_kilobytes(process, "smaps_rollup", r"Pss_(?:Anon|Shmem)") for process in processes) * 1024.0


def resident_bytes(processes: Sequence[int]) -> float:
    """Resident memory of processes, bytes, including pages of mapped files; 0 for ended processes."""
    return sum(_read_kilobytes(process, "status", "VmRSS") for process in processes) * 1024.0


def _read_kilobytes(process: int, file: str, fields: str) -> float:
    """Sum the values of a file in a process's /proc folder whose names match the regular expression `fields`."""
    try:
        text = Path(f"/proc/{process}/{file}").read_text()
    except OSError:
        return 0.0
    return float(sum(int(size) for size in re.findall(rf"^{fields}:\s+(\d+) kB", text, re.MULTILINE)))
