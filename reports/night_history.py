"""History of nightly runs ("nights"): the results of their campaigns, and the values of their metrics, in SQLite."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from marsyard.campaigns.errors import StoreError
from marsyard.campaigns.store.record import utc_now
from marsyard.reports.metrics import Metric
from marsyard.reports.statistics.difference_tests import Sample

#: Version of the tables, as `PRAGMA user_version`.
SCHEMA_VERSION = 1
#: Maximum number of earlier nights with which a night is compared.
MAX_EARLIER_NIGHTS = 30
#: Maximum number of stored cases per metric and night.
MAX_CASES = 10_000

#: States of a night.
RUNNING, FINISHED, INTERRUPTED = "running", "finished", "interrupted"

_TABLES = Path(__file__).parent / "templates" / "history.sql"


@dataclass(frozen=True)
class NightCampaign:
    """Result of a campaign in a night; `definition` is the hash of the campaign's definition."""

    name: str
    definition: str
    directory: str
    verdict: str
    exit_code: int
    sentence: str


@dataclass(frozen=True)
class Night:
    """A stored night: number, start and end, state (running, finished or interrupted), and commit of the program."""

    night: int
    started_utc: str
    finished_utc: str | None
    state: str
    git_commit: str | None


@dataclass(frozen=True)
class MetricChange:
    """A changed metric.

    - is_rate: whether the metric is a success rate (larger is better), not an error
    - before, now: rate or median error in the earlier nights and in this night; `now` is NaN without its column
    - p_value: p-value with Holm correction for the number of metrics compared in this night
    - nights: number of earlier nights
    """

    campaign: str
    metric: str
    is_rate: bool
    before: float
    now: float
    p_value: float
    nights: int

    @property
    def is_regression(self) -> bool:
        """Whether the change is a regression; a metric without its column is one."""
        if math.isnan(self.now):
            return True
        return self.now < self.before if self.is_rate else self.now > self.before


class History:
    """Database of the results of nightly runs, as a context manager with atomic writes; a missing file is created.

    The SQL table `figures` contains the metrics: `figure` is the name, `rate` is 1 for a rate, `level` is the value,
    and `amounts` are the values of the cases.

    Raises StoreError if the file cannot be opened, is not a history, or has another version.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        is_new = not path.exists()
        try:
            self._connection = sqlite3.connect(path, isolation_level=None)
            self._connection.execute("PRAGMA synchronous = FULL")
            version = self._connection.execute("PRAGMA user_version").fetchone()[0]
            if is_new or (version == 0 and not self._connection.execute("SELECT * FROM sqlite_master").fetchall()):
                tables = f"PRAGMA user_version = {SCHEMA_VERSION}; {_TABLES.read_text(encoding='utf-8')}"
                self._connection.executescript(f"BEGIN; {tables} COMMIT;")
            elif version != SCHEMA_VERSION:
                raise StoreError(f"{path} has schema {version}; this version of Marsyard reads {SCHEMA_VERSION}")
        except sqlite3.Error as error:
            raise StoreError(f"{path} is not a history of nights: {error}") from error

    def __enter__(self) -> History:
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.close()

    def begin(self, git_commit: str | None) -> int:
        """Begin a night and return its number; a night still marked as running becomes interrupted."""
        with self._transaction():
            self._connection.execute("UPDATE nights SET state = ? WHERE state = ?", (INTERRUPTED, RUNNING))
            row = self._connection.execute("SELECT COALESCE(MAX(night), 0) + 1 FROM nights").fetchone()
            self._connection.execute(
                "INSERT INTO nights VALUES (?, ?, NULL, ?, ?)", (row[0], utc_now(), RUNNING, git_commit)
            )
        return int(row[0])

    def add(self, night: int, campaign: NightCampaign, metrics: Sequence[Metric]) -> None:
        """Store the result of a campaign in a night."""
        rows, identity = [], (campaign.name, campaign.definition, campaign.directory)
        for metric in metrics:
            values, terrains = metric.sample.values[:MAX_CASES], metric.sample.terrains[:MAX_CASES]
            blobs = values.astype("<f4").tobytes(), terrains.astype("<i8").tobytes()
            rows.append((night, campaign.name, metric.name, metric.is_rate, metric.summary, *blobs))
        with self._transaction():
            self._connection.execute(
                "INSERT INTO campaigns VALUES (?, ?, ?, ?, ?, ?, ?)",
                (night, *identity, campaign.verdict, campaign.exit_code, campaign.sentence),
            )
            self._connection.executemany("INSERT INTO figures VALUES (?, ?, ?, ?, ?, ?, ?)", rows)

    def finish(self, night: int, state: str, changes: Sequence[MetricChange] = ()) -> None:
        """End a night with its changes."""
        with self._transaction():
            self._connection.executemany(
                "INSERT INTO changes VALUES (?, ?, ?, ?, ?)",
                [(night, item.campaign, item.metric, item.p_value, item.is_regression) for item in changes],
            )
            self._connection.execute(
                "UPDATE nights SET state = ?, finished_utc = ? WHERE night = ?", (state, utc_now(), night)
            )

    def nights(self) -> list[Night]:
        """List all nights, the latest first."""
        return [Night(*row) for row in self._connection.execute("SELECT * FROM nights ORDER BY night DESC")]

    def campaigns(self, night: int) -> list[NightCampaign]:
        """List the results of the campaigns of a night, in the order in which the campaigns ended."""
        rows = self._connection.execute(
            "SELECT name, definition, directory, verdict, exit_code, sentence FROM campaigns WHERE night = ? "
            "ORDER BY rowid",
            (night,),
        )
        return [NightCampaign(*row) for row in rows]

    def metrics(self, night: int, campaign: str) -> list[Metric]:
        """List the metrics of a campaign in a night."""
        rows = self._connection.execute(
            "SELECT figure, rate, amounts, terrains FROM figures WHERE night = ? AND campaign = ? ORDER BY rowid",
            (night, campaign),
        )
        return [Metric(name, bool(is_rate), _unpack(*stored)) for name, is_rate, *stored in rows]

    def earlier_samples(self, night: int, campaign: NightCampaign, metric: str) -> list[Sample]:
        """Read the samples of a metric in earlier finished nights since its last change, the latest first."""
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
            (night, campaign.name, metric, campaign.definition, FINISHED, night, MAX_EARLIER_NIGHTS),
        )
        return [_unpack(*row) for row in rows]

    def missing_metrics(self, night: int, campaign: NightCampaign) -> list[Metric]:
        """List the metrics of the previous finished night of a campaign that this night lacks, without values."""
        rows = self._connection.execute(
            """
            SELECT figure, rate FROM figures WHERE campaign = :campaign AND night = (
                SELECT MAX(n.night) FROM nights n JOIN campaigns c ON c.night = n.night
                WHERE n.night < :night AND n.state = :state AND c.name = :campaign AND c.definition = :definition)
            AND figure NOT IN (SELECT figure FROM figures WHERE campaign = :campaign AND night = :night) ORDER BY rowid
            """,
            {"night": night, "campaign": campaign.name, "state": FINISHED, "definition": campaign.definition},
        )
        return [Metric(name, bool(is_rate), _unpack(b"", b"")) for name, is_rate in rows]

    @contextmanager
    def _transaction(self) -> Iterator[None]:
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


def _unpack(values: bytes, terrains: bytes) -> Sample:
    return Sample(np.frombuffer(values, "<f4").astype(np.float64), np.frombuffer(terrains, "<i8").astype(np.int64))
