"""Progress of a running campaign: bars with rate and time left on a terminal, lines elsewhere, and `run.log`.

The classes are `Watch` objects (`marsyard.campaigns.running.engine`).
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
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn
from rich.text import Text

if TYPE_CHECKING:
    from marsyard.campaigns.running.engine import Watch

LOG_FILE = "run.log"
#: Seconds between two lines of a stage, on the console and in the log.
LINE_INTERVAL_S, LOG_INTERVAL_S = 10.0, 60.0


def left_s(done: int, total: int, elapsed_s: float) -> float:
    """Seconds that a stage still takes at its mean rate so far, the rate that `rate_text` prints."""
    return elapsed_s / done * (total - done) if done else 0.0


def rate_text(done: int, elapsed_s: float) -> str:
    """Steps a second, or seconds a step where that is the easier number."""
    if done == 0 or elapsed_s <= 0.0:
        return ""
    rate = done / elapsed_s
    return f"{rate:.1f} /s" if rate >= 1.0 else f"{1.0 / rate:.1f} s each"


def _elapsed_s(task: Task) -> float:
    """Seconds of a stage up to now, or to its end: a stage that has ended stops counting."""
    ended = task.finished_time if task.finished else task.elapsed
    return ended or 0.0


class _RateColumn(ProgressColumn):
    def render(self, task: Task) -> Text:
        return Text(rate_text(int(task.completed), _elapsed_s(task)))


class _LeftColumn(ProgressColumn):
    """Time left while a stage runs, its duration when it has ended."""

    def render(self, task: Task) -> Text:
        done, total, elapsed = int(task.completed), int(task.total or 0), _elapsed_s(task)
        if task.finished or task.stop_time is not None:
            return Text(f"{timedelta(seconds=round(elapsed))} in all")
        return Text(f"{timedelta(seconds=round(left_s(done, total, elapsed)))} left" if done else "")


class BarProgress:
    """A bar for each stage."""

    def __init__(self, console: Console) -> None:
        self.bars = Progress(
            TextColumn("{task.description:<10}"),
            BarColumn(),
            MofNCompleteColumn(),
            _RateColumn(),
            _LeftColumn(),
            console=console,
        )
        self._task = self.bars.add_task("starting", visible=False)

    def begin(self, stage: str, total: int) -> None:
        """See `marsyard.campaigns.running.engine.Watch`."""
        self.bars.stop_task(self._task)
        self._task = self.bars.add_task(stage, total=total)

    def step(self) -> None:
        """See `marsyard.campaigns.running.engine.Watch`."""
        self.bars.advance(self._task)

    def note(self, text: str) -> None:
        """See `marsyard.campaigns.running.engine.Watch`."""
        self.bars.console.print(f"note: {text}", markup=False, highlight=False, soft_wrap=True)


class LineProgress:
    """A line when a stage begins, every so often, and when it ends."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._stage, self._total, self._done = "", 0, 0
        self._began = self._printed = 0.0

    def begin(self, stage: str, total: int) -> None:
        """See `marsyard.campaigns.running.engine.Watch`."""
        self._stage, self._total, self._done = stage, total, 0
        self._began = self._printed = time.monotonic()
        self._line(f"{stage}: {total}")

    def step(self) -> None:
        """See `marsyard.campaigns.running.engine.Watch`."""
        self._done += 1
        now = time.monotonic()
        if self._done < self._total and now - self._printed < LINE_INTERVAL_S:
            return
        self._printed, elapsed = now, now - self._began
        text = f"{self._stage}: {self._done}/{self._total}, {rate_text(self._done, elapsed)}"
        left = left_s(self._done, self._total, elapsed)
        self._line(f"{text}, {left:.0f} s left" if self._done < self._total else f"{text}, {elapsed:.1f} s")

    def note(self, text: str) -> None:
        """See `marsyard.campaigns.running.engine.Watch`."""
        self._line(f"note: {text}")

    def _line(self, text: str) -> None:
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)


class RunLog:
    """A `Watch` that appends to the log and forwards to another; a log that cannot be written stops no campaign."""

    def __init__(self, directory: Path, watch: Watch) -> None:
        self._path, self._watch = directory / LOG_FILE, watch
        self._stage, self._total, self._done = "", 0, 0
        self._started, self._write_campaign, self._begun = time.monotonic(), 0.0, False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _at: TracebackType | None
    ) -> None:
        if not self._begun:
            return  # the campaign did not begin: the folder is not its own
        duration = f"{time.monotonic() - self._started:.1f} s"
        stopped = "" if kind is None else f", {self._stage}: {self._done}/{self._total}: {kind.__name__}: {error}"
        self._line(f"{'stopped' if stopped else 'ended'} after {duration}{stopped}")

    def begin(self, stage: str, total: int) -> None:
        """Log the begin of a stage."""
        self._stage, self._total, self._done = stage, total, 0
        self._line(f"{stage}: {total}")
        self._watch.begin(stage, total)

    def step(self) -> None:
        """Count a step; log the progress at intervals."""
        self._done += 1
        if self._done == self._total or time.monotonic() - self._write_campaign > LOG_INTERVAL_S:
            self._line(f"{self._stage}: {self._done}/{self._total}")
        self._watch.step()

    def note(self, text: str) -> None:
        """Log a note."""
        self._line(f"note: {text}")
        self._watch.note(text)

    def _line(self, text: str) -> None:
        self._write_campaign, lines = time.monotonic(), [text]
        if not self._begun:
            self._begun = True
            versions = f"marsyard {version('marsyard')}, Python {platform.python_version()}, {platform.platform()}"
            lines = [f"session: {shlex.join(['marsyard', *sys.argv[1:]])}", versions, text]
        now = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        with suppress(OSError), self._path.open("a", encoding="utf-8") as file:
            file.writelines(f"{now} {' '.join(line.split())}\n" for line in lines)


@contextmanager
def campaign_progress(console: Console) -> Iterator[Watch]:
    """Report a running campaign as suits the console: by bars on a terminal, by lines elsewhere."""
    if not console.is_terminal:
        yield LineProgress(console)
        return
    shown = BarProgress(console)
    with shown.bars:
        yield shown
