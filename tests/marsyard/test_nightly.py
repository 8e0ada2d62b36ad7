"""Tests of `marsyard nightly`: plans, regressions, interrupted runs and seeds."""

import json
import sqlite3
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import DefinitionError
from marsyard.cli import nightly_run
from marsyard.cli.nightly_run import PLAN_FILE, hash_definition, night_seed, read_plan
from tests.campaigns.fake_campaign import DISPERSIONS, REQUIREMENT, write_campaign
from tests.command import marsyard

Nightly = Callable[..., tuple[int, str]]


@pytest.fixture
def nightly(tmp_path: Path) -> Nightly:
    """Return a function that runs a plan of one campaign and returns exit status and report (nightly.md)."""
    (tmp_path / "plan.toml").write_text('[[campaigns]]\ncampaign = "fake.toml"\ncases = 60\n')

    def run(**parameters: object) -> tuple[int, str]:
        parameter_lines = "\n".join(f"{name} = {value}" for name, value in parameters.items())
        requirement = REQUIREMENT.replace("0.99", "0.5").replace("5.0", "3.0")
        write_campaign(tmp_path, parameter_lines, requirement=requirement, dispersions=DISPERSIONS)
        status = marsyard("nightly", tmp_path / "plan.toml", "--out", tmp_path / "out", "--jobs", 1).status
        return status, (tmp_path / "out" / "nightly.md").read_text()

    return run


@pytest.mark.slow
def test_regression_is_reported_with_its_metric(
    nightly: Nightly, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    status, first_report = nightly()
    assert "No metric has a history" in first_report
    assert (tmp_path / "out" / "site" / "index.html").is_file()
    record = json.loads((tmp_path / "out" / "runs" / "night-00001-fake" / "campaign.json").read_text())
    assert record["exit_code"] == status
    # the environment variable imitates a change of the algorithm's code
    monkeypatch.setenv("FAKE_ERROR_SCALE", "4.0")
    second_status, second_report = nightly()
    assert "2 regressions" in second_report or "1 regression" in second_report
    assert "**fake: velocity error (m/s)**" in second_report
    assert (status in (0, 3), second_status) == (True, 1)
    connection = sqlite3.connect(tmp_path / "out" / "history.sqlite")
    states = connection.execute("SELECT state FROM nights").fetchall()
    connection.close()
    assert states == [("finished",), ("finished",)]


def test_invalid_campaign_does_not_stop_the_nightly_run(nightly: Nightly, tmp_path: Path) -> None:
    (tmp_path / "plan.toml").write_text(
        '[[campaigns]]\ncampaign = "unknown-campaign"\n\n[[campaigns]]\ncampaign = "fake.toml"\ncases = 6\n'
    )
    status, report = nightly()
    assert status == 1
    assert "NOT RUN" in report
    assert "unknown-campaign" in report
    assert "| fake |" in report


def test_checks_run_after_the_campaigns(nightly: Nightly, tmp_path: Path) -> None:
    commands = {
        "speed": [sys.executable, "-c", "import os; print('slow', os.getcwd()); raise SystemExit(1)"],
        "versions": [sys.executable, "-c", "print('up to date')"],
        "absent": [str(tmp_path / "absent")],
        "hanging": [sys.executable, "-c", "import time; time.sleep(60)"],
    }
    limits = dict.fromkeys(commands, 60.0) | {"hanging": 0.1}
    checks = "".join(
        f"[[checks]]\nname = {json.dumps(name)}\ncommand = {json.dumps(command)}\ntime_limit_s = {limits[name]}\n"
        for name, command in commands.items()
    )
    (tmp_path / "plan.toml").write_text(f'[[campaigns]]\ncampaign = "unknown-campaign"\n{checks}')
    status, report = nightly()
    assert status == 1
    assert f"| check: speed | FAIL | exit code 1: slow {tmp_path}; log: runs/night-00001-speed.log |" in report.replace(
        "\\", ""
    )
    assert "| check: versions | PASS | exit code 0: up to date" in report
    assert "| check: absent | NOT RUN |" in report
    assert "| check: hanging | NOT RUN |" in report
    assert (tmp_path / "out" / "runs" / "night-00001-versions.log").read_text() == "up to date\n"


@pytest.mark.slow
def test_killed_run_is_shown_and_not_compared(
    nightly: Nightly, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Killed(BaseException):
        """Exception that no handler catches; it imitates SIGKILL."""

    def kill(*_: object) -> None:
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(nightly_run, "run_scheduled_campaign", kill)
        with pytest.raises(Killed):
            nightly()
    assert (tmp_path / "out" / "nightly.md").read_text().startswith("# Night 1: RUNNING")
    _, report = nightly()
    assert report.startswith("# Night 2:")
    assert "Night 1, started" in report
    assert "was interrupted" in report
    assert "No metric has a history" in report

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(nightly_run, "run_scheduled_campaign", interrupt)
        status, report = nightly()
    assert (status, report.splitlines()[0]) == (130, "# Night 3: INTERRUPTED")


def test_seeds_differ_between_nightly_runs() -> None:
    assert len({night_seed(seed, night) for seed in range(20) for night in range(50)}) == 1000


def test_hash_of_a_definition_does_not_depend_on_the_seed(tmp_path: Path) -> None:
    path = write_campaign(tmp_path)
    first_campaign, second_campaign = (load_campaign(str(path), seed=seed) for seed in (1, 2))
    assert hash_definition(first_campaign) == hash_definition(second_campaign)
    assert hash_definition(first_campaign) != hash_definition(load_campaign(str(path), ["altitude_m=1500"]))


def test_campaigns_of_the_shipped_plan_load() -> None:
    for entry in read_plan(PLAN_FILE).campaigns:
        entry.load(0, 1, PLAN_FILE.parent)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "campaigns"),
        ("not toml", "not valid TOML"),
        ('[[campaigns]]\ncampaign = "a"\ncase = 3\n', "campaigns[0].case"),
        ('[[campaigns]]\ncampaign = "a"\n[[campaigns]]\ncampaign = "a"\n', "twice"),
        ('[[campaigns]]\ncampaign = "a"\n' + 2 * '[[checks]]\nname = "a"\ncommand = ["x"]\n', "used twice"),
        ('[[campaigns]]\ncampaign = "a"\n[[checks]]\nname = "a/b"\ncommand = ["x"]\n', "checks[0].name"),
    ],
)
def test_invalid_plans_are_rejected(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "plan.toml").write_text(text)
    with pytest.raises(DefinitionError) as error_info:
        read_plan(tmp_path / "plan.toml")
    assert message in str(error_info.value)
