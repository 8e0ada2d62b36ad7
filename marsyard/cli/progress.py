"""Progress of a running campaign: bars or text lines on the terminal, and the log file `run.log`.

The public classes implement the protocol `ProgressObserver` of `marsyard.campaigns.running.progress`.
"""

from __future__ import annotations

import platform
import shlex
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn
from rich.text import Text

if TYPE_CHECKING:
    from marsyard.campaigns.running.progress import ProgressObserver

#: Time between two progress lines of a stage, seconds.
LINE_INTERVAL_S = 10.0
LOG_FILE = "run.log"
#: Time between two lines of a stage in the log, seconds.
LOG_INTERVAL_S = 60.0


def remaining_s(done: int, total: int, elapsed_s: float) -> float:
    """Estimate the remaining time, seconds, from the mean rate so far."""
    return elapsed_s / done * (total - done) if done else 0.0


def format_rate(done: int, elapsed_s: float) -> str:
    """Format the rate in items per second, or as seconds per item if the rate is below 1/s."""
    if done == 0 or elapsed_s <= 0.0:
        return ""
    rate = done / elapsed_s
    return f"{rate:.1f} /s" if rate >= 1.0 else f"{1.0 / rate:.1f} s per item"


def _elapsed_s(task: Task) -> float:
    """Return the elapsed time of a stage, seconds; the end time is fixed when the stage ends."""
    elapsed = task.finished_time if task.finished else task.elapsed
    return elapsed or 0.0


class _RateColumn(ProgressColumn):
    """Mean rate of a stage."""

    def render(self, task: Task) -> Text:
        return Text(format_rate(int(task.completed), _elapsed_s(task)))


class _RemainingColumn(ProgressColumn):
    """Remaining time of a running stage; duration of a completed stage."""

    def render(self, task: Task) -> Text:
        done, total, elapsed = int(task.completed), int(task.total or 0), _elapsed_s(task)
        if task.finished or task.stop_time is not None:
            return Text(f"total {timedelta(seconds=round(elapsed))}")
        return Text(f"{timedelta(seconds=round(remaining_s(done, total, elapsed)))} left" if done else "")


class BarProgress:
    """Progress bars, one for each stage."""

    def __init__(self, console: Console) -> None:
        self.bars = Progress(
            TextColumn("{task.description:<10}"),
            BarColumn(),
            MofNCompleteColumn(),
            _RateColumn(),
            _RemainingColumn(),
            console=console,
        )
        self._task = self.bars.add_task("starting", visible=False)

    def begin(self, stage: str, total: int) -> None:
        """See `marsyard.campaigns.running.progress.ProgressObserver`."""
        self.bars.stop_task(self._task)
        self._task = self.bars.add_task(stage, total=total)

    def step(self) -> None:
        """See `marsyard.campaigns.running.progress.ProgressObserver`."""
        self.bars.advance(self._task)

    def note(self, text: str) -> None:
        """See `marsyard.campaigns.running.progress.ProgressObserver`."""
        self.bars.console.print(f"note: {text}", markup=False, highlight=False, soft_wrap=True)


class LineProgress:
    """Text lines: at the start and end of a stage, and every `LINE_INTERVAL_S`."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._stage, self._total, self._done = "", 0, 0
        self._start_s = self._last_print_s = 0.0

    def begin(self, stage: str, total: int) -> None:
        """See `marsyard.campaigns.running.progress.ProgressObserver`."""
        self._stage, self._total, self._done = stage, total, 0
        self._start_s = self._last_print_s = time.monotonic()
        self._print(f"{stage}: {total}")

    def step(self) -> None:
        """See `marsyard.campaigns.running.progress.ProgressObserver`."""
        self._done += 1
        now_s = time.monotonic()
        if self._done < self._total and now_s - self._last_print_s < LINE_INTERVAL_S:
            return
        self._last_print_s, elapsed_s = now_s, now_s - self._start_s
        text = f"{self._stage}: {self._done}/{self._total}, {format_rate(self._done, elapsed_s)}"
        remaining = remaining_s(self._done, self._total, elapsed_s)
        self._print(f"{text}, {remaining:.0f} s left" if self._done < self._total else f"{text}, {elapsed_s:.1f} s")

    def note(self, text: str) -> None:
        """See `marsyard.campaigns.running.progress.ProgressObserver`."""
        self._print(f"note: {text}")

    def _print(self, text: str) -> None:
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)


@contextmanager
def campaign_progress(console: Console) -> Iterator[ProgressObserver]:
    """Report progress by bars on a terminal and in a notebook, and by text lines otherwise."""
    has_bars = find_spec("ipywidgets") is not None if console.is_jupyter else console.is_terminal
    if not has_bars:
        yield LineProgress(console)
        return
    progress = BarProgress(console)
    with progress.bars:
        yield progress


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
