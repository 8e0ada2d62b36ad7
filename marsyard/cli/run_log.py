"""Log of a campaign: the file `run.log` in its folder."""

from __future__ import annotations

import platform
import shlex
import sys
import time
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from marsyard.campaigns.running.progress import ProgressObserver

LOG_FILE = "run.log"
#: Time between two lines of a stage, seconds.
LOG_INTERVAL_S = 60.0


class RunLog:
    """Observer that writes `run.log` and forwards each call to `observer`; errors in writing the log are ignored."""

    def __init__(self, directory: Path, observer: ProgressObserver) -> None:
        self._path, self._observer = directory / LOG_FILE, observer
        self._stage, self._total, self._done = "", 0, 0
        self._start_s, self._last_write_s, self._has_entries = time.monotonic(), 0.0, False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _traceback: TracebackType | None
    ) -> None:
        if not self._has_entries:
            return  # the campaign did not start, and the folder may belong to another campaign
        duration = f"{time.monotonic() - self._start_s:.1f} s"
        reason = "" if kind is None else f", {self._stage}: {self._done}/{self._total}: {kind.__name__}: {error}"
        self._write(f"{'stopped' if reason else 'ended'} after {duration}{reason}")

    def begin(self, stage: str, total: int) -> None:
        """Log the start of a stage."""
        self._stage, self._total, self._done = stage, total, 0
        self._write(f"{stage}: {total}")
        self._observer.begin(stage, total)

    def step(self) -> None:
        """Count a step; log the progress at intervals."""
        self._done += 1
        if self._done == self._total or time.monotonic() - self._last_write_s > LOG_INTERVAL_S:
            self._write(f"{self._stage}: {self._done}/{self._total}")
        self._observer.step()

    def note(self, text: str) -> None:
        """Log a note."""
        self._write(f"note: {text}")
        self._observer.note(text)

    def _write(self, text: str) -> None:
        self._last_write_s, lines = time.monotonic(), [text]
        if not self._has_entries:
            self._has_entries = True
            versions = f"marsyard {version('marsyard')}, Python {platform.python_version()}, {platform.platform()}"
            lines = [f"session: {shlex.join(['marsyard', *sys.argv[1:]])}", versions, text]
        utc = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        with suppress(OSError), self._path.open("a", encoding="utf-8") as file:
            file.writelines(f"{utc} {' '.join(line.split())}\n" for line in lines)
