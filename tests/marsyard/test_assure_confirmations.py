"""Tests of assurance packages of confirmations: the record is part of the package, and a changed entry is found."""

import json
import shutil
from pathlib import Path

import pytest

from marsyard.reports.assurance.package import MANIFEST, hash_files
from tests.marsyard.confirmation_project import RECORD, Command, create_project, make_command


@pytest.fixture
def marsyard(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Command:
    """Create a repository with a campaign, and return a function that runs the command line in it."""
    create_project(tmp_path)
    return make_command(monkeypatch, tmp_path)


def rehash(folder: Path) -> None:
    manifest = json.loads((folder / MANIFEST).read_text())
    (folder / MANIFEST).write_text(json.dumps(manifest | {"files": hash_files(folder)}))


def test_record_of_confirmations_is_verified_without_its_repository(
    marsyard: Command, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    assert marsyard("run", "fake.toml", "--confirm", "--jobs", 1, "--out", "run").status == 0
    output = marsyard("assure", "run", "--out", "package")
    assert (output.status, "fake: PASS, 10 cases" in output.out) == (0, True)
    # a registered confirmation shows that its cases are new; other defeaters remain
    assert "claim: supported, with open defeaters" in output.out
    case = json.loads(Path("package/case.json").read_text())
    statements = {item["statement"]: item for item in case["elements"]}
    (text,) = [text for text in statements if text.startswith("Confirmations of claim")]
    assert "VELOCITY PASS" in text
    assert statements[text]["evidence"] == f"runs/fake/{RECORD}"
    # elsewhere, without the repository and its record
    elsewhere = Path(shutil.copytree("package", tmp_path_factory.mktemp("elsewhere") / "package"))
    (tmp_path / RECORD).unlink()
    assert marsyard("assure", "--verify", elsewhere).status == 0
    # one result is removed, or changed, with a new hash
    record = elsewhere / "runs/fake" / RECORD
    lines = record.read_text().splitlines(keepends=True)
    for changed, named in (
        ([line.replace('"cases": 10', '"cases": 12') for line in lines], "the chain of hashes is broken"),
        (lines[:1], f"runs/fake/{RECORD}: the record does not contain confirmation 1"),
    ):
        record.write_text("".join(changed))
        rehash(elsewhere)
        output = marsyard("assure", "--verify", elsewhere)
        assert output.status == 1
        assert named in output.out
