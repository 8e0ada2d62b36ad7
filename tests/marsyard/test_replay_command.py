"""Tests of `marsyard replay`: stored products are replaced only by complete new ones."""

import errno
import json
import os
import shutil
import sqlite3
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marsyard.campaigns.errors import StoreError
from marsyard.campaigns.store.products import load_products, pack_products, save_packed
from tests.campaigns.fake_campaign import RecordingWatch, run, sign_folder, write_campaign
from tests.command import run_command
from tests.inline_workers import inline_workers_fixture

_inline_workers = inline_workers_fixture()
SCENARIO = """
from tests.campaigns.fake_scenario import FakeScenario

class MyScenario(FakeScenario):
    pass
"""


@pytest.fixture(scope="module")
def stored_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run a campaign whose scenario can be imported only from its own folder; keep all products."""
    folder = tmp_path_factory.mktemp("custom")
    (folder / "my_scenario.py").write_text(SCENARIO)
    path = write_campaign(folder)
    path.write_text(path.read_text().replace("tests.campaigns.fake_scenario:FakeScenario", "my_scenario:MyScenario"))
    working_folder = Path.cwd()
    os.chdir(folder)
    try:
        run(path, folder / "run", RecordingWatch(), "cases=2", "retain.products=all", jobs=1)
    finally:
        os.chdir(working_folder)
    assert (folder / "run" / "cases" / "0" / "products.json").exists()
    return folder / "run"


def _read_files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_missing_scenario_is_reported_and_changes_nothing(
    stored_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [entry for entry in sys.path if entry != str(stored_run.parent)])
    monkeypatch.delitem(sys.modules, "my_scenario", raising=False)
    files_before = _read_files(stored_run)
    for command in (("replay", stored_run, 0), ("resume", stored_run, "--allow-changed")):
        status, output = run_command(*command)
        assert status == 2
        assert "cannot import scenario 'my_scenario:MyScenario': No module named 'my_scenario'" in output
        assert "Traceback" not in output
    assert {name: text for name, text in _read_files(stored_run).items() if name != "campaign.lock"} == {
        name: text for name, text in files_before.items() if name != "campaign.lock"
    }


def test_missing_algorithm_is_reported_and_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from marsyard.campaigns.definition.identity import create_identity
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.campaigns.store import record
    from marsyard.campaigns.store.origin import describe_origin
    from marsyard.campaigns.store.rows import ROWS_FILE, create_store

    folder = tmp_path / "run"
    folder.mkdir()
    definition = load_campaign("dimes-smoke", [], 1).definition
    parameters = {**definition.parameters, "algorithm": "my_absent_module:Estimator"}
    create_store(folder / ROWS_FILE, {"identity": "x"})
    identity = create_identity(definition)
    definition = definition.model_copy(update={"parameters": parameters})
    record.write_first_record(folder, definition, identity, "nobody", origin=describe_origin(definition))
    files_before = _read_files(folder)
    status, output = run_command("replay", folder, 0)
    assert status == 2
    assert "cannot import algorithm 'my_absent_module:Estimator'" in output
    assert _read_files(folder) == files_before


def test_products_are_kept_if_the_replayed_case_fails(
    stored_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = shutil.copytree(stored_run, tmp_path / "run")
    monkeypatch.chdir(stored_run.parent)
    files_before = _read_files(copy / "cases")
    text = (copy / "campaign.json").read_text()
    changed_record = json.loads(text)
    changed_record["definition"]["parameters"]["raising_cases"] = [0]
    changed_record["changes"] = [{"utc": "", "cases_before": 1, "in": ["the definition"]}]
    (copy / "campaign.json").write_text(json.dumps(changed_record))
    sign_folder(copy)
    status, output = run_command("replay", copy, 0)
    assert status == 1
    assert "case 0: CRASHED" in output
    assert "keeps its previous products" in output
    assert _read_files(copy / "cases") == files_before
    (copy / "campaign.json").write_text(text)
    assert run_command("replay", copy, 0)[0] == 0


def test_read_only_folder_is_replayed_into_another(
    stored_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows are read from a copy because SQLite writes files. `os.access` is patched because tests may run as root."""
    copy = shutil.copytree(stored_run, tmp_path / "run")
    monkeypatch.chdir(stored_run.parent)
    original_access = os.access

    def deny_write_access(path: Path, mode: int, **options: bool) -> bool:
        is_denied = mode == os.W_OK and Path(path).is_relative_to(copy)
        return not is_denied and original_access(path, mode, **options)

    opened_files: list[str] = []
    original_connect = sqlite3.connect
    monkeypatch.setattr("os.access", deny_write_access)

    def record_open(name: str, **options: Any) -> sqlite3.Connection:
        opened_files.append(str(name))
        connection: sqlite3.Connection = original_connect(name, **options)
        return connection

    monkeypatch.setattr("marsyard.campaigns.store.rows.sqlite3.connect", record_open)
    status, output = run_command("replay", copy, 1, "--out", tmp_path / "out")
    assert (status, "the row equals the stored one" in output) == (0, True), output
    assert opened_files
    assert not any(str(copy) in name for name in opened_files)
    assert (tmp_path / "out" / "products.json").exists()


def test_products_are_replaced_completely_or_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "case"
    save_packed(folder, pack_products({"x": np.arange(3)}), {"case": 0})
    (folder / "note.txt").write_text("a file of the user")
    files_before = _read_files(folder)
    original_write_bytes = Path.write_bytes

    def raise_disk_full(path: Path, data: bytes) -> int:
        if path.name == "products.json":
            raise OSError(errno.ENOSPC, "No space left on device")
        return original_write_bytes(path, data)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", raise_disk_full)
        with pytest.raises(StoreError, match="No space left on device"):
            save_packed(folder, pack_products({"x": np.arange(4)}), {"case": 1})
    assert _read_files(folder) == files_before
    save_packed(folder, pack_products({"x": np.arange(4)}), {"case": 1})
    assert load_products(folder)["x"].size == 4
    assert set(_read_files(folder)) == set(files_before)
