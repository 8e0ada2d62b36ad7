"""Run single cases of a campaign in worker processes."""

import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from types import MappingProxyType
from typing import Any

from marsyard.algorithms.faults import describe_error
from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import CampaignDefinition, CaseLimits
from marsyard.campaigns.definition.components import algorithm_process_limits
from marsyard.campaigns.execution import worker_process
from marsyard.campaigns.execution.case_rows import list_draws, make_finished_row, make_unfinished_row
from marsyard.campaigns.execution.work import Executor, TaskResult, Work, WorkLimits
from marsyard.campaigns.outcomes import CRASHED, OUT_OF_MEMORY, WorkerExitError
from marsyard.campaigns.sampling.study_points import POINT_COLUMN, StudyPoint
from marsyard.campaigns.store.product_selection import ProductSelection
from marsyard.campaigns.store.products import PackedProducts, pack_products
from marsyard.campaigns.store.rows import Row
from marsyard.scenarios.systems import scenario
from marsyard.scenarios.timeline_recording import recording_timelines
from marsyard.sim.array_cache import CacheWarning

#: Maximum number of notes for each kind of change of the process state.
_MAX_NOTES = 3


@dataclass(frozen=True)
class CompletedCase:
    """Row of a case and, if they are stored, its products.

    `note` describes why products could not be stored, and how the case changed its worker process.
    """

    row: Row
    products: PackedProducts | None = None
    note: str = ""


def definition_text(definition: CampaignDefinition) -> str:
    """Convert a definition to the JSON text that is sent to the workers."""
    return definition.model_dump_json()


@lru_cache(maxsize=1)
def _load_campaign(definition: str) -> Campaign:
    """Create the campaign of a definition text; the result is cached because loading is slow."""
    campaign_definition = CampaignDefinition.model_validate_json(definition)
    campaign = Campaign(campaign_definition, scenario(campaign_definition.scenario))
    with suppress(ValueError):  # imports and constructs custom parts; the case reports an error
        campaign.base_parameters()
    worker_process.limit_threads()
    worker_process.accept_process_state()
    return campaign


def create_loader(definition: CampaignDefinition) -> Callable[[], object]:
    """Return the function that loads a campaign in a worker (`Work.load`)."""
    return partial(_load_campaign, definition_text(definition))


def run_case(
    definition: str, selection: ProductSelection, points: Mapping[int, StudyPoint], case: int
) -> CompletedCase:
    """Run one case of the campaign of a `definition_text`; the row of a failed case contains its exception.

    - selection: decides whether the products of the case are returned with the row
    - points: points of the cases of a study; other cases are drawn by the sampling design
    """
    wall_start_s, cpu_start_s = time.perf_counter(), time.process_time()
    products: Mapping[str, Any] = {}
    point, draws, is_repeatable = points.get(case), {}, False
    try:
        campaign = _load_campaign(definition)
        wall_start_s, cpu_start_s = time.perf_counter(), time.process_time()
        if point is not None:
            campaign = campaign.at(point)
        values = campaign.draws(case) if point is None else campaign.draws_at(point)
        draws = list_draws(values)
        with recording_timelines(selection.timelines):
            parameters = campaign.with_values(values, () if point is None else point.removed)
            streams = campaign.streams(case) if point is None else campaign.streams_at(point)
            result = campaign.scenario.run(parameters, streams)
        row = make_finished_row(case, result, draws, campaign.definition.requirements)
        products = result.products
    except BaseException as error:
        # a scenario returns the failure of its algorithm as a row, which is final
        is_repeatable = True
        outcome = OUT_OF_MEMORY if isinstance(error, MemoryError) else CRASHED
        row = make_unfinished_row(case, outcome, describe_error(error), traceback.format_exc(), draws)
    wall_time_s, cpu_time_s = time.perf_counter() - wall_start_s, time.process_time() - cpu_start_s
    row = {**row, "wall_time_s": wall_time_s, "cpu_time_s": cpu_time_s}
    if row["outcome"] in (CRASHED, OUT_OF_MEMORY):
        worker_process.request_fresh_worker(is_repeatable=is_repeatable)
    if not products or not selection.selects(row):
        return CompletedCase(row)
    try:
        return CompletedCase(row, pack_products(products))
    except TypeError as error:
        return CompletedCase(row, None, f"the products of case {case} could not be stored: {error}")


