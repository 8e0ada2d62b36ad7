"""Tests of the chain of hashes: changed, removed, added and reordered rows are reported with their case."""

import hashlib
import shutil
import sqlite3
from collections.abc import Callable, Sequence
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from marsyard.campaigns.errors import StoreError
from marsyard.campaigns.store import chain
from marsyard.campaigns.store.key import is_signature, sign
from marsyard.campaigns.store.rows import Row, RowStore, create_store
from tests.campaigns.fake_campaign import RecordingWatch, run, write_campaign
from tests.command import run_command


@pytest.fixture
def store_path(tmp_path: Path) -> Path:
    """Create a store of the cases 0 to 7 in two transactions; case 2 was run again, and case 6 has other columns."""
    path = tmp_path / "cases.sqlite"
    create_store(path, {"identity": "abc"})
    rows: list[Row] = [{"case": case, "outcome": "VALID", "answered": True, "x": case / 7.0} for case in range(8)]
    rows[6] = {**rows[6], "text": "ä\n"}
    with RowStore(path) as store:
        store.add(rows[:5])
        store.add([*rows[5:], {**rows[2], "outcome": "SILENT", "x": 0.5}])
        store.verify()
    return path


def execute(path: Path, *statements: str) -> None:
    with sqlite3.connect(path) as connection:
        for statement in statements:
            connection.execute(statement)
    connection.close()


def verify(path: Path) -> None:
    with RowStore(path) as store:
        store.verify()


FORMER_ROW = (
    "UPDATE cases SET position = 3, outcome = 'VALID', row = '[2, \"VALID\", true, 0.2857142857142857]' "
    "WHERE case_number = 2"
)
REMOVE_LAST = ["DELETE FROM cases WHERE case_number = 7", "DELETE FROM chain WHERE position >= 8"]
MOVE = "UPDATE {0} SET {1} = {2} WHERE {1} = {3}"
EXCHANGE = [MOVE.format("cases", "case_number", new, old) for new, old in ((99, 1), (1, 3), (3, 99))]
#: SQL statements that change a store, and the beginning of the message.
CHANGES = {
    "value": (["UPDATE cases SET row = replace(row, '714', '1') WHERE case_number = 5"], "the row of case 5 was ch"),
    "outcome": (["UPDATE cases SET outcome = 'CRASHED' WHERE case_number = 4"], "the row of case 4 was changed"),
    "column": (["UPDATE layouts SET names = replace(names, 'text', 'note')"], "the row of case 6 was changed"),
    "layout": (["UPDATE cases SET layout = 77 WHERE case_number = 3"], "the row of case 3 was changed"),
    "not UTF-8": (
        ["UPDATE cases SET row = CAST(x'ff' AS TEXT) WHERE case_number = 3"],
        "the row of case 3 was changed",
    ),
    "removed": (["DELETE FROM cases WHERE case_number = 3"], "the row of case 3 was removed"),
    "removed with entry": (
        ["DELETE FROM cases WHERE case_number = 3", "DELETE FROM chain WHERE case_number = 3"],
        "the chain of hashes breaks at case 4",
    ),
    "last removed": (REMOVE_LAST, "the row of case 2 was removed or replaced"),
    "last removed, former row restored": ([*REMOVE_LAST, FORMER_ROW], "rows after that of case 6 were removed"),
    "former row": ([FORMER_ROW], "the row of case 2 was removed or replaced"),
    "all removed": (["DELETE FROM cases", "DELETE FROM chain"], "rows were removed"),
    "added": (
        ["INSERT INTO cases SELECT 9, 99, outcome, layout, row FROM cases WHERE case_number = 1"],
        "the row of case 9 was added",
    ),
    "exchanged": (EXCHANGE, "the row of case 1 was removed"),
    "exchanged with positions": (
        [
            *EXCHANGE,
            "UPDATE cases SET position = 2 WHERE case_number = 1",
            "UPDATE cases SET position = 4 WHERE case_number = 3",
        ],
        "the row of case 1 was changed",
    ),
    "reordered": (
        [MOVE.format("chain", "position", new, old) for new, old in ((99, 4), (4, 5), (5, 99))],
        "the chain of hashes breaks at case 4",
    ),
    "type": (["UPDATE kinds SET kind = 'str' WHERE name = 'x'"], "the chain of hashes breaks at case 0"),
    "added type": (["INSERT INTO kinds VALUES ('x', 'str', 99)"], "rows after that of case 2 were removed"),
    "campaign": (["UPDATE about SET value = 'abd'"], "the chain of hashes breaks at case 0"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_changed_rows_are_reported(store_path: Path, change: str) -> None:
    statements, message = CHANGES[change]
    verify(store_path)
    execute(store_path, *statements)
    with pytest.raises(StoreError) as error_info:
        verify(store_path)
    assert str(error_info.value).startswith(f"{store_path}: {message}")


def test_failed_transaction_leaves_a_complete_chain(store_path: Path) -> None:
    with RowStore(store_path) as store:
        new_columns: Row = {"case": 9, "outcome": "VALID", "answered": True, "new": "x"}
        with pytest.raises(KeyError):
            store.add([new_columns, {"case": 10}])
        assert (store.row(9), store.count()) == (None, 8)
        store.verify()
        store.add([new_columns])
        store.verify()
        assert store.row(9) == new_columns
    verify(store_path)


def test_rows_are_verified_while_a_campaign_adds_rows(store_path: Path) -> None:
    with RowStore(store_path) as reader, RowStore(store_path) as writer:
        for case in range(10, 14):
            writer.add([{"case": case, "outcome": "VALID", "answered": True, "x": 0.1}])
            reader.verify()


def rewrite_chain(path: Path) -> None:
    """Change a row, and compute all hashes again, as a program without the key of the user can."""
    execute(path, "UPDATE cases SET row = replace(row, 'false', 'true'), outcome = replace(outcome, 'SILENT', 'VALID')")
    with sqlite3.connect(path) as connection:
        about = dict(connection.execute("SELECT key, value FROM about"))
        head, kinds = chain.first_head(about), chain._read_kinds(connection)
        for position, case, row_hash, _, *texts in connection.execute(chain._ENTRIES).fetchall():
            row_hash = row_hash if texts[0] is None else chain.hash_row(case, *texts)
            head = chain.next_head(head, row_hash, kinds.get(position, ()))
            connection.execute("UPDATE chain SET row_hash = ?, head = ? WHERE position = ?", (row_hash, head, position))
        connection.execute("UPDATE seals SET digest = ? WHERE name = 'rows'", (head.hex(),))
    connection.close()


@pytest.fixture
def campaign(failing_campaign: Path, tmp_path: Path) -> Path:
    """Return a copy of a finished campaign."""
    return shutil.copytree(failing_campaign, tmp_path / "run")


Words = Callable[[Path], Sequence[str | Path]]
COMMANDS: dict[str, Words] = {
    "report": lambda folder: ("report", folder),
    "resume": lambda folder: ("resume", folder, "--jobs", "1", "--retry", "all"),
    "append": lambda folder: ("append", folder, "2", "--jobs", "1"),
    "replay": lambda folder: ("replay", folder, "0"),
    "compare": lambda folder: ("compare", folder, folder),
}


def change_outcome(path: Path) -> None:
    execute(path, "UPDATE cases SET outcome = 'VALID' WHERE case_number = 3")


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (change_outcome, "the row of case 3 was changed after it was stored"),
        (rewrite_chain, "was written by another user or program"),
    ],
)
def test_commands_refuse_changed_rows(
    campaign: Path, command: str, change: Callable[[Path], None], message: str
) -> None:
    """A program without the key of the user can compute the hashes, but not the signature."""
    change(campaign / "cases.sqlite")
    content = (campaign / "campaign.json").read_bytes()
    status, output = run_command(*COMMANDS[command](campaign))
    assert (status, message in output) == (2, True), output
    assert (campaign / "campaign.json").read_bytes() == content


