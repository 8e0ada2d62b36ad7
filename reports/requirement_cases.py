"""Cases of each requirement: the violations first, then the cases nearest to the limit, each with its cause.

A driver is a condition that may affect the metric.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from marsyard.campaigns.definition.parameter_paths import leaves
from marsyard.campaigns.outcomes import ENGINE_FAILURES
from marsyard.reports.column_values import numbers, to_float
from marsyard.reports.explorer import ExploredRequirement, ExploredStatus
from marsyard.reports.images import thumbnail
from marsyard.reports.populations import compute_margins
from marsyard.reports.presentation import Cause, system_presentation
from marsyard.reports.section import Grid
from marsyard.reports.stored import StoredRun, table
from marsyard.reports.verdicts import Verdict
from marsyard.reports.wording import NOTHING, count, label, number, percent
from marsyard.scenarios.columns import split_unit

#: Maximum number of violations, and of the cases nearest to the limit, that are listed for a requirement.
MAX_VIOLATIONS, MAX_NEAREST = 9, 3
#: Maximum number of violations that are grouped by cause.
_MAX_GROUPED = 5000
#: Maximum number of drivers of a case, and of similar violations.
MAX_DRIVERS, MAX_SIMILAR = 12, 3
#: A driver is unusual outside the central fraction of 95 % of the campaign's values.
_USUAL = 0.95


@dataclass(frozen=True)
class ListedCase:
    """A case in the list of a requirement.

    - sentence: error, cause and unusual conditions in words
    - thumbnail: data URI of an image; empty without stored products
    """

    case: int
    violates: bool
    outcome: str
    sentence: str
    thumbnail: str


@dataclass(frozen=True)
class RequirementCases:
    """Violations of a requirement (at most `MAX_VIOLATIONS`), the cases nearest to its limit, and groups by cause.

    `same_as` is an earlier requirement with the same list of cases, which the page does not repeat; may be empty.
    """

    requirement_id: str
    n_violations: int
    violations: Sequence[ListedCase]
    nearest: Sequence[ListedCase]
    groups: Grid
    same_as: str = ""

    @property
    def title(self) -> str:
        """Number of violations in words."""
        text = count(self.n_violations, "violation") if self.n_violations else "no violation"
        return f"{text}, the same cases as {self.same_as}" if self.same_as else text


@dataclass(frozen=True)
class CaseStatus:
    """Result of a case for one requirement: `word` is met, violated or not counted; `margin` may be empty."""

    requirement_id: str
    word: str
    margin: str


@dataclass(frozen=True)
class CaseDriver:
    """Value of a condition in a case, and the percentile of this value in the campaign (NaN if unknown)."""

    name: str
    value: str
    percentile: float

    @property
    def percentile_text(self) -> str:
        """The percentile, rounded to whole numbers."""
        return NOTHING if math.isnan(self.percentile) else f"{100.0 * self.percentile:.0f}"


@dataclass(frozen=True)
class CaseSummary:
    """Summary of a case: results by requirement, conditions, previous and next violation, and similar violations.

    cases: number of cases of the percentiles
    """

    statuses: Sequence[CaseStatus]
    drivers: Sequence[CaseDriver]
    previous: int | None
    following: int | None
    similar: Sequence[int]
    cases: int


def _classify_margins(margins: Float[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Return the `ExploredStatus` of each case."""
    statuses = np.where(margins < 0.0, ExploredStatus.VIOLATED, ExploredStatus.MET)
    return np.where(np.isposinf(margins), ExploredStatus.NOT_COUNTED, statuses)


@dataclass(frozen=True)
class _Evaluated:
    """A verdict with the margin of each case; the margin has a meaning beyond its sign if it is `graded`."""

    verdict: Verdict
    margins: Float[np.ndarray, " n"]
    graded: bool

    @property
    def violations(self) -> Int[np.ndarray, " v"]:
        """Rows of the violations, the smallest margin first."""
        rows = np.flatnonzero(self.margins < 0.0)
        return rows[np.argsort(self.margins[rows], kind="stable")]


