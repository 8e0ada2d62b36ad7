"""`marsyard report`, `compare` and `dashboard` on stored rows, and what decides a campaign that stops itself."""

from __future__ import annotations

import importlib.util
import json
import shutil
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.workers import ExecutorConfig
from marsyard.campaigns.running.engine import run_campaign
from marsyard.campaigns.store import record
from marsyard.cli import app as cli
from marsyard.cli.outcome import run_until_decided
from marsyard.cli.site_server import server
from marsyard.reports.evaluation import next_look
from marsyard.reports.presentation import notable_cases
from marsyard.reports.sampling_design import SamplingDesign
from marsyard.reports.stored import read_run
from marsyard.reports.verdicts import judge_campaign
from tests.campaigns.fake_campaign import REQUIREMENT, Silence, write_campaign

pytestmark = [
    pytest.mark.filterwarnings("ignore:Failed to kill subprocesses"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning:matplotlib"),
]
Command = Callable[..., tuple[int, str, str]]
MakeRun = Callable[..., Path]
COLUMNS = ["case", "outcome", "answered", "velocity_error_m_s"]
ASKED = """
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
    """The synthetic runs of the reports' own tests."""
    path = Path(__file__).resolve().parents[1] / "reports" / "conftest.py"
    spec = importlib.util.spec_from_file_location("made_up_runs", path)
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)

    def make(name: str, draws: int = 1, **changes: Any) -> Path:
        frame = made.synthetic_frame(40, seed=draws)[COLUMNS]
        directory: Path = made.write_run(tmp_path / name, frame, **changes)
        return directory

    return make


