"""Tests of the files of a campaign folder: rows (SQLite), table of rows (Parquet), record and products."""

import errno
import math
import os
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from marsyard.campaigns.definition.campaign_file import Requirement
from marsyard.campaigns.errors import StoreError
from marsyard.campaigns.store import lock, record, temporary_files
from marsyard.campaigns.store.lock import folder_lock, is_locked
from marsyard.campaigns.store.products import load_products, pack_products, save_packed
from marsyard.campaigns.store.rows import RowStore, create_store
from marsyard.campaigns.store.table import numeric_metrics, read_rows, write_table


def complete_row(row: dict[str, Any]) -> dict[str, Any]:
    """Add the columns that every row needs."""
    return {"outcome": "VALID", "answered": True, **row}


@contextmanager
def open_store(folder: Path, rows: Iterable[dict[str, Any]]) -> Iterator[RowStore]:
    """Create a store in `folder`, add completed rows and open it; `thorough` checks all pages of the file first."""
    create_store(folder / "cases.sqlite", {"identity": "abc"})
    with RowStore(folder / "cases.sqlite", thorough=True) as store:
        store.add(map(complete_row, rows))
        yield store


def test_rows_are_read_in_case_order(tmp_path: Path) -> None:
    rows: list[dict[str, Any]] = [
        {"case": 2, "x": math.nan, "big": 2**62},
        {"case": 0, "x": math.inf, "text": "ä\0\n"},
        {"case": 1, "x": 0.1 + 0.2, "flag": True},
    ]
    with open_store(tmp_path, rows) as store:
        stored_rows = [store.row(case) or {} for case in range(3)]
        assert store.about == {"identity": "abc"}
        assert (store.count(), store.list_cases_with_outcomes(["VALID"]), store.count_unfinished()) == (3, [0, 1, 2], 0)
        assert store.row(1) == complete_row(rows[2])
        assert store.row(7) is None
    assert [row["case"] for row in stored_rows] == [0, 1, 2]
    assert stored_rows[1] == complete_row(rows[2])
    assert math.isnan(float(stored_rows[2]["x"]))
    assert stored_rows[0]["text"] == "ä\0\n"


def test_missing_rows_are_listed_and_rows_replaced(tmp_path: Path) -> None:
    with open_store(tmp_path, [{"case": 1, "outcome": "CRASHED"}, {"case": 2}, {"case": 5}]) as store:
        assert store.list_missing_cases(9) == [range(1), range(3, 5), range(6, 9)]
        assert store.list_missing_cases(6) == [range(1), range(3, 5)]
        assert store.list_cases_with_outcomes(["CRASHED", "TIMED_OUT"]) == [1]
        assert (store.list_cases_with_outcomes([]), store.count_unfinished()) == ([], 1)
        store.add([complete_row({"case": 1, "x": 3.0})])
        assert store.row(1) == complete_row({"case": 1, "x": 3.0})
        assert store.list_cases_with_outcomes(["VALID"]) == [1, 2, 5]


def test_rows_are_stored_before_the_store_is_closed(tmp_path: Path) -> None:
    (tmp_path / "copy").mkdir()
    with open_store(tmp_path, [{"case": 0}]):
        for name in ("cases.sqlite", "cases.sqlite-wal"):
            (tmp_path / "copy" / name).write_bytes((tmp_path / name).read_bytes())
    with RowStore(tmp_path / "copy" / "cases.sqlite", thorough=True) as store:
        assert store.count() == 1


def test_full_disk_is_reported_without_loss_of_rows(tmp_path: Path) -> None:
    with open_store(tmp_path, [{"case": 0}]) as store:
        store._connection.execute("PRAGMA max_page_count = 12")  # imitates a full disk
        with pytest.raises(StoreError, match="the disk is full; all earlier rows are stored"):
            store.add(complete_row({"case": case, "text": "x" * 1000}) for case in range(1, 100))
        assert store.count() == 1


#: Page size of the SQLite database, in bytes.
_PAGE_BYTES = 4096


def _truncate(path: Path, pages: float) -> None:
    """Shorten the database file to a number of pages."""
    with path.open("r+b") as file:
        file.truncate(int(pages * _PAGE_BYTES))


