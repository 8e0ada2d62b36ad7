"""Tests of the nightly check for slower code (`benchmarks.check`) with random time ratios: false alarms, detections."""

import json
import time
from pathlib import Path

import numpy as np
import pytest

from benchmarks import check
from benchmarks.check import PAIRS, compare, log_ratios, select_slower

#: Names of the timed functions (hot paths).
HOT_PATHS = ("one", "two", "three", "four", "five", "six")


def draw_ratios(rng: np.random.Generator, sd: float, factor: float = 1.0) -> dict[str, list[float]]:
    """Draw the logarithms of time ratios with the median `factor` for each hot path."""
    return {name: (np.log(factor) + sd * rng.standard_normal(PAIRS)).tolist() for name in HOT_PATHS}


@pytest.mark.slow
@pytest.mark.parametrize("sd", [0.03, 0.2])
def test_unchanged_hot_paths_raise_few_alarms(sd: float) -> None:
    """At a false alarm rate of 1 %, more than 9 alarms in 400 comparisons have a probability below 1 %."""
    rng = np.random.default_rng(1)
    alarms = sum(bool(select_slower(compare(draw_ratios(rng, sd), draw_ratios(rng, sd)))) for _ in range(400))
    assert alarms <= 9


@pytest.mark.slow
def test_accepted_growth_raises_few_alarms() -> None:
    """A growth of 10 % is below the accepted 15 %; more than 6 alarms in 200 have a probability below 1 %."""
    rng = np.random.default_rng(2)
    alarms = sum(bool(select_slower(compare(draw_ratios(rng, 0.05, 1.1), draw_ratios(rng, 0.05)))) for _ in range(200))
    assert alarms <= 6


@pytest.mark.parametrize(("sd", "factor"), [(0.05, 1.3), (0.2, 1.8)])
def test_slower_hot_path_is_detected(sd: float, factor: float) -> None:
    rng = np.random.default_rng(3)
    detections = 0
    # only the hot path "three" is slower
    for _ in range(100):
        ratios = draw_ratios(rng, sd) | {"three": draw_ratios(rng, sd, factor)["three"]}
        slower = select_slower(compare(ratios, draw_ratios(rng, sd)))
        detections += [comparison.name for comparison in slower] == ["three"]
    assert detections >= 95


def test_ratio_of_processor_times_is_measured() -> None:
    def occupy_processor(seconds: float) -> None:
        end = time.process_time() + seconds
        while time.process_time() < end:
            pass

    ratios = log_ratios(lambda: occupy_processor(0.02), lambda: occupy_processor(0.01), 3)
    assert np.median(ratios) == pytest.approx(np.log(2.0), abs=0.1)


def test_ratios_of_another_processor_are_not_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    record = {"measured": "2026-01-01T00:00:00+00:00", "log_ratios": {}}
    (tmp_path / "ratios.json").write_text(json.dumps({"another": record}))
    monkeypatch.setattr(check, "RATIOS", tmp_path / "ratios.json")
    monkeypatch.setattr("sys.argv", ["check"])
    assert check.main() == 2
    message = capsys.readouterr().err
    assert check.processor_features() in message
    assert "another" in message
