"""Child processes and memory use, read from Linux's /proc to enforce memory limits; empty or zero on other systems."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path


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