def _overwrite_pages(path: Path) -> None:
    """Overwrite two pages of the database file."""
    with path.open("r+b") as file:
        file.seek(5 * _PAGE_BYTES)
        file.write(b"\xa5" * 2 * _PAGE_BYTES)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: _truncate(path, 0), "wrong application id"),
        (lambda path: _truncate(path, 0.5), "damaged"),
        (lambda path: _truncate(path, 7.5), "damaged"),
        (_overwrite_pages, "damaged"),
        (lambda path: path.write_text("no database at all, but some text that is longer than a header" * 9), "damaged"),
        (lambda path: path.unlink(), "no such file"),
    ],
)
def test_damaged_store_is_rejected_and_unchanged(tmp_path: Path, damage: Callable[[Path], None], message: str) -> None:
    path = tmp_path / "cases.sqlite"
    with open_store(tmp_path, ({"case": case, "text": "x" * 100} for case in range(300))):
        pass
    damage(path)
    content = path.read_bytes() if path.exists() else None
    with pytest.raises(StoreError, match=message):
        RowStore(path, thorough=True)
    assert (path.read_bytes() if path.exists() else None) == content


def test_store_of_another_version_is_rejected(tmp_path: Path) -> None:
    with open_store(tmp_path, []):
        pass
    connection = sqlite3.connect(tmp_path / "cases.sqlite")
    connection.execute("PRAGMA user_version = 99")
    connection.close()
    with pytest.raises(StoreError, match="has version 99; this version of Marsyard reads 3"):
        RowStore(tmp_path / "cases.sqlite")


def write_case_table(folder: Path, rows: Iterable[dict[str, Any]], measures: tuple[str, ...] = ()) -> Path:
    """Write a Parquet table of rows; it has the columns `measures` even if no row has a value."""
    with open_store(folder, rows) as store:
        write_table(folder / "t.parquet", store, measures)
    return folder / "t.parquet"


def test_columns_have_the_narrowest_type(tmp_path: Path) -> None:
    rows: list[dict[str, Any]] = [
        {"case": 1, "number": 2.5, "integer": 2, "mixed": "x", "large": 1, "only_case_1": "y"},
        {"case": 0, "number": 1, "integer": 1, "mixed": 1, "large": 10**30, "only_case_0": 1.0},
    ]
    path = write_case_table(tmp_path, rows, ("metric",))
    first, second = read_rows(path)
    assert (first["number"], type(first["integer"]), first["mixed"], first["large"]) == (1.0, int, "1", 1e30)
    assert math.isnan(second["only_case_0"])
    assert math.isnan(first["metric"])
    assert ("only_case_1" in first, second["only_case_1"]) == (False, "y")
    assert not list(tmp_path.glob("*.partial"))
    # the order of columns follows the case numbers, not the order of storage
    row_columns = ["number", "integer", "mixed", "large", "only_case_0", "only_case_1", "metric"]
    engine_columns = ["case_attempts", "wall_time_s", "cpu_time_s", "error", "traceback"]
    names = ["case", "outcome", "answered", *row_columns, *engine_columns]
    assert pq.read_schema(path).names == names
    assert str(read_rows(path, 1)) == str([second])


def test_tables_are_written_in_row_groups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("marsyard.campaigns.store.table._GROUP_ROWS", 7)
    rows = [{"case": case, "x": case / 3, **({"y": case} if case % 5 else {"z": True})} for case in range(50)]
    path = write_case_table(tmp_path, rows)
    assert pq.ParquetFile(path).num_row_groups == 8
    for row, stored_row in zip(rows, read_rows(path), strict=True):
        # NaN differs from itself and marks a missing value
        columns = {name: value for name, value in stored_row.items() if name in ("case", "x", "y", "z")}
        assert {name: value for name, value in columns.items() if value == value} == row


def test_empty_table_is_read_and_text_is_rejected(tmp_path: Path) -> None:
    path = write_case_table(tmp_path, [])
    assert read_rows(path) == []
    path.write_text("not a table")
    with pytest.raises(StoreError, match="not a table of cases"):
        read_rows(path)


def test_invalid_records_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="no such folder"):
        record.read(tmp_path / "nothing")
    with pytest.raises(StoreError, match=r"it has no campaign\.json"):
        record.read(tmp_path)
    for text, message in (("{", "damaged"), ("[]", "damaged"), ("{}", "damaged"), ('{"schema": 99}', "has schema 99")):
        (tmp_path / "campaign.json").write_text(text)
        with pytest.raises(StoreError, match=message):
            record.read(tmp_path)
    (tmp_path / "campaign.json").write_text('{"schema": 1, "definition": {"name": 3}}')
    with pytest.raises(StoreError, match="damaged"):
        record.stored_definition(tmp_path)


