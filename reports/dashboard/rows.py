"""The dashboard's table: a row for each requirement, with its latest verdict, its margin and its trend."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from marsyard.campaigns.definition.requirements import StatedRequirement
from marsyard.reports.dashboard.entries import Entry, Shown
from marsyard.reports.verdicts import ESTIMATE
from marsyard.reports.wording import NOTHING, percent

#: Further campaigns whose latest verdicts stand beside a requirement's.
MOST_BESIDE = 7
#: Campaigns that a sparkline shows, the latest ones, and its size in pixels.
_TREND, _WIDTH, _HEIGHT = 24, 120.0, 26.0


@dataclass(frozen=True)
class Sparkline:
    """Rates seen over time, the oldest to the left: a line's points, the last of them, the height of the rate asked."""

    points: str
    last: tuple[float, float]
    asked: float
    text: str


@dataclass(frozen=True)
class Cell:
    """A campaign's verdict on a requirement."""

    entry: Entry
    shown: Shown


@dataclass(frozen=True)
class RequirementRow:
    """A requirement: what it asks, the latest of each campaign, and the trend of the campaign judged last.

    `all_cells` are the verdicts of all campaigns, the latest first, those that did not come to their end behind all
    others; `cells` the latest of each campaign's name.
    """

    requirement: str
    statement: str
    kind: str
    source: str
    cells: Sequence[Cell]
    all_cells: Sequence[Cell]
    trend: Sparkline | None

    @property
    def latest(self) -> Cell | None:
        """The verdict of the campaign that was run last, and to its end where any was."""
        return self.cells[0] if self.cells else None


def requirement_rows(entries: Sequence[Entry], stated: Mapping[str, StatedRequirement]) -> list[RequirementRow]:
    """A row for every requirement that is stated or that a campaign asks; the stated ones first."""
    cells: dict[str, list[Cell]] = {name: [] for name in stated}
    for entry in entries:
        for shown in entry.shown:
            cells.setdefault(shown.requirement, []).append(Cell(entry, shown))
    return [_row(name, found, stated.get(name)) for name, found in cells.items()]


def _row(name: str, listed: Sequence[Cell], stated: StatedRequirement | None) -> RequirementRow:
    found = sorted(listed, key=lambda cell: not cell.entry.finished)
    latest: dict[str, Cell] = {}
    for cell in found:
        latest.setdefault(cell.entry.name, cell)
    cells = list(latest.values())
    same = [cell for cell in found if cell.entry.name == cells[0].entry.name and cell.entry.finished]
    return RequirementRow(
        requirement=name,
        statement=stated.statement if stated else (cells[0].shown.statement if cells else ""),
        kind=(stated.kind or "") if stated else "",
        source=stated.source if stated else "",
        cells=cells,
        all_cells=found,
        trend=sparkline([cell.shown for cell in reversed(same)]),
    )


def sparkline(shown: Sequence[Shown]) -> Sparkline | None:
    """Rates seen over time against the rate asked; None where fewer than two campaigns tell one."""
    known = [one for one in shown if math.isfinite(one.estimate) and math.isfinite(one.probability)][-_TREND:]
    if len(known) < 2:
        return None
    rates = [one.estimate for one in known]
    low = min(*rates, *(one.probability for one in known))
    low -= 0.15 * (1.0 - low) + 1e-9
    step = (_WIDTH - 8.0) / (len(known) - 1)

    def height(rate: float) -> float:
        return round(3.0 + (_HEIGHT - 6.0) * (1.0 - rate) / (1.0 - low), 2)

    places = [(round(4.0 + step * k, 2), height(rate)) for k, rate in enumerate(rates)]
    text = f"{len(known)} campaigns, rates {percent(rates[0])} to {percent(rates[-1])}"
    return Sparkline(" ".join(f"{x},{y}" for x, y in places), places[-1], height(known[-1].probability), text)


def coverage(rows: Sequence[RequirementRow]) -> list[tuple[str, int]]:
    """Latest verdicts and how many requirements have each, those that no campaign shows last."""
    words = [row.latest.shown.status for row in rows if row.latest is not None]
    known = [word for word in dict.fromkeys(("FAIL", "INSUFFICIENT", "MET BY RATE", "PASS", *words)) if word in words]
    found = [(word, words.count(word)) for word in known]
    missing = sum(row.latest is None for row in rows)
    return [*found, ("NO CAMPAIGN", missing)] if missing else found


def evidence_text(shown: Shown) -> str:
    """The cases behind a verdict."""
    return f"{shown.failures:,} of {shown.n:,} failed" if shown.n else "no case yet"


def basis_text(shown: Shown) -> str:
    """What a verdict rests on where that is no confidence; empty otherwise."""
    return "decided by rate" if shown.decide_by == ESTIMATE else ""


def margin_text(shown: Shown) -> str:
    """By how much what decides lies above or below the rate asked, in percentage points."""
    if math.isnan(shown.margin):
        return NOTHING
    return f"{100.0 * shown.margin:+.2f} pp".replace("-", "−")
