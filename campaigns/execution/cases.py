"""How one case runs in a worker process: the only place where a scenario is called."""

from __future__ import annotations

import json
import re
import time
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

from marsyard.algorithms.faults import describe_error
from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.configuration import CampaignConfiguration, Limits, Requirement
from marsyard.campaigns.execution.state_notes import StateNotes
from marsyard.campaigns.execution.work import Work, Workers, WorkLimits
from marsyard.campaigns.execution.worker_process import (
    LOADING_S,
    Done,
    leave_note,
    limit_threads,
    request_fresh_worker,
    settle,
    start_clock,
)
from marsyard.campaigns.outcomes import CRASHED, OUT_OF_MEMORY, UNFINISHED, CaseEndedError
from marsyard.campaigns.store.columns import LEADING_COLUMNS, TRAILING_COLUMNS, Row
from marsyard.campaigns.store.products import PackedProducts, pack_products
from marsyard.campaigns.store.retention import Keep
from marsyard.scenarios.interface import CaseResult, Scalar, conditions_recorded_by
from marsyard.scenarios.registry import scenario
from marsyard.sim.cache import CacheWarning

#: Bits of the largest integers that are stored: all of these have a float64, whose maximum is below 2 ** 1024.
_MAX_INT_BITS = 1023

#: Characters of an error's text, or of a traceback, that a row keeps: its beginning and its end.
_TEXT_LENGTH = 8000


@dataclass(frozen=True)
class CompletedCase:
    """A case's row and, where they are kept, the products of the scenario.

    `note` is why products that were to be kept could not be, and what the case changed in its worker process.
    """

    row: Row
    products: PackedProducts | None = None
    note: str = ""


def configuration_text(configuration: CampaignConfiguration) -> str:
    """The configuration as it travels to the workers and into `campaign.json`."""
    return configuration.model_dump_json()


@lru_cache(maxsize=1)
def _campaign(configuration: str) -> Campaign:
    """The campaign that a worker works on; a pure function of its text, kept because reading it takes time."""
    start_clock(grace_s=LOADING_S)
    stated = CampaignConfiguration.model_validate_json(configuration)
    found = scenario(stated.scenario)
    limit_threads()
    settle()
    start_clock()
    return Campaign(stated, found)


def run_case(configuration: str, keep: Keep, case: int) -> CompletedCase:
    """Runs one case; whatever it raises becomes part of its row.

    Parameters
    ----------
    configuration
        From `configuration_text`.
    keep
        Whether the scenario's products come back with the row.
    case
        The case's number.
    """
    wall, cpu = time.perf_counter(), time.process_time()
    products: Mapping[str, Any] = {}
    conditions: dict[str, Scalar] = {}

    def record(columns: Mapping[str, Scalar]) -> None:
        conditions.update(_scenario_columns(columns))
        leave_note(json.dumps({"case": case, "conditions": conditions}))

    try:
        campaign = _campaign(configuration)
        wall, cpu = time.perf_counter(), time.process_time()
        with conditions_recorded_by(record):
            result = campaign.scenario.run(campaign.parameters(case), campaign.streams(case))
        row = _scored(case, result, campaign.configuration.requirements)
        products = result.products
    except BaseException as error:
        outcome = OUT_OF_MEMORY if isinstance(error, MemoryError) else CRASHED
        row = unfinished_row(case, outcome, describe_error(error), traceback.format_exc(), conditions)
    times = {"wall_time_s": time.perf_counter() - wall, "cpu_time_s": time.process_time() - cpu}
    row = {**row, **times}
    if row["outcome"] in (CRASHED, OUT_OF_MEMORY):
        request_fresh_worker()
    if not products or not keep.wants(row):
        return CompletedCase(row)
    try:
        return CompletedCase(row, pack_products(products))
    except TypeError as error:
        return CompletedCase(row, None, f"the products of case {case} could not be kept: {error}")


def prepare_input(configuration: str, shared_input: int) -> str:
    """Builds one input that many cases share, or verifies it; returns what the cache warned of, empty if nothing."""
    campaign = _campaign(configuration)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CacheWarning)
        campaign.scenario.prepare(campaign.base_parameters(), shared_input)
    return "; ".join(str(one.message) for one in caught if issubclass(one.category, CacheWarning))


def run_cases(
    workers: Workers,
    configuration: CampaignConfiguration,
    cases: Iterable[int],
    *,
    keep: Keep,
    total: int | None = None,
) -> Iterator[list[CompletedCase]]:
    """Runs cases, and yields them as they end; one that takes its worker down, or must be ended, has a row as well."""
    task: Callable[[int], CompletedCase] = partial(run_case, configuration_text(configuration), keep)
    state_notes = StateNotes()
    for ended in workers.run(Work(task, cases, case_limits(configuration.limits), total)):
        yield [_with_note(_completed(done), state_notes.of(done)) for done in ended]


def _with_note(completed: CompletedCase, note: str) -> CompletedCase:
    return replace(completed, note="; ".join(filter(None, (completed.note, note)))) if note else completed


def case_limits(limits: Limits) -> WorkLimits:
    """What one case may use."""
    memory = None if limits.memory_gb is None else limits.memory_gb * 1e9
    return WorkLimits(limits.case_time_s, memory, limits.output_mb * 1e6)


