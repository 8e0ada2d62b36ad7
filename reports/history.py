"""What nights found, in one SQLite file: figures case by case, so that any later night can be held against them."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from marsyard.campaigns.errors import StoreError
from marsyard.reports.statistics.changes import Sample

#: Version of the tables, as `PRAGMA user_version`.
SCHEMA = 1
#: Nights that a night is held against, at most: the latest ones.
WINDOW = 30
#: Cases of a figure that are kept of a night, at most.
MAX_CASES = 10_000

RUNNING, FINISHED, INTERRUPTED = "running", "finished", "interrupted"

_TABLES = f"""
PRAGMA user_version = {SCHEMA};
CREATE TABLE nights (
    night INTEGER PRIMARY KEY, started_utc TEXT NOT NULL, finished_utc TEXT, state TEXT NOT NULL, git_commit TEXT
);
CREATE TABLE campaigns (
    night INTEGER NOT NULL REFERENCES nights, name TEXT NOT NULL, definition TEXT NOT NULL, directory TEXT NOT NULL,
    verdict TEXT NOT NULL, exit_code INTEGER NOT NULL, sentence TEXT NOT NULL, PRIMARY KEY (night, name)
);
CREATE TABLE figures (
    night INTEGER NOT NULL REFERENCES nights, campaign TEXT NOT NULL, figure TEXT NOT NULL, rate INTEGER NOT NULL,
    level REAL, amounts BLOB NOT NULL, terrains BLOB NOT NULL, PRIMARY KEY (night, campaign, figure)
);
CREATE TABLE changes (
    night INTEGER NOT NULL REFERENCES nights, campaign TEXT NOT NULL, figure TEXT NOT NULL, p_value REAL NOT NULL,
    worse INTEGER NOT NULL, PRIMARY KEY (night, campaign, figure)
);
"""


@dataclass(frozen=True)
class NightCampaign:
    """What a campaign came to in a night; `definition` tells campaigns of one name but other contents apart."""

    name: str
    definition: str
    directory: str
    verdict: str
    exit_code: int
    sentence: str


@dataclass(frozen=True)
class NightFigure:
    """One figure of a campaign in a night: whether it is a rate, its level, and its cases."""

    figure: str
    rate: bool
    level: float
    sample: Sample


@dataclass(frozen=True)
class Night:
    """A night as the history has it."""

    night: int
    started_utc: str
    finished_utc: str | None
    state: str
    git_commit: str | None


class History:
    """The history, as a context: one writer at a time, every step whole or not at all.

    Parameters
    ----------
    path
        The file, which is made where there is none.

    Raises
    ------
    StoreError
        Where it cannot be opened, is no history, or is one of another version.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        fresh = not path.exists()
        try:
            self._connection = sqlite3.connect(path, isolation_level=None)
            self._connection.execute("PRAGMA synchronous = FULL")
            version = self._connection.execute("PRAGMA user_version").fetchone()[0]
            if fresh or (version == 0 and not self._connection.execute("SELECT * FROM sqlite_master").fetchall()):
                self._connection.executescript(f"BEGIN; {_TABLES} COMMIT;")
            elif version != SCHEMA:
                raise StoreError(f"{path} has schema {version}; this version of Marsyard reads {SCHEMA}")
        except sqlite3.Error as error:
            raise StoreError(f"{path} is no history of nights: {error}") from error

    def __enter__(self) -> History:
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.close()

    def begin(self, git_commit: str | None) -> int:
        """Begins a night and returns its number; one that was still running was interrupted, and is marked so."""
        with self._whole():
            self._connection.execute("UPDATE nights SET state = ? WHERE state = ?", (INTERRUPTED, RUNNING))
            row = self._connection.execute("SELECT COALESCE(MAX(night), 0) + 1 FROM nights").fetchone()
            self._connection.execute(
                "INSERT INTO nights VALUES (?, ?, NULL, ?, ?)", (row[0], utc_now(), RUNNING, git_commit)
            )
        return int(row[0])

    def add(self, night: int, campaign: NightCampaign, figures: Sequence[NightFigure]) -> None:
        """Keeps what a campaign came to in a night."""
        one = campaign
        with self._whole():
            self._connection.execute(
                "INSERT INTO campaigns VALUES (?, ?, ?, ?, ?, ?, ?)",
                (night, one.name, one.definition, one.directory, one.verdict, one.exit_code, one.sentence),
            )
            self._connection.executemany(
                "INSERT INTO figures VALUES (?, ?, ?, ?, ?, ?, ?)",
                [
                    (night, one.name, figure.figure, figure.rate, figure.level, *_packed(figure.sample))
                    for figure in figures
                ],
            )

    def finish(self, night: int, state: str, changes: Sequence[tuple[str, str, float, bool]] = ()) -> None:
        """Ends a night with the changes that it found: campaign, figure, corrected p, whether it is for the worse."""
        with self._whole():
            self._connection.executemany(
                "INSERT INTO changes VALUES (?, ?, ?, ?, ?)", [(night, *one) for one in changes]
            )
            self._connection.execute(
                "UPDATE nights SET state = ?, finished_utc = ? WHERE night = ?", (state, utc_now(), night)
            )

    def nights(self) -> list[Night]:
        """All nights, the latest first."""
        return [Night(*row) for row in self._connection.execute("SELECT * FROM nights ORDER BY night DESC")]

    def campaigns(self, night: int) -> list[NightCampaign]:
        """What the campaigns of a night came to, in the order in which they ended."""
        rows = self._connection.execute(
            "SELECT name, definition, directory, verdict, exit_code, sentence FROM campaigns WHERE night = ? "
            "ORDER BY rowid",
            (night,),
        )
        return [NightCampaign(*row) for row in rows]

    def figures(self, night: int, campaign: str) -> list[NightFigure]:
        """A campaign's figures in a night."""
        rows = self._connection.execute(
            "SELECT figure, rate, level, amounts, terrains FROM figures WHERE night = ? AND campaign = ? "
            "ORDER BY rowid",
            (night, campaign),
        )
        return [
            NightFigure(name, bool(rate), float("nan") if level is None else level, _unpacked(values, terrains))
            for name, rate, level, values, terrains in rows
        ]

    def before(self, night: int, campaign: NightCampaign, figure: str) -> list[Sample]:
        """A figure in earlier nights of the same campaign, the latest first: those that came to their end, back to the
        night that last found it changed, which is the first of the new state.
        """
        rows = self._connection.execute(
            """
            SELECT f.amounts, f.terrains FROM figures f
            JOIN nights n ON n.night = f.night
            JOIN campaigns c ON c.night = f.night AND c.name = f.campaign
            WHERE f.night < ? AND f.campaign = ? AND f.figure = ? AND c.definition = ? AND n.state = ?
            AND f.night >= COALESCE(
                (SELECT MAX(night) FROM changes WHERE campaign = f.campaign AND figure = f.figure AND night < ?), 0)
            ORDER BY f.night DESC LIMIT ?
            """,
            (night, campaign.name, figure, campaign.definition, FINISHED, night, WINDOW),
        )
        return [_unpacked(*row) for row in rows]

    @contextmanager
    def _whole(self) -> Iterator[None]:
        """One transaction."""
        try:
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield
            except BaseException:
                with suppress(sqlite3.Error):
                    self._connection.execute("ROLLBACK")
                raise
            self._connection.execute("COMMIT")
        except sqlite3.Error as error:
            raise StoreError(f"{self._path} cannot be written: {error}") from error


def utc_now() -> str:
    """The time, to the second."""
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def _packed(sample: Sample) -> tuple[bytes, bytes]:
    values, terrains = sample.values[:MAX_CASES], sample.terrains[:MAX_CASES]
    return values.astype("<f4").tobytes(), terrains.astype("<i8").tobytes()


def _unpacked(values: bytes, terrains: bytes) -> Sample:
    return Sample(np.frombuffer(values, "<f4").astype(np.float64), np.frombuffer(terrains, "<i8").astype(np.int64))
