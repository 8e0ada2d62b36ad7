"""Attempts to obtain PASS for an algorithm that failed its confirmation: none ends with exit status 0 or plain PASS.

Each attempt starts with a repository whose committed record contains a confirmation with FAIL (`failed`), and ends with
commands of which the cases alone would meet the requirement.
"""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from marsyard.campaigns.store.confirmation_record import read_record
from tests.command import Output
from tests.marsyard.confirmation_project import (
    BAD_LUCK,
    CALIBRATION,
    CAMPAIGN,
    RECORD,
    Command,
    commit_all,
    copy_project,
    create_project,
    git,
    is_unqualified_pass,
    make_command,
)

CONFIRM = ("run", "fake.toml", "--confirm", "--jobs", 1, "--out")
#: Exit status and status of the requirement of each command of an attempt.
Expected = list[tuple[int, str]]
Attempt = Callable[[Command, Path], list[Output]]


@pytest.fixture(scope="module")
def failed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the repository that the tests copy; the first test that uses it runs the failed confirmation."""
    return tmp_path_factory.mktemp("failed")


@pytest.fixture
def project(failed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Copy the repository with the failed confirmation `run-failed`, whose record is committed."""
    if not (failed / "run-failed" / "report.html").exists():
        create_project(failed)
        with monkeypatch.context() as context:
            context.setenv(*BAD_LUCK)
            output = make_command(context, failed)(*CONFIRM, "run-failed")
        assert (output.status, "verdict: FAIL" in output.out) == (1, True)
        commit_all(failed)
    copy_project(failed, tmp_path)
    return tmp_path


def repeat(marsyard: Command, folder: Path) -> list[Output]:
    # the joint rates are 50 % and 90 % of the required 75 %; all cases of both runs succeed
    return [marsyard(*CONFIRM, folder / "run-2"), marsyard(*CONFIRM, folder / "run-3", "-n", 80)]


def delete_the_record(marsyard: Command, folder: Path) -> list[Output]:
    (folder / RECORD).unlink()
    outputs = [marsyard(*CONFIRM, folder / "run-deleted")]
    (folder / RECORD).unlink()
    commit_all(folder)
    marsyard("confirmations", "--create")
    commit_all(folder)
    return [*outputs, marsyard(*CONFIRM, folder / "run-created")]


def select_another_record(marsyard: Command, folder: Path) -> list[Output]:
    outputs = [marsyard(*CONFIRM, folder / "run-other", "--confirmations", folder / "other.jsonl")]
    path = folder / "other" / RECORD
    path.parent.mkdir()
    path.touch()
    commit_all(folder)
    return [*outputs, marsyard(*CONFIRM, folder / "run-sibling", "--confirmations", path)]


def use_a_record_of_another_repository(marsyard: Command, folder: Path) -> list[Output]:
    path = folder.parent / f"{folder.name}-other" / RECORD
    path.parent.mkdir()
    path.touch()
    git(path.parent, "init", "-q")
    commit_all(path.parent)
    return [marsyard(*CONFIRM, folder / "run-other", "--confirmations", path)]


def rename_the_campaign(marsyard: Command, folder: Path) -> list[Output]:
    (folder / "fake.toml").write_text(CAMPAIGN.replace('name = "fake"', 'name = "better"'))
    return [marsyard(*CONFIRM, folder / "run-renamed")]


def rename_the_class(marsyard: Command, folder: Path) -> list[Output]:
    (folder / "estimator.py").write_text("class Better:\n    pass\n")
    (folder / "fake.toml").write_text(CAMPAIGN.replace("estimator:Estimator", "estimator:Better"))
    commit_all(folder)
    return [marsyard(*CONFIRM, folder / "run-renamed")]


def rename_the_module(marsyard: Command, folder: Path) -> list[Output]:
    (folder / "estimator.py").rename(folder / "renamed.py")
    (folder / "fake.toml").write_text(CAMPAIGN.replace("estimator:Estimator", "renamed:Estimator"))
    return [marsyard(*CONFIRM, folder / "run-renamed")]


