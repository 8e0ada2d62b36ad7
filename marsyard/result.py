"""Results of a stored campaign for notebooks: cases, verdicts, violations, figures and comparisons."""

from __future__ import annotations

import html
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from marsyard.campaigns.errors import CampaignError, unknown_name_message
from marsyard.campaigns.store.products import case_directory, save_packed
from marsyard.campaigns.store.table import refresh_table
from marsyard.reports import campaign_diff, figures
from marsyard.reports.column_selection import primary_metric
from marsyard.reports.evaluation import Evaluation, evaluate_run
from marsyard.reports.images import thumbnail
from marsyard.reports.presentation import write_case_figures
from marsyard.reports.report_file import PAGE_FILE
from marsyard.reports.requirement_cases import CaseFinder, CaseSummary
from marsyard.reports.stored import read_run
from marsyard.reports.verdicts import find_bound
from marsyard.scenarios.timeline import Timeline

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Columns of the table of verdicts: fields of `Verdict`.
_VERDICT_COLUMNS = ("status", "n", "failures", "estimate", "lower", "upper", "probability", "confidence", "note")
#: Figures of all errors, by name.
FIGURES = {
    "errors": figures.error_scatter,
    "histogram": figures.error_histogram,
    "distribution": figures.error_distribution,
}


@dataclass(frozen=True)
class Case:
    """A case of a stored campaign.

    - number: number of the case, from 0
    - row: values of all columns, such as outcome, errors and conditions
    - summary: result and margin for each requirement, conditions with percentiles, and neighbouring violations
    """

    result: Result
    number: int
    row: Mapping[str, Any] = field(repr=False)
    summary: CaseSummary = field(repr=False)

    @property
    def products(self) -> Mapping[str, Any]:
        """Images and intermediate results by name; empty if they are not stored (then use `replay`)."""
        return self.result.evaluation.run.products(self.number)

    @property
    def timeline(self) -> Timeline | None:
        """The case in space and time; None unless it was run by `replay`, or its scenario records none."""
        return Timeline.from_products(self.products)

    def replay(self) -> Case:
        """Run the case again, store its products, and return the case with them.

        Raises CampaignError if the row differs from the stored one, or the case crashes.
        """
        from marsyard.campaigns.running.replay import replay

        rerun = replay(self.result.directory, self.number)
        if rerun.failed or rerun.differing:
            reason = f"its row differs in {', '.join(rerun.differing)}" if rerun.differing else rerun.row["error"]
            raise CampaignError(f"case {self.number} of {self.result.directory}: {reason}")
        if rerun.products is not None:
            save_packed(case_directory(self.result.directory, self.number), rerun.products, rerun.row)
        return Result(self.result.directory).case(self.number)

    def figures(self, folder: str | Path | None = None) -> list[Path]:
        """Draw the figures of the case as PNG files and return their paths.

        folder: folder of the files; the folder of the case if None. Without stored products the case runs again.
        """
        case = self if self.products else self.replay()
        target = case_directory(self.result.directory, self.number) if folder is None else Path(folder)
        target.mkdir(parents=True, exist_ok=True)
        return write_case_figures(target, case.products)

    def _repr_html_(self) -> str:
        image = thumbnail(self.products)
        picture = f'<img src="{image}" alt="last image">' if image else ""
        statuses = pd.DataFrame([asdict(status) for status in self.summary.statuses])
        drivers = pd.DataFrame(
            [(item.name, item.value, item.percentile_text) for item in self.summary.drivers],
            columns=["condition", "value", "percentile"],
        )
        title = html.escape(f"Case {self.number}: {self.row.get('outcome', '')}")
        tables = [table.to_html(index=False) for table in (statuses, drivers) if len(table)]
        return f"<div><h4>{title}</h4>{picture}{''.join(tables)}</div>"


