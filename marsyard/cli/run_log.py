"""The log of a campaign's folder, `run.log`: command, progress and end of each session."""

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
    from marsyard.campaigns.running.engine import Watch

LOG_FILE = "run.log"
#: Seconds between two lines on how far a stage is.
LINE_INTERVAL_S = 60.0


class RunLog:
    """A `Watch` that appends to the log and forwards to another; a log that cannot be written stops no campaign."""

    def __init__(self, directory: Path, watch: Watch) -> None:
        self._path = directory / LOG_FILE
        self._watch = watch
        self._stage, self._total, self._done = "", 0, 0
        self._started = time.monotonic()
        self._written = 0.0
        self._begun = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _at: TracebackType | None
    ) -> None:
        if not self._begun:
            return  # the campaign did not begin: its folder is none of ours
        taken = f"{time.monotonic() - self._started:.1f} s"
        if kind is None:
            self._line(f"ended after {taken}")
        else:
            self._line(f"stopped after {taken}, {self._how_far()}: {kind.__name__}: {error}")

    def begin(self, stage: str, total: int) -> None:
        """A stage of so many steps begins."""
        self._stage, self._total, self._done = stage, total, 0
        self._line(f"{stage}: {total}")
        self._watch.begin(stage, total)

    def step(self) -> None:
        """A step of the stage has ended."""
        self._done += 1
        if self._done == self._total or time.monotonic() - self._written > LINE_INTERVAL_S:
            self._line(self._how_far())
        self._watch.step()

    def note(self, text: str) -> None:
        """Something that the user should know."""
        self._line(f"note: {text}")
        self._watch.note(text)

    def _how_far(self) -> str:
        return f"{self._stage}: {self._done}/{self._total}"

    def _line(self, text: str) -> None:
        self._written = time.monotonic()
        lines = [text]
        if not self._begun:
            self._begun = True
            lines.insert(
                0, f"marsyard {version('marsyard')}, Python {platform.python_version()}, {platform.platform()}"
            )
            lines.insert(0, f"session: {shlex.join(['marsyard', *sys.argv[1:]])}")
        now = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        with suppress(OSError), self._path.open("a", encoding="utf-8") as file:
            file.writelines(f"{now} {' '.join(line.split())}\n" for line in lines)