def test_trusted_rows_are_accepted(campaign: Path) -> None:
    rewrite_chain(campaign / "cases.sqlite")
    verify(campaign / "cases.sqlite")
    assert run_command("report", campaign)[0] == 2
    for words in (("report", campaign, "--trust"), ("report", campaign)):
        status, output = run_command(*words)
        assert (status, "verdict: FAIL" in output) == (1, True), output


def test_folder_of_another_user_is_read(campaign: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The chain of another user's rows is verified, but not the signature."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "another user"))
    assert run_command("compare", campaign, campaign)[0] == 0
    assert not (tmp_path / "another user").exists()
    assert run_command("report", campaign)[0] == 1
    execute(campaign / "cases.sqlite", "DELETE FROM cases WHERE case_number = 3")
    status, output = run_command("report", campaign)
    assert (status, "the row of case 3 was removed" in output) == (2, True)


def test_changed_table_is_refused_and_written_again(campaign: Path) -> None:
    path = campaign / "cases.parquet"
    content = path.read_bytes()
    pq.write_table(pq.read_table(path).slice(1), path)
    for words in (("report", campaign), ("compare", campaign, campaign)):
        status, output = run_command(*words)
        assert (status, "cases.parquet was changed" in output) == (2, True), output
    assert run_command("resume", campaign, "--jobs", "1")[0] == 1
    assert path.read_bytes() == content


def test_table_without_a_signature_is_refused(campaign: Path) -> None:
    """A program without the key of the user changes the table, and its recorded hash."""
    path = campaign / "cases.parquet"
    pq.write_table(pq.read_table(path).slice(1), path)
    with sqlite3.connect(campaign / "cases.sqlite") as connection:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        connection.execute("UPDATE seals SET digest = ? WHERE name = 'table'", (digest,))
    connection.close()
    status, output = run_command("report", campaign)
    assert (status, "cases.parquet was changed" in output) == (2, True)


def test_rows_without_a_chain_are_reported_as_not_verified(campaign: Path) -> None:
    (campaign / "cases.sqlite").unlink()
    status, output = run_command("report", campaign)
    assert (status, "rows: not verified, since" in output) == (1, True), output


@pytest.mark.usefixtures("inline_workers")
def test_chain_continues_over_resume_and_append(tmp_path: Path, watch: RecordingWatch) -> None:
    path = write_campaign(tmp_path, "raising_cases = [3]", requirement="")
    directory = run(path, tmp_path / "run", watch, "retain.showcase=none", jobs=1)
    with RowStore(directory / "cases.sqlite") as store:
        first = store._last_entry()
    for words in (("resume", directory, "--retry", "all", "--jobs", "1"), ("append", directory, "3", "--jobs", "1")):
        assert run_command(*words)[0] == 1
    with RowStore(directory / "cases.sqlite") as store:
        store.verify()
        # 12 cases, one repeated case and 3 appended cases
        assert (first[0], store._last_entry()[0], store.count()) == (12, 16, 15)


def test_any_text_can_be_checked_as_a_signature(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A record from elsewhere can contain any JSON text, such as a lone surrogate."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert is_signature(sign(b"content"), b"content")
    assert not is_signature("\ud800", b"content")
