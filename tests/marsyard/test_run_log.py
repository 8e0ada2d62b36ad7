"""A campaign's log: what was asked for, how it went, how it ended."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from marsyard.cli.progress import LOG_FILE, RunLog


class Told:
    """A `Watch` that remembers."""

    def __init__(self) -> None:
        self.heard: list[str] = []

    def begin(self, stage: str, total: int) -> None:
        self.heard.append(f"{stage} {total}")

    def step(self) -> None:
        self.heard.append("step")

    def note(self, text: str) -> None:
        self.heard.append(text)


def lines(folder: Path) -> list[str]:
    text = (folder / LOG_FILE).read_text()
    assert all(re.match(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ ", line) for line in text.splitlines())
    return [line.split(" ", 1)[1] for line in text.splitlines()]


def test_a_session_is_written_down_and_passed_on(tmp_path: Path) -> None:
    reported = Told()
    with RunLog(tmp_path, reported) as log:
        log.begin("cases", 2)
        log.step()
        log.note("two\nlines")
        log.step()
    assert reported.heard == ["cases 2", "step", "two\nlines", "step"]
    session, versions, *rest, last = lines(tmp_path)
    assert session.startswith("session: marsyard")
    assert versions.startswith("marsyard 0.")
    assert rest == ["cases: 2", "note: two lines", "cases: 2/2"]
    assert re.fullmatch(r"ended after \d+\.\d s", last)


def _interrupted(folder: Path) -> None:
    with RunLog(folder, Told()) as log:
        log.begin("cases", 5)
        log.step()
        raise KeyboardInterrupt("SIGINT")


def test_what_stopped_it_is_said_and_the_next_session_added(tmp_path: Path) -> None:
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            _interrupted(tmp_path)
    message = lines(tmp_path)
    assert sum(line.startswith("session: ") for line in message) == 2
    assert re.fullmatch(r"stopped after \d+\.\d s, cases: 1/5: KeyboardInterrupt: SIGINT", message[-1])


def test_no_campaign_is_stopped_by_its_log(tmp_path: Path) -> None:
    (tmp_path / LOG_FILE).mkdir()
    with RunLog(tmp_path, Told()) as log:
        log.begin("cases", 1)
        log.step()


def test_a_folder_that_is_another_campaigns_is_left_alone(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="taken"), RunLog(tmp_path, Told()):
        raise ValueError("taken")
    assert not (tmp_path / LOG_FILE).exists()
