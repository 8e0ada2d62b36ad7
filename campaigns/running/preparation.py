"""Preparation of a campaign: shared inputs (terrains), compiled kernels, and an estimate of time and disk space."""

from __future__ import annotations

import json
import statistics
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.errors import UNFINISHED, CampaignError
from marsyard.campaigns.execution.cases import CompletedCase, configuration_text, prepare_input, run_cases, work_limits
from marsyard.campaigns.execution.worker_process import Executor, Work
from marsyard.campaigns.execution.workers import ExecutorConfig, create_executor
from marsyard.campaigns.store.products import KEEP_ALL
from marsyard.scenarios.interface import SelectsInputs
from marsyard.scenarios.systems import scenario_paths
from marsyard.sim.cache import cache_directory, cached_bytes, limit_bytes
from marsyard.sim.kernel_cache import count_compiled_functions, kernels_are_ready

#: Seconds between two reports on compilation.
REPORT_INTERVAL_S = 10.0
#: Maximum number of trial cases; the first is excluded from the mean, since it loads code and terrains.
_MAX_TRIALS = 9
#: Seconds after which no further trial case is begun.
_TRIAL_S = 20.0
#: Bytes of SQLite and of the table for each byte of a row's text: pages, index and compressed columns.
_ROW_OVERHEAD = 1.6


@dataclass(frozen=True)
class InputPlan:
    """Shared inputs that cases use.

    present: numbers of those on disk, where the scenario states that.
    to_build: numbers of those to be built, each with its bytes on disk (0 where the scenario does not state it).
    limit_bytes: size limit of the cache.
    """

    present: tuple[int, ...]
    to_build: dict[int, int]
    limit_bytes: int

    @property
    def build_bytes(self) -> int:
        """Bytes on disk of all inputs to be built."""
        return sum(self.to_build.values())

    @property
    def to_prepare(self) -> tuple[int, ...]:
        """Inputs to be prepared before the cases: existing ones, to be verified, then others up to the cache's limit.

        The cases build the rest when they need it.
        """
        selected, size = list(self.present), 0
        for number, one in self.to_build.items():
            size += one
            if size > self.limit_bytes:
                break
            selected.append(number)
        return tuple(selected)


def plan_inputs(campaign: Campaign, cases: Iterable[int]) -> InputPlan:
    """Plan the shared inputs of some of a campaign's cases.

    Raises CampaignError where the cache's limit is not a number, or its folder cannot be created.
    """
    numbers = find_used_inputs(campaign, cases)
    if not numbers:
        return InputPlan((), {}, 0)
    scenario, base = campaign.scenario, campaign.base_parameters()
    selects = isinstance(scenario, SelectsInputs)
    try:
        folder = cache_directory("terrain")
        limit = limit_bytes(folder, cached_bytes(folder))
        sizes = {n: scenario.missing_bytes(base, n) if isinstance(scenario, SelectsInputs) else 0 for n in numbers}
    except OSError as error:
        raise CampaignError(f"the cache cannot be used: {error}") from error
    except ValueError as error:
        raise CampaignError(str(error)) from error
    present = tuple(n for n in numbers if selects and sizes[n] == 0)
    return InputPlan(present, {n: size for n, size in sizes.items() if n not in present}, limit)


def find_used_inputs(campaign: Campaign, cases: Iterable[int]) -> tuple[int, ...]:
    """Numbers of the shared inputs that cases use, ascending; all where the scenario does not state those of a case.

    Draws are a function of the case's number. The search ends when all inputs occur: for 250 terrains after about 1,500
    cases of two milliseconds each.
    """
    every = campaign.scenario.shared_inputs(campaign.base_parameters())
    if not every or not isinstance(campaign.scenario, SelectsInputs):
        return every
    allowed, used = set(every), set[int]()
    for case in cases:
        try:
            used |= allowed.intersection(campaign.scenario.case_inputs(campaign.parameters(case), case))
        except ValueError:
            continue  # the case's row will state why its parameters are refused
        if used == allowed:
            break
    return tuple(sorted(used))