_leaves = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5)
_arrays = st.sampled_from(
    [np.arange(3, dtype=np.uint16), np.eye(2), np.zeros((0, 2), np.float32), np.array(["ab", "c"])]
)
_keys = st.text(max_size=3)
_random_products = st.dictionaries(
    st.text(max_size=5),
    st.recursive(_leaves | _arrays, lambda entry: st.lists(entry, max_size=2) | st.dictionaries(_keys, entry)),
    max_size=4,
)


def _is_equal(value: Any, expected: Any) -> bool:
    if isinstance(value, np.ndarray):
        return value.dtype == expected.dtype and np.array_equal(value, expected)
    if isinstance(value, dict):
        return value.keys() == expected.keys() and all(_is_equal(value[key], expected[key]) for key in value)
    if isinstance(value, list):
        return len(value) == len(expected) and all(map(_is_equal, value, expected))
    return type(value) is type(expected) and value == expected


@given(products=_random_products)
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_products_are_read_as_written(tmp_path: Path, products: dict[str, Any]) -> None:
    save_packed(tmp_path, pack_products(products), {})
    assert _is_equal(load_products(tmp_path), products)


@pytest.mark.parametrize("value", [object(), np.array([object()]), {1, 2}])
def test_unsupported_products_are_rejected(tmp_path: Path, value: object) -> None:
    with pytest.raises(TypeError, match=r"products\.a\.0 is a"):
        pack_products({"a": [value]})
    with pytest.raises(StoreError, match="contains no products"):
        load_products(tmp_path)


def test_numeric_metrics_contain_the_summands_of_a_sum() -> None:
    confidence = {"probability": 0.9, "confidence": 0.9}
    total = Requirement.model_validate({"id": "A", "metric": "a_s + b_s", "bound": 2.0, **confidence})
    boolean = Requirement.model_validate({"id": "B", "metric": "safe", **confidence})
    assert numeric_metrics([total, boolean]) == ["a_s", "b_s"]


@pytest.fixture
def _locks(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """Locks of the file system: used (None), missing (an error number), or not seen by other machines (0)."""

    def flock(*_: object) -> None:
        if request.param:
            raise OSError(request.param, os.strerror(request.param))

    monkeypatch.setattr(lock, "_BEAT_S", 0.1)
    monkeypatch.setattr(lock, "_SILENCE_S", 1.5)
    if request.param is not None:
        monkeypatch.setattr("fcntl.flock", flock)


@pytest.mark.usefixtures("_locks")
@pytest.mark.parametrize("_locks", [None, errno.ENOLCK, errno.EOPNOTSUPP, 0], indirect=True)
def test_folder_lock_is_exclusive(tmp_path: Path) -> None:
    """Without locks of the file system, a heartbeat locks the folder."""
    assert not is_locked(tmp_path)
    with folder_lock(tmp_path):
        assert is_locked(tmp_path)
        with pytest.raises(StoreError, match=f"is in use: process {os.getpid()} on .* uses it"), folder_lock(tmp_path):
            pass
    assert not is_locked(tmp_path)
    # a process of another machine that has ended without a sign
    (tmp_path / "campaign.lock").write_text("process 1 on another machine (0123abcd)\n")
    assert not is_locked(tmp_path)
    with folder_lock(tmp_path):
        assert is_locked(tmp_path)


def test_temporary_files_of_dead_processes_are_removed(tmp_path: Path) -> None:
    program = (
        "import os, sys, pathlib\n"
        "from marsyard.campaigns.store.temporary_files import replace_file, partial_suffix\n"
        "folder = pathlib.Path(sys.argv[1])\n"
        "(folder / 'cases' / '3' / ('.x' + partial_suffix())).mkdir(parents=True)\n"
        "with replace_file(folder / 'cases.parquet') as partial:\n"
        "    partial.touch()\n"
        "    os._exit(9)\n"
    )
    subprocess.run([sys.executable, "-c", program, str(tmp_path)], check=False)
    own, foreign = tmp_path / f"own{temporary_files.partial_suffix()}", tmp_path / "x.0123abcd-1.partial"
    own.touch()
    foreign.touch()
    assert len([*tmp_path.rglob("*.partial")]) == 4
    with folder_lock(tmp_path):
        pass
    assert {*tmp_path.rglob("*.partial")} == {own, foreign}


def test_failed_writing_leaves_no_temporary_file(tmp_path: Path) -> None:
    with pytest.raises(TypeError):
        record.write(tmp_path, {"key": object()})
    assert not list(tmp_path.iterdir())
