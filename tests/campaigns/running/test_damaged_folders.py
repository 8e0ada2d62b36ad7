"""Tests of damaged campaign folders: commands use the folder again or report its damage."""

import errno
import json
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import typer

from marsyard.campaigns.definition.evidence import Evidence
from marsyard.campaigns.errors import CampaignError, DefinitionError, StoreError
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.execution.workers import LocalExecutor
from marsyard.campaigns.running.engine import resume_campaign
from marsyard.campaigns.running.replay import replay
from marsyard.campaigns.store import record
from marsyard.campaigns.store.rows import ROWS_FILE, RowStore, create_store
from marsyard.campaigns.store.table import write_table
from marsyard.cli.errors import handle_user_errors
from tests.campaigns.fake_campaign import CampaignFile, RecordingWatch, read_case_rows, run, sign_folder

#: Value of a key that the record does not have.
REMOVED = object()


@pytest.mark.parametrize(
    "entry",
    [
        5,
        {"kind": "unknown"},
        {"kind": "confirmation", "overlap": "much"},
        {"kind": "confirmation", "number": []},
        {"kind": "calibration", "changes": 5},
    ],
)
def test_invalid_evidence_in_a_record_is_an_exploration(entry: object) -> None:
    assert Evidence.read(entry) == Evidence()


@pytest.mark.usefixtures("inline_workers")
def test_run_killed_at_its_start_can_be_restarted(
    campaign_file: CampaignFile, tmp_path: Path, watch: RecordingWatch
) -> None:
    directory = tmp_path / "run"
    directory.mkdir()
    create_store(directory / ROWS_FILE, {"identity": "killed run"})
    with pytest.raises(StoreError, match="a run was stopped before its first case: start it again with --out"):
        resume_campaign(directory, ExecutorConfig(1), watch)
    run(campaign_file(), directory, watch, "cases=2")
    assert len(read_case_rows(directory)) == 2
    # a store with rows is never overwritten, even if its record is missing
    (directory / "campaign.json").unlink()
    for name in ("cases.parquet", "cases"):
        path = directory / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    with pytest.raises(StoreError, match=r"contains a campaign \(cases.sqlite\)"):
        run(campaign_file(), directory, watch, "cases=2")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("state", ["finished"], "state is not a text"),
        ("cases", "12", "cases is not a whole number"),
        ("cases_finished", True, "cases_finished is not a whole number"),
        ("sessions", {"a": 1}, "sessions is not a list"),
        ("sessions", [], "sessions is empty"),
        ("identity", "abc", "identity is not a table"),
        ("identity", {"definition": "a"}, "identity has no"),
        ("identity", {"definition": "a", "code": "b", "versions": {}}, "identity has no .* or inputs"),
        ("environment", 3, "environment is not a table"),
        ("definition", [], "definition is not a table"),
        ("changes", None, "changes is not a list"),
        ("sessions", REMOVED, "damaged: it has no sessions"),
    ],
)
def test_record_of_wrong_types_is_rejected(
    failing_campaign: Path, tmp_path: Path, key: str, value: Any, message: str
) -> None:
    stored_record = json.loads((failing_campaign / "campaign.json").read_text())
    (tmp_path / "campaign.json").write_text(
        json.dumps({name: item for name, item in (stored_record | {key: value}).items() if item is not REMOVED})
    )
    with pytest.raises(StoreError, match=message):
        record.read(tmp_path)


@pytest.mark.parametrize("command", [lambda folder: replay(folder, 0), lambda folder: resume_campaign(
    folder, ExecutorConfig(1), RecordingWatch()
)])  # fmt: skip
def test_stored_parameters_with_wrong_types_are_rejected(
    failing_campaign: Path, tmp_path: Path, command: Callable[[Path], Any]
) -> None:
    stored_record = json.loads((failing_campaign / "campaign.json").read_text())
    stored_record["definition"]["parameters"] = {"altitude_m": [1], "wind": 3}
    (tmp_path / "campaign.json").write_text(json.dumps(stored_record))
    sign_folder(tmp_path)
    shutil.copy(failing_campaign / ROWS_FILE, tmp_path)
    with pytest.raises(DefinitionError, match=r"parameters\.altitude_m"):
        command(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("UPDATE cases SET layout = 77", "unknown layout 77"),
        ("UPDATE layouts SET names = '{\"a\": 1}'", "is not a list of column names"),
        ("UPDATE layouts SET names = 'x'", "is not a list of column names"),
        ("UPDATE cases SET row = '[1'", "a row cannot be read"),
        ("UPDATE cases SET row = '[1]'", "a row cannot be read"),
        ("DROP TABLE layouts", "no such table"),
    ],
)
def test_damaged_store_is_reported(tmp_path: Path, change: str, message: str) -> None:
    """Each stored row refers to a layout: a list of column names in another table of the database."""
    path = tmp_path / ROWS_FILE
    create_store(path, {})
    with RowStore(path) as store:
        store.add([{"case": 0, "outcome": "VALID", "answered": True}])
    connection = sqlite3.connect(path)
    connection.execute(change)
    connection.commit()
    connection.close()

    def read() -> None:
        with RowStore(path) as store:
            write_table(tmp_path / "table", store)
            store.row(0)

    with pytest.raises(StoreError, match=message):
        read()


def test_full_temporary_folder_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def raise_disk_full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("marsyard.campaigns.execution.workers.tempfile.mkdtemp", raise_disk_full)
    with pytest.raises(CampaignError, match=r"TMPDIR defines their folder.*No space left"):
        LocalExecutor(1)


def test_full_disk_is_reported_without_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    @handle_user_errors
    def command() -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "somewhere")

    with pytest.raises(typer.Exit) as error:
        command()
    assert error.value.exit_code == 2
    assert capsys.readouterr().err == "error: [Errno 28] No space left on device: 'somewhere'\n"
