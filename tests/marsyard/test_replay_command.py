"""`marsyard replay` changes a campaign's folder only where it has something better to put there."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from marsyard.campaigns.errors import StoreError
from marsyard.campaigns.store.products import load_products, pack_products, save_packed
from marsyard.cli.app import app
from tests.campaigns.fake_campaign import Silence, run, write_campaign

SCENARIO = """
from tests.campaigns.fake_scenario import FakeScenario

class Mine(FakeScenario):
    pass
"""


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished campaign of a scenario that is found from its own folder only, with the products of case 0."""
    folder = tmp_path_factory.mktemp("mine")
    (folder / "my_scenario.py").write_text(SCENARIO)
    path = write_campaign(folder)
    path.write_text(path.read_text().replace("tests.campaigns.fake_scenario:FakeScenario", "my_scenario:Mine"))
    before = Path.cwd()
    os.chdir(folder)
    try:
        run(path, folder / "run", Silence(), "cases=2", "retain.products=all", jobs=1)
    finally:
        os.chdir(before)
    assert (folder / "run" / "cases" / "0" / "products.json").exists()
    return folder / "run"


def reported(*words: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, list(map(str, words)))
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.output


def _content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_scenario_that_is_not_found_is_one_message_and_changes_nothing(
    stored: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [entry for entry in sys.path if entry != str(stored.parent)])
    monkeypatch.delitem(sys.modules, "my_scenario", raising=False)
    before = _content(stored)
    for command in (("replay", stored, 0), ("resume", stored, "--allow-changed")):
        status, output = reported(*command)
        assert status == 2
        assert "no scenario at 'my_scenario:Mine': No module named 'my_scenario'" in output
        assert "Traceback" not in output
    assert {name: text for name, text in _content(stored).items() if name != "campaign.lock"} == {
        name: text for name, text in before.items() if name != "campaign.lock"
    }


def test_an_algorithm_that_is_not_found_is_one_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from marsyard.campaigns.definition.identity import identity_of
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.campaigns.store import record
    from marsyard.campaigns.store.rows import ROWS_FILE, create_store

    folder = tmp_path / "run"
    folder.mkdir()
    configuration = load_campaign("dimes-smoke", [], 1).configuration
    parameters = {**configuration.parameters, "algorithm": "my_absent_module:Estimator"}
    create_store(folder / ROWS_FILE, {"identity": "x"})
    identity = identity_of(configuration)
    record.begin(folder, configuration.model_copy(update={"parameters": parameters}), identity, "nobody")
    before = _content(folder)
    status, output = reported("replay", folder, 0)
    assert status == 2
    assert "no algorithm at 'my_absent_module:Estimator'" in output
    assert _content(folder) == before


def test_products_are_kept_where_the_case_fails_this_time(
    stored: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = shutil.copytree(stored, tmp_path / "run")
    monkeypatch.chdir(stored.parent)
    before = _content(copy / "cases")
    text = (copy / "campaign.json").read_text()
    changed = json.loads(text)
    changed["configuration"]["parameters"]["raising_cases"] = [0]
    (copy / "campaign.json").write_text(json.dumps(changed))
    status, output = reported("replay", copy, 0)
    assert status == 1
    assert "case 0: CRASHED" in output
    assert "keeps the products that it had" in output
    assert _content(copy / "cases") == before
    (copy / "campaign.json").write_text(text)
    assert reported("replay", copy, 0)[0] == 0


def test_a_folder_that_cannot_be_written_to_is_replayed_into_another(
    stored: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows are read from a copy: SQLite would put files next to its log. (Tests may run as root, who may write.)"""
    copy = shutil.copytree(stored, tmp_path / "run")
    monkeypatch.chdir(stored.parent)
    access = os.access

    def refused(path: Path, mode: int, **options: bool) -> bool:
        hidden = mode == os.W_OK and Path(path).is_relative_to(copy)
        return not hidden and access(path, mode, **options)

    opened: list[str] = []
    connect = "marsyard.campaigns.store.rows.sqlite3.connect"
    original = sqlite3.connect
    monkeypatch.setattr("os.access", refused)

    def record_open(name: str, **options: Any) -> sqlite3.Connection:
        opened.append(str(name))
        connection: sqlite3.Connection = original(name, **options)
        return connection

    monkeypatch.setattr(connect, record_open)
    status, output = reported("replay", copy, 1, "--out", tmp_path / "out")
    assert (status, "the row equals the stored one" in output) == (0, True), output
    assert opened
    assert not any(str(copy) in name for name in opened)
    assert (tmp_path / "out" / "products.json").exists()


def test_products_are_replaced_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "case"
    save_packed(folder, pack_products({"x": np.arange(3)}), {"case": 0})
    (folder / "note.txt").write_text("the user's own")
    before = _content(folder)
    write = Path.write_bytes

    def full(path: Path, data: bytes) -> int:
        if path.name == "products.json":
            raise OSError(28, "No space left on device")
        return write(path, data)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_bytes", full)
        with pytest.raises(StoreError, match="No space left on device"):
            save_packed(folder, pack_products({"x": np.arange(4)}), {"case": 1})
    assert _content(folder) == before
    save_packed(folder, pack_products({"x": np.arange(4)}), {"case": 1})
    assert load_products(folder)["x"].size == 4
    assert set(_content(folder)) == set(before)
