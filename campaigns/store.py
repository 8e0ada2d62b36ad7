"""Rows on disk: SQLite while a campaign runs, one transaction a row, and a Parquet table of all when it ends."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from campaigns.errors import StoreError
from campaigns.execution import LEADING_COLUMNS, TRAILING_COLUMNS, Row

TABLE_FILE = "cases.parquet"
ROWS_FILE = "cases.sqlite"


class RowStore:
    """The rows of a running campaign, written by one process only.

    The database is locked for as long as it is open. Its journal is a write-ahead log, so that a row is safe from a
    killed program as soon as `add` returns.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._connection = sqlite3.connect(path, isolation_level=None, timeout=0.0)
            self._connection.execute("PRAGMA locking_mode = EXCLUSIVE")
            self._connection.execute("PRAGMA journal_mode = WAL")
            self._connection.execute("PRAGMA synchronous = NORMAL")
            self._connection.execute(
                "CREATE TABLE IF NOT EXISTS cases (case_number INTEGER PRIMARY KEY, row TEXT NOT NULL)"
            )
        except sqlite3.Error as error:
            raise StoreError(f"{path}: {error}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._connection.close()

    def add(self, row: Row) -> None:
        """Stores a row."""
        try:
            self._connection.execute("INSERT INTO cases VALUES (?, ?)", (row["case"], json.dumps(dict(row))))
        except sqlite3.Error as error:
            raise StoreError(f"{self._path}: {error}") from error

    def rows(self) -> Iterator[Row]:
        """The rows in the order of their cases."""
        for (text,) in self._connection.execute("SELECT row FROM cases ORDER BY case_number"):
            yield json.loads(text)


def columns_of(rows: Sequence[Row]) -> list[str]:
    """Every column in any row: the engine's first and last, the scenario's between them as they first appear."""
    found = dict.fromkeys(name for row in rows for name in row)
    own = [name for name in found if name not in LEADING_COLUMNS and name not in TRAILING_COLUMNS]
    return [*LEADING_COLUMNS, *own, *TRAILING_COLUMNS]


def write_table(path: Path, rows: Sequence[Row], measures: Sequence[str] = ()) -> None:
    """Writes rows as a Parquet table, whole or not at all.

    A number that a row lacks is NaN, anything else that it lacks is null.

    Parameters
    ----------
    path
        Where to.
    rows
        In the order in which they are to stand.
    measures
        Columns of numbers that the table must have even where no row does.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    names = columns_of(rows)
    own = names[: -len(TRAILING_COLUMNS)]
    names = [*own, *(name for name in measures if name not in names), *TRAILING_COLUMNS]
    table = pa.table({name: _column([row.get(name) for row in rows]) for name in names})
    partial = path.with_suffix(".partial")
    try:
        pq.write_table(table, partial)
        partial.replace(path)
    except OSError as error:
        raise StoreError(f"{path}: {error.strerror or error}") from error


def _column(values: list[Any]) -> Any:
    """A column of the narrowest type that holds all its values."""
    import pyarrow as pa

    kinds = {type(value) for value in values if value is not None}
    if kinds <= {bool} and kinds:
        return pa.array(values, pa.bool_())
    if kinds == {int}:
        try:
            return pa.array(values, pa.int64())
        except OverflowError:
            kinds = {float}
    if kinds <= {int, float}:
        return pa.array([float("nan") if value is None else float(value) for value in values], pa.float64())
    return pa.array([None if value is None else str(value) for value in values], pa.string())


def read_rows(path: Path) -> list[dict[str, Any]]:
    """The rows of a Parquet table, without what they lack.

    Raises
    ------
    StoreError
        Where there is no such table.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        rows: list[dict[str, Any]] = pq.read_table(path).to_pylist()
    except (OSError, pa.ArrowException) as error:
        raise StoreError(f"{path}: not a table of cases: {error}") from error
    return [{name: value for name, value in row.items() if value is not None} for row in rows]
