"""Start a campaign or study as a program, kill it after some of its cases, and resume it."""

import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

MARSYARD = [sys.executable, "-m", "marsyard"]


def start_program(
    arguments: Sequence[object], directory: Path, log_bytes: int = 17_000, **options: Any
) -> subprocess.Popen[bytes]:
    """Run ``marsyard ARGUMENTS --out DIRECTORY`` as a process; return it as soon as rows are stored.

    - log_bytes: size of the write-ahead log of the SQLite database with the awaited rows; without rows it has two pages
      of 4 kB
    - options: further options of the process
    """
    command = [*MARSYARD, *map(str, arguments), "--out", str(directory)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, **options)
    log, deadline = directory / "cases.sqlite-wal", time.monotonic() + 180.0
    while not (log.exists() and log.stat().st_size > log_bytes) and time.monotonic() < deadline:
        if process.poll() is not None:
            break
        time.sleep(0.02)
    return process


def start_and_kill(arguments: Sequence[object], directory: Path, log_bytes: int = 17_000) -> None:
    """Run `start_program`, and kill the process."""
    process = start_program(arguments, directory, log_bytes)
    process.kill()
    process.communicate()


def kill_and_resume(arguments: Sequence[object], directory: Path, log_bytes: int) -> subprocess.CompletedProcess[str]:
    """Run `start_and_kill` with two workers, and resume the study."""
    start_and_kill([*arguments, "--jobs", "2"], directory, log_bytes)
    return subprocess.run([*MARSYARD, "resume", str(directory)], capture_output=True, text=True, check=False)
