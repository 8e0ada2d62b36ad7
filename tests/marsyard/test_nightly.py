"""`marsyard nightly` as a user runs it."""

from __future__ import annotations

import json
import sqlite3
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import ConfigurationError
from marsyard.cli import app as cli
from marsyard.cli import nightly_plan
from marsyard.cli.nightly_plan import PLAN_FILE, definition_of, night_seed, read_plan
from tests.campaigns.fake_campaign import DISPERSIONS, REQUIREMENT, write_campaign

pytestmark = [
    pytest.mark.filterwarnings("ignore:Failed to kill subprocesses"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning:matplotlib"),
]
Nightly = Callable[..., tuple[int, str]]


@pytest.fixture
def nightly(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Nightly:
    """Runs a night of a plan of one campaign; returns its status and its page."""
    (tmp_path / "plan.toml").write_text('[[campaigns]]\ncampaign = "fake.toml"\ncases = 60\n')

    def run(**parameters: object) -> tuple[int, str]:
        stated = "\n".join(f"{name} = {value}" for name, value in parameters.items())
        asked = REQUIREMENT.replace("0.99", "0.5").replace("5.0", "3.0")
        write_campaign(tmp_path, stated, requirement=asked, dispersions=DISPERSIONS)
        command = ["marsyard", "nightly", str(tmp_path / "plan.toml"), "--out", str(tmp_path / "out"), "--jobs", "1"]
        monkeypatch.setattr(sys, "argv", command)
        with pytest.raises(SystemExit) as ended:
            cli.main()
        capfd.readouterr()
        return int(ended.value.code or 0), (tmp_path / "out" / "nightly.md").read_text()

    return run


def test_an_algorithm_made_worse_is_named_with_its_metric(
    nightly: Nightly, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    status, first = nightly()
    assert "No figure has a history" in first
    assert (tmp_path / "out" / "site" / "index.html").is_file()
    record = json.loads((tmp_path / "out" / "runs" / "night-00001-fake" / "campaign.json").read_text())
    assert record["exit_code"] == status
    # Worse by what the campaign does not state, as an algorithm's code would be.
    monkeypatch.setenv("FAKE_ERROR_SCALE", "4.0")
    worse, second = nightly()
    assert "2 regressions" in second or "1 regression" in second
    assert "**fake: velocity error (m/s)**" in second
    assert (status in (0, 3), worse) == (True, 1)
    connection = sqlite3.connect(tmp_path / "out" / "history.sqlite")
    nights = connection.execute("SELECT state FROM nights").fetchall()
    connection.close()
    assert nights == [("finished",), ("finished",)]


def test_a_campaign_that_cannot_be_run_costs_the_night_no_other(nightly: Nightly, tmp_path: Path) -> None:
    (tmp_path / "plan.toml").write_text(
        '[[campaigns]]\ncampaign = "nonesuch"\n\n[[campaigns]]\ncampaign = "fake.toml"\ncases = 6\n'
    )
    status, text = nightly()
    assert status == 1
    assert "NOT RUN" in text
    assert "nonesuch" in text
    assert "| fake |" in text


def test_a_killed_night_is_visible_and_compared_with_nothing(
    nightly: Nightly, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Killed(BaseException):
        """What no handler catches, as SIGKILL."""

    def kill(*_: object) -> None:
        raise Killed

    with monkeypatch.context() as now:
        now.setattr(nightly_plan, "run_planned", kill)
        with pytest.raises(Killed):
            nightly()
    assert (tmp_path / "out" / "nightly.md").read_text().startswith("# Night 1: RUNNING")
    _, page = nightly()
    assert page.startswith("# Night 2:")
    assert "Night 1, begun" in page
    assert "was interrupted" in page
    assert "No figure has a history" in page
    with monkeypatch.context() as now:
        now.setattr(nightly_plan, "run_planned", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        status, page = nightly()
    assert (status, page.splitlines()[0]) == (130, "# Night 3: INTERRUPTED")


def test_nights_draw_cases_of_their_own(tmp_path: Path) -> None:
    assert len({night_seed(seed, night) for seed in range(20) for night in range(50)}) == 1000
    path = write_campaign(tmp_path)
    one, other = (load_campaign(str(path), seed=seed) for seed in (1, 2))
    assert definition_of(one) == definition_of(other)
    assert definition_of(one) != definition_of(load_campaign(str(path), ["altitude_m=1500"]))


def test_the_shipped_plan_names_campaigns_that_are_there() -> None:
    for planned in read_plan(PLAN_FILE).campaigns:
        planned.load(0, 1, PLAN_FILE.parent)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "campaigns"),
        ("not toml", "not valid TOML"),
        ('[[campaigns]]\ncampaign = "a"\ncase = 3\n', "campaigns[0].case"),
        ('[[campaigns]]\ncampaign = "a"\n[[campaigns]]\ncampaign = "a"\n', "twice"),
    ],
)
def test_a_plan_that_is_none_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "plan.toml").write_text(text)
    with pytest.raises(ConfigurationError) as raised:
        read_plan(tmp_path / "plan.toml")
    assert message in str(raised.value)
