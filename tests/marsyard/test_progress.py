"""Tests of progress output: rates and remaining time."""

import io

import pytest
from rich.console import Console

from marsyard.cli.progress import BarProgress, LineProgress


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
