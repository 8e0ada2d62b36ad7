"""Chain of hashes over the rows of a store: a changed, removed, added or reordered row breaks it.

Each stored row has an entry in the table `chain`: the SHA-256 of the row, and the head, the SHA-256 of the previous
head and of this row. The first head is a hash of the texts that identify the campaign. The last head is stored a second
time, signed with the key of the user (`marsyard.campaigns.store.key`). A row that replaces another one has a new entry.
The tables of the rows (`cases`, `layouts`, `kinds`) are those of `marsyard.campaigns.store.rows`.
"""

import hashlib
import json
import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

from marsyard.campaigns.store.key import is_signature, sign

#: SQL of the tables of the chain. A seal is a signed digest: the last head, or the SHA-256 of the table's file.
CHAIN_TABLES = """
CREATE TABLE chain (
    position INTEGER PRIMARY KEY, case_number INTEGER NOT NULL, row_hash BLOB NOT NULL, head BLOB NOT NULL
);
CREATE TABLE seals (name TEXT PRIMARY KEY, digest TEXT NOT NULL, signature TEXT NOT NULL);
"""
#: Names of the seals.
ROWS, TABLE = "rows", "table"
#: SQL of the entries, with their rows. A replaced row has no entry with its present position.
_ENTRIES = """
SELECT chain.position, chain.case_number, chain.row_hash, chain.head,
    CAST(cases.outcome AS BLOB), CAST(layouts.names AS BLOB), CAST(cases.row AS BLOB)
FROM chain
LEFT JOIN cases ON cases.case_number = chain.case_number AND cases.position = chain.position
LEFT JOIN layouts ON layouts.layout = cases.layout
ORDER BY chain.position
"""


class Seal(NamedTuple):
    """Digest of a seal, and whether this user signed it."""

    digest: str
    is_own: bool


def first_head(about: Mapping[str, str]) -> bytes:
    """Return the head of an empty store from the texts that identify its campaign."""
    return hashlib.sha256(json.dumps(dict(about), sort_keys=True).encode()).digest()


def hash_row(case: int, outcome: bytes, names: bytes, row: bytes) -> bytes:
    """Return the SHA-256 of a row, from the texts that are stored; the lengths separate the texts."""
    return hashlib.sha256(b"%d %d %d\n%b%b%b" % (case, len(outcome), len(names), outcome, names, row)).digest()


def next_head(head: bytes, row_hash: bytes, kinds: Iterable[tuple[str, str]]) -> bytes:
    """Return the head after a row; `kinds` are the types of columns that this row was the first to have."""
    return hashlib.sha256(head + row_hash + json.dumps(sorted(kinds)).encode()).digest()


def write_seal(connection: sqlite3.Connection, name: str, digest: str) -> None:
    """Store a digest with its signature. Raises StoreError if the key of the user cannot be read."""
    signature = sign(_seal_text(name, digest))
    connection.execute("INSERT OR REPLACE INTO seals VALUES (?, ?, ?)", (name, digest, signature))


def read_seals(connection: sqlite3.Connection) -> dict[str, Seal]:
    """Return the seals by name."""
    seals = connection.execute("SELECT name, digest, signature FROM seals")
    return {name: Seal(digest, is_signature(str(text), _seal_text(name, digest))) for name, digest, text in seals}


def _seal_text(name: str, digest: str) -> bytes:
    return f"{name} {digest}".encode()


def find_broken_link(connection: sqlite3.Connection, about: Mapping[str, str]) -> str:
    """Describe the first row that disagrees with the chain; an empty text if all rows agree."""
    head, last_case = first_head(about), None
    rows = 0
    without_row: dict[int, None] = {}
    kinds = _read_kinds(connection)
    for position, case, row_hash, stored_head, outcome, names, row in connection.execute(_ENTRIES):
        head = next_head(head, row_hash, kinds.pop(position, ()))
        if head != stored_head:
            return f"the chain of hashes breaks at case {case}: rows before it were changed, removed or reordered"
        if row is None:
            without_row[case] = None
        else:
            rows += 1
            without_row.pop(case, None)
            if names is None or hash_row(case, outcome, names, row) != row_hash:
                return f"the row of case {case} was changed after it was stored"
        last_case = case
    if without_row:
        return f"the row of case {next(iter(without_row))} was removed or replaced"
    added = next(_find_added_rows(connection), None) if rows != _count_rows(connection) else None
    if added is not None:
        return f"the row of case {added} was added or moved"
    seal = read_seals(connection).get(ROWS)
    # kinds of columns that are left belong to entries that were removed
    if seal is None or seal.digest != head.hex() or kinds:
        return f"rows after that of case {last_case} were removed" if rows else "rows were removed"
    return ""


def _read_kinds(connection: sqlite3.Connection) -> dict[int, list[tuple[str, str]]]:
    """Return the types of columns by the position of the entry whose row was the first to have them."""
    kinds: dict[int, list[tuple[str, str]]] = {}
    for name, kind, position in connection.execute("SELECT name, kind, position FROM kinds"):
        kinds.setdefault(position, []).append((name, kind))
    return kinds


def _count_rows(connection: sqlite3.Connection) -> int:
    return int(connection.execute("SELECT count(*) FROM cases").fetchone()[0])


def _find_added_rows(connection: sqlite3.Connection) -> Iterator[int]:
    """Yield the cases whose rows have no entry."""
    query = """
        SELECT cases.case_number FROM cases LEFT JOIN chain ON chain.position = cases.position
        WHERE chain.case_number IS NOT cases.case_number ORDER BY 1
    """
    return (case for (case,) in connection.execute(query))
