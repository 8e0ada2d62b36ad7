"""Tests of confirmations: runs on calibration seeds give no PASS; confirmation runs are recorded and shown.

A confirmation (`marsyard run --confirm`) evaluates fixed options on a new seed. The seed is computed from namespace,
campaign and number of the confirmation. Algorithm, options and requirements are frozen: with others there is no PASS.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from marsyard.campaigns.definition.evidence import Evidence, EvidenceKind, confirmation_seed
from marsyard.campaigns.errors import StoreError
from marsyard.campaigns.store.confirmations import read_confirmations
from marsyard.cli import app as cli
from tests.campaigns.fake_campaign import TOP_LEVEL_KEYS, write_campaign

pytestmark = [
    pytest.mark.filterwarnings("ignore:Failed to kill subprocesses"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning:matplotlib"),
]
Command = Callable[..., tuple[int, str, str]]
#: The lower bound of 10 cases without failure is 0.1^(1/10) = 79 % at 90 % confidence (PASS), and 0.05^(1/10) = 74 % at
#: 95 % (INSUFFICIENT for two confirmations together).
REQUIREMENT = """
[[requirements]]
id = "VELOCITY"
statement = "The error is small."
metric = "velocity_error_m_s"
bound = 1000.0
probability = 0.75
confidence = 0.9
"""
CALIBRATION = """
[calibration]
namespace = "review-board"

