"""Runner of the cases of a study: it evaluates points, or reads their stored rows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.evidence import Evidence
from marsyard.campaigns.errors import CampaignError, StoreError
from marsyard.campaigns.execution.cases import run_cases
from marsyard.campaigns.execution.work import Executor
from marsyard.campaigns.outcomes import ENGINE_FAILURES
from marsyard.campaigns.running.engine import check_metrics
from marsyard.campaigns.running.progress import ProgressObserver
from marsyard.campaigns.sampling.study_points import POINT_COLUMN, StudyPoint
from marsyard.campaigns.store import record
from marsyard.campaigns.store.product_selection import ProductSelection
from marsyard.campaigns.store.rows import Row, RowStore

#: A study is stopped with an error if none of this number of first cases has finished.
_MAX_FIRST_CRASHES = 20


class CaseLimitError(Exception):
    """The study needs more cases than its limit."""


class PointRunner:
    """Runner of the cases of a study, in the order of their numbers; cases with a stored row are read.

    - campaign: campaign with the design `adaptive`; its number of cases is the limit of the study
    - directory, store: folder of the study, and its rows
    """

    def __init__(
        self, campaign: Campaign, directory: Path, store: RowStore, executor: Executor, observer: ProgressObserver
    ) -> None:
        self._campaign, self._directory, self._store = campaign, directory, store
        self._executor, self._observer = executor, observer
        self._is_checked = self._has_finished_case = False
        #: Number of cases evaluated so far.
        self.n_cases = 0

    @property
    def evidence(self) -> Evidence:
        """Kind of evidence of the study's seed."""
        return Evidence.read(record.read(self._directory).get("evidence"))

    def run(self, new_points: Sequence[StudyPoint], reserved_cases: int = 0) -> list[Row]:
        """Evaluate points in parallel; return their rows in the same order. New streams have the number of the case.

        reserved_cases: number of cases, out of the limit, that these points cannot use
        Raises CaseLimitError before the first case beyond the limit, StoreError if a stored row has another point, and
        CampaignError if none of the first cases finished.
        """
        first = self.n_cases
        limit = self._campaign.definition.total_cases - reserved_cases
        if first + len(new_points) > limit:
            raise CaseLimitError(f"the study needs more than {limit} cases")
        points = {case: point.with_numbers(case) for case, point in enumerate(new_points, start=first)}
        rows = {case: row for case in points if (row := self._store.row(case)) is not None}
        for case, row in rows.items():
            if row.get(POINT_COLUMN) != points[case].text:
                raise StoreError(f"{self._directory}: case {case} was run at another point; the study has changed")
        missing = [case for case in points if case not in rows]
        definition = self._campaign.definition
        for batch in run_cases(
            self._executor,
            definition,
            missing,
            selection=ProductSelection(),
            total=len(missing),
            points={case: points[case] for case in missing},
        ):
            self._store.add(completed.row for completed in batch)
            for completed in batch:
                if completed.note:
                    self._observer.note(completed.note)
                if not self._is_checked and completed.row["outcome"] not in ENGINE_FAILURES:
                    check_metrics(definition, completed.row, self._directory)
                    self._is_checked = True
                rows[int(completed.row["case"])] = completed.row
                self._observer.step()
        self.n_cases += len(new_points)
        self._has_finished_case |= any(row["outcome"] not in ENGINE_FAILURES for row in rows.values())
        if not self._has_finished_case and self.n_cases >= _MAX_FIRST_CRASHES:
            error = next(iter(rows.values())).get("error")
            raise CampaignError(f"{self._directory}: none of the first {self.n_cases} cases finished: {error}")
        return [rows[case] for case in points]
