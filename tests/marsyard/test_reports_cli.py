"""Tests of `marsyard report`, `compare` and `dashboard`, and of campaigns that stop after a decided verdict.

Exit status: 0 requirements met, 1 failed, 2 error, 3 no verdict.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.running.engine import run_campaign
from marsyard.campaigns.store import record
from marsyard.cli.campaign import run_until_decided
from marsyard.reports.decision import evaluate_requirements
from marsyard.reports.evaluation import next_look
from marsyard.reports.gallery import gallery_candidates
from marsyard.reports.sampling_design import SamplingDesign
from marsyard.reports.stored import read_run
from tests.campaigns.fake_campaign import REQUIREMENT, RecordingWatch, write_campaign
from tests.command import marsyard
from tests.reports.synthetic_run import MakeRun, make_rows, write_run

COLUMNS = ["case", "outcome", "answered", "velocity_error_m_s"]
REQUIREMENTS = """
[[requirements]]
id = "STRICT"
metric = "velocity_error_m_s"
bound = 0.001
probability = 0.9
confidence = 0.9
campaigns = ["dimes-*"]
"""


@pytest.fixture
def make_run(tmp_path: Path) -> MakeRun:
    """Return a function that writes a synthetic run of 40 cases."""

    def write_synthetic_run(name: str, row_seed: int = 1, **changes: Any) -> Path:
        return write_run(tmp_path / name, make_rows(40, seed=row_seed)[COLUMNS], **changes)

    return write_synthetic_run


def test_stored_rows_are_evaluated_again(make_run: MakeRun, tmp_path: Path) -> None:
    directory, requirements = make_run("run"), tmp_path / "requirements.toml"
    requirements.write_text(REQUIREMENTS)
    status, out, _ = marsyard("report", directory, "--requirements", requirements, "--csv")
    assert (status, "STRICT" in out, "verdict: FAIL" in out) == (1, True, True)
    assert json.loads((directory / "report.json").read_text())["verdicts"][0]["requirement_id"] == "STRICT"
    assert "STRICT" in (directory / "verification.csv").read_text()
    # the campaign's record is unchanged
    assert "exit_code" not in _read_record(directory)
    rows = pd.read_csv(directory / "cases.csv")
    assert (len(rows), list(rows)) == (40, COLUMNS)
    requirements.write_text(REQUIREMENTS.replace("dimes-*", "vtt-*"))
    status, _, err = marsyard("report", directory, "--requirements", requirements)
    assert (status, "no requirement lists the campaign" in err) == (2, True)


@pytest.mark.slow
def test_pdf_is_written(make_run: MakeRun, monkeypatch: pytest.MonkeyPatch) -> None:
    directory = make_run("run")
    assert shutil.which("chromium"), "the test needs Debian's Chromium"
    status, out, err = marsyard("report", directory, "--pdf")
    assert (status, err) == (3, "")
    assert f"pdf: {(directory / 'report.pdf').resolve()}" in out
    assert (directory / "report.pdf").read_bytes().startswith(b"%PDF-")
    monkeypatch.setenv("PATH", "/nowhere")
    status, _, err = marsyard("report", directory, "--pdf")
    assert (status, "install chromium" in err) == (2, True)


def test_two_campaigns_are_compared(make_run: MakeRun) -> None:
    runs = make_run("a"), make_run("b", 2, seed=8)
    status, out, err = marsyard("compare", *runs)
    assert (status, err) == (0, "")
    # the rate of cases that were completed
    assert "came to an end" in out
    assert "different draws" in out
    comparison = json.loads(marsyard("compare", *runs, "--json")[1])
    assert (comparison["second"], comparison["paired"]) == (str(runs[1]), False)
    figures = {figure["name"]: figure for figure in comparison["figures"]}
    assert figures["came to an end"]["first"] == {"rate": 1.0, "cases": 40}


def test_dashboard_is_written(make_run: MakeRun, tmp_path: Path) -> None:
    make_run("run")
    status, out, _ = marsyard("dashboard", tmp_path, "--out", tmp_path / "site")
    assert (status, "campaigns: 1" in out) == (0, True)
    broken = tmp_path / "broken"
    broken.mkdir()
    for name in ("campaign.json", "cases.parquet"):
        (broken / name).write_text("{}")
    status, out, err = marsyard("dashboard", tmp_path, "--out", tmp_path / "site")
    assert (status, "campaigns: 1" in out, f"not shown: {broken}" in err) == (1, True, True)
    assert marsyard("dashboard", tmp_path / "none")[0] == 2
    assert "Requirements and campaigns" in (tmp_path / "site" / "index.html").read_text()


def _make_rows(n: int, failures: int) -> pd.DataFrame:
    """Return cases whose first `failures` errors exceed the bound of 5 m/s."""
    errors = [6.0] * failures + [1.0] * (n - failures)
    return pd.DataFrame({"case": range(n), "outcome": "VALID", "answered": True, "velocity_error_m_s": errors})


def _find_next_look(n: int, failures: int, max_cases: int, **changes: Any) -> int | None:
    """Return the number of cases of the next evaluation after `n` cases; None if the campaign stops."""
    requirement = {
        "id": "R",
        "metric": "velocity_error_m_s",
        "bound": 5.0,
        "probability": 0.9,
        "confidence": 0.9,
        **changes,
    }
    design = SamplingDesign(max_cases=max_cases)
    return next_look(evaluate_requirements(_make_rows(n, failures), [requirement], design), design, n)


def test_campaign_continues_until_its_verdict_is_decided() -> None:
    # evaluations are planned at 16, 32, 64, 128, 256 and 512 cases
    assert _find_next_look(16, 1, 512) == 32
    # the evaluation at 128 cases spends 1/8 of the risk: its confidence is 98.75 %
    assert _find_next_look(128, 0, 512) is None
    assert _find_next_look(128, 128, 512) is None
    assert _find_next_look(512, 50, 512) is None
    # a verdict by the observed rate needs no further evaluation
    assert _find_next_look(16, 1, 512, decide_by="estimate") is None


def test_campaign_stops_if_no_further_evaluation_can_decide() -> None:
    # 64 cases cannot show 99.99 % (23,026 cases needed), but one failure can refute it
    assert _find_next_look(16, 0, 64, probability=0.9999) == 32
    assert _find_next_look(32, 0, 33, probability=0.5) is None


@pytest.mark.slow
def test_adaptive_campaign_reports_its_end(tmp_path: Path) -> None:
    requirement = REQUIREMENT.replace("0.99", "0.5")
    dispersions = '[dispersions]\naltitude_m = {distribution = "normal", mean = 2000, sd = 100}\n'
    path = write_campaign(tmp_path, "error_scale = 1e3", requirement=requirement, dispersions=dispersions)
    campaign, watch = load_campaign(str(path), cases=128), RecordingWatch()
    run_until_decided(campaign, tmp_path / "run", ExecutorConfig(jobs=1), watch)
    definition = record.stored_definition(tmp_path / "run")
    # All cases fail on one terrain, which counts as one case. One failure does not refute a rate of 50 %.
    assert (definition.total_cases, definition.max_cases) == (128, 128)
    assert watch.notes[-1] == "stopped after 128 of at most 128 cases"


@pytest.mark.slow
def test_gallery_reruns_each_gallery_candidate_once(tmp_path: Path) -> None:
    dispersions = '[dispersions]\naltitude_m = {distribution = "normal", mean = 2000, sd = 100}\n'
    path, directory = write_campaign(tmp_path, dispersions=dispersions), tmp_path / "run"
    run_campaign(load_campaign(str(path), cases=12), directory, ExecutorConfig(jobs=1), RecordingWatch())
    candidates = set(gallery_candidates(read_run(directory)))
    assert len(candidates) >= 4
    _, out, err = marsyard("report", directory, "--gallery")
    stored_cases = {int(folder.name) for folder in (directory / "cases").iterdir()}
    assert (candidates - stored_cases, err) == (set(), "")
    assert out.count("rerun for its images") == len(candidates - {_read_record(directory)["showcase"]})
    # cases with stored images are not run again
    assert "rerun for" not in marsyard("report", directory, "--gallery")[1]


def _read_record(directory: Path) -> dict[str, Any]:
    record_content: dict[str, Any] = json.loads((directory / "campaign.json").read_text())
    return record_content


def test_undecidable_requirements_are_rejected(tmp_path: Path) -> None:
    campaign = load_campaign(str(write_campaign(tmp_path, requirement="")))
    with pytest.raises(CampaignError, match="no requirement with a confidence level"):
        run_until_decided(campaign, tmp_path / "run", ExecutorConfig(jobs=1), RecordingWatch())
    latin_hypercube = write_campaign(tmp_path, extra_tables='[design]\nkind = "latin-hypercube"\n')
    with pytest.raises(CampaignError, match="only independent random samples"):
        run_until_decided(
            load_campaign(str(latin_hypercube)), tmp_path / "run", ExecutorConfig(jobs=1), RecordingWatch()
        )