def set_a_parameter(marsyard: Command, folder: Path) -> list[Output]:
    return [marsyard(*CONFIRM, folder / "run-set", "--set", "error_scale=0.5")]


def rename_a_copy_and_its_texts(marsyard: Command, folder: Path) -> list[Output]:
    text = CAMPAIGN.replace('"fake"', '"copy"').replace("high = 99", 'high = 99, source = "other", unit = "-"')
    (folder / "fake.toml").write_text(f'description = "other"\n{text}')
    return [marsyard(*CONFIRM, folder / "run-copy")]


def rename_a_copy_and_change_a_width(marsyard: Command, folder: Path) -> list[Output]:
    text = CAMPAIGN.replace('"fake"', '"copy"').replace("high = 99", "high = 98")
    (folder / "estimator.py").write_text("class Better:\n    version = 2\n")
    (folder / "fake.toml").write_text(text.replace("VELOCITY", "V").replace("estimator:Estimator", "estimator:Better"))
    commit_all(folder)
    return [marsyard(*CONFIRM, folder / "run-copy")]


def weaken_the_requirement_in_a_copy(marsyard: Command, folder: Path) -> list[Output]:
    text = CAMPAIGN.replace("probability = 0.75", "probability = 0.5").replace('"fake"', '"copy"')
    (folder / "copy.toml").write_text(text.replace("VELOCITY", "VELOCITY-2"))
    commit_all(folder)
    return [marsyard("run", "copy.toml", "--confirm", "--jobs", 1, "--out", folder / "run-copy")]


def edit_the_record(marsyard: Command, folder: Path) -> list[Output]:
    path = folder / RECORD
    path.write_text(
        path.read_text().replace('"FAIL"', '"PASS"').replace("[0, 1, 0, 0, 0, 0, 10]", "[1, 0, 0, 0, 0, 0, 10]")
    )
    # the last line was changed: its entry is valid, but git knows another version
    outputs = [marsyard(*CONFIRM, folder / "run-last-line")]
    path.write_text(path.read_text().replace('"number": 1, "seed"', '"number": 1,  "seed"', 1))
    return [*outputs, marsyard(*CONFIRM, folder / "run-edited"), marsyard("report", folder / "run-last-line")]


def shorten_the_record(marsyard: Command, folder: Path) -> list[Output]:
    path = folder / RECORD
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))
    return [marsyard(*CONFIRM, folder / "run-shortened")]


def stop_a_bad_run(marsyard: Command, folder: Path) -> list[Output]:
    """A claim with PASS; a second confirmation of it was started and stopped."""
    (folder / "estimator.py").write_text("class Estimator:\n    version = 2\n")
    marsyard(*CONFIRM, folder / "run-2")
    marsyard(*CONFIRM, folder / "run-3")
    path = folder / RECORD
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))  # as if the second run had been killed
    return [marsyard("report", folder / "run-2"), marsyard(*CONFIRM, folder / "run-4", "-n", 9)]


def reuse_a_seed(marsyard: Command, folder: Path) -> list[Output]:
    entry = read_record(folder / RECORD).confirmations[0]
    bank = f"bank_seed={entry.bank_seeds['bank_seed']}"
    same = ("run", "fake.toml", "--seed", entry.seed, "--jobs", 1, "--set", bank, "--out")
    return [
        marsyard(*same, folder / "run-repeated"),
        marsyard(*same, folder / "run-changed", "--set", "error_scale=0.5"),
    ]


def confirm_on_terrains_of_the_calibration(marsyard: Command, folder: Path) -> list[Output]:
    text = CAMPAIGN.replace("[dispersions]", "is_imported = true\n[dispersions]")
    (folder / "fake.toml").write_text(
        text.replace('"fake"', '"imported"') + CALIBRATION.replace('"fake"', '"imported"')
    )
    commit_all(folder)
    return [marsyard(*CONFIRM, folder / "run-imported")]


