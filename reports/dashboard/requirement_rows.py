"""Rows of the dashboard's table: one per requirement, with its verdicts in all campaigns."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from marsyard.campaigns.definition.evidence import EvidenceKind
from marsyard.campaigns.definition.requirements import SharedRequirement
from marsyard.reports.dashboard.entries import Entry
from marsyard.reports.overall import EXPLORATORY_PASS, describe_status
from marsyard.reports.robustness_wording import reach_text
from marsyard.reports.verdicts import ESTIMATE, GIVEN_TRUTH, Status, Verdict
from marsyard.reports.wording import NOTHING, format_fraction, percent

#: Maximum number of campaigns in a sparkline, and its width and height, pixels.
_MAX_POINTS, _WIDTH_PX, _HEIGHT_PX = 24, 120.0, 26.0
#: Maximum number of other campaigns next to a requirement's verdict.
MAX_OTHER_VERDICTS = 7


@dataclass(frozen=True)
class Sparkline:
    """Line of the observed rates over time, oldest first, in pixels of an SVG image.

    - points: points of the line as SVG text ("x,y x,y"); last: the last point
    - required_y: y of the line of the required rate; text: description of the line
    """

    points: str
    last: tuple[float, float]
    required_y: float
    text: str


@dataclass(frozen=True)
class Cell:
    """Verdict of a campaign on a requirement; `changes` describes how the campaign has changed the requirement."""

    entry: Entry
    verdict: Verdict
    changes: str = ""

    @property
    def word(self) -> str:
        """The status; PASS of an exploration is marked."""
        is_exploration = self.entry.report.evidence.kind is EvidenceKind.EXPLORATION
        return describe_status(self.verdict.status, is_exploration=is_exploration)

    @property
    def is_confirmation(self) -> bool:
        """Whether the campaign is a confirmation, which precedes all explorations."""
        return self.entry.report.evidence.is_confirmation

    @property
    def basis(self) -> str:
        """What the verdict is based on, and how far it reaches; may be empty."""
        by_rate = "evaluated by observed rate" if self.verdict.decide_by == ESTIMATE else ""
        reach = reach_text(self.verdict, self.entry.report.robustness)
        return "; ".join(filter(None, (self.changes, by_rate, reach)))


@dataclass(frozen=True)
class RequirementRow:
    """A requirement, its latest verdict for each campaign name, and the trend of the first of these campaigns.

    - cells: verdict for each campaign name, the first one in the order of `all_cells`
    - all_cells: verdicts of all campaigns: confirmations, then other campaigns, then campaigns that have changed the
      requirement, then unfinished ones, each the latest first
    - studies: latest study of each kind and campaign name
    """

    requirement: str
    statement: str
    kind: str
    source: str
    cells: Sequence[Cell]
    all_cells: Sequence[Cell]
    trend: Sparkline | None
    studies: Sequence[Entry]

    @property
    def latest(self) -> Cell | None:
        """Verdict of the latest confirmation, or of the latest campaign without one; None without a campaign."""
        return self.cells[0] if self.cells else None


def requirement_rows(entries: Sequence[Entry], shared: Mapping[str, SharedRequirement]) -> list[RequirementRow]:
    """Create a row for each requirement of `shared` and of the campaigns, the most severe verdict first."""
    cells: dict[str, list[Cell]] = {name: [] for name in shared}
    for entry in entries:
        for verdict in entry.report.verdicts:
            name = verdict.requirement_id
            cells.setdefault(name, []).append(Cell(entry, verdict, describe_changes(verdict, shared.get(name))))
        if entry.report.study is not None:
            cells.setdefault(entry.report.study.requirement, [])
    rows = []
    for name, unsorted_cells in cells.items():
        sorted_cells = sorted(
            unsorted_cells, key=lambda cell: (not cell.entry.is_finished, bool(cell.changes), not cell.is_confirmation)
        )
        latest_by_campaign: dict[str, Cell] = {}
        for cell in sorted_cells:
            latest_by_campaign.setdefault(cell.entry.name, cell)
        latest = list(latest_by_campaign.values())
        history = [
            cell.verdict
            for cell in sorted_cells
            if cell.entry.name == latest[0].entry.name
            and cell.entry.is_finished
            and cell.is_confirmation == latest[0].is_confirmation
        ]
        requirement, kind, source = shared.get(name), "", ""
        statement = latest[0].verdict.statement if latest else ""
        if requirement:
            statement = statement if statement.startswith(GIVEN_TRUTH) else requirement.statement
            kind, source = requirement.kind or "", requirement.source
        studies: dict[str, Entry] = {}
        for entry in entries:
            if entry.report.study is not None and entry.report.study.requirement == name:
                studies.setdefault(entry.title, entry)
        line = sparkline(history[::-1])
        rows.append(RequirementRow(name, statement, kind, source, latest, sorted_cells, line, [*studies.values()]))
    # failed requirements first, then PASS of explorations before PASS, those without a campaign last
    words = [*map(str, Status), EXPLORATORY_PASS, Status.PASS]
    order = {word: index for index, word in enumerate(words)} | {None: len(words)}
    return sorted(rows, key=lambda row: order[row.latest.word if row.latest else None])


def sparkline(verdicts: Sequence[Verdict]) -> Sparkline | None:
    """Create the line of observed rates over time and of the required rate; None for fewer than two campaigns."""
    finite = [verdict for verdict in verdicts if all(map(math.isfinite, (verdict.estimate, verdict.probability)))]
    finite = finite[-_MAX_POINTS:]
    if len(finite) < 2:
        return None
    rates = [verdict.estimate for verdict in finite]
    low = min(*rates, *(verdict.probability for verdict in finite))
    # margin below the lowest rate: 15 % of its distance from 100 %; positive also if all rates are 100 %
    low -= 0.15 * (1.0 - low) + 1e-9
    # margins of 4 pixels on the left and right, of 3 pixels at the top and bottom
    step_px = (_WIDTH_PX - 8.0) / (len(finite) - 1)

    def compute_y(rate: float) -> float:
        return round(3.0 + (_HEIGHT_PX - 6.0) * (1.0 - rate) / (1.0 - low), 2)

    points = [(round(4.0 + step_px * index, 2), compute_y(rate)) for index, rate in enumerate(rates)]
    text = f"{len(finite)} campaigns, rates {percent(rates[0])} to {percent(rates[-1])}"
    return Sparkline(" ".join(f"{x},{y}" for x, y in points), points[-1], compute_y(finite[-1].probability), text)


def count_verdicts(rows: Sequence[RequirementRow]) -> list[tuple[str, int]]:
    """Count the requirements per verdict in the order of the rows; requirements without a campaign come last."""
    counts = [*Counter(row.latest.word for row in rows if row.latest is not None).items()]
    n_missing = sum(row.latest is None for row in rows)
    return [*counts, ("NO CAMPAIGN", n_missing)] if n_missing else counts


def evidence_text(verdict: Verdict) -> str:
    """Describe the number of cases of a verdict."""
    if not verdict.n:
        return "no case yet"
    text = f"{verdict.failures:,} of {verdict.n:,} failed"
    all_cases = verdict.all_cases
    if all_cases is None or all_cases.n == verdict.n:
        return text
    return f"{text}; over all cases {all_cases.failures:,} of {all_cases.n:,}"


def describe_changes(verdict: Verdict, shared: SharedRequirement | None) -> str:
    """Describe how a campaign has changed a shared requirement; empty if it has not."""
    if shared is None:
        return ""
    bound = math.nan if shared.bound is None else shared.bound
    values: dict[str, tuple[object, object]] = {
        "required rate": (format_fraction(verdict.probability), format_fraction(shared.probability)),
        "confidence": (format_fraction(verdict.confidence), format_fraction(shared.confidence)),
        "population": (verdict.population, shared.population),
        "metric": (verdict.metric, shared.metric),
        "bound": (f"{verdict.bound:g}", f"{bound:g}"),
        "scale": (f"{verdict.scale:g}", f"{shared.scale:g}"),
        "decided by": (verdict.decide_by, shared.decide_by),
    }
    changes = [f"{name} {own}, not {other}" for name, (own, other) in values.items() if own != other]
    return f"changed by the campaign: {'; '.join(changes)}" if changes else ""


def margin_text(verdict: Verdict) -> str:
    """Format the margin of the deciding value relative to the required rate, in percentage points."""
    return NOTHING if math.isnan(verdict.margin) else f"{100.0 * verdict.margin:+.2f} pp".replace("-", "−")
