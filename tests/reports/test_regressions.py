"""Tests of the history of nightly runs ("nights") and of the detection of regressions."""

import sqlite3
from pathlib import Path

import numpy as np
import pytest

from marsyard.campaigns.errors import StoreError
from marsyard.reports.metrics import Metric
from marsyard.reports.night_history import FINISHED, INTERRUPTED, RUNNING, History, MetricChange, NightCampaign
from marsyard.reports.nightly import NightComparison, find_changes, format_night_page, list_comparisons
from marsyard.reports.statistics.difference_tests import Sample

N_CASES, N_TERRAINS = 100, 12


def _make_error_pool(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return errors in metres, shape (terrains, 200), and answer probabilities of terrains of different difficulty."""
    rng = np.random.default_rng(seed)
    scale = rng.uniform(0.5, 2.0, N_TERRAINS)
    return np.abs(rng.normal(size=(N_TERRAINS, 200))) * scale[:, None], rng.uniform(0.85, 1.0, N_TERRAINS)


def _draw_metrics(
    rng: np.random.Generator, pool: tuple[np.ndarray, np.ndarray], error_factor: float = 1.0
) -> list[Metric]:
    """Draw the metrics of one nightly run from the pool; `error_factor` multiplies every error."""
    terrains = rng.integers(0, N_TERRAINS, N_CASES)
    errors = error_factor * pool[0][terrains, rng.integers(0, 200, N_CASES)]
    is_answered = (rng.random(N_CASES) < pool[1][terrains]).astype(np.float64)
    rates = [("within 2 m", (errors < 2.0).astype(np.float64)), ("answered", is_answered)]
    metrics = [Metric(name, True, Sample(values, terrains)) for name, values in rates]
    return [*metrics, Metric("error (m)", False, Sample(errors, terrains))]


def _detect_changes(
    rng: np.random.Generator, pool: tuple[np.ndarray, np.ndarray], error_factor: float = 1.0
) -> list[MetricChange]:
    """Compare a nightly run of two campaigns with seven earlier runs; `error_factor` changes the first campaign."""
    comparisons = []
    for campaign, factor in (("first", error_factor), ("second", 1.0)):
        earlier_runs = [_draw_metrics(rng, pool) for _ in range(7)]
        for index, metric in enumerate(_draw_metrics(rng, pool, factor)):
            comparisons.append(NightComparison(campaign, metric, [run[index].sample for run in earlier_runs]))
    return find_changes(comparisons)


@pytest.mark.slow
def test_random_variation_is_not_reported_as_change() -> None:
    # 200 nightly runs, family-wise error rate of 1 %: P(more than 6 false alarms) = 0.4 %
    rng, pool = np.random.default_rng(1), _make_error_pool(2)
    assert sum(bool(_detect_changes(rng, pool)) for _ in range(200)) <= 6


@pytest.mark.slow
def test_simulated_regression_is_detected() -> None:
    # errors larger by 75 % must be detected in 95 % of 60 nightly runs of 100 cases
    rng, pool = np.random.default_rng(3), _make_error_pool(4)
    n_detected = 0
    for _ in range(60):
        changes = _detect_changes(rng, pool, 1.75)
        n_detected += ("first", "error (m)", True) in {
            (change.campaign, change.metric, change.is_regression) for change in changes
        }
    assert n_detected >= 57


def _make_campaign(definition: str = "d") -> NightCampaign:
    return NightCampaign("first", definition, "runs/x", "PASS", 0, "1 requirement met.")


def _add_run(history: History, seed: int, error_factor: float = 1.0, definition: str = "d") -> int:
    night = history.begin("abc")
    history.add(
        night, _make_campaign(definition), _draw_metrics(np.random.default_rng(seed), _make_error_pool(4), error_factor)
    )
    return night


def test_history_stores_campaigns_and_metrics(tmp_path: Path) -> None:
    with History(tmp_path / "history.sqlite") as history:
        night = _add_run(history, 1)
        history.finish(night, FINISHED)
    with History(tmp_path / "history.sqlite") as history:
        (night_record,) = history.nights()
        assert (night_record.night, night_record.state, night_record.git_commit) == (night, FINISHED, "abc")
        assert history.campaigns(night) == [_make_campaign()]
        metrics = history.metrics(night, "first")
        assert [metric.name for metric in metrics] == ["within 2 m", "answered", "error (m)"]
        expected = _draw_metrics(np.random.default_rng(1), _make_error_pool(4))[2]
        assert metrics[2].sample.values == pytest.approx(expected.sample.values, rel=1e-6)
        assert metrics[2].sample.terrains.tolist() == expected.sample.terrains.tolist()


def test_nightly_runs_are_compared_with_finished_runs_of_the_campaign(tmp_path: Path) -> None:
    with History(tmp_path / "history.sqlite") as history:
        for seed in range(3):
            history.finish(_add_run(history, seed), FINISHED)
        _add_run(history, 9, error_factor=5.0)  # the process was killed before `finish`
        history.finish(_add_run(history, 3, definition="another"), FINISHED)
        night = _add_run(history, 4)
        states = {entry.night: entry.state for entry in history.nights()}
        assert states == {1: FINISHED, 2: FINISHED, 3: FINISHED, 4: INTERRUPTED, 5: FINISHED, night: RUNNING}
        comparisons = list_comparisons(history, night)
        assert {len(entry.before) for entry in comparisons} == {3}
        assert find_changes(comparisons) == []


def test_reported_change_restarts_the_history(tmp_path: Path) -> None:
    with History(tmp_path / "history.sqlite") as history:
        for seed in range(4):
            history.finish(_add_run(history, seed), FINISHED)
        night = _add_run(history, 5, error_factor=3.0)
        regressions = find_changes(list_comparisons(history, night))
        assert "error (m)" in {entry.metric for entry in regressions}
        history.finish(night, FINISHED, regressions)
        # after a reported change, later runs are compared with that run only
        next_night = _add_run(history, 6, error_factor=3.0)
        n_compared = {entry.metric.name: len(entry.before) for entry in list_comparisons(history, next_night)}
        assert n_compared["error (m)"] == 1
        assert find_changes(list_comparisons(history, next_night)) == []


def test_metric_without_its_column_is_a_regression(tmp_path: Path) -> None:
    """It is reported once: later nights are compared with nights that lack it, too."""
    with History(tmp_path / "history.sqlite") as history:
        for seed in range(2):
            history.finish(_add_run(history, seed), FINISHED)
        for expected in (["answered"], []):
            night = history.begin("abc")
            metrics = _draw_metrics(np.random.default_rng(9), _make_error_pool(4))
            history.add(night, _make_campaign(), [metric for metric in metrics if metric.name != "answered"])
            comparisons = list_comparisons(history, night)
            changes = find_changes(comparisons)
            assert [(change.metric, change.is_regression) for change in changes] == [(name, True) for name in expected]
            history.finish(night, FINISHED, changes)
            page = format_night_page(
                history.nights()[0], history.nights()[1:], history.campaigns(night), changes, len(comparisons)
            )
            assert ("**first: answered**: its column is missing now" in page) == bool(expected)
        other = history.begin("abc")
        history.add(other, _make_campaign("another definition"), [])
        assert list_comparisons(history, other) == []


def test_failed_write_adds_no_metrics(tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    with History(path) as history:
        night = _add_run(history, 1)
        with pytest.raises(StoreError, match="cannot be written"):
            history.add(night, _make_campaign(), _draw_metrics(np.random.default_rng(2), _make_error_pool(4)))
        assert len(history.metrics(night, "first")) == 3


def test_invalid_history_files_are_rejected(tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    path.write_bytes(b"not an SQLite file, but longer than the header of an SQLite file" * 10)
    with pytest.raises(StoreError, match="not a history of nights"):
        History(path)
    newer = tmp_path / "newer.sqlite"
    connection = sqlite3.connect(newer)
    connection.execute("PRAGMA user_version = 99")
    connection.close()
    with pytest.raises(StoreError, match="schema 99"):
        History(newer)


def test_page_lists_regressions_and_interrupted_runs(tmp_path: Path) -> None:
    hostile = "a|b\n# <script>`*"
    with History(tmp_path / "history.sqlite") as history:
        history.finish(_add_run(history, 1), INTERRUPTED)
        history.finish(_add_run(history, 2), FINISHED)
        later, earlier = history.nights()
    # campaign, metric, is a rate, value before, value now, p-value, number of earlier nights
    changes_of_night = [
        MetricChange("first", "DIMES-VEL", True, 0.95, 0.7, 2e-6, 7),
        MetricChange("first", "error (m)", False, 2.0, 1.0, 1e-3, 7),
    ]
    text = format_night_page(
        later, [earlier], [NightCampaign(hostile, "d", "x", "FAIL", 1, hostile)], changes_of_night, 6
    )
    assert text.startswith("# Night 2: 1 FAIL, 1 regression\n")
    assert "- **first: DIMES-VEL**: 95.00 % in 7 earlier nights, 70.00 % now (p = 2e-06)" in text
    assert text.index("## Regressions") < text.index("DIMES-VEL") < text.index("## Improvements")
    assert "Night 1, started" in text
    assert "<script>" not in text
    assert "| a&#124;b \\# &#60;script&#62;\\`\\* | FAIL |" in text
    unchanged_text = format_night_page(later, [], [_make_campaign()], [], 6)
    assert "No metric has changed." in unchanged_text
    assert "no history" not in unchanged_text
