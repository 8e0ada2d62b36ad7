"""Identification of the processor type, on which the last bits of results depend."""

from __future__ import annotations

import hashlib
import platform
from functools import cache
from pathlib import Path


@cache
def processor_features() -> str:
    """Return the machine type and a hash of the instruction set extensions that compiled code is made for."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    stated = next((line.split(":", 1)[1] for line in lines if line.startswith(("flags", "Features"))), "")
    flags = " ".join(sorted(stated.split()))
    return f"{platform.machine()}-{hashlib.sha256(flags.encode()).hexdigest()[:12]}"
