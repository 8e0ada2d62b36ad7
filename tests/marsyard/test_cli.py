"""Tests of the command line: output, error messages, exit status and run folders.

Exit status: 0 requirements met, 1 requirement or case failed, 2 error, 3 no verdict.
"""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from tests.campaigns.fake_campaign import REQUIREMENT, TOP_LEVEL_KEYS, write_campaign
from tests.campaigns.killing import start_and_kill
from tests.command import marsyard


@pytest.fixture(scope="module")
def finished_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run a small campaign with the installed command."""
    folder = tmp_path_factory.mktemp("campaign")
    path = write_campaign(folder, "unanswered_cases = [2]", requirement=REQUIREMENT.replace("0.99", "0.9"))
    command = [str(Path(sys.executable).with_name("marsyard")), "run", str(path), "--jobs", "1", "-n", "6"]
    result = subprocess.run([*command, "--out", str(folder / "run")], capture_output=True, text=True, timeout=120)
    assert result.returncode == 3, result.stderr
    (folder / "stdout.txt").write_text(result.stdout)
    (folder / "stderr.txt").write_text(result.stderr)
    return folder / "run"


def test_run_prints_table_verdict_and_report(finished_run: Path) -> None:
    out = (finished_run.parent / "stdout.txt").read_text()
    assert "velocity" in out
    assert "1 of 6" in out
    lines = out.rstrip().splitlines()
    assert "verdict: INSUFFICIENT" in lines
    assert lines[-1] == f"report: {finished_run / 'report.html'}"
    assert (finished_run / "report.html").stat().st_size > 1000
    assert json.loads((finished_run / "campaign.json").read_text())["exit_code"] == 3
    progress = (finished_run.parent / "stderr.txt").read_text()
    assert re.search(r"^cases: 6/6, [\d.]+ (/s|s per item), [\d.]+ s$", progress, re.MULTILINE)
    assert "\x1b" not in out + progress


def test_replay_fails_if_the_row_differs(finished_run: Path, tmp_path: Path) -> None:
    (tmp_path / "campaign.json").write_bytes((finished_run / "campaign.json").read_bytes())
    frame = pd.read_parquet(finished_run / "cases.parquet")
    frame["altitude_m"] += 1.0 * (frame.index == 1)
    frame.to_parquet(tmp_path / "cases.parquet")
    result = marsyard("replay", tmp_path, 1)
    assert result.status == 1
    assert "the row differs from the stored one in: altitude_m" in result.out


def test_stages_are_saved_as_separate_files(finished_run: Path, tmp_path: Path) -> None:
    result = marsyard("replay", finished_run, 0, "--save-stages", "--out", tmp_path / "case")
    assert (result.status, result.err) == (0, "")
    assert "case 0: VALID" in result.out
    assert "the row equals the stored one" in result.out
    stages = tmp_path / "case" / "stages"
    files = sorted(str(path.relative_to(stages)) for path in stages.rglob("*.*"))
    assert files == ["01-image.png", "02-title.json", "03-nested/01-0/01-x.npy"]
    image = cv2.imread(str(stages / "01-image.png"), cv2.IMREAD_UNCHANGED)
    assert image.dtype == np.uint16
    assert image.tolist() == [[0, 1, 2], [3, 4, 5]]
    assert f"stages: 3 files in {stages}" in result.out


@pytest.mark.slow
def test_killed_campaign_is_reported_and_resumed(tmp_path: Path) -> None:
    path = write_campaign(tmp_path, "sleep_s = 0.1", dispersions="", requirement=REQUIREMENT)
    start_and_kill(["run", path, "-n", "40", "--jobs", "1"], tmp_path / "run")
    record_before = (tmp_path / "run" / "campaign.json").read_bytes()
    report_result = marsyard("report", tmp_path / "run")
    assert (report_result.status, report_result.err) == (3, "")
    message = re.search(
        r"INCOMPLETE: (\d+) of 40 cases; the campaign was killed; to continue: marsyard resume (\S+)", report_result.out
    )
    assert message
    assert message[2] == str(tmp_path / "run")
    assert 0 < int(message[1]) == len(pd.read_parquet(tmp_path / "run" / "cases.parquet")) < 40
    assert (tmp_path / "run" / "campaign.json").read_bytes() == record_before
    early_append = marsyard("append", tmp_path / "run", 2)
    assert (early_append.status, "is not finished (running): marsyard resume" in early_append.err) == (2, True)
    resume_result = marsyard("resume", tmp_path / "run", "--jobs", 1, "--allow-changed")
    assert (resume_result.status, "INCOMPLETE" in resume_result.out) == (3, False)
    assert list(pd.read_parquet(tmp_path / "run" / "cases.parquet")["case"]) == list(range(40))
    append_result = marsyard("append", tmp_path / "run", 20, "--jobs", 1, "--allow-changed")
    assert append_result.status == 3
    assert "of 60" in append_result.out
    # minimum number of cases for 99 % at 90 % confidence, if 40 cases were evaluated before
    assert "takes at least 297 cases without a failure; the campaign has 60" in append_result.out


@pytest.mark.usefixtures("inline_workers")
def test_dry_run_only_estimates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = marsyard("run", write_campaign(tmp_path, "sleep_s = 0.05"), "--dry-run", "-n", 100_000, "--jobs", 2)
    assert (result.status, result.err) == (0, "")
    assert re.search(r"^100,000 cases on 2 workers: about [\d.]+ (min|h)$", result.out, re.MULTILINE)
    assert re.search(r"^  0\.\d+ s per case \(0\.\d+ to \d[\d.]* s in 9 trial cases\)$", result.out, re.MULTILINE)
    assert re.search(r"^disk: [\d.]+ MB of rows, up to [\d.]+ MB of products$", result.out, re.MULTILINE)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fake.toml"]
    result = marsyard("run", tmp_path / "fake.toml", "--dry-run", "-n", 3, "--cluster", "local:7")
    assert "3 cases on 7 workers" in result.text
    result = marsyard("run", tmp_path / "fake.toml", "--dry-run", "-n", 3, "--cluster", "tcp://host:8786")
    assert "the cluster is assumed to have one worker per core" in result.text


def _crashing_case_setting(case: int) -> str:
    return f"raising_cases = [{case}]"


@pytest.mark.parametrize(
    ("parameters", "requirement", "status", "verdict"),
    [
        pytest.param("", "", 0, "NO REQUIREMENT", marks=pytest.mark.slow),
        (_crashing_case_setting(1), "", 1, "NO REQUIREMENT"),
        # three cases on one terrain count as one case: the lower bound of one success is 10 % at 90 % confidence
        ("", REQUIREMENT.replace("0.99", "0.09"), 0, "PASS"),
        ("error_scale = 1e3", REQUIREMENT, 1, "FAIL"),
        ("", REQUIREMENT, 3, "INSUFFICIENT"),
        # the requirement is undecided, but a crash gives status 1
        pytest.param(
            _crashing_case_setting(1), REQUIREMENT.replace("0.99", "0.9"), 1, "INSUFFICIENT", marks=pytest.mark.slow
        ),
    ],
)
@pytest.mark.usefixtures("inline_workers")
def test_exit_status_follows_verdict_and_crashes(
    tmp_path: Path, parameters: str, requirement: str, status: int, verdict: str
) -> None:
    path = write_campaign(tmp_path, parameters, dispersions="", requirement=requirement)
    result = marsyard("run", path, "-n", 3, "--jobs", 1, "--out", tmp_path / "run")
    assert (result.status, f"verdict: {verdict}" in result.out) == (status, True), result.out + result.err
    (tmp_path / "run" / "report.html").unlink()
    report_result = marsyard("report", tmp_path / "run")
    assert (tmp_path / "run" / "report.html").exists()
    assert (report_result.status, f"verdict: {verdict}" in report_result.out) == (status, True)


@pytest.mark.usefixtures("inline_workers")
def test_definition_error_precedes_failed_cases(tmp_path: Path) -> None:
    invalid_requirement = REQUIREMENT.replace("velocity_error_m_s", "velocity_error_m")
    path = write_campaign(tmp_path, _crashing_case_setting(0), dispersions="", requirement=invalid_requirement)
    result = marsyard("run", path, "-n", 3, "--jobs", 1, "--out", tmp_path / "run")
    assert result.status == 2
    assert "unknown column of numbers 'velocity_error_m' (did you mean 'velocity_error_m_s'?)" in result.err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "dimes-smok"], "unknown campaign 'dimes-smok'"),
        (["run", "{folder}/none.toml"], "none.toml: no such file"),
        (["run", "{file}", "-n", "0"], "-n 0: cases: input should be greater than or equal to 1"),
        (["run", "{file}", "--seed", "-1"], "--seed -1: seed: input should be greater than or equal to 0"),
        (["run", "{file}", "--jobs", "0"], "--jobs 0: at least one worker process is needed"),
        (["run", "{file}", "--set", "altitude_m=-2"], "parameters.altitude_m: input should be greater than 0, got -2"),
        (["run", "dimes-smoke", "--set", "descent.altitud_first_m=1500"], "(did you mean 'altitude_first_m'?)"),
        (["run", "dimes-smoke", "--set", "render.backend=vulkan"], "osmesa"),
        (["run", "{file}", "--out", "{run}"], "contains a campaign"),
        (["run", "{file}", "--out", "{file}/run"], "cannot be written: Not a directory"),
        (["run", "{file}", "--out", "/proc/run"], "cannot be written"),
        (["run", "{file}", "--case-time", "0"], "--set limits.case_time_s=0.0: limits.case_time_s: input should be gr"),
        (["run", "{file}", "--jobs", "2", "--cluster", "local:2"], "cannot be combined"),
        (["run", "{file}", "--dry-run", "--jobs", "-1"], "at least one worker process is needed"),
        (["resume", "{folder}"], "does not contain a campaign"),
        (["resume", "{folder}/none"], "none: no such folder"),
        (["resume", "{run}", "--retry", "crased"], "unknown outcome 'crased' (did you mean 'crashed'?); allowed: all"),
        (["resume", "{run}", "--case-time", "-1"], "--case-time -1.0: input should be greater than 0"),
        (["append", "{folder}", "3"], "does not contain a campaign"),
        (["show", "dimes-smok"], "unknown campaign 'dimes-smok'"),
        (["report", "{folder}/none"], "none: no such folder"),
        (["report", "{folder}"], "does not contain a campaign"),
        (["replay", "{run}", "6"], "has no case 6; allowed: 0 to 5"),
        (["replay", "{run}", "--", "-1"], "has no case -1; allowed: 0 to 5"),
        (["replay", "{folder}", "0"], "does not contain a campaign"),
        (["replay", "{run}", "0", "--out", "{file}/x"], "cannot be written"),
    ],
)
def test_invalid_arguments_are_rejected(finished_run: Path, tmp_path: Path, arguments: list[str], message: str) -> None:
    file = write_campaign(tmp_path)
    result = marsyard(*(argument.format(file=file, run=finished_run, folder=tmp_path) for argument in arguments))
    assert (result.status, result.out, "Traceback" in result.err) == (2, "", False)
    assert " ".join(message.split()) in result.text
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("command", "options"),
    [
        ("resume", ("--retry", "all")),
        ("resume", ("--case-time", "5")),
        ("resume", ("--allow-changed",)),
        ("append", ("2", "--allow-changed")),
    ],
)
def test_options_of_campaigns_are_rejected_for_studies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, options: tuple[str, ...]
) -> None:
    monkeypatch.setattr("marsyard.cli.studies.contains_study", lambda directory: directory == tmp_path)
    result = marsyard(command, tmp_path, *options)
    assert result.status == 2
    name = next(option for option in options if option.startswith("--"))
    assert f"{name}: not for studies; {tmp_path} contains a study" in result.text


def test_internal_error_has_status_2(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("marsyard.scenarios.systems.catalogue", lambda: 1 / 0)
    result = marsyard("list")
    assert result.status == 2
    assert "ZeroDivisionError" in result.err


@pytest.mark.slow
def test_default_output_folder_is_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = write_campaign(tmp_path, dispersions="", requirement="")
    for _ in range(2):
        assert marsyard("run", path, "-n", 1, "--set", "retain.showcase=none", "--jobs", 1).status == 0
    folders = sorted(path.name for path in (tmp_path / "runs").iterdir())
    assert len(folders) == 2
    assert all(re.fullmatch(r"fake-\d{8}T\d{6}Z(-2)?", name) for name in folders)


def test_names_in_brackets_are_not_markup(tmp_path: Path) -> None:
    top_level_keys = TOP_LEVEL_KEYS.replace("a campaign without terrain", "[red]bold[/red] [oops")
    result = marsyard("show", write_campaign(tmp_path, top_level_keys=top_level_keys))
    assert "[red]bold[/red] [oops" in result.out


def test_version_and_doctor_print_their_output(monkeypatch: pytest.MonkeyPatch) -> None:
    assert re.fullmatch(r"marsyard \d+\.\d+\.\d+\n", marsyard("--version").out)
    monkeypatch.setattr("marsyard.doctor.run", lambda console, as_json: console.print("checked") or 1)
    result = marsyard("doctor")
    assert (result.status, result.out) == (1, "checked\n")


@pytest.mark.parametrize(
    ("command", "text", "allowed"),
    [("--help", "Exit status: 0 all requirements met", ()), ("list", "dimes-gusev", ("pydantic",))],
)
def test_short_commands_import_no_heavy_package(command: str, text: str, allowed: tuple[str, ...]) -> None:
    result = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "marsyard", command], capture_output=True, text=True
    )
    assert result.returncode == 0
    assert text in re.sub(r"[\s│]+", " ", result.stdout)
    for package in {"numpy", "pandas", "scipy", "joblib", "pydantic", "matplotlib"} - set(allowed):
        assert not re.search(rf"\| +{package}\n", result.stderr)


def test_invalid_campaign_is_rejected_before_slow_imports(tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_text('name = "bad"\nscenario = "descent"\ncases = 1\n[parameters.camera]\nfocal_length_mmm = 1\n')
    command = [sys.executable, "-X", "importtime", "-m", "marsyard", "run", str(path)]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 2
    assert "did you mean 'focal_length_mm'?" in result.stderr
    for package in ("pandas", "matplotlib", "pyarrow", "joblib", "trimesh", "networkx", "rasterio", "pyrender"):
        assert f" {package}\n" not in result.stderr


@pytest.mark.slow
def test_terminal_shows_a_progress_bar(tmp_path: Path) -> None:
    path = write_campaign(tmp_path, dispersions="", requirement="")
    command = [sys.executable, "-m", "marsyard", "run", str(path), "-n", "2", "--jobs", "1"]
    command += ["--out", str(tmp_path / "run")]
    environment = {**os.environ, "FORCE_COLOR": "1", "TERM": "xterm", "COLUMNS": "100"}
    result = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert result.returncode == 0, result.stderr
    assert "2/2" in result.stderr
    assert "total 0:" in result.stderr
    assert "━" in result.stderr
