"""Nightly runs: their history in an SQLite file, the metrics that changed, and the page of a night."""

from __future__ import annotations

import math
import sqlite3
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path

import numpy as np

from marsyard.campaigns.errors import StoreError
from marsyard.campaigns.store.record import utc_now
from marsyard.reports.statistics.difference_tests import Metric, Sample, correct_holm, difference_p_value
from marsyard.reports.wording import count, format_fraction, number, percent

#: Maximum probability of at least one false alarm in a night in which no metric has changed.
MAX_FALSE_ALARM_PROBABILITY = 0.01
#: Significance level of changes. The other half of the probability allows for a second false alarm: after a false
#: alarm, the only reference is one unusual night (docs/adr/0027).
_SIGNIFICANCE = 0.5 * MAX_FALSE_ALARM_PROBABILITY
#: Expected number of permutations that exceed a change at the significance level.
_MIN_EXCEEDANCES = 10


@dataclass(frozen=True)
class MetricChange:
    """A changed metric.

    - is_rate: whether the metric is a success rate (larger is better), not an error
    - before, now: rate or median error in the earlier nights and in this night
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
        """Whether the change is a regression."""
        return self.now < self.before if self.is_rate else self.now > self.before


@dataclass(frozen=True)
class NightComparison:
    """A metric of one night, and its samples in earlier nights (`before`)."""

    campaign: str
    metric: Metric
    before: Sequence[Sample]


def find_changes(comparisons: Sequence[NightComparison]) -> list[MetricChange]:
    """Find the changed metrics of a night; a false alarm has at most the probability `MAX_FALSE_ALARM_PROBABILITY`."""
    earlier_samples: list[Sample | None] = []
    for comparison in comparisons:
        columns = ([getattr(sample, field) for sample in comparison.before] for field in ("values", "terrains"))
        earlier_samples.append(Sample(*map(np.concatenate, columns)) if comparison.before else None)
    # Holm's method compares the smallest p-value with the significance level divided by the number of metrics
    permutations = math.ceil(_MIN_EXCEEDANCES * len(comparisons) / _SIGNIFICANCE)
    p_values = correct_holm(
        [
            math.nan if sample is None else difference_p_value(comparison.metric.sample, sample, permutations)
            for comparison, sample in zip(comparisons, earlier_samples, strict=True)
        ]
    )
    return [
        MetricChange(
            campaign=comparison.campaign,
            metric=comparison.metric.name,
            is_rate=comparison.metric.is_rate,
            before=replace(comparison.metric, sample=sample).summary,
            now=comparison.metric.summary,
            p_value=p_value,
            nights=len(comparison.before),
        )
        for comparison, sample, p_value in zip(comparisons, earlier_samples, p_values, strict=True)
        if sample is not None and p_value <= _SIGNIFICANCE
    ]


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


def list_comparisons(history: History, night: int) -> list[NightComparison]:
    """List every metric of a night with its samples in earlier nights."""
    return [
        NightComparison(campaign.name, metric, history.earlier_samples(night, campaign, metric.name))
        for campaign in history.campaigns(night)
        for metric in history.metrics(night, campaign.name)
    ]


def format_night_page(
    night: Night,
    earlier: Sequence[Night],
    campaigns: Sequence[NightCampaign],
    changes: Sequence[MetricChange],
    compared: int,
) -> str:
    """Format the night's page in Markdown.

    - earlier: previous nights, the latest first
    - changes: changed metrics
    - compared: number of compared metrics
    """
    regressions = [change for change in changes if change.is_regression]
    improvements = [change for change in changes if not change.is_regression]
    verdict_counts = Counter(campaign.verdict for campaign in campaigns)
    headline, end = night.state.upper(), f"{night.state}: its metrics are excluded from comparisons"
    if night.state == FINISHED:
        verdicts = ", ".join(f"{n_campaigns} {verdict}" for verdict, n_campaigns in verdict_counts.items())
        headline = verdicts + (f", {count(len(regressions), 'regression')}" if regressions else "")
        end = f"ended {night.finished_utc}"
    lines = [f"# Night {night.night}: {headline}", ""]
    lines.append(f"Started {night.started_utc}, {end}; commit {night.git_commit or 'not known'}.")
    unfinished_nights = list(takewhile(lambda earlier_night: earlier_night.state != FINISHED, earlier))
    lines += [""] * bool(unfinished_nights)
    lines += [
        f"Night {previous.night}, started {previous.started_utc}, was {previous.state}."
        for previous in unfinished_nights
    ]
    lines += ["", "| Campaign | Verdict | |", "|---|---|---|"]
    lines += [f"| {_escape(run.name)} | {_escape(run.verdict)} | {_escape(run.sentence)} |" for run in campaigns]
    for title, group_changes in (("Regressions", regressions), ("Improvements", improvements)):
        if group_changes:
            lines += ["", f"## {title}", ""]
        for change in group_changes:
            before, now = ((percent if change.is_rate else number)(value) for value in (change.before, change.now))
            values = f"{before} in {count(change.nights, 'earlier night')}, {now} now (p = {change.p_value:.1g})"
            lines.append(f"- **{_escape(change.campaign)}: {_escape(change.metric)}**: {values}")
    text = (
        f"{count(compared, 'metric')} compared with earlier nights; the probability of a false alarm is at most "
        f"{format_fraction(MAX_FALSE_ALARM_PROBABILITY)}.{'' if changes else ' No metric has changed.'}"
    )
    lines += ["", text if compared else "No metric has a history for a comparison yet.", ""]
    return "\n".join(lines)


def _escape(text: str) -> str:
    """Escape characters with a meaning in Markdown or HTML."""
    escapes = {letter: f"&#{ord(letter)};" for letter in "&<>|"} | {letter: f"\\{letter}" for letter in "\\`*_[]#"}
    return "".join(escapes.get(letter, letter) for letter in " ".join(text.split()))
