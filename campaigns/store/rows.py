"""Rows of a campaign, stored during its run in one SQLite file by one process.

The Parquet table can always be created again from this file. A row is a JSON list of values. Rows with the same columns
have the same layout, and the column names are stored once for each layout.

A chain of hashes (`marsyard.campaigns.store.chain`) shows whether rows were changed after they were stored.

The journal is a write-ahead log with `synchronous = FULL`. A committed transaction is not lost if the program is
killed, nor at a power failure if the disk executes `fsync` correctly. Each batch (about one second of work) needs one
`fsync`, which takes some milliseconds.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Any

from marsyard.campaigns.errors import StoreError
from marsyard.campaigns.outcomes import ENGINE_FAILURES
from marsyard.campaigns.store import chain
from marsyard.campaigns.store.temporary_files import replace_file
from marsyard.scenarios.columns import LEADING, TRAILING
from marsyard.scenarios.interface import Scalar

ROWS_FILE = "cases.sqlite"
#: Row of one case as stored.
Row = Mapping[str, Scalar]
#: Columns that the engine writes in front of and after those of the scenario.
LEADING_COLUMNS, TRAILING_COLUMNS = ([column.name for column in columns] for columns in (LEADING, TRAILING))
#: Version of the tables below, stored as `PRAGMA user_version`.
STORE_VERSION = 3
#: Identifier of the file type (`PRAGMA application_id`): "Mars".
_APPLICATION_ID = int.from_bytes(b"Mars", "big")
#: SQL of an empty store. The journal mode DELETE leaves no second file when the new store is renamed.
_TABLES = f"""
PRAGMA journal_mode = DELETE;
PRAGMA application_id = {_APPLICATION_ID};
PRAGMA user_version = {STORE_VERSION};
BEGIN;
CREATE TABLE about (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE layouts (layout INTEGER PRIMARY KEY, names TEXT NOT NULL UNIQUE);
CREATE TABLE kinds (name TEXT NOT NULL, kind TEXT NOT NULL, position INTEGER NOT NULL, PRIMARY KEY (name, kind));
CREATE TABLE cases (
    case_number INTEGER PRIMARY KEY, position INTEGER NOT NULL, outcome TEXT NOT NULL, layout INTEGER NOT NULL,
    row TEXT NOT NULL
);
{chain.CHAIN_TABLES}
COMMIT;
"""


def create_store(path: Path, about: Mapping[str, str]) -> None:
    """Create an empty store atomically; `about` contains texts by key that identify the campaign."""
    try:
        with replace_file(path) as partial, closing(sqlite3.connect(partial, isolation_level=None)) as connection:
            connection.executescript(_TABLES)
            connection.executemany("INSERT INTO about VALUES (?, ?)", about.items())
            chain.write_seal(connection, chain.ROWS, chain.first_head(about).hex())
    except (sqlite3.Error, OSError) as error:
        raise StoreError(f"{path} cannot be written: {error}") from error


class RowStore(AbstractContextManager["RowStore"]):
    """Rows of a campaign, as a context.

    - path: a file created by `create_store`
    - thorough: check all pages of the file first; required before more rows are written

    Raises StoreError if the file is missing, damaged, or of another version; the file is then unchanged.
    """

    def __init__(self, path: Path, *, thorough: bool = False) -> None:
        self._path = path
        if not path.is_file():
            raise StoreError(f"{path}: no such file; no rows can be added to this campaign")
        try:
            self._connection = sqlite3.connect(f"{path.resolve().as_uri()}?mode=rw", uri=True, isolation_level=None)
        except sqlite3.Error as error:
            raise StoreError(f"{path} cannot be opened: {error}") from error
        execute = self._connection.execute
        try:
            (application,) = execute("PRAGMA application_id").fetchone()
            (version,) = execute("PRAGMA user_version").fetchone()
            if application != _APPLICATION_ID:
                raise StoreError(f"{path} is damaged, or is not a store of this version: wrong application id")
            if version != STORE_VERSION:
                raise StoreError(f"{path} has version {version}; this version of Marsyard reads {STORE_VERSION}")
            problems = [text for (text,) in execute("PRAGMA quick_check(1)")] if thorough else ["ok"]
            if problems != ["ok"]:
                raise StoreError(f"{path} is damaged: {' '.join(problems)}; nothing was written to it")
            execute("PRAGMA journal_mode = WAL")
            execute("PRAGMA synchronous = FULL")
            self._load_columns()
        except BaseException as error:
            self._connection.close()
            if isinstance(error, sqlite3.Error):
                raise self._store_error(error) from error
            raise

    def _load_columns(self) -> None:
        """Read the layouts, and the types of each column's values."""
        self._layouts: dict[tuple[str, ...], int] = {}
        for text, layout in self._connection.execute("SELECT names, layout FROM layouts"):
            try:
                names = json.loads(text)
            except (ValueError, TypeError):
                names = None
            if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
                raise StoreError(f"{self._path} is damaged: layout {layout} is not a list of column names")
            self._layouts[tuple(names)] = layout
        self._kinds = set(self._connection.execute("SELECT name, kind FROM kinds"))

    def _store_error(self, error: sqlite3.Error) -> StoreError:
        """Create the error for the user, with a remedy if the disk is full."""
        text = str(error)
        if "full" in text:
            advice = "free disk space and resume"
            return StoreError(f"{self._path}: the disk is full; all earlier rows are stored: {advice}")
        if "malformed" in text or "not a database" in text:
            return StoreError(f"{self._path} is damaged: {text}; nothing was written to it")
        return StoreError(f"{self._path}: {text}")

    def __exit__(self, *_: object) -> None:
        # closing can fail after a failed write; the log file then remains and is read the next time
        with suppress(sqlite3.Error):
            self._connection.close()

    @property
    def about(self) -> dict[str, str]:
        """Texts that identify the campaign (`create_store`)."""
        return dict(self._query("SELECT key, value FROM about"))

    def add(self, rows: Iterable[Row]) -> None:
        """Store rows in one transaction; a new row of a case replaces the existing row.

        Raises StoreError on failure; none of the rows is then stored.
        """
        with self._transaction():
            position, head = self._last_entry()
            for row in rows:
                position += 1
                head = self._add_row(row, position, head)
            chain.write_seal(self._connection, chain.ROWS, head.hex())

    def _last_entry(self) -> tuple[int, bytes]:
        """Return position and head of the last entry of the chain; 0 and the first head of an empty store."""
        last = next(self._query("SELECT position, head FROM chain ORDER BY position DESC LIMIT 1"), None)
        return (0, chain.first_head(self.about)) if last is None else last

    def _add_row(self, row: Row, position: int, head: bytes) -> bytes:
        """Store a row and its entry of the chain; return the new head."""
        execute, names = self._connection.execute, tuple(row)
        names_text = json.dumps(names)
        if names not in self._layouts:
            self._layouts[names] = len(self._layouts) + 1
            execute("INSERT INTO layouts VALUES (?, ?)", (self._layouts[names], names_text))
        new_kinds = {(name, classify_value(value)) for name, value in row.items()} - self._kinds
        self._kinds |= new_kinds
        for kind in new_kinds:
            execute("INSERT INTO kinds VALUES (?, ?, ?)", (*kind, position))
        case, outcome, text = row["case"], row["outcome"], json.dumps(list(row.values()))
        row_hash = chain.hash_row(int(case), str(outcome).encode(), names_text.encode(), text.encode())
        head = chain.next_head(head, row_hash, new_kinds)
        entry = case, position, outcome, self._layouts[names], text
        execute("INSERT OR REPLACE INTO cases VALUES (?, ?, ?, ?, ?)", entry)
        execute("INSERT INTO chain VALUES (?, ?, ?, ?)", (position, case, row_hash, head))
        return head

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        """Execute the statements inside the context in one transaction, or none of them after an exception."""
        execute = self._connection.execute
        try:
            execute("BEGIN IMMEDIATE")
            try:
                yield
                execute("COMMIT")
            except BaseException:
                if self._connection.in_transaction:
                    execute("ROLLBACK")
                self._load_columns()
                raise
        except sqlite3.Error as error:
            raise self._store_error(error) from error

    def verify(self) -> None:
        """Verify the chain of all rows. Raises StoreError for the first row that disagrees."""
        try:
            self._connection.execute("BEGIN")  # rows that a running campaign adds meanwhile are not read
            try:
                problem = chain.find_broken_link(self._connection, self.about)
            finally:
                self._connection.execute("COMMIT")
        except sqlite3.Error as error:
            raise self._store_error(error) from error
        if problem:
            raise StoreError(f"{self._path}: {problem}; its rows are not those that the campaign stored")

    @property
    def head(self) -> str:
        """Last head of the chain of hashes, which depends on all rows."""
        return self._last_entry()[1].hex()

    def copy(self, path: Path) -> None:
        """Copy the rows into a new file, complete without a log file. Raises StoreError if it cannot be written."""
        try:
            with closing(sqlite3.connect(path)) as target:
                self._connection.backup(target)
                target.execute("PRAGMA journal_mode = DELETE")
        except sqlite3.Error as error:
            raise StoreError(f"{path} cannot be written: {error}") from error

    @property
    def is_signed(self) -> bool:
        """Whether this user's installation stored the last rows."""
        seal = self._seals().get(chain.ROWS)
        return seal is not None and seal.is_own

    def sign(self) -> None:
        """Sign the last head and the table, which this user trusts although another one stored them."""
        seals = self._seals()
        with self._transaction():
            for name, seal in seals.items():
                chain.write_seal(self._connection, name, seal.digest)

    @property
    def table_digest(self) -> str | None:
        """SHA-256 of the table's file that was written from the rows; None without one, or if another user wrote it."""
        seal = self._seals().get(chain.TABLE)
        return seal.digest if seal is not None and (seal.is_own or not self.is_signed) else None

    def record_table(self, digest: str) -> None:
        """Record the SHA-256 of the table's file that was written from the rows."""
        with self._transaction():
            chain.write_seal(self._connection, chain.TABLE, digest)

    def _seals(self) -> dict[str, chain.Seal]:
        try:
            return chain.read_seals(self._connection)
        except sqlite3.Error as error:
            raise self._store_error(error) from error

    def count(self) -> int:
        """Return the number of cases that have a row."""
        ((number,),) = self._query("SELECT count(*) FROM cases")
        return int(number)

    def count_unfinished(self) -> int:
        """Return the number of unfinished cases."""
        return len(self.list_cases_with_outcomes(ENGINE_FAILURES))

    def list_missing_cases(self, total: int) -> list[range]:
        """List the cases below `total` that have no row, as ranges."""
        ends = [-1, *(number for (number,) in self._query("SELECT case_number FROM cases ORDER BY 1")), total]
        return [
            range(previous + 1, following)
            for previous, following in itertools.pairwise(ends)
            if following > previous + 1
        ]

    def list_cases_with_outcomes(self, outcomes: Iterable[str]) -> list[int]:
        """List the cases with one of these outcomes."""
        values = sorted(outcomes)
        placeholders = ", ".join("?" * len(values))
        query = f"SELECT case_number FROM cases WHERE outcome IN ({placeholders}) ORDER BY 1"  # noqa: S608
        return [number for (number,) in self._query(query, values)]

    def find_first_finished_case(self) -> int | None:
        """Return the first finished case; None if no case is finished."""
        placeholders = ", ".join("?" * len(ENGINE_FAILURES))
        query = f"SELECT min(case_number) FROM cases WHERE outcome NOT IN ({placeholders})"  # noqa: S608
        ((case,),) = self._query(query, sorted(ENGINE_FAILURES))
        return None if case is None else int(case)

    def row(self, case: int) -> Row | None:
        """Return the row of a case; None if it has none."""
        record = next(self._query("SELECT layout, row FROM cases WHERE case_number = ?", [case]), None)
        try:
            columns = () if record is None else self.columns_by_layout()[record[0]]
            return None if record is None else dict(zip(columns, json.loads(record[1]), strict=True))
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            raise StoreError(f"{self._path} is damaged: a row cannot be read: {error}") from error

    def columns_by_layout(self) -> dict[int, tuple[str, ...]]:
        """Return the columns of each layout; the layouts are in the order of their first cases."""
        order = self._query("SELECT layout FROM cases GROUP BY layout ORDER BY min(case_number)")
        names = {layout: columns for columns, layout in self._layouts.items()}
        try:
            return {layout: names[layout] for (layout,) in order}
        except KeyError as error:
            raise StoreError(f"{self._path} is damaged: rows have the unknown layout {error}") from error

    def kinds(self) -> dict[str, set[str]]:
        """Return the types of each column's values: `bool`, `int`, `big` (beyond 64 bits), `float`, `str`."""
        values: dict[str, set[str]] = {}
        for name, kind in self._kinds:
            values.setdefault(name, set()).add(kind)
        return values

    def chunks(self, size: int) -> Iterator[list[tuple[int, list[Any]]]]:
        """Yield layouts and values of all rows in the order of their cases, in chunks of `size` rows."""
        rows = self._query("SELECT layout, row FROM cases ORDER BY case_number")
        while records := list(itertools.islice(rows, size)):
            # parsing one joined text takes half the time of parsing each row
            try:
                values = json.loads(f"[{','.join(text for _, text in records)}]")
                chunk = [(layout, row) for (layout, _), row in zip(records, values, strict=True)]
            except (ValueError, TypeError, RecursionError) as error:
                raise StoreError(f"{self._path} is damaged: a row cannot be read: {error}") from error
            yield chunk

    def _query(self, query: str, values: Sequence[Any] = ()) -> Iterator[Any]:
        """Execute a query, and yield its rows. Raises StoreError on failure, also for a text that is not UTF-8."""
        try:
            # `yield from` would close the cursor, also after the store is closed
            for row in self._connection.execute(query, values):  # noqa: UP028
                yield row
        except sqlite3.Error as error:
            raise self._store_error(error) from error


def is_empty_store(path: Path) -> bool:
    """Whether a file is a store without rows; False if it is damaged or not a valid store."""
    try:
        with readable_store(path) as store:
            return store.count() == 0
    except StoreError:
        return False


@contextmanager
def readable_store(path: Path) -> Iterator[RowStore]:
    """Open the rows of a campaign for reading; a temporary copy is opened if the folder is not writable.

    SQLite creates files in the folder even for reading. Raises StoreError like `RowStore`, or if the copy fails.
    """
    with ExitStack() as stack:
        if not all(os.access(target, os.W_OK, effective_ids=True) for target in (path, path.parent)):
            try:
                folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="marsyard-"))
                for file in (path, path.with_name(f"{path.name}-wal")):
                    if file.exists():
                        shutil.copyfile(file, Path(folder, file.name))
            except OSError as error:
                raise StoreError(f"{path} cannot be copied to be read: {error.strerror or error}") from error
            path = Path(folder, path.name)
        yield stack.enter_context(RowStore(path))


def classify_value(value: Any) -> str:
    """Return the type of a value as in `RowStore.kinds`."""
    kind = type(value)
    return "big" if kind is int and not -(2**63) <= value < 2**63 else kind.__name__
