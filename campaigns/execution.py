"""How one case runs in a worker process: the only place where a scenario is called."""

from __future__ import annotations

import re
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any

from campaigns.configuration import CRASHED, CampaignConfiguration
from campaigns.sampling import Campaign
from campaigns.workers import WorkerDiedError, Workers, limit_threads
from scenarios.interface import CaseResult, Scalar
from scenarios.registry import scenario

#: One case as stored.
Row = Mapping[str, Scalar]

#: Columns that the engine writes, before and behind those of the scenario.
LEADING_COLUMNS = ("case", "outcome", "answered")
TRAILING_COLUMNS = ("wall_time_s", "cpu_time_s", "error", "traceback")


@dataclass(frozen=True)
class CompletedCase:
    """A case's row and, where asked for, the products of the scenario."""

    row: Row
    products: Mapping[str, Any] = field(default_factory=dict)


def configuration_text(campaign: Campaign) -> str:
    """The configuration as it travels to the workers and into `campaign.json`."""
    return campaign.configuration.model_dump_json()


@lru_cache(maxsize=1)
def _campaign(configuration: str) -> Campaign:
    """The campaign that a worker works on; a pure function of its text, kept because reading it takes time."""
    stated = CampaignConfiguration.model_validate_json(configuration)
    found = scenario(stated.scenario)
    limit_threads()
    return Campaign(stated, found)


def run_case(configuration: str, keep_products: bool, case: int) -> CompletedCase:
    """Runs one case; whatever it raises becomes part of its row.

    Parameters
    ----------
    configuration
        From `configuration_text`.
    keep_products
        Whether the scenario's products come back with the row.
    case
        The case's number.
    """
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        campaign = _campaign(configuration)
        wall, cpu = time.perf_counter(), time.process_time()
        result = campaign.scenario.run(campaign.parameters(case), campaign.streams(case))
        row = _scored(case, result)
        products = result.products if keep_products else {}
    except BaseException as error:
        row, products = crashed_row(case, error, traceback.format_exc()), {}
    times = {"wall_time_s": time.perf_counter() - wall, "cpu_time_s": time.process_time() - cpu}
    return CompletedCase({**row, **times}, products)


def prepare_input(configuration: str, shared_input: int) -> None:
    """Builds one input that many cases share."""
    campaign = _campaign(configuration)
    campaign.scenario.prepare(campaign.base_parameters(), shared_input)


def run_cases(
    workers: Workers, configuration: str, cases: Iterable[int], *, keep_products: bool = False
) -> Iterator[CompletedCase]:
    """Runs cases, and yields each as it ends; a case that takes its worker down is a crashed one."""
    task: Callable[[int], CompletedCase] = partial(run_case, configuration, keep_products)
    for done in workers.run(task, cases):
        if done.result is not None:
            yield done.result
        elif done.error is not None:
            times = {"wall_time_s": float("nan"), "cpu_time_s": float("nan")}
            trace = _above_engine(done.error.trace) if isinstance(done.error, WorkerDiedError) else ""
            yield CompletedCase({**crashed_row(done.item, done.error, trace), **times})


def crashed_row(case: int, error: BaseException, trace: str) -> Row:
    """The row of a case that did not come to an end."""
    return {
        "case": case,
        "outcome": CRASHED,
        "answered": False,
        "error": _without_addresses(f"{type(error).__name__}: {error}"),
        "traceback": _without_addresses(trace),
    }


def _above_engine(trace: str) -> str:
    """The frames of a dump down to the one in which the engine called the scenario."""
    lines = trace.splitlines()
    last = next((place for place, line in enumerate(lines) if line.endswith(" in run_case")), len(lines))
    return "\n".join(lines[: last + 1])


def _without_addresses(text: str) -> str:
    """Text without the addresses of objects, which change from run to run."""
    return re.sub(r"\b0x[0-9a-fA-F]{4,}\b", "0x...", text)


def _scored(case: int, result: CaseResult) -> Row:
    """The row of a case that came to an end, in plain Python values."""
    if result.outcome == CRASHED:
        raise ValueError(f"the outcome {CRASHED} is kept for cases that do not come to an end")
    clashes = sorted({*LEADING_COLUMNS, *TRAILING_COLUMNS}.intersection(result.row))
    if clashes:
        raise ValueError(f"the scenario's row has columns that the engine writes: {', '.join(clashes)}")
    columns = {str(name): _plain(str(name), value) for name, value in result.row.items()}
    head: Row = {"case": case, "outcome": str(result.outcome), "answered": bool(result.answered)}
    return {**head, **columns, "error": "", "traceback": ""}


def _plain(column: str, value: Any) -> Scalar:
    """A value as one of Python's own; NumPy's scalars are unwrapped."""
    plain = value.item() if hasattr(value, "item") and getattr(value, "ndim", 0) == 0 else value
    if type(plain) in (float, int, str, bool):
        return plain  # type: ignore[no-any-return]
    raise TypeError(f"column {column} holds a {type(value).__name__}; allowed: float, int, str, bool")
