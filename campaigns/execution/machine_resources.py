"""Processor cores and memory of this machine."""

import math
import os
import re
from pathlib import Path


def available_cores() -> int:
    """Number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def free_memory() -> float:
    """Return the available memory in bytes; infinite if the operating system does not report it."""
    try:
        text = Path("/proc/meminfo").read_text()
    except OSError:
        return math.inf
    match = re.search(r"^MemAvailable:\s+(\d+) kB", text, re.MULTILINE)
    return float(match[1]) * 1024.0 if match else math.inf
