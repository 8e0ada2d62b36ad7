"""Processes below a process, and the memory that processes take, as Linux states it; elsewhere nothing is found."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path


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


def used_memory(processes: Sequence[int], worth_knowing: float = 0.0) -> float:
    """Bytes of memory that processes have to themselves; 0 for those that are gone.

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


def resident_bytes(processes: Sequence[int]) -> float:
    """Resident memory of processes, pages of mapped files included; 0 for those that are gone."""
    return sum(_kilobytes(process, "status", "VmRSS") for process in processes) * 1024.0


def _kilobytes(process: int, file: str, fields: str) -> float:
    """Sum of fields of a file of Linux about a process."""
    try:
        text = Path(f"/proc/{process}/{file}").read_text()
    except OSError:
        return 0.0
    return float(sum(int(size) for size in re.findall(rf"^{fields}:\s+(\d+) kB", text, re.MULTILINE)))