@contextmanager
def report_compilation(scenario: str, note: Callable[[str], None]) -> Iterator[Callable[[], None]]:
    """Report the compilation of kernels until the context ends; nothing where they are compiled already.

    Yields a function to be called when the first case has ended and compilation is complete.
    """
    if scenario not in scenario_paths() or kernels_are_ready(scenario):
        yield lambda: None
        return
    note("compiling numeric kernels once on this machine, about two minutes (ahead of time: marsyard compile)")
    ended, began, before = threading.Event(), time.monotonic(), count_compiled_functions()

    def report() -> None:
        while not ended.wait(REPORT_INTERVAL_S):
            number = count_compiled_functions() - before
            note(f"compiling numeric kernels: {number} functions so far, {time.monotonic() - began:.0f} s")

    def finish() -> None:
        if not ended.is_set():
            ended.set()
            note(f"numeric kernels are compiled, {time.monotonic() - began:.0f} s")

    thread = threading.Thread(target=report, daemon=True)
    thread.start()
    try:
        yield finish
    finally:
        ended.set()
        thread.join()


@dataclass(frozen=True)
class Estimate:
    """Time and disk space of a campaign.

    trials, unfinished: number of trial cases, and of unfinished ones among them.
    case_s, case_range_s: mean wall-clock time of a trial case on one worker, and its range.
    inputs, input_s, inputs_bytes: shared inputs (terrains) to be built, mean time of building one, and bytes on disk
    together (0 where the scenario does not state it).
    cache_limit_bytes: size limit of their cache.
    time_s: of the whole campaign with the requested workers, if there is a core for each.
    rows_bytes, products_bytes: on disk: SQLite and table; kept products (within their budget).
    """

    trials: int
    unfinished: int
    case_s: float
    case_range_s: tuple[float, float]
    inputs: int
    input_s: float
    inputs_bytes: float
    cache_limit_bytes: float
    time_s: float
    rows_bytes: float
    products_bytes: float


def estimate(campaign: Campaign, jobs: int) -> Estimate:
    """Run trial cases, evenly spread over the campaign, in one worker; keep only the shared inputs built for them."""
    configuration, total = campaign.configuration, campaign.configuration.total_cases
    plan = plan_inputs(campaign, range(total))
    trials: list[CompletedCase] = []
    times: list[float] = []
    built: list[float] = []
    number = min(_MAX_TRIALS, total)
    with create_executor(ExecutorConfig()) as executor:
        began = time.monotonic()
        for case in (index * total // number for index in range(number)):
            if trials and time.monotonic() - began > _TRIAL_S:
                break
            built += _build_inputs(campaign, executor, case)
            start = time.monotonic()
            ((completed,),) = run_cases(executor, configuration, [case], keep=KEEP_ALL)
            trials.append(completed)
            times.append(time.monotonic() - start)
    times = times[1:] or times
    case_s, input_s = statistics.fmean(times), statistics.fmean(built or [0.0])
    row_bytes = statistics.fmean(len(json.dumps(list(one.row.values()))) for one in trials)
    product_bytes = statistics.fmean(one.products.size if one.products else 0 for one in trials)
    retain = configuration.retain
    # of failed cases, only the rows decide how many there are
    kept = {"none": 0, "worst": retain.worst, "every": -(-total // retain.every), "all": total, "failed": total}
    products = min(total, kept[retain.products] + int(retain.showcase != "none")) * product_bytes
    return Estimate(
        trials=len(trials),
        unfinished=sum(one.row["outcome"] in UNFINISHED for one in trials),
        case_s=case_s,
        case_range_s=(min(times), max(times)),
        inputs=len(plan.to_build),
        input_s=input_s,
        inputs_bytes=plan.build_bytes,
        cache_limit_bytes=plan.limit_bytes,
        time_s=(total * case_s + len(plan.to_build) * input_s) / jobs,
        rows_bytes=total * row_bytes * _ROW_OVERHEAD,
        products_bytes=min(products, retain.budget_gb * 1e9),
    )


def _build_inputs(campaign: Campaign, executor: Executor, case: int) -> list[float]:
    """Build the missing shared inputs of a case; return the time of each.

    Where the scenario does not state the inputs of a case, the first input stands for all, and is built for case 0.
    """
    missing = list(plan_inputs(campaign, [case]).to_build)
    if not isinstance(campaign.scenario, SelectsInputs):
        missing = missing[:1] if case == 0 else []
    limits = campaign.configuration.limits
    task = partial(prepare_input, configuration_text(campaign.configuration))
    times = []
    for number in missing:
        began = time.monotonic()
        list(executor.run(Work(task, [number], work_limits(limits, limits.prepare_time_s))))
        times.append(time.monotonic() - began)
    return times
