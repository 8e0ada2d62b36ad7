"""Start a study as a program, kill it after some of its cases, and resume it."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path


def kill_and_resume(arguments: Sequence[str], directory: Path, log_bytes: int) -> subprocess.CompletedProcess[str]:
    """Run ``marsyard ARGUMENTS --out DIRECTORY``, kill it, and resume the study.

    The process is killed when the write-ahead log of its SQLite database exceeds `log_bytes`. The log of an empty
    database has about 8 kB, so that a larger log contains rows.
    """
    marsyard = [sys.executable, "-m", "marsyard"]
    command = [*marsyard, *arguments, "--jobs", "2", "--out", str(directory)]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        log, deadline = directory / "cases.sqlite-wal", time.monotonic() + 120.0
        while not (log.exists() and log.stat().st_size > log_bytes) and time.monotonic() < deadline:
            time.sleep(0.02)
        os.kill(process.pid, signal.SIGKILL)
    return subprocess.run([*marsyard, "resume", str(directory)], capture_output=True, text=True, check=False)