[[calibration.runs]]
options = ["error_scale"]
campaign = "fake"
seed = 5
note = "the scale was adjusted to these cases"
"""


@pytest.fixture
def marsyard(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Command:
    """Return a function that runs the command line in an empty folder: exit code, standard output and error."""
    monkeypatch.chdir(tmp_path)

    def run_command(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["marsyard", *map(str, arguments)])
        with pytest.raises(SystemExit) as error_info:
            cli.main()
        captured = capfd.readouterr()
        return int(error_info.value.code or 0), captured.out, captured.err

    return run_command


@pytest.fixture
def campaign(tmp_path: Path) -> Path:
    """Write a campaign of 10 cases that all meet the requirement; the option `error_scale` is calibrated on seed 5."""
    return write_campaign(
        tmp_path,
        top_level_keys=TOP_LEVEL_KEYS.replace("cases = 12", "cases = 10"),
        dispersions='[dispersions]\nterrain = { distribution = "in-turn", low = 0, high = 9 }\n',
        requirement=REQUIREMENT,
        extra_tables=CALIBRATION,
    )


def _read_evidence(directory: Path) -> Evidence:
    return Evidence.read(json.loads((directory / "campaign.json").read_text())["evidence"])


def _read_statuses(directory: Path) -> list[str]:
    return [verdict["status"] for verdict in json.loads((directory / "report.json").read_text())["verdicts"]]


def test_run_on_a_seed_used_for_calibration_cannot_pass(campaign: Path, marsyard: Command, tmp_path: Path) -> None:
    status, out, _ = marsyard("run", campaign, "--out", tmp_path / "calibration", "--jobs", 1)
    assert (status, _read_statuses(tmp_path / "calibration")) == (3, ["INSUFFICIENT"])
    assert "The verdict would be PASS. Calibrated on these cases" in " ".join(out.split())
    assert "error_scale" in out
    assert _read_evidence(tmp_path / "calibration").kind is EvidenceKind.CALIBRATION
    # a seed on which no option was calibrated can pass
    status, out, _ = marsyard("run", campaign, "--seed", 6, "--out", tmp_path / "unused-seed", "--jobs", 1)
    assert (status, _read_statuses(tmp_path / "unused-seed")) == (0, ["PASS"])
    assert "evidence: Exploration" in out


def test_run_on_a_seed_used_for_calibration_can_fail(campaign: Path, marsyard: Command, tmp_path: Path) -> None:
    out = tmp_path / "run"
    arguments = ("run", campaign, "--set", "error_scale=1e9", "--out", out, "--jobs", 1)
    assert (marsyard(*arguments)[0], _read_statuses(out)) == (1, ["FAIL"])


def test_confirmation_passes_and_its_seed_cannot_be_used_for_other_options(
    campaign: Path, marsyard: Command, tmp_path: Path
) -> None:
    folders = {name: tmp_path / name for name in ("first", "changed", "repeated", "second")}
    seed = confirmation_seed("review-board", "fake", 1)
    status, out, _ = marsyard("run", campaign, "--confirm", "--out", folders["first"], "--jobs", 1)
    assert (status, _read_statuses(folders["first"])) == (0, ["PASS"])
    assert "evidence: Confirmation 1 in the namespace 'review-board'" in out
    assert json.loads((folders["first"] / "campaign.json").read_text())["seed"] == seed
    (entry,) = read_confirmations(tmp_path / "confirmations.jsonl")
    assert (entry.seed, entry.number, entry.cases, entry.results) == (seed, 1, 10, {"VELOCITY": "PASS"})

    # a run with another option on the same seed is marked as reuse of the seed and cannot be PASS
    arguments = ("run", campaign, "--set", "error_scale=0.5")
    status, out, _ = marsyard(*arguments, "--seed", seed, "--out", folders["changed"], "--jobs", 1)
    assert (status, _read_statuses(folders["changed"])) == (3, ["INSUFFICIENT"])
    assert "parameters.error_scale (1.0, now 0.5)" in " ".join(out.split())
    assert _read_evidence(folders["changed"]).kind is EvidenceKind.REUSED_SEED
    page = (folders["changed"] / "report.html").read_text()
    assert "reused confirmation seed 1" in page
    assert "parameters.error_scale (1.0, now 0.5)" in page

    # a second run with the same options is a repetition
    assert marsyard("run", campaign, "--seed", seed, "--out", folders["repeated"], "--jobs", 1)[0] == 0
    assert _read_evidence(folders["repeated"]).kind is EvidenceKind.REPETITION

    # the changed option needs a new confirmation seed; the output states the correction for two confirmations
    status, out, _ = marsyard(*arguments, "--confirm", "--out", folders["second"], "--jobs", 1)
    output = " ".join(out.split())
    assert (status, _read_evidence(folders["second"]).algorithm_confirmations) == (0, 2)
    assert "up to 2 times that of one" in output
    assert "for all 2 confirmations together (each at 95.00 %): INSUFFICIENT" in output
    second = json.loads((folders["second"] / "campaign.json").read_text())
    assert second["seed"] == confirmation_seed("review-board", "fake", 2)
    status, out, _ = marsyard("confirmations", "--json")
    assert (status, [entry["results"] for entry in json.loads(out)]) == (0, [{"VELOCITY": "PASS"}] * 2)
    assert marsyard("confirmations")[1].count("PASS") == 2

    # requirements that were not frozen with the confirmation give no PASS
    requirements = tmp_path / "requirements.toml"
    requirements.write_text(REQUIREMENT.replace("0.75", "0.7") + 'campaigns = ["fake"]\n')
    status, out, _ = marsyard("report", folders["second"], "--requirements", requirements)
    assert (status, "requirements other than those of the campaign" in " ".join(out.split())) == (3, True)

    # the dashboard shows the kind of evidence
    assert marsyard("dashboard", tmp_path, "--out", tmp_path / "site")[0] == 0
    index = (tmp_path / "site" / "index.html").read_text()
    assert all(
        title in index for title in ("confirmation 1", "not the frozen evaluation", "reused confirmation seed 1")
    )
    assert "not the frozen evaluation" in (tmp_path / "site" / "verification.csv").read_text()


@pytest.mark.slow
def test_run_on_the_seed_of_a_later_confirmation_is_recognised(
    campaign: Path, marsyard: Command, tmp_path: Path
) -> None:
    seed = confirmation_seed("review-board", "fake", 3)
    status, out, _ = marsyard("run", campaign, "--seed", seed, "--out", tmp_path / "early", "--jobs", 1)
    assert (status, "run without --confirm" in " ".join(out.split())) == (3, True)


def test_changed_code_invalidates_a_confirmation(campaign: Path, marsyard: Command, tmp_path: Path) -> None:
    directory = tmp_path / "run"
    marsyard("run", campaign, "--confirm", "--out", directory, "--jobs", 1)
    path = directory / "campaign.json"
    record = json.loads(path.read_text())
    record["changes"] = [{"utc": "", "cases_before": 3, "in": ["code (abc, now def)"]}]
    path.write_text(json.dumps(record))
    status, out, _ = marsyard("report", directory)
    assert (status, "code (abc, now def)" in " ".join(out.split())) == (3, True)


def test_errors_are_reported_before_the_first_case(campaign: Path, marsyard: Command, tmp_path: Path) -> None:
    status, _, err = marsyard("run", campaign, "--confirm", "--seed", 3)
    assert (status, "--confirm and --seed cannot be combined" in err) == (2, True)
    (tmp_path / "confirmations.jsonl").write_text("{}\n")
    status, _, err = marsyard("run", campaign, "--confirm", "--out", tmp_path / "run")
    assert (status, "confirmations.jsonl:1 is not an entry" in err) == (2, True)
    with pytest.raises(StoreError, match="not an entry"):
        read_confirmations(tmp_path / "confirmations.jsonl")
    status, _, err = marsyard("confirmations", tmp_path / "none.jsonl")
    assert (status, "no such file" in err) == (2, True)
    text = campaign.read_text().replace('options = ["error_scale"]', 'options = ["eror_scale"]')
    campaign.write_text(text)
    status, _, err = marsyard("run", campaign)
    assert (status, "calibration.runs[0].options[0]" in err, "error_scale" in err) == (2, True, True)


@pytest.mark.slow
def test_interrupted_confirmation_stays_in_the_record(campaign: Path, marsyard: Command, tmp_path: Path) -> None:
    """A run that stopped after it had reserved its seed counts in the correction of the next confirmation."""
    marsyard("run", campaign, "--confirm", "--out", tmp_path / "first", "--jobs", 1)
    path = tmp_path / "confirmations.jsonl"
    path.write_text(path.read_text().splitlines()[0] + "\n")
    marsyard("run", campaign, "--confirm", "--out", tmp_path / "second", "--jobs", 1)
    first, second = read_confirmations(path)
    assert (first.results, second.number, _read_evidence(tmp_path / "second").algorithm_confirmations) == (None, 2, 2)