class CaseFinder:
    """Finds the cases of the requirements of a campaign, and summarises single cases."""

    def __init__(self, run: StoredRun, verdicts: Sequence[Verdict]) -> None:
        self._run = run
        self._frame = run.all_cases
        presentation = system_presentation(str(run.recorded("scenario") or ""))
        self._explain = None if presentation is None else presentation.explain
        self._parameters = dict(leaves(table(run.definition.get("parameters"))))
        margin_columns = {str(entry.get("id")): entry.get("margin") for entry in run.requirements}
        self._evaluated = [
            _Evaluated(verdict, margins, graded=math.isfinite(verdict.bound) or bool(margin_columns[name]))
            for verdict in verdicts
            if (name := verdict.requirement_id) in margin_columns
            and (margins := compute_margins(self._frame, verdict, margin_columns[name])) is not None
        ]
        metric = next((item.verdict.metric for item in self._evaluated if math.isfinite(item.verdict.bound)), "")
        self._drivers = run.driver_columns(metric, MAX_DRIVERS) if "case" in self._frame else []
        values_by_driver = {column: numbers(run.frame, column) for column in self._drivers}
        self._ordered_values = {name: np.sort(values[np.isfinite(values)]) for name, values in values_by_driver.items()}
        is_violation = np.zeros(len(self._frame), dtype=np.bool_)
        for item in self._evaluated:
            is_violation |= item.margins < 0.0
        has_numbers = "case" in self._frame
        #: Numbers of the cases that violate any requirement, in increasing order; empty for rows without numbers.
        self.violating_cases: list[int] = self._frame.loc[is_violation, "case"].tolist() if has_numbers else []
        self._thumbnails: dict[int, str] = {}

    def requirement_cases(self) -> list[RequirementCases]:
        """List the cases of each requirement."""
        if "case" not in self._frame:
            return []
        lists, first_names = [], dict[object, str]()
        for item in self._evaluated:
            entry = self._list_cases(item)
            cases = [(listed.case, listed.violates) for listed in (*entry.violations, *entry.nearest)]
            key = entry.n_violations, item.verdict.metric, tuple(cases)
            same_as = first_names.setdefault(key, entry.requirement_id)
            lists.append(entry if same_as == entry.requirement_id else replace(entry, same_as=same_as))
        return lists

    @property
    def requirement_ids(self) -> list[str]:
        """Requirements that can be evaluated on the rows."""
        return [item.verdict.requirement_id for item in self._evaluated]

    def violations(self, requirement_id: str) -> list[int]:
        """Return the numbers of the cases that violate a requirement, the smallest margin first.

        Empty for rows without numbers.
        """
        rows = [item.violations for item in self._evaluated if item.verdict.requirement_id == requirement_id]
        return self._frame["case"].iloc[rows[0]].tolist() if rows and "case" in self._frame else []

    def explored_requirements(self) -> list[ExploredRequirement]:
        """Return the status of all cases by requirement, for the explorer."""
        return [
            ExploredRequirement(
                item.verdict.requirement_id,
                item.verdict.metric,
                item.verdict.bound / item.verdict.scale,
                _classify_margins(item.margins),
            )
            for item in self._evaluated
        ]

    def worst_violations(self, max_per_requirement: int) -> list[int]:
        """Return the worst violations of each requirement, without repetition; empty for rows without numbers."""
        if "case" not in self._frame:
            return []
        rows = [row for item in self._evaluated for row in item.violations[:max_per_requirement]]
        return list(dict.fromkeys(int(self._frame["case"].iloc[row]) for row in rows))

    def summary(self, case: int) -> CaseSummary | None:
        """Summarise a case; None without a row of it."""
        rows = np.flatnonzero(self._frame["case"] == case) if "case" in self._frame else np.zeros(0, dtype=np.int64)
        if not rows.size:
            return None
        row = int(rows[0])
        statuses = [
            CaseStatus(item.verdict.requirement_id, *_describe_margin(item, float(item.margins[row])))
            for item in self._evaluated
        ]
        earlier = [other for other in self.violating_cases if other < case]
        later = [other for other in self.violating_cases if other > case]
        previous, following = (earlier[-1] if earlier else None), (later[0] if later else None)
        similar = self._similar_violations(row)
        return CaseSummary(statuses, self._case_drivers(row), previous, following, similar, len(self._run.frame))

    def _list_cases(self, item: _Evaluated) -> RequirementCases:
        """List the violations of a requirement, and the cases nearest to its limit if its margin is graded."""
        violations = item.violations
        met = np.flatnonzero((item.margins >= 0.0) & np.isfinite(item.margins)) if item.graded else np.zeros(0, int)
        nearest = met[np.argsort(item.margins[met], kind="stable")][:MAX_NEAREST]
        listed, near = (
            [self._listed_case(item, int(row)) for row in rows] for rows in (violations[:MAX_VIOLATIONS], nearest)
        )
        return RequirementCases(
            item.verdict.requirement_id, int(violations.size), listed, near, self._group_causes(item, violations)
        )

    def _listed_case(self, item: _Evaluated, row: int) -> ListedCase:
        """Describe the case in a row of the table for the list of a requirement."""
        values = self._row(row)
        case, violates = int(values["case"]), bool(item.margins[row] < 0.0)
        cause = self._find_cause(item, values)
        unusual = self._unusual_driver(row)
        parts = [self._describe_error(item, values, violates), "" if cause is None else cause.detail, unusual]
        sentence = "; ".join(part for part in parts if part)
        sentence = f"{sentence[:1].upper()}{sentence[1:]}."
        if case in self._run.stored_cases and case not in self._thumbnails:
            self._thumbnails[case] = thumbnail(self._run.products(case))
        outcome = str(values.get("outcome", NOTHING))
        return ListedCase(case, violates, outcome, sentence, self._thumbnails.get(case, ""))

    def _row(self, row: int) -> dict[str, Any]:
        return {str(name): value for name, value in self._frame.iloc[row].items()}

    def _find_cause(self, item: _Evaluated, values: Mapping[str, Any]) -> Cause | None:
        if self._explain is None or values.get("outcome") in ENGINE_FAILURES:
            return None
        # sampled parameters are columns, whose values replace those of the campaign's file
        return self._explain({**self._parameters, **values}, item.verdict.metric)

    def _describe_error(self, item: _Evaluated, values: Mapping[str, Any], violates: bool) -> str:
        """Describe the metric of a case relative to its limit, or why it has none."""
        verdict, outcome = item.verdict, str(values.get("outcome", ""))
        if outcome in ENGINE_FAILURES:
            return f"{outcome}: {str(values.get('error') or 'no message').splitlines()[0]}"
        if math.isnan(verdict.bound):
            return f"{label(verdict.metric)}: {'no' if violates else 'yes'}"
        columns = verdict.metric.split(" + ")
        unit = split_unit(columns[-1])[1]
        value = verdict.scale * sum(to_float(values.get(column)) for column in columns)
        words = label(verdict.metric) if len(columns) > 1 else label(verdict.metric).removesuffix(f" ({unit})")
        if math.isnan(value):
            return f"no value of {words}"
        return f"{words} {number(abs(value))} {unit}, limit {verdict.bound:g} {unit}".replace(" ,", ",").rstrip()

    def _percentile(self, column: str, row: int) -> float:
        """Return the percentile of a case's value among all cases; NaN without a value."""
        ordered = self._ordered_values[column]
        value = to_float(self._frame[column].iloc[row]) if column in self._frame else math.nan
        if not ordered.size or math.isnan(value):
            return math.nan
        # mid-rank, so that a frequent value is not extreme
        below, up_to = (np.searchsorted(ordered, value, side) for side in ("left", "right"))
        return float(0.5 * (below + up_to) / ordered.size)

    def _unusual_driver(self, row: int) -> str:
        """Name the driver with the most unusual value of a case; empty if no value is unusual."""
        percentiles = {column: self._percentile(column, row) for column in self._drivers}
        known = {column: percentile for column, percentile in percentiles.items() if not math.isnan(percentile)}
        column = max(known, key=lambda name: (abs(known[name] - 0.5), known[name], name), default="")
        if not column or 2.0 * abs(known[column] - 0.5) < _USUAL:
            return ""
        percentile = known[column]
        unit = split_unit(column)[1]
        value = number(to_float(self._frame[column].iloc[row]))
        fraction, word = (percentile, "lower") if percentile < 0.5 else (1.0 - percentile, "higher")
        name = label(column).removesuffix(f" ({unit})")
        return f"{name} is {value} {unit}".rstrip() + f" ({word} in {percent(fraction)} of the cases)"

    def _case_drivers(self, row: int) -> list[CaseDriver]:
        drivers = []
        for column in self._drivers:
            value = to_float(self._frame[column].iloc[row]) if column in self._frame else math.nan
            if not math.isnan(value):
                drivers.append(CaseDriver(label(column), number(value), self._percentile(column, row)))
        return sorted(drivers, key=lambda driver: -abs(np.nan_to_num(driver.percentile - 0.5)))

    def _similar_violations(self, row: int) -> list[int]:
        """Find the violations nearest to a case in the ranks of its drivers."""
        if len(self.violating_cases) < 2 or not self._drivers:
            return []
        is_other_violation = np.isin(self._frame["case"].to_numpy(), self.violating_cases)
        is_other_violation[row] = False
        others, this_case = self._frame[is_other_violation], self._frame.iloc[[row]]
        distances = np.zeros(len(others))
        for column, ordered in self._ordered_values.items():
            ranks, rank = (
                np.searchsorted(ordered, numbers(rows, column)) / len(ordered) for rows in (others, this_case)
            )
            distances += (ranks - rank) ** 2
        return others["case"].iloc[np.argsort(distances, kind="stable")[:MAX_SIMILAR]].tolist()

    def _group_causes(self, item: _Evaluated, violations: Int[np.ndarray, " v"]) -> Grid:
        """Count violations by outcome and cause, the largest group first, with the number of an example."""
        counts: Counter[tuple[str, str]] = Counter()
        examples: dict[tuple[str, str], int] = {}
        records: list[Any] = self._frame.iloc[violations[:_MAX_GROUPED]].to_dict("records")
        for values in records:
            cause = self._find_cause(item, values)
            group = str(values.get("outcome", NOTHING)), NOTHING if cause is None else cause.name
            counts[group] += 1
            examples.setdefault(group, int(values["case"]))
        rows = [[*group, f"{n:,}", f"case {examples[group]}"] for group, n in counts.most_common()]
        return Grid(["Outcome", "Cause", "Violations", "Example"], rows)


def _describe_margin(item: _Evaluated, margin: float) -> tuple[str, str]:
    """Return the word for a margin, and the margin with its unit (empty if it is not graded or infinite)."""
    word = "not counted" if margin == math.inf else "violated" if margin < 0.0 else "met"
    if not item.graded or math.isinf(margin):
        return word, ""
    unit = split_unit(item.verdict.metric.split(" + ")[-1])[1] if math.isfinite(item.verdict.bound) else ""
    return word, f"{number(margin)} {unit}".rstrip()
