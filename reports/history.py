"""History of nightly runs in an SQLite file, detection of changed figures, and the page `nightly.md`."""

from __future__ import annotations

import math
import sqlite3
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import takewhile
from pathlib import Path

import numpy as np

from marsyard.campaigns.errors import StoreError
from marsyard.reports.statistics.changes import Sample, difference_p, holm
from marsyard.reports.wording import count, format_fraction, number, percent

#: Version of the tables, as `PRAGMA user_version`.
SCHEMA = 1
#: Maximum number of earlier nights that a night is compared with.
WINDOW = 30
#: Maximum number of stored cases of a figure and night.
MAX_CASES = 10_000

RUNNING, FINISHED, INTERRUPTED = "running", "finished", "interrupted"

_TABLES = Path(__file__).parent / "templates" / "history.sql"


@dataclass(frozen=True)
class NightCampaign:
    """Result of a campaign in a night; `definition` identifies the campaign's contents."""

    name: str
    definition: str
    directory: str
    verdict: str
    exit_code: int
    sentence: str


@dataclass(frozen=True)
class NightFigure:
    """One figure of a campaign in a night: rate or error, its level, and its cases."""

    figure: str
    rate: bool
    level: float
    sample: Sample


@dataclass(frozen=True)
class Night:
    """A stored night."""

    night: int
    started_utc: str
    finished_utc: str | None
    state: str
    git_commit: str | None


