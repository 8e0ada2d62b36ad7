"""Tests that the commands which read a campaign's folder execute nothing that the folder names."""

import json
import pickle
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.campaigns.fake_campaign import RecordingWatch, run, write_campaign
from tests.command import marsyard
from tests.inline_workers import use_inline_workers

#: A module that leaves a file when it is imported, or an object of it is constructed.
TRAP = """
from pathlib import Path
Path("executed").write_text("imported")
class Scenario: ...
class Estimator: ...
"""
#: Parameters of a stored campaign, by scenario, whose values name code.
NAMES: Mapping[str, dict[str, Any]] = {
    "trap:Scenario": {},
    "descent": {"algorithm": "trap:Estimator", "compared": ["trap.pkl:Estimator", "exec:./trap.sh"]},
    "landing": {"algorithm": "trap.pkl:Estimator", "compared": ["trap:Estimator"]},
    "rover": {"algorithm": "trap:Estimator", "compared": []},
    "localisation": {"algorithm": "trap:Estimator", "compared": []},
}
PARTS = {"flight": {"motion": "trap:Estimator"}, "scores": ["trap:Estimator"]}


class Trap:
    """An object that leaves a file when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return exec, ("open('executed', 'w').write('unpickled')",)


pytestmark = pytest.mark.usefixtures("_own_folder")


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run a campaign as the user whose state is next to its folder."""
    folder = tmp_path_factory.mktemp("original")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(folder / "state"))
        use_inline_workers(patch)
        return run(write_campaign(folder), folder / "run", RecordingWatch())


@pytest.fixture
def _own_folder(original: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setenv("XDG_STATE_HOME", str(original.parent / "state"))


@pytest.fixture
def folders(original: Path, tmp_path: Path) -> dict[str, Path]:
    """Folders of campaigns that name code which leaves a file when it is executed, by scenario."""
    (tmp_path / "trap.py").write_text(TRAP)
    (tmp_path / "trap.pkl").write_bytes(pickle.dumps(Trap()))
    (tmp_path / "trap.sh").write_text("#!/bin/sh\ntouch executed\n")
    (tmp_path / "trap.sh").chmod(0o755)
    folders = {}
    for number, (scenario, names) in enumerate(NAMES.items()):
        folders[scenario] = shutil.copytree(original, tmp_path / f"run-{number}")
        record = json.loads((original / "campaign.json").read_text())
        record["definition"] |= {"scenario": scenario, "parameters": names | PARTS}
        record["changes"] = [{"utc": "", "cases_before": 0, "in": ["the definition"]}]
        for entry in record["algorithms"]:
            entry |= {"spec": "trap:Estimator", "path": "trap:Estimator"}
        (folders[scenario] / "campaign.json").write_text(json.dumps(record))
    return folders


def test_reading_commands_execute_nothing(folders: Mapping[str, Path], tmp_path: Path) -> None:
    names = [folder.name for folder in folders.values()]
    for words in (
        *(("report", name, "--csv") for name in names),
        ("compare", *names[:2]),
        ("dashboard", ".", "--out", "site"),
        ("merge", *names, "--out", "merged"),
    ):
        assert "Traceback" not in marsyard(*words).text, words
        assert not (tmp_path / "executed").exists(), words
    assert all((folder / "report.html").exists() for folder in folders.values())
    assert (tmp_path / "site" / "index.html").exists()


@pytest.mark.parametrize("scenario", ["trap:Scenario", "descent", "rover"])
def test_running_commands_refuse_code_from_elsewhere(
    folders: Mapping[str, Path], tmp_path: Path, scenario: str
) -> None:
    folder = folders[scenario]
    stored = (folder / "campaign.json").read_bytes()
    for command in (("replay", "0"), ("resume",), ("append", "2"), ("report", "--gallery")):
        output = marsyard(command[0], folder.name, *command[1:])
        assert (output.status, "was created or changed elsewhere" in output.text) == (2, True), output
        assert (folder / "campaign.json").read_bytes() == stored
        assert not (tmp_path / "executed").exists(), command


def test_folder_from_elsewhere_runs_with_trusted_code_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another user's folder is refused; with --trust it runs if its code is the recorded one."""
    use_inline_workers(monkeypatch)
    estimator = "class Estimator:\n    def estimate(self, measurements): raise AssertionError\n"
    (tmp_path / "trusted_estimator.py").write_text(estimator)
    (tmp_path / "fake.toml").write_text(
        'name = "fake"\nscenario = "tests.campaigns.fake_velocity:FakeVelocityScenario"\ncases = 1\n'
    )
    words = ("run", "fake.toml", "--algorithm", "trusted_estimator:Estimator", "--out", "run")
    assert marsyard(*words).status == 1
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "another user"))
    assert "was created or changed elsewhere" in marsyard("replay", "run", "0").text
    (tmp_path / "trusted_estimator.py").write_text(f"{estimator}# changed\n")
    output = marsyard("replay", "run", "0", "--trust")
    assert (output.status, "trusted_estimator:Estimator" in output.text) == (2, True)
    (tmp_path / "trusted_estimator.py").write_text(estimator)
    assert "the row equals the stored one" in marsyard("replay", "run", "0", "--trust").text
