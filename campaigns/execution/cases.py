"""Run single cases of a campaign in worker processes, and make their rows with checked columns."""

import re
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from types import MappingProxyType
from typing import Any

from marsyard.algorithms.faults import describe_error
from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import CampaignDefinition, CaseLimits, Requirement
from marsyard.campaigns.definition.components import own_limits
from marsyard.campaigns.definition.parameter_paths import leaves
from marsyard.campaigns.execution import worker_process
from marsyard.campaigns.execution.work import Executor, TaskResult, Work, WorkLimits
from marsyard.campaigns.hidden_folders import hide_folders
from marsyard.campaigns.outcomes import CRASHED, ENGINE_FAILURES, OUT_OF_MEMORY, WorkerExitError
from marsyard.campaigns.sampling.study_points import POINT_COLUMN, StudyPoint
from marsyard.campaigns.store.product_selection import ProductSelection
from marsyard.campaigns.store.products import PackedProducts, pack_products
from marsyard.campaigns.store.rows import LEADING_COLUMNS, TRAILING_COLUMNS, Row
from marsyard.scenarios.interface import CaseResult, Scalar
from marsyard.scenarios.systems import scenario
from marsyard.scenarios.timeline_recording import recording_timelines
from marsyard.sim.array_cache import CacheWarning

#: Maximum number of notes for each kind of change of the process state.
_MAX_NOTES = 3
#: Maximum bit length of stored integers: a float64 is below 2 ** 1024.
_MAX_INT_BITS = 1023
#: Maximum characters of an error's text, or of a traceback, in a row; the middle of a longer text is omitted.
_MAX_TEXT = 8000


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
    point, draws = points.get(case), {}
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
        row = _make_finished_row(case, result, draws, campaign.definition.requirements)
        products = result.products
    except BaseException as error:
        outcome = OUT_OF_MEMORY if isinstance(error, MemoryError) else CRASHED
        row = make_unfinished_row(case, outcome, describe_error(error), traceback.format_exc(), draws)
    wall_time_s, cpu_time_s = time.perf_counter() - wall_start_s, time.process_time() - cpu_start_s
    row = {**row, "wall_time_s": wall_time_s, "cpu_time_s": cpu_time_s}
    if row["outcome"] in (CRASHED, OUT_OF_MEMORY):
        worker_process.request_fresh_worker()
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
    time_s, memory_bytes = own_limits(definition)
    case_memory = None if limits.memory_bytes is None else limits.memory_bytes + memory_bytes
    limits = replace(limits, time_s=limits.time_s + time_s, memory_bytes=case_memory)
    for results in executor.run(Work(task, cases, limits, total, create_loader(definition))):
        completed_cases = []
        for task_result in results:
            times = {"wall_time_s": float("nan"), "cpu_time_s": float("nan")}
            case_result = task_result.result or CompletedCase(
                {**_build_terminated_row(definition, task_result, points.get(task_result.item)), **times}
            )
            note = "; ".join(filter(None, (case_result.note, *_describe_changes(task_result, note_counts))))
            row, point = case_result.row, points.get(task_result.item)
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


def list_draws(values: Mapping[str, Any]) -> dict[str, Scalar]:
    """List the sampled values of a case by parameter path, the values of a table by their own paths."""
    return _convert_columns({path: value for path, value in leaves(dict(values)) if value is not None and value != []})


def make_unfinished_row(
    case: int, outcome: str, error: str, trace: str, draws: Mapping[str, Scalar] | None = None
) -> Row:
    """Create the row of an unfinished case, with its sampled values."""
    return {
        "case": case,
        "outcome": outcome,
        "answered": False,
        **(draws or {}),
        "error": _clean_text(error),
        "traceback": _clean_text(trace),
    }


def _clean_text(text: str) -> str:
    """Shorten a text; remove lone surrogates, and object addresses and folders, which change from run to run."""
    text = hide_folders(text)
    if len(text) > _MAX_TEXT:
        half = _MAX_TEXT // 2
        text = f"{text[:half]}\n... {len(text) - 2 * half} characters omitted ...\n{text[-half:]}"
    text = re.sub(r"\b0x[0-9a-fA-F]{4,}\b", "0x...", text)
    return _replace_surrogates(text)


def _make_finished_row(
    case: int, result: CaseResult, draws: Mapping[str, Scalar], requirements: Sequence[Requirement]
) -> Row:
    """Create the row of a finished case, in plain Python values.

    A column of the scenario takes precedence over a sampled value of this name, which shows that it applied.
    Raises TypeError or ValueError if a column cannot be stored, or if a metric or population column has a wrong type.
    One value of a wrong type would convert the stored column to text, so that the requirement could not be evaluated.
    """
    failure = result.failure
    if (result.outcome in ENGINE_FAILURES) != (failure is not None):
        raise ValueError(f"the outcome {result.outcome} is reserved for cases that do not finish")
    columns = {**draws, **_convert_columns(result.row)}
    for requirement in requirements:
        metrics, has_bound = requirement.metric_columns, requirement.bound is not None
        for name in (*requirement.population_columns, *(() if has_bound else metrics)):
            if type(columns.get(name, True)) is not bool:
                raise TypeError(f"column {name} contains {columns[name]!r:.100}; {requirement.id} needs true or false")
        for name in metrics if has_bound else ():
            if type(columns.get(name, 0.0)) is str:
                raise TypeError(f"column {name} contains {columns[name]!r:.100}; {requirement.id} needs a number")
    error, trace = ("", "") if failure is None else (_clean_text(failure.error), _clean_text(failure.trace))
    engine_columns: Row = {
        "case": case,
        "outcome": _replace_surrogates(str(result.outcome)),
        "answered": bool(result.answered),
    }
    return {**engine_columns, **columns, "error": error, "traceback": trace}


def _convert_columns(row: Mapping[str, Any]) -> dict[str, Scalar]:
    """Convert the columns of a scenario, including NumPy scalars, to plain Python values.

    Raises ValueError or TypeError if a column cannot be stored.
    """
    reserved_names = sorted({*LEADING_COLUMNS, *TRAILING_COLUMNS}.intersection(row))
    if reserved_names:
        raise ValueError(f"the scenario's row has columns that the engine writes: {', '.join(reserved_names)}")
    columns: dict[str, Scalar] = {}
    for name, value in row.items():
        scalar = value.item() if hasattr(value, "item") and getattr(value, "ndim", 0) == 0 else value
        if type(scalar) not in (float, int, bool, str):
            raise TypeError(f"column {name} contains a {type(value).__name__}; allowed: float, int, str, bool")
        if type(scalar) is int and scalar.bit_length() > _MAX_INT_BITS:
            bits = scalar.bit_length()
            raise ValueError(f"column {name} contains an integer of {bits} bits, beyond the range of a float")
        columns[_replace_surrogates(str(name))] = _replace_surrogates(scalar) if isinstance(scalar, str) else scalar
    return columns


def _replace_surrogates(text: str) -> str:
    """Replace lone surrogates, which UTF-8 cannot represent."""
    return text.encode("utf-8", errors="replace").decode("utf-8")