@dataclass(frozen=True)
class Result:
    """A stored campaign; `directory` is its folder."""

    directory: Path

    @cached_property
    def evaluation(self) -> Evaluation:
        """The rows of the campaign with the verdicts on its requirements."""
        return evaluate_run(self.directory)

    @cached_property
    def _finder(self) -> CaseFinder:
        return CaseFinder(self.evaluation.run, self.evaluation.verdicts)

    @property
    def cases(self) -> pd.DataFrame:
        """Rows of all cases, indexed by the number of the case."""
        return self.evaluation.run.all_cases.set_index("case")

    @property
    def verdict(self) -> str:
        """The verdict of the campaign: PASS, FAIL, MET BY RATE, INSUFFICIENT or NO REQUIREMENT."""
        return self.evaluation.overall_verdict.word

    @property
    def verdicts(self) -> pd.DataFrame:
        """Verdicts, one row per requirement: number of cases and failures, observed rate, bounds, required rate."""
        rows = [[getattr(item, name) for name in _VERDICT_COLUMNS] for item in self.evaluation.verdicts]
        index = pd.Index([item.requirement_id for item in self.evaluation.verdicts], name="requirement")
        return pd.DataFrame(rows, index=index, columns=list(_VERDICT_COLUMNS))

    def robustness(self) -> pd.DataFrame:
        """Return the smallest changes that turn PASS into FAIL, one row per requirement, parameter and kind of change.

        The columns are those of `marsyard.reports.robustness.Robustness`; changes are in assumed spreads.
        """
        records = [asdict(item) | {"text": item.pass_text} for item in self.evaluation.robustness]
        return pd.DataFrame(records).set_index("requirement") if records else pd.DataFrame()

    @property
    def variants(self) -> pd.DataFrame:
        """Verdicts under other models (`marsyard robust --variant`), one row per variant and requirement."""
        return pd.DataFrame([asdict(item) for item in self.evaluation.variants])

    def failures(self, requirement: str | None = None) -> pd.DataFrame:
        """Return the rows of the violations, the largest excess first; of any requirement if None.

        Raises CampaignError for an unknown requirement.
        """
        names = [requirement] if requirement is not None else self._finder.requirement_ids
        allowed = self._finder.requirement_ids
        if requirement is not None and requirement not in allowed:
            raise CampaignError(f"{self.directory}: {unknown_name_message('requirement', requirement, allowed)}")
        cases = dict.fromkeys(case for name in names for case in self._finder.violations(name))
        return self.cases.loc[list(cases)]

    def case(self, number: int) -> Case:
        """Return a case. Raises CampaignError if it has no row."""
        summary = self._finder.summary(number)
        if summary is None:
            raise CampaignError(f"{self.directory} has no case {number}; allowed: 0 to {len(self.cases) - 1}")
        row = {str(name): value for name, value in self.cases.loc[number].items()}
        return Case(self, number, row, summary)

    def figure(self, name: str = "errors", metric: str | None = None) -> Figure:
        """Draw a figure of all errors: `errors` (scatter plot), `histogram` or `distribution`.

        metric: column of the errors; the metric of the first requirement with a bound if None
        Raises CampaignError for an unknown figure or metric, or without values.
        """
        if name not in FIGURES:
            raise CampaignError(unknown_name_message("figure", name, FIGURES))
        frame, run = self.evaluation.run.all_cases, self.evaluation.run
        column = primary_metric(frame, run.requirements) if metric is None else metric
        if column is None or column not in frame:
            raise CampaignError(f"{self.directory} has no column '{column}'")
        drawn = FIGURES[name](frame, column, find_bound(self.evaluation.verdicts, column))
        if drawn is None:
            raise CampaignError(f"{self.directory} has no values of {column} for the figure '{name}'")
        return drawn

    def compare(self, other: Result | str | Path) -> pd.DataFrame:
        """Compare success rates, availability and errors with another campaign by significance tests.

        One row per metric, with texts; p-values are two-sided and corrected for the number of metrics (Holm).
        """
        second = other.directory if isinstance(other, Result) else Path(other)
        _, differences = campaign_diff.compare_campaigns(read_run(self.directory), read_run(second))
        grid = campaign_diff.campaign_diff_grid(["this campaign", "other campaign"], differences)
        return pd.DataFrame(grid.rows, columns=list(grid.head)).set_index(grid.head[0])

    @property
    def report(self) -> Path:
        """Path of the report."""
        return self.directory / PAGE_FILE

    def _repr_html_(self) -> str:
        overall = self.evaluation.overall_verdict
        title = html.escape(f"{self.evaluation.run.name}: {overall.word}")
        verdicts = self.verdicts[["status", "n", "failures", "estimate", "lower", "probability"]]
        return f"<div><h4>{title}</h4><p>{html.escape(overall.sentence)}</p>{verdicts.to_html()}</div>"


def open_result(directory: str | Path) -> Result:
    """Open a stored campaign; the rows of an unfinished one are those stored so far.

    Raises CampaignError if the folder contains no campaign.
    """
    refresh_table(Path(directory))
    return Result(Path(directory))
