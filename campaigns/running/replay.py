"""Run single cases of a stored campaign again (replay)."""

from dataclasses import dataclass
from pathlib import Path

from marsyard.campaigns.definition.campaign_file import CampaignDefinition
from marsyard.campaigns.definition.identity import Identity, create_identity
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.cases import run_cases
from marsyard.campaigns.execution.work import Executor
from marsyard.campaigns.execution.workers import LocalExecutor
from marsyard.campaigns.outcomes import ENGINE_FAILURES
from marsyard.campaigns.running.stored_campaign import load_stored_campaign
from marsyard.campaigns.sampling.design import ADAPTIVE
from marsyard.campaigns.sampling.study_points import POINT_COLUMN, StudyPoint
from marsyard.campaigns.store import record
from marsyard.campaigns.store.origin import check_rows
from marsyard.campaigns.store.product_selection import ALL_PRODUCTS, REPLAYED_PRODUCTS
from marsyard.campaigns.store.products import PackedProducts
from marsyard.campaigns.store.rows import Row
from marsyard.campaigns.store.table import stored_row


@dataclass(frozen=True)
class Replay:
    """A case that was run again.

    - row, stored: new row and stored row of the case (None if no row is stored)
    - differing: columns in which the two rows differ, except attempts and columns with `time` in their name
    - products: products for figures; None if the scenario returned none, or none that can be stored
    - note: reason why there are no products; empty without a problem
    - changed: differences in definition, code and package versions from the stored campaign
    """

    case: int
    row: Row
    stored: Row | None
    differing: tuple[str, ...]
    products: PackedProducts | None
    note: str = ""
    changed: tuple[str, ...] = ()

    @property
    def failed(self) -> bool:
        """Whether the case did not finish in the replay, although it finished in the stored campaign."""
        was_finished = self.stored is not None and self.stored["outcome"] not in ENGINE_FAILURES
        return was_finished and self.row["outcome"] in ENGINE_FAILURES


def replay(directory: Path, case: int) -> Replay:
    """Run one case of a stored campaign again, in a worker process.

    Raises CampaignError if the folder contains no campaign, the case does not exist, or the scenario or an algorithm
    cannot be imported.
    """
    definition = record.stored_definition(directory)
    if not 0 <= case < definition.total_cases:
        raise CampaignError(f"{directory} has no case {case}; allowed: 0 to {definition.total_cases - 1}")
    load_stored_campaign(directory, definition)
    check_rows(directory)
    stored = stored_row(directory, case)
    changed = Identity.read(record.read(directory)["identity"]).differences(create_identity(definition))
    if stored is None and definition.design.kind == ADAPTIVE:
        raise CampaignError(f"{directory}: the study has not run case {case}")
    with LocalExecutor(1) as workers:
        return replay_in_executor(workers, definition, case, stored, tuple(changed))


def replay_in_executor(
    executor: Executor,
    definition: CampaignDefinition,
    case: int,
    stored: Row | None,
    changed: tuple[str, ...] = (),
    *,
    timeline: bool = True,
) -> Replay:
    """Run one case again in an executor, and compare it with its stored row, which contains the point of a study.

    timeline: whether the products contain the timeline of the case
    """
    text = None if stored is None else stored.get(POINT_COLUMN)
    points = {case: StudyPoint.read(text)} if isinstance(text, str) else {}
    selection = REPLAYED_PRODUCTS if timeline else ALL_PRODUCTS
    # one batch with one case
    ((completed,),) = run_cases(executor, definition, [case], selection=selection, points=points)
    differing = differing_columns(completed.row, stored) if stored is not None else ()
    return Replay(case, completed.row, stored, differing, completed.products, completed.note, changed)


def differing_columns(row: Row, stored: Row) -> tuple[str, ...]:
    """List the columns in which two rows are not bit-identical, except times and attempts; NaN equals a missing number.

    The traceback of an unfinished case is not compared, since a process is not always terminated at the same line.
    """
    excluded_columns = {"case_attempts"} | ({"traceback"} if row.get("outcome") in ENGINE_FAILURES else set())
    differing = []
    for name in dict.fromkeys((*row, *stored)):
        # NaN differs from itself
        values = [None if value is None or value != value else value for value in (row.get(name), stored.get(name))]
        if "time" not in name and name not in excluded_columns and values[0] != values[1]:
            differing.append(name)
    return tuple(differing)