def prepare_limits(limits: Limits) -> WorkLimits:
    """What building one shared input may use."""
    return WorkLimits(limits.prepare_time_s, case_limits(limits).memory_bytes, limits.output_mb * 1e6)


def _completed(done: Done[CompletedCase]) -> CompletedCase:
    """What became of a case, as a row in any event."""
    if done.result is not None:
        return done.result
    error = done.error
    times = {"wall_time_s": float("nan"), "cpu_time_s": float("nan")}
    if isinstance(error, CaseEndedError):
        conditions = _recorded_conditions(done.item, error.note)
        row = unfinished_row(done.item, error.outcome, str(error), _above(error.trace), conditions)
    else:
        row = unfinished_row(done.item, CRASHED, describe_error(error), "")
    return CompletedCase({**row, **times})


def _recorded_conditions(case: int, note: str) -> Mapping[str, Scalar]:
    """The columns that a case recorded before its process ended."""
    try:
        left = json.loads(note)
        return _scenario_columns(left["conditions"]) if left["case"] == case else {}
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
        # the process ended while it wrote, or something else wrote there
        return {}


def unfinished_row(
    case: int, outcome: str, error: str, trace: str, conditions: Mapping[str, Scalar] | None = None
) -> Row:
    """The row of a case that did not come to an end, with what it had recorded of its conditions."""
    return {
        "case": case,
        "outcome": outcome,
        "answered": False,
        **(conditions or {}),
        "error": _plain_text(error),
        "traceback": _plain_text(trace),
    }


def _above(trace: str) -> str:
    """A dump of frames without those above the one in which the engine called the scenario."""
    lines = trace.splitlines()
    called = next((place for place, line in enumerate(lines) if line.endswith(" in run_case")), None)
    if called is None:
        return trace
    after = next((k for k in range(called + 1, len(lines)) if not lines[k].startswith("  File ")), len(lines))
    return "\n".join([*lines[: called + 1], *lines[after:]])


def _plain_text(text: str) -> str:
    """Text that any file takes, cut where it is long, without addresses of objects: they change from run to run."""
    if len(text) > _TEXT_LENGTH:
        half = _TEXT_LENGTH // 2
        text = f"{text[:half]}\n... {len(text) - 2 * half} characters left out ...\n{text[-half:]}"
    text = re.sub(r"\b0x[0-9a-fA-F]{4,}\b", "0x...", text)
    return _utf8(text)


def _scored(case: int, result: CaseResult, requirements: Sequence[Requirement]) -> Row:
    """The row of a case that came to an end, in plain Python values.

    Raises
    ------
    TypeError, ValueError
        Where a column holds what cannot be stored, or what a requirement cannot be judged by.
    """
    failure = result.failure
    if (result.outcome in UNFINISHED) != (failure is not None):
        raise ValueError(f"the outcome {result.outcome} is kept for cases that do not come to an end")
    columns = _scenario_columns(result.row)
    _check_requirements(columns, requirements)
    head: Row = {"case": case, "outcome": _utf8(str(result.outcome)), "answered": bool(result.answered)}
    if failure is None:
        return {**head, **columns, "error": "", "traceback": ""}
    return {**head, **columns, "error": _plain_text(failure.error), "traceback": _plain_text(failure.trace)}


def _scenario_columns(row: Mapping[str, Any]) -> dict[str, Scalar]:
    """Columns of a scenario in plain Python values; raises ValueError or TypeError where they cannot be stored."""
    clashes = sorted({*LEADING_COLUMNS, *TRAILING_COLUMNS}.intersection(row))
    if clashes:
        raise ValueError(f"the scenario's row has columns that the engine writes: {', '.join(clashes)}")
    return {_utf8(str(name)): _plain(str(name), value) for name, value in row.items()}


def _check_requirements(columns: Mapping[str, Scalar], requirements: Sequence[Requirement]) -> None:
    """Raises TypeError where a requirement's metric or population is a column of another kind in this case.

    One such value would make the stored column one of texts, and the requirement undecidable for all cases.
    """
    for asked in requirements:
        flags = (*asked.population_columns, *(asked.metric_columns if asked.bound is None else ()))
        for name in flags:
            if name in columns and type(columns[name]) is not bool:
                raise TypeError(f"column {name} holds {columns[name]!r:.100}; {asked.id} needs true or false")
        for name in () if asked.bound is None else asked.metric_columns:
            if type(columns.get(name, 0.0)) is str:
                raise TypeError(f"column {name} holds {columns[name]!r:.100}; {asked.id} needs a number")


def _utf8(text: str) -> str:
    """Text without lone surrogates."""
    return text.encode("utf-8", errors="replace").decode("utf-8")


def _plain(column: str, value: Any) -> Scalar:
    """A value as one of Python's own; NumPy's scalars are unwrapped."""
    plain = value.item() if hasattr(value, "item") and getattr(value, "ndim", 0) == 0 else value
    if type(plain) is int and plain.bit_length() > _MAX_INT_BITS:
        raise ValueError(f"column {column} holds an integer of {plain.bit_length()} bits, beyond what a float can hold")
    if type(plain) in (float, int, bool):
        return plain  # type: ignore[no-any-return]
    if type(plain) is str:
        return _utf8(plain)
    raise TypeError(f"column {column} holds a {type(value).__name__}; allowed: float, int, str, bool")
