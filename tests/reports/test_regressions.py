from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np
import pytest

from marsyard.campaigns.errors import StoreError
from marsyard.reports.history import (
    FINISHED,
    INTERRUPTED,
    RUNNING,
    Change,
    Comparison,
    History,
    NightCampaign,
    NightFigure,
    changes,
    compare_night,
    night_text,
)
from marsyard.reports.statistics.changes import Sample

CASES, TERRAINS = 100, 12


def _pool(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors of cases on terrains of which some are harder, shape (terrains, 200), and chances of an answer."""
    rng = np.random.default_rng(seed)
    scale = rng.uniform(0.5, 2.0, TERRAINS)
    return np.abs(rng.normal(size=(TERRAINS, 200))) * scale[:, None], rng.uniform(0.85, 1.0, TERRAINS)


def _night(rng: np.random.Generator, pool: tuple[np.ndarray, np.ndarray], worse: float = 1.0) -> list[NightFigure]:
    """A night's figures, resampled from the pool; `worse` multiplies every error."""
    terrains = rng.integers(0, TERRAINS, CASES)
    errors = worse * pool[0][terrains, rng.integers(0, 200, CASES)]
    answered = (rng.random(CASES) < pool[1][terrains]).astype(np.float64)
    rates = [("within 2 m", (errors < 2.0).astype(np.float64)), ("answered", answered)]
    figures = [NightFigure(name, True, float(values.mean()), Sample(values, terrains)) for name, values in rates]
    return [*figures, NightFigure("error (m)", False, float(np.median(errors)), Sample(errors, terrains))]


def _found(rng: np.random.Generator, pool: tuple[np.ndarray, np.ndarray], worse: float = 1.0) -> list[Change]:
    """What a night tells that is held against seven before it, of two campaigns, the first of them made worse."""
    comparisons = []
    for campaign, factor in (("first", worse), ("second", 1.0)):
        before = [_night(rng, pool) for _ in range(7)]
        for place, figure in enumerate(_night(rng, pool, factor)):
            comparisons.append(Comparison(campaign, figure, [night[place].sample for night in before]))
    return changes(comparisons)


def test_noise_is_not_reported() -> None:
    # 200 nights of 6 figures each: with a family-wise rate of 1 % more than 6 alarms come in 0.4 % of the tests.
    rng, pool = np.random.default_rng(1), _pool(2)
    assert sum(bool(_found(rng, pool)) for _ in range(200)) <= 6


def test_a_planted_regression_is_found_and_named() -> None:
    # Every error three quarters as large again, in nights of 100 cases; asked: 95 % of the nights. 60 nights.
    rng, pool = np.random.default_rng(3), _pool(4)
    named = 0
    for _ in range(60):
        found = _found(rng, pool, 1.75)
        named += ("first", "error (m)", True) in {(one.campaign, one.figure, one.worse) for one in found}
    assert named >= 57


def _campaign(definition: str = "d") -> NightCampaign:
    return NightCampaign("first", definition, "runs/x", "PASS", 0, "1 requirement met.")


def _add(history: History, seed: int, worse: float = 1.0, definition: str = "d") -> int:
    night = history.begin("abc")
    history.add(night, _campaign(definition), _night(np.random.default_rng(seed), _pool(4), worse))
    return night


def test_the_history_keeps_what_it_is_given(tmp_path: Path) -> None:
    with History(tmp_path / "history.sqlite") as history:
        night = _add(history, 1)
        history.finish(night, FINISHED)
    with History(tmp_path / "history.sqlite") as history:
        (stored,) = history.nights()
        assert (stored.night, stored.state, stored.git_commit) == (night, FINISHED, "abc")
        assert history.campaigns(night) == [_campaign()]
        figures = history.figures(night, "first")
        assert [figure.figure for figure in figures] == ["within 2 m", "answered", "error (m)"]
        expected = _night(np.random.default_rng(1), _pool(4))[2]
        assert figures[2].sample.values == pytest.approx(expected.sample.values, rel=1e-6)
        assert figures[2].sample.terrains.tolist() == expected.sample.terrains.tolist()


def test_nights_are_held_against_whole_nights_of_the_same_campaign(tmp_path: Path) -> None:
    with History(tmp_path / "history.sqlite") as history:
        for seed in range(3):
            history.finish(_add(history, seed), FINISHED)
        _add(history, 9, worse=5.0)  # killed
        history.finish(_add(history, 3, definition="another"), FINISHED)
        night = _add(history, 4)
        states = {one.night: one.state for one in history.nights()}
        assert states == {1: FINISHED, 2: FINISHED, 3: FINISHED, 4: INTERRUPTED, 5: FINISHED, night: RUNNING}
        comparisons = compare_night(history, night)
        assert {len(one.before) for one in comparisons} == {3}
        assert changes(comparisons) == []


def test_a_change_begins_a_new_history(tmp_path: Path) -> None:
    with History(tmp_path / "history.sqlite") as history:
        for seed in range(4):
            history.finish(_add(history, seed), FINISHED)
        night = _add(history, 5, worse=3.0)
        found = changes(compare_night(history, night))
        assert "error (m)" in {one.figure for one in found}
        history.finish(night, FINISHED, [(one.campaign, one.figure, one.p_value, one.worse) for one in found])
        # The same again is no news; held against the night that was reported, and no other.
        again = _add(history, 6, worse=3.0)
        held = {one.figure.figure: len(one.before) for one in compare_night(history, again)}
        assert held["error (m)"] == 1
        assert changes(compare_night(history, again)) == []


def test_a_night_is_whole_or_not_there(tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    with History(path) as history:
        night = _add(history, 1)
        with pytest.raises(StoreError, match="cannot be written"):
            history.add(night, _campaign(), _night(np.random.default_rng(2), _pool(4)))
        assert len(history.figures(night, "first")) == 3


def test_what_is_no_history_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    path.write_bytes(b"nothing of the kind, and long enough to be looked at" * 10)
    with pytest.raises(StoreError, match="no history"):
        History(path)
    other = tmp_path / "other.sqlite"
    connection = sqlite3.connect(other)
    connection.execute("PRAGMA user_version = 99")
    connection.close()
    with pytest.raises(StoreError, match="schema 99"):
        History(other)


def test_the_page_names_regressions_and_interrupted_nights(tmp_path: Path) -> None:
    hostile = "a|b\n# <script>`*"
    with History(tmp_path / "history.sqlite") as history:
        history.finish(_add(history, 1), INTERRUPTED)
        history.finish(_add(history, 2), FINISHED)
        later, earlier = history.nights()
    found = [
        Change("first", "DIMES-VEL", True, 0.95, 0.7, 2e-6, 7),
        Change("first", "error (m)", False, 2.0, 1.0, 1e-3, 7),
    ]
    text = night_text(later, [earlier], [NightCampaign(hostile, "d", "x", "FAIL", 1, hostile)], found, 6)
    assert text.startswith("# Night 2: 1 FAIL, 1 regression\n")
    assert "- **first: DIMES-VEL**: 95.00 % in 7 nights before, 70.00 % now (p = 2e-06)" in text
    assert text.index("## Regressions") < text.index("DIMES-VEL") < text.index("## Improvements")
    assert "Night 1, begun" in text
    assert "<script>" not in text
    assert "| a&#124;b \\# &#60;script&#62;\\`\\* | FAIL |" in text
    quiet = night_text(later, [], [_campaign()], [], 6)
    assert "None has changed." in quiet
    assert "no history" not in quiet
