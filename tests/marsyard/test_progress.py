"""Tests of progress output: rates and remaining time on the terminal, and the log file of a campaign."""

import io
import re
from pathlib import Path

import pytest
from rich.console import Console

from marsyard.cli.progress import LOG_FILE, BarProgress, LineProgress, RunLog
from tests.campaigns.fake_campaign import RecordingWatch


class Clock:
    """A clock whose time is set by the test."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def _render_bars(bars: BarProgress, clock: Clock) -> list[str]:
    """Return the lines of the progress bars at the current time."""
    console = Console(width=120, file=io.StringIO(), get_time=clock, force_terminal=False)
    console.print(bars.bars.get_renderable())
    file = console.file
    assert isinstance(file, io.StringIO)
    return file.getvalue().splitlines()


def test_time_left_follows_the_rate_of_the_stage() -> None:
    clock = Clock()
    bars = BarProgress(Console(file=io.StringIO(), force_terminal=True, get_time=clock))
    bars.bars.live.auto_refresh = False
    bars.begin("preparing", 2)
    for _ in range(2):
        clock.now_s += 5.0
        bars.step()
    bars.begin("cases", 10)
    # the first case is slow because it fills the caches
    for duration_s in (90.0, 5.0, 5.0):
        clock.now_s += duration_s
        bars.step()
    first, second = (line for line in _render_bars(bars, clock) if line.strip())
    assert "5.0 s per item" in first
    assert "total 0:00:10" in first
    # three cases took 100 s; the remaining 7 take 233 s = 3:53 min
    assert "33.3 s per item" in second
    assert "0:03:53 left" in second
    clock.now_s += 1000.0
    assert "total 0:00:10" in _render_bars(bars, clock)[0]
    assert "5.0 s per item" in _render_bars(bars, clock)[0]


def test_unfinished_stage_stops_its_clock() -> None:
    clock = Clock()
    bars = BarProgress(Console(file=io.StringIO(), force_terminal=True, get_time=clock))
    bars.begin("cases", 10)
    clock.now_s += 4.0
    bars.step()
    bars.begin("showcase", 1)
    clock.now_s += 60.0
    assert "4.0 s per item" in _render_bars(bars, clock)[0]


def test_lines_print_time_left_at_the_printed_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr("marsyard.cli.progress.time.monotonic", clock)
    console = Console(file=io.StringIO(), force_terminal=False)
    lines = LineProgress(console)
    # after one case of 12.5 s, seven cases need 87.5 s
    lines.begin("cases", 8)
    clock.now_s += 12.5
    lines.step()
    file = console.file
    assert isinstance(file, io.StringIO)
    assert file.getvalue().splitlines()[-1] == "cases: 1/8, 12.5 s per item, 88 s left"


def read_log(folder: Path) -> list[str]:
    text = (folder / LOG_FILE).read_text()
    assert all(re.match(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ ", line) for line in text.splitlines())
    return [line.split(" ", 1)[1] for line in text.splitlines()]


def test_session_is_logged_and_forwarded(tmp_path: Path) -> None:
    watch = RecordingWatch()
    with RunLog(tmp_path, watch) as log:
        log.begin("cases", 2)
        log.step()
        log.note("two\nlines")
        log.step()
    assert (watch.steps, watch.notes) == ({"cases": 2}, ["two\nlines"])
    session, versions, *rest, last = read_log(tmp_path)
    assert session.startswith("session: marsyard")
    assert versions.startswith("marsyard 0.")
    assert rest == ["cases: 2", "note: two lines", "cases: 2/2"]
    assert re.fullmatch(r"ended after \d+\.\d s", last)


def _run_and_interrupt(folder: Path) -> None:
    with RunLog(folder, RecordingWatch()) as log:
        log.begin("cases", 5)
        log.step()
        raise KeyboardInterrupt("SIGINT")


def test_interruption_is_logged_and_sessions_are_appended(tmp_path: Path) -> None:
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            _run_and_interrupt(tmp_path)
    log_lines = read_log(tmp_path)
    assert sum(line.startswith("session: ") for line in log_lines) == 2
    assert re.fullmatch(r"stopped after \d+\.\d s, cases: 1/5: KeyboardInterrupt: SIGINT", log_lines[-1])


def test_unwritable_log_does_not_stop_the_campaign(tmp_path: Path) -> None:
    (tmp_path / LOG_FILE).mkdir()
    with RunLog(tmp_path, RecordingWatch()) as log:
        log.begin("cases", 1)
        log.step()


def test_log_is_not_written_if_the_folder_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="rejected"), RunLog(tmp_path, RecordingWatch()):
        raise ValueError("rejected")
    assert not (tmp_path / LOG_FILE).exists()