def prepare_input(definition: str, shared_input: int) -> str:
    """Build or verify the shared input (such as a terrain) with this number; return the warnings of its cache."""
    campaign = _load_campaign(definition)
    with warnings.catch_warnings(record=True) as cache_warnings:
        warnings.simplefilter("always", CacheWarning)
        campaign.scenario.prepare(campaign.base_parameters(), shared_input)
    return "; ".join(str(item.message) for item in cache_warnings if issubclass(item.category, CacheWarning))


def run_cases(
    executor: Executor,
    definition: CampaignDefinition,
    cases: Iterable[int],
    *,
    selection: ProductSelection,
    total: int | None = None,
    points: Mapping[int, StudyPoint] = MappingProxyType({}),
) -> Iterator[list[CompletedCase]]:
    """Run cases; yield the results as the cases end, including cases whose worker died or was terminated.

    points: see `run_case`; rows of these cases contain their point
    """
    task: Callable[[int], CompletedCase] = partial(run_case, definition_text(definition), selection, dict(points))
    note_counts: Counter[str] = Counter()
    limits = work_limits(definition.limits, definition.limits.case_time_s)
    # algorithms in processes of their own have their own limits: one that uses them up must not end the case
    time_s, memory_bytes = algorithm_process_limits(definition)
    case_memory = None if limits.memory_bytes is None else limits.memory_bytes + memory_bytes
    limits = replace(limits, time_s=limits.time_s + time_s, memory_bytes=case_memory)
    for results in executor.run(Work(task, cases, limits, total, create_loader(definition))):
        completed_cases = []
        for task_result in results:
            times = {"wall_time_s": float("nan"), "cpu_time_s": float("nan")}
            point = points.get(task_result.item)
            case_result = task_result.result or CompletedCase(
                {**_build_terminated_row(definition, task_result, point), **times}
            )
            note = "; ".join(filter(None, (case_result.note, *_describe_changes(task_result, note_counts))))
            row = {**case_result.row, "case_attempts": task_result.attempts}
            row = row if point is None else {**row, POINT_COLUMN: point.text}
            completed_cases.append(replace(case_result, row=row, note=note))
        yield completed_cases


def work_limits(limits: CaseLimits, time_s: float) -> WorkLimits:
    """Create the limits of one case, or of the preparation of one shared input, with a time limit in seconds."""
    memory = None if limits.memory_gb is None else limits.memory_gb * 1e9
    return WorkLimits(time_s, memory, limits.output_mb * 1e6)


def _build_terminated_row(definition: CampaignDefinition, result: TaskResult[Any], point: StudyPoint | None) -> Row:
    """Create the row of a case whose process ended early, with the sampled values of the case."""
    case, error, draws = result.item, result.error, {}
    campaign = Campaign(definition, scenario(definition.scenario))
    with suppress(ValueError):  # an undefined formula also ends the case in its worker
        draws = list_draws(campaign.draws(case) if point is None else campaign.at(point).draws_at(point))
    if not isinstance(error, WorkerExitError):
        return make_unfinished_row(case, CRASHED, describe_error(error), "", draws)
    trace = error.trace
    lines = trace.splitlines()
    call_index = next((index for index, line in enumerate(lines) if line.endswith(" in run_case")), None)
    if call_index is not None:
        # remove the frames above the engine's call of the scenario
        next_thread = next(
            (index for index in range(call_index + 1, len(lines)) if not lines[index].startswith("  File ")), len(lines)
        )
        trace = "\n".join([*lines[: call_index + 1], *lines[next_thread:]])
    return make_unfinished_row(case, error.outcome, str(error), trace, draws)


def _describe_changes(result: TaskResult[Any], note_counts: Counter[str]) -> Iterator[str]:
    """Yield notes on a case that changed its worker process; `note_counts` limits the notes of each kind in one run."""
    notes = [
        (part.partition(" (")[0], f"case {result.item} changed its worker process: {part}") for part in result.changed
    ]
    if result.crashed_only_after is not None:
        text = (
            f"case {result.item} crashed in the worker of case {result.crashed_only_after}, but not in a fresh worker"
        )
        notes.append(("crashed only after", f"{text}: an earlier case changed the state of that worker"))
    for kind, text in notes:
        note_counts[kind] += 1
        if note_counts[kind] <= _MAX_NOTES:
            yield f"{text} (further cases of this kind are not listed)" if note_counts[kind] == _MAX_NOTES else text