@pytest.fixture
def marsyard(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Command:
    def command(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["marsyard", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        captured = capfd.readouterr()
        return int(ended.value.code or 0), captured.out, captured.err

    return command


def test_stored_rows_are_judged_again(make_run: MakeRun, marsyard: Command, tmp_path: Path) -> None:
    directory, asked = make_run("run"), tmp_path / "asked.toml"
    asked.write_text(ASKED)
    status, out, _ = marsyard("report", directory, "--requirements", asked, "--csv")
    assert (status, "STRICT" in out, "verdict: FAIL" in out) == (1, True, True)
    assert json.loads((directory / "report.json").read_text())["verdicts"][0]["requirement_id"] == "STRICT"
    assert "STRICT" in (directory / "verification.csv").read_text()
    # The campaign itself stays what it was.
    assert "exit_code" not in json.loads((directory / "campaign.json").read_text())
    rows = pd.read_csv(directory / "cases.csv")
    assert (len(rows), list(rows)) == (40, COLUMNS)
    asked.write_text(ASKED.replace("dimes-*", "vtt-*"))
    status, _, err = marsyard("report", directory, "--requirements", asked)
    assert (status, "no requirement names the campaign" in err) == (2, True)


def test_a_pdf_is_printed(make_run: MakeRun, marsyard: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    directory = make_run("run")
    assert shutil.which("chromium"), "printing takes Debian's Chromium"
    status, out, err = marsyard("report", directory, "--pdf")
    assert (status, err) == (3, "")
    assert f"pdf: {(directory / 'report.pdf').resolve()}" in out
    assert (directory / "report.pdf").read_bytes().startswith(b"%PDF-")
    monkeypatch.setenv("PATH", "/nowhere")
    status, _, err = marsyard("report", directory, "--pdf")
    assert (status, "install chromium" in err) == (2, True)


def test_two_campaigns_side_by_side(make_run: MakeRun, marsyard: Command) -> None:
    both = make_run("a"), make_run("b", 2, seed=8)
    status, out, err = marsyard("compare", *both)
    assert (status, err) == (0, "")
    assert "came to an end" in out
    assert "draws of their own" in out
    reported = json.loads(marsyard("compare", *both, "--json")[1])
    assert (reported["second"], reported["paired"]) == (str(both[1]), False)
    figures = {one["name"]: one for one in reported["figures"]}
    assert figures["came to an end"]["first"] == {"rate": 1.0, "cases": 40}


def test_a_dashboard_is_written_and_served_on_this_machine_alone(
    make_run: MakeRun, marsyard: Command, tmp_path: Path
) -> None:
    make_run("run")
    status, out, _ = marsyard("dashboard", tmp_path, "--out", tmp_path / "site")
    assert (status, "campaigns: 1" in out) == (0, True)
    assert marsyard("dashboard", tmp_path / "none")[0] == 2
    (tmp_path / "secret.txt").write_text("secret")
    (tmp_path / "site" / "way-out").symlink_to(tmp_path / "secret.txt")
    with server(tmp_path / "site", "127.0.0.1", 0) as serving:
        assert serving.server_address[0] == "127.0.0.1"
        threading.Thread(target=serving.serve_forever, daemon=True).start()
        root = f"http://127.0.0.1:{serving.server_port}"
        with urllib.request.urlopen(f"{root}/") as answer:  # noqa: S310
            assert "Requirements and campaigns" in answer.read().decode()
        for wrong in ("/c/", "/../secret.txt", "/%2e%2e/secret.txt", "/way-out"):
            with pytest.raises(urllib.error.HTTPError) as refused:
                urllib.request.urlopen(root + wrong)  # noqa: S310
            assert refused.value.code == 404
            refused.value.close()
        serving.shutdown()


def _rows(n: int, failures: int) -> pd.DataFrame:
    errors = [6.0] * failures + [1.0] * (n - failures)
    return pd.DataFrame({"case": range(n), "outcome": "VALID", "answered": True, "velocity_error_m_s": errors})


def _next(n: int, failures: int, most: int, **changes: Any) -> int | None:
    asked = {"id": "R", "metric": "velocity_error_m_s", "bound": 5.0, "probability": 0.9, "confidence": 0.9, **changes}
    how = SamplingDesign(max_cases=most)
    return next_look(judge_campaign(_rows(n, failures), [asked], how), how, n)


def test_a_campaign_goes_on_while_it_is_open() -> None:
    # Of 512 cases the looks are at 16, 32, 64, 128, 256 and 512.
    assert _next(16, 1, 512) == 32
    # 128 cases spend an eighth of the risk: at 98.75 % none failed of 128 shows 90 %, all failed refutes it.
    assert _next(128, 0, 512) is None
    assert _next(128, 128, 512) is None
    assert _next(512, 50, 512) is None
    # Decided by the estimate it is never waited for.
    assert _next(16, 1, 512, decide_by="estimate") is None


def test_a_campaign_stops_where_no_case_left_can_decide() -> None:
    # 99.99 % takes 23,026 cases at 90 %: 64 cannot show it, and one failure is enough to refute it.
    assert _next(16, 0, 64, probability=0.9999) == 32
    assert _next(32, 0, 33, probability=0.5) is None


def test_a_campaign_stops_itself_and_says_so(tmp_path: Path) -> None:
    asked = REQUIREMENT.replace("0.99", "0.5")
    dispersions = '[dispersions]\naltitude_m = {distribution = "normal", mean = 2000, sd = 100}\n'
    path = write_campaign(tmp_path, "error_scale = 1e3", requirement=asked, dispersions=dispersions)
    campaign, watch = load_campaign(str(path), cases=128), Silence()
    run_until_decided(campaign, tmp_path / "run", ExecutorConfig(jobs=1), watch)
    stored = record.stored_configuration(tmp_path / "run")
    # All cases fail, but on one terrain, and that refutes a rate of half at none of the looks: it runs to its end.
    assert (stored.total_cases, stored.max_cases) == (128, 128)
    assert watch.notes[-1] == "stopped after 128 of at most 128 cases"


def test_the_gallery_runs_its_cases_again(tmp_path: Path, marsyard: Command) -> None:
    dispersions = '[dispersions]\naltitude_m = {distribution = "normal", mean = 2000, sd = 100}\n'
    path, directory = write_campaign(tmp_path, dispersions=dispersions), tmp_path / "run"
    run_campaign(load_campaign(str(path), cases=12), directory, ExecutorConfig(jobs=1), Silence())
    wanted = set(notable_cases(read_run(directory)))
    assert len(wanted) >= 4
    _, out, err = marsyard("report", directory, "--gallery")
    kept = {int(folder.name) for folder in (directory / "cases").iterdir()}
    assert (wanted - kept, err) == (set(), "")
    assert out.count("ran again for its pictures") == len(wanted - {json.loads(_record(directory))["showcase"]})
    # once they are kept nothing is run again
    assert "ran again" not in marsyard("report", directory, "--gallery")[1]


def _record(directory: Path) -> str:
    return (directory / "campaign.json").read_text()


def test_what_cannot_be_decided_is_refused(tmp_path: Path) -> None:
    campaign = load_campaign(str(write_campaign(tmp_path, requirement="")))
    with pytest.raises(CampaignError, match="no requirement that is decided"):
        run_until_decided(campaign, tmp_path / "run", ExecutorConfig(jobs=1), Silence())
    latin = write_campaign(tmp_path, more='[design]\nkind = "latin-hypercube"\n')
    with pytest.raises(CampaignError, match="only independent random draws"):
        run_until_decided(load_campaign(str(latin)), tmp_path / "run", ExecutorConfig(jobs=1), Silence())