FAIL, UNREGISTERED, OTHER_CLAIMS = (1, "FAIL"), (4, "PASS (unregistered)"), (4, "PASS (other claims)")
INSUFFICIENT, INVALID = (3, "INSUFFICIENT"), (2, "")
ATTEMPTS: list[tuple[Attempt, Expected, str]] = [
    (repeat, [FAIL, FAIL], "Confirmation 1 of this claim resulted in FAIL, which is final"),
    (delete_the_record, [UNREGISTERED, UNREGISTERED], "No record of earlier runs is known here"),
    (select_another_record, [UNREGISTERED, UNREGISTERED], "No record of earlier runs is known here"),
    (use_a_record_of_another_repository, [UNREGISTERED], "is not in the git repository of"),
    (rename_the_campaign, [FAIL], "joint evidence of the confirmations 1, 2 of this claim"),
    (rename_the_class, [OTHER_CLAIMS], "Other claims: 1: fake with estimator:Estimator"),
    (rename_the_module, [FAIL], "joint evidence of the confirmations 1, 2 of this claim"),
    (set_a_parameter, [OTHER_CLAIMS], "VELOCITY FAIL"),
    (rename_a_copy_and_its_texts, [FAIL], "joint evidence of the confirmations 1, 2 of this claim"),
    (rename_a_copy_and_change_a_width, [OTHER_CLAIMS], "Other claims: 1: fake"),
    (weaken_the_requirement_in_a_copy, [OTHER_CLAIMS], "Other claims: 1: fake"),
    (edit_the_record, [UNREGISTERED, INVALID, INSUFFICIENT], "is not the beginning of"),
    (shorten_the_record, [UNREGISTERED], "is not the beginning of"),
    (stop_a_bad_run, [INSUFFICIENT, INVALID], "Confirmation 2 was started on"),
    (reuse_a_seed, [FAIL, INSUFFICIENT], "resulted in FAIL, which is final"),
    (confirm_on_terrains_of_the_calibration, [INSUFFICIENT], "100 % of its cases are on terrains of calibration runs"),
]


#: A scenario with one more parameter.
OTHER_SCENARIO = """
from tests.campaigns.fake_scenario import TestedParameters, TestedScenario

class OtherParameters(TestedParameters):
    gravity_m_s2: float = 3.71

class World(TestedScenario):
    parameters_type = OtherParameters
"""
#: Attempts of the suite; the others are made in `make validate`.
QUICK = {"repeat", "rename_a_copy_and_change_a_width", "delete_the_record", "reuse_a_seed", "edit_the_record"}


@pytest.mark.parametrize(
    ("attempt", "expected", "text"),
    [
        pytest.param(*values, id=values[0].__name__, marks=[] if values[0].__name__ in QUICK else pytest.mark.slow)
        for values in ATTEMPTS
    ],
)
def test_attempt_gives_no_unqualified_pass(
    project: Path, monkeypatch: pytest.MonkeyPatch, attempt: Attempt, expected: Expected, text: str
) -> None:
    outputs = attempt(make_command(monkeypatch, project), project)
    assert not any(map(is_unqualified_pass, outputs)), [output.out for output in outputs]
    statuses = [status for _, status in expected if status]
    assert [output.status for output in outputs] == [status for status, _ in expected], outputs
    assert any(text in output.text for output in outputs), outputs
    for output, status in zip([output for output in outputs if output.status != 2], statuses, strict=True):
        assert f"verdict: {status}" in output.text


def test_cases_of_the_attempts_alone_would_pass(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The repository of the attempts gives PASS for a campaign of another scenario."""
    (project / "world.py").write_text(OTHER_SCENARIO)
    text = CAMPAIGN.replace('"fake"', '"new"').replace("tests.campaigns.fake_scenario:TestedScenario", "world:World")
    (project / "fake.toml").write_text(text)
    output = make_command(monkeypatch, project)(*CONFIRM, project / "run-new")
    assert (output.status, is_unqualified_pass(output), "verdict: PASS" in output.out) == (0, True, True)
    report = json.loads((project / "run-new" / "report.json").read_text())
    assert (report["verdict"], report["exit_code"]) == ("PASS", 0)
    assert "Other claims: 1" in report["evidence"]["text"]