class History:
    """The history as a context manager, with atomic writes; a missing file is created.

    Raises StoreError if the file cannot be opened, is no history, or has another version.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        fresh = not path.exists()
        try:
            self._connection = sqlite3.connect(path, isolation_level=None)
            self._connection.execute("PRAGMA synchronous = FULL")
            version = self._connection.execute("PRAGMA user_version").fetchone()[0]
            if fresh or (version == 0 and not self._connection.execute("SELECT * FROM sqlite_master").fetchall()):
                tables = f"PRAGMA user_version = {SCHEMA}; {_TABLES.read_text(encoding='utf-8')}"
                self._connection.executescript(f"BEGIN; {tables} COMMIT;")
            elif version != SCHEMA:
                raise StoreError(f"{path} has schema {version}; this version of Marsyard reads {SCHEMA}")
        except sqlite3.Error as error:
            raise StoreError(f"{path} is no history of nights: {error}") from error

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

    def add(self, night: int, campaign: NightCampaign, figures: Sequence[NightFigure]) -> None:
        """Store the result of a campaign in a night."""
        one, rows = campaign, []
        for figure in figures:
            values, terrains = figure.sample.values[:MAX_CASES], figure.sample.terrains[:MAX_CASES]
            packed = values.astype("<f4").tobytes(), terrains.astype("<i8").tobytes()
            rows.append((night, one.name, figure.figure, figure.rate, figure.level, *packed))
        with self._transaction():
            self._connection.execute(
                "INSERT INTO campaigns VALUES (?, ?, ?, ?, ?, ?, ?)",
                (night, one.name, one.definition, one.directory, one.verdict, one.exit_code, one.sentence),
            )
            self._connection.executemany("INSERT INTO figures VALUES (?, ?, ?, ?, ?, ?, ?)", rows)

    def finish(self, night: int, state: str, changes: Sequence[tuple[str, str, float, bool]] = ()) -> None:
        """End a night with its changes: campaign, figure, corrected p, whether it is a regression."""
        with self._transaction():
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
        """Results of the campaigns of a night, in the order in which they ended."""
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
            NightFigure(name, bool(rate), float("nan") if level is None else level, _unpack(values, terrains))
            for name, rate, level, values, terrains in rows
        ]

    def before(self, night: int, campaign: NightCampaign, figure: str) -> list[Sample]:
        """A figure in earlier finished nights of the same campaign, the latest first, back to its last change."""
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


def utc_now() -> str:
    """Current time, to the second."""
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def _unpack(values: bytes, terrains: bytes) -> Sample:
    return Sample(np.frombuffer(values, "<f4").astype(np.float64), np.frombuffer(terrains, "<i8").astype(np.int64))


#: Maximum probability of any reported change in a night without changes.
FALSE_ALARMS = 0.01
#: Significance level of changes; the other half is for nights that follow a false alarm.
_LEVEL = 0.5 * FALSE_ALARMS
#: Expected number of permutations beyond a change at the significance level.
_RESOLVED = 10


@dataclass(frozen=True)
class Change:
    """A changed figure.

    rate: whether it is a rate of successes, where more is better, or an error
    before, now: rate or median in the earlier nights and tonight
    p_value: corrected for the number of figures compared tonight
    nights: number of earlier nights
    """

    campaign: str
    figure: str
    rate: bool
    before: float
    now: float
    p_value: float
    nights: int

    @property
    def worse(self) -> bool:
        """Whether the change is a regression."""
        return self.now < self.before if self.rate else self.now > self.before


@dataclass(frozen=True)
class Comparison:
    """A figure of tonight with its samples in earlier nights."""

    campaign: str
    figure: NightFigure
    before: Sequence[Sample]


def changes(comparisons: Sequence[Comparison]) -> list[Change]:
    """The changed figures of a night, with a family-wise rate of false alarms of at most `FALSE_ALARMS`."""
    pooled: list[Sample | None] = []
    for one in comparisons:
        parts = ([getattr(sample, part) for sample in one.before] for part in ("values", "terrains"))
        pooled.append(Sample(*map(np.concatenate, parts)) if one.before else None)
    permutations = math.ceil(_RESOLVED * len(comparisons) / _LEVEL)
    p_values = holm(
        [
            math.nan if before is None else difference_p(one.figure.sample, before, permutations)
            for one, before in zip(comparisons, pooled, strict=True)
        ]
    )
    return [
        Change(
            campaign=one.campaign,
            figure=one.figure.figure,
            rate=one.figure.rate,
            before=quality_level(before, one.figure.rate),
            now=quality_level(one.figure.sample, one.figure.rate),
            p_value=p,
            nights=len(one.before),
        )
        for one, before, p in zip(comparisons, pooled, p_values, strict=True)
        if before is not None and p <= _LEVEL
    ]


def compare_night(history: History, night: int) -> list[Comparison]:
    """Every figure of a night with its samples in earlier nights."""
    return [
        Comparison(campaign.name, figure, history.before(night, campaign, figure.figure))
        for campaign in history.campaigns(night)
        for figure in history.figures(night, campaign.name)
    ]


def quality_level(sample: Sample, rate: bool) -> float:
    """The rate or the median; NaN for no cases."""
    known = sample.known().values
    if known.size == 0:
        return math.nan
    return float(known.mean() if rate else np.median(known))


def night_text(
    night: Night, earlier: Sequence[Night], campaigns: Sequence[NightCampaign], found: Sequence[Change], compared: int
) -> str:
    """The night's page in Markdown.

    earlier: previous nights, the latest first
    found, compared: changed figures, and how many were compared
    """
    worse = [one for one in found if one.worse]
    better = [one for one in found if not one.worse]
    counts = Counter(one.verdict for one in campaigns)
    headline, end = night.state.upper(), f"{night.state}: its figures are kept aside"
    if night.state == FINISHED:
        verdicts = ", ".join(f"{cases} {word}" for word, cases in counts.items())
        headline = verdicts + (f", {count(len(worse), 'regression')}" if worse else "")
        end = f"ended {night.finished_utc}"
    lines = [f"# Night {night.night}: {headline}", ""]
    lines.append(f"Begun {night.started_utc}, {end}; commit {night.git_commit or 'not known'}.")
    broken = list(takewhile(lambda one: one.state != FINISHED, earlier))
    lines += [""] * bool(broken)
    lines += [f"Night {one.night}, begun {one.started_utc}, was {one.state}." for one in broken]
    lines += ["", "| Campaign | Verdict | |", "|---|---|---|"]
    lines += [f"| {_cell(one.name)} | {_cell(one.verdict)} | {_cell(one.sentence)} |" for one in campaigns]
    for title, some in (("Regressions", worse), ("Improvements", better)):
        if some:
            lines += ["", f"## {title}", ""]
        for one in some:
            show = percent if one.rate else number
            figures = f"{show(one.before)} in {count(one.nights, 'night')} before, {show(one.now)} now"
            lines.append(f"- **{_cell(one.campaign)}: {_cell(one.figure)}**: {figures} (p = {one.p_value:.1g})")
    text = (
        f"{count(compared, 'figure')} compared with the nights before; the chance of any false alarm is at most "
        f"{format_fraction(FALSE_ALARMS)}.{'' if found else ' None has changed.'}"
    )
    lines += ["", text if compared else "No figure has a history to be compared with yet.", ""]
    return "\n".join(lines)


def _cell(text: str) -> str:
    marks = {letter: f"&#{ord(letter)};" for letter in "&<>|"} | {letter: f"\\{letter}" for letter in "\\`*_[]#"}
    return "".join(marks.get(letter, letter) for letter in " ".join(text.split()))
