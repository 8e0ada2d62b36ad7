"""Tests of the log file of a campaign: command, progress, end and interruptions."""

import re
from pathlib import Path

import pytest

from marsyard.cli.progress import LOG_FILE, RunLog


class CallRecorder:
    """A progress watch that records its calls."""

    def __init__(self) -> None:
        self.calls: list[str] = []

    def begin(self, stage: str, total: int) -> None:
        self.calls.append(f"{stage} {total}")

    def step(self) -> None:
        self.calls.append("step")

    def note(self, text: str) -> None:
        self.calls.append(text)


def read_log(folder: Path) -> list[str]:
    text = (folder / LOG_FILE).read_text()
    assert all(re.match(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ ", line) for line in text.splitlines())
    return [line.split(" ", 1)[1] for line in text.splitlines()]


def test_session_is_logged_and_forwarded(tmp_path: Path) -> None:
    watch = CallRecorder()
    with RunLog(tmp_path, watch) as log:
        log.begin("cases", 2)
        log.step()
        log.note("two\nlines")
        log.step()
    assert watch.calls == ["cases 2", "step", "two\nlines", "step"]
    session, versions, *rest, last = read_log(tmp_path)
    assert session.startswith("session: marsyard")
    assert versions.startswith("marsyard 0.")
    assert rest == ["cases: 2", "note: two lines", "cases: 2/2"]
    assert re.fullmatch(r"ended after \d+\.\d s", last)


def _run_and_interrupt(folder: Path) -> None:
    with RunLog(folder, CallRecorder()) as log:
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
    with RunLog(tmp_path, CallRecorder()) as log:
        log.begin("cases", 1)
        log.step()


def test_log_is_not_written_if_the_folder_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="rejected"), RunLog(tmp_path, CallRecorder()):
        raise ValueError("rejected")
    assert not (tmp_path / LOG_FILE).exists()
