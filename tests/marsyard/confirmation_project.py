"""A git repository with a campaign, an algorithm and a record of confirmations, for the tests of confirmations."""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from marsyard.campaigns.definition.evidence import Evidence
from tests.command import Output, marsyard
from tests.inline_workers import use_inline_workers

#: The lower bound of 10 cases without failure is 0.1^(1/10) = 79 % at 90 % confidence: PASS.
CAMPAIGN = """
name = "fake"
scenario = "tests.campaigns.fake_scenario:TestedScenario"
cases = 10
seed = 5

[parameters]
algorithm = "estimator:Estimator"

[dispersions]
terrain = { distribution = "in-turn", low = 0, high = 99 }

[[requirements]]
id = "VELOCITY"
statement = "The error is small."
metric = "velocity_error_m_s"
bound = 1000.0
probability = 0.75
confidence = 0.9
"""
CALIBRATION = """
[[calibration.runs]]
options = ["error_scale"]
campaign = "fake"
seed = 5
note = "the scale was adjusted to these cases"
"""
#: Variable of the fake scenario, and its value with which all cases fail: a bad result by chance.
BAD_LUCK = ("FAKE_ERROR_SCALE", "1e9")
RECORD = "confirmations.jsonl"
Command = Callable[..., Output]


def is_unqualified_pass(output: Output) -> bool:
    """Whether the exit status is 0, or the headline or a requirement is PASS without a qualification."""
    lines = [line.strip() for line in output.out.splitlines()]
    rows = [line.split() for line in lines if line.startswith("VELOCITY")]
    is_pass = any("PASS" in row[1:2] and "(" not in row[2] for row in rows)
    return output.status == 0 or "verdict: PASS" in lines or is_pass


def git(folder: Path, *arguments: str) -> None:
    """Run git in a folder."""
    identity = ("-c", "user.name=Test", "-c", "user.email=test@example.org")
    subprocess.run(["git", "-C", str(folder), *identity, *arguments], check=True, capture_output=True)


def commit_all(folder: Path) -> None:
    """Commit all files except the folders of runs."""
    git(folder, "add", "-A", "--", ".", ":!run-*")
    git(folder, "commit", "-q", "--allow-empty", "-m", "state")


def create_project(folder: Path) -> None:
    """Create a repository with a campaign, an algorithm, and an empty record, all committed."""
    (folder / "fake.toml").write_text(CAMPAIGN)
    (folder / "estimator.py").write_text("class Estimator:\n    pass\n")
    (folder / RECORD).touch()
    git(folder, "init", "-q")
    commit_all(folder)


def make_command(monkeypatch: pytest.MonkeyPatch, folder: Path) -> Command:
    """Return a function that runs the command line in a folder, with cases in the process of the test."""
    use_inline_workers(monkeypatch)
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))

    def run_command(*arguments: object) -> Output:
        for name in ("estimator", "renamed"):  # imported from the folder of another test
            sys.modules.pop(name, None)
        return marsyard(*arguments)

    return run_command


def copy_project(source: Path, target: Path) -> None:
    """Copy a repository with its runs; the records of the runs then name the record of the copy."""
    shutil.copytree(source, target, dirs_exist_ok=True)
    for path in target.glob("run-*/campaign.json"):
        path.write_text(path.read_text().replace(str(source.resolve()), str(target.resolve())))


def read_evidence(directory: Path) -> Evidence:
    """Read the kind of evidence of a run from its record."""
    return Evidence.read(json.loads((directory / "campaign.json").read_text())["evidence"])


def read_statuses(directory: Path) -> list[str]:
    """Read the statuses of the requirements from a report."""
    return [verdict["status"] for verdict in json.loads((directory / "report.json").read_text())["verdicts"]]


def confirm(marsyard: Command, name: str, *arguments: object) -> tuple[int, list[str]]:
    """Run a confirmation in the folder `name`; return its exit status and the statuses of its requirements."""
    output = marsyard("run", "fake.toml", "--confirm", "--jobs", 1, "--out", name, *arguments)
    return output.status, read_statuses(Path(name)) if Path(name, "report.json").exists() else []
