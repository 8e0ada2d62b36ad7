"""Tests that records and reports name the evaluated algorithm and the command that repeats the campaign."""

import csv
import html
import io
import json
import re
import shlex
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as Xml

import pytest

from marsyard.reports.dashboard.site import write_site
from tests.campaigns.fake_campaign import read_case_rows
from tests.command import run_command
from tests.inline_workers import use_inline_workers

ALGORITHM = """
from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome

class MyEstimator:
    version = "3.1"
    options = {"gain": 0.5}

    def estimate(self, measurements):
        return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None)
"""
CAMPAIGN = """
name = "custom-campaign"
scenario = "tests.campaigns.fake_velocity:FakeVelocityScenario"
cases = 50
[[requirements]]
id = "v"
metric = "velocity_error_m_s"
bound = 5.0
probability = 0.2
confidence = 0.5
population = "all"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run a campaign with a custom algorithm in a folder whose name has a space."""
    path: Path = tmp_path_factory.mktemp("a folder")
    (path / "my_module.py").write_text(ALGORITHM)
    (path / "custom file.toml").write_text(CAMPAIGN)
    words = ["run", "custom file.toml", "-n", "3", "--seed", "9", "--set", 'description="it\'s quoted"']
    words += ["--algorithm", "my_module:MyEstimator", "--algorithm", "homography", "--jobs", "1", "--out", "run"]
    with pytest.MonkeyPatch.context() as patch:
        use_inline_workers(patch)
        patch.chdir(path)
        patch.setattr(sys, "path", [*sys.path])
        status, output = run_command(*words)
    # no answer is valid, so that the requirement fails or remains undecided
    assert status in (1, 3), output
    return path


def _read_record(folder: Path) -> Mapping[str, Any]:
    record: Mapping[str, Any] = json.loads((folder / "run" / "campaign.json").read_text())
    return record


def test_record_describes_the_algorithms(folder: Path) -> None:
    tested_entry, compared_entry = _read_record(folder)["algorithms"]
    assert tested_entry["spec"] == tested_entry["path"] == "my_module:MyEstimator"
    assert (tested_entry["role"], compared_entry["role"]) == ("tested", "compared")
    assert (tested_entry["version"], tested_entry["options"]) == ("3.1", {"gain": 0.5})
    assert re.fullmatch("[0-9a-f]{16}", tested_entry["source_hash"])
    assert compared_entry["spec"] == "homography"
    assert compared_entry["path"] == "marsyard.algorithms.dimes.baselines:HomographyEstimator"
    assert compared_entry["version"]
    assert compared_entry["options"]


def test_reports_name_the_evaluated_algorithm(folder: Path) -> None:
    source = _read_record(folder)["algorithms"][0]["source_hash"]
    page = html.unescape((folder / "run" / "report.html").read_text())
    header = page.partition("<nav")[0]
    assert "my_module:MyEstimator" in header
    assert "3.1" in header
    assert source[:10] in header
    provenance = page.partition('id="provenance"')[2]
    assert '{"gain": 0.5}' in provenance
    assert source in provenance
    (row,) = csv.DictReader(io.StringIO((folder / "run" / "verification.csv").read_text()))
    assert (row["algorithm"], row["algorithm_version"]) == ("my_module:MyEstimator", "3.1")
    assert (row["algorithm_options"], row["algorithm_source"]) == ('{"gain": 0.5}', source)
    suite = Xml.parse(folder / "run" / "junit.xml").getroot()  # noqa: S314
    properties = {entry.get("name"): entry.get("value") for entry in suite.iter("property")}
    assert (properties["algorithm"], properties["algorithm_source"]) == ("my_module:MyEstimator", source)
    report = json.loads((folder / "run" / "report.json").read_text())
    assert [entry["name"] for entry in report["algorithm_details"] if entry["tested"]] == ["my_module:MyEstimator"]


def test_dashboard_names_the_evaluated_algorithm(folder: Path, tmp_path: Path) -> None:
    site = write_site(tmp_path / "site", [folder / "run"])
    index = site.index.read_text()
    evidence = re.search(r'data-requirement="v".*?</tr>', index, re.DOTALL)
    assert evidence is not None
    assert "my_module:MyEstimator 3.1" in evidence[0]
    page = html.unescape(next((tmp_path / "site" / "c").glob("*/index.html")).read_text())
    source = _read_record(folder)["algorithms"][0]["source_hash"]
    assert all(text in page for text in ("my_module:MyEstimator 3.1", source, '{"gain": 0.5}'))
    matrix = list(csv.DictReader(io.StringIO((tmp_path / "site" / "verification.csv").read_text())))
    assert next(row for row in matrix if row["requirement"] == "v")["algorithm"] == "my_module:MyEstimator"


@pytest.mark.slow
def test_command_in_the_report_repeats_the_campaign(folder: Path, tmp_path: Path) -> None:
    page = (folder / "run" / "report.html").read_text()
    command_block = re.search(r"Run the campaign again</dt><dd>(.*?)</dd>", page, re.DOTALL)
    assert command_block is not None
    change_folder, command = [html.unescape(line) for line in re.findall(r"<code>(.*?)</code>", command_block[1])]
    assert shlex.split(change_folder) == ["cd", str(folder)]
    program = shlex.quote(str(Path(sys.executable).with_name("marsyard")))
    second_run = tmp_path / "again"
    line = command.replace("marsyard", program, 1) + f" --jobs 1 --out {shlex.quote(str(second_run))}"
    script = f"{change_folder} && {line}"
    result = subprocess.run(
        ["/bin/sh", "-c", script], cwd="/", capture_output=True, text=True, timeout=120, check=False
    )
    assert result.returncode in (1, 3), result.stderr
    first, second = (
        json.loads((run_folder / "campaign.json").read_text()) for run_folder in (folder / "run", second_run)
    )
    assert first["definition"] == second["definition"]
    assert first["algorithms"] == second["algorithms"]
    columns = ("case", "outcome", "image_hash", "algorithm", "homography.velocity_error_m_s")
    rows = [
        [{column: row[column] for column in columns} for row in read_case_rows(run_folder)]
        for run_folder in (folder / "run", second_run)
    ]
    assert rows[0] == rows[1]
    assert len(rows[0]) == 3


def test_appended_blocks_are_in_the_command(folder: Path) -> None:
    from marsyard.reports.provenance import rerun_commands
    from marsyard.reports.stored import read_run

    run = read_run(folder / "run")
    definition = {**run.record["definition"], "appended": [20]}
    run_with_append = type(run)(run.directory, run.frame, run.all_cases, {**run.record, "definition": definition}, ())
    assert rerun_commands(run_with_append)[-1] == "marsyard append runs/custom-campaign-again 20"


def test_run_without_a_recorded_command_is_reported(folder: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "cases.parquet").write_bytes((folder / "run" / "cases.parquet").read_bytes())
    (run / "campaign.json").write_text(json.dumps({**_read_record(folder), "command": None}))
    assert run_command("report", run)[0] in (1, 3)
    page = (run / "report.html").read_text()
    assert "marsyard run custom-campaign -n 3 --seed 9" in page
    assert "The original command was not recorded" in page
