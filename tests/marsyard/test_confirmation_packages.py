"""Tests of assurance packages of confirmations: the record, verified without its repository, and other claims."""

import json
import shutil
from pathlib import Path

import pytest

from marsyard.reports.assurance.package import MANIFEST, hash_files
from tests.marsyard.confirmation_project import BAD_LUCK, RECORD, Command, commit_all, confirm


def rehash(folder: Path) -> None:
    manifest = json.loads((folder / MANIFEST).read_text())
    (folder / MANIFEST).write_text(json.dumps(manifest | {"files": hash_files(folder)}))


def test_record_of_confirmations_is_verified_without_its_repository(
    confirmed: Command, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    output = confirmed("assure", "run-1", "--out", "package")
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
    assert confirmed("assure", "--verify", elsewhere).status == 0
    # one result is removed, or changed, with a new hash
    record = elsewhere / "runs/fake" / RECORD
    lines = record.read_text().splitlines(keepends=True)
    for changed, named in (
        ([line.replace('"cases": 10', '"cases": 12') for line in lines], "the chain of hashes is broken"),
        (lines[:1], f"runs/fake/{RECORD}: the record does not contain confirmation 1"),
    ):
        record.write_text("".join(changed))
        rehash(elsewhere)
        output = confirmed("assure", "--verify", elsewhere)
        assert output.status == 1
        assert named in output.out


def test_package_lists_other_claims_of_the_record(
    marsyard: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with monkeypatch.context() as patch:
        patch.setenv(*BAD_LUCK)
        assert confirm(marsyard, "run-1") == (1, ["FAIL"])
    (tmp_path / "estimator.py").write_text("class Estimator:\n    version = 2\n")
    commit_all(tmp_path)
    assert confirm(marsyard, "run-2") == (4, ["PASS (other claims)"])
    assert marsyard("assure", "run-2", "--out", "package").status == 0
    defeaters = [
        item["statement"]
        for item in json.loads(Path("package/case.json").read_text())["elements"]
        if item["type"] == "defeater"
    ]
    assert any(text.startswith("Other claims: 1: fake with estimator:Estimator") for text in defeaters)
    assert marsyard("assure", "--verify", "package").status == 0
    # the report conceals them
    path = Path("package/runs/fake/report.json")
    report = json.loads(path.read_text())
    report["evidence"]["notes"] = []
    report["verdicts"][0]["status"] = "PASS"
    path.write_text(json.dumps(report))
    rehash(Path("package"))
    output = marsyard("assure", "--verify", "package")
    assert output.status == 1
    assert "VELOCITY is PASS in spite of other claims" in output.out
    assert "report.json: evidence does not follow" in output.out
