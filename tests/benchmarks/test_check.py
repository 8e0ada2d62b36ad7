"""Tests of the nightly check for slower code, and of the campaigns and commands that `make bench` measures."""

import json
import subprocess
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks import check, project, reporting
from benchmarks.check import PAIRS, compare, log_ratios, select_slower
from benchmarks.estimators import simulate_descents
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.reports.dashboard.site import write_site
from tests.marsyard.confirmation_project import git

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


def test_tasks_run_in_a_new_clone_with_an_empty_cache(tmp_path: Path) -> None:
    (tmp_path / "Makefile").write_text(
        'demo:\n\t@test -n "$$MARSYARD_CACHE" -a ! -e "$$MARSYARD_CACHE" && mkdir "$$MARSYARD_CACHE" && sleep 0.2\n'
        "test:\n\t@test -d $$MARSYARD_CACHE -a ! -e uncommitted\n"
    )
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", "-A")
    git(tmp_path, "commit", "-q", "-m", "state")
    (tmp_path / "uncommitted").touch()
    demo, test, both = project.measure(tmp_path)
    assert 0.2 <= demo.median < 20.0
    assert both.median == pytest.approx((demo.median + test.median) / 60.0)
    assert [row.limit_text for row in (demo, test, both)] == ["<= 90", "<= 300", "<= 12"]


def test_failing_task_stops_the_measurement(tmp_path: Path) -> None:
    (tmp_path / "Makefile").write_text("demo:\n\t@echo the demo failed; exit 1\n")
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    git(tmp_path, "add", "-A")
    git(tmp_path, "commit", "-q", "-m", "state")
    with pytest.raises(RuntimeError, match=r"make demo ended with 2: the demo failed"):
        project.measure(tmp_path)


def test_rows_of_rendered_cases_are_multiplied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(*arguments: str) -> None:
        folder = Path(arguments[arguments.index("--out") + 1])
        folder.mkdir()
        pd.DataFrame({"case": range(8), "error_m": 2.0, "answered": True}).to_parquet(folder / "cases.parquet")
        (folder / "campaign.json").write_text(json.dumps({"name": "loc-light", "cases": 8}))
        (folder / "cases.sqlite").touch()

    monkeypatch.setattr(reporting, "run_marsyard", run)
    folder = reporting._write_campaign_with_images(tmp_path / "run", 300)
    rows = pd.read_parquet(folder / "cases.parquet")
    assert rows["case"].tolist() == list(range(300))
    assert rows["error_m"].nunique() == 300
    assert rows["answered"].all()
    assert json.loads((folder / "campaign.json").read_text())["cases"] == 300


def test_synthetic_campaigns_have_reports_and_a_dashboard(tmp_path: Path) -> None:
    run = reporting.synthetic_campaign(tmp_path / "of-24", 24)
    assert reporting.write_report(run).exists()
    site = write_site(reporting._copy_campaigns(tmp_path / "many", run, 3), [tmp_path / "many" / "runs"])
    assert (site.campaigns, site.problems) == (3, [])


def test_simulated_descents_are_those_of_the_campaign() -> None:
    campaign = load_campaign("dimes-smoke")
    (descent,) = simulate_descents("dimes-smoke", 1)
    row = campaign.scenario.run(campaign.parameters(0), campaign.streams(0)).row
    assert descent.velocity_m_s.tolist() == [row["velocity_true_x_m_s"], row["velocity_true_y_m_s"]]
    assert descent.has_feasible_overlap == row["feasible_overlap"]
    assert len(descent.measurements.images) == 3
