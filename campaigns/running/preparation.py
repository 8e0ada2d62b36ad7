"""Preparation of a campaign: plan of shared inputs (terrains), compilation, estimate of time and disk space.

A shared input is used by several cases, and is built once into a cache on disk; a scenario numbers its shared inputs.
An input that only one case uses is built by this case in memory, so that the cache does not grow with the cases.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import ENGINE_FAILURES, CampaignError
from marsyard.campaigns.execution.cases import (
    CompletedCase,
    configuration_text,
    create_loader,
    prepare_input,
    run_cases,
    work_limits,
)
from marsyard.campaigns.execution.executors import create_executor
from marsyard.campaigns.execution.worker_process import Executor, Work
from marsyard.campaigns.execution.workers import ExecutorConfig
from marsyard.campaigns.store.products import ALL_PRODUCTS
from marsyard.scenarios.interface import SelectsInputs
from marsyard.scenarios.systems import systems
from marsyard.sim.cache import cache_directory, cached_bytes, limit_bytes
from marsyard.sim.kernel_cache import kernels_are_ready, mark_ready

#: Note before the first compilation on a machine.
COMPILATION_NOTE = (
    "compiling numeric kernels once on this machine, about a minute (to compile in advance: marsyard compile)"
)
#: Maximum number of trial cases; the first is excluded from the mean, since it loads code and terrains.
_MAX_TRIALS = 9
#: Seconds after which no further trial case is started.
_MAX_TRIAL_TIME_S = 20.0
#: Bytes of SQLite file and table per byte of a row's JSON text: pages, index and compressed columns.
_ROW_OVERHEAD = 1.6


@dataclass(frozen=True)
class InputPlan:
    """Shared inputs of some cases.

    - present: numbers of the inputs on disk, if the scenario reports them
    - to_build: numbers of the inputs to be built, with their bytes on disk (0 if the scenario does not report them)
    - limit_bytes: size limit of the cache
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
        """Inputs to be prepared before the cases: existing inputs are verified, new inputs are built up to the limit.

        Cases build the remaining inputs in memory.
        """
        selected, size = list(self.present), 0
        for number, input_bytes in self.to_build.items():
            size += input_bytes
            if size > self.limit_bytes:
                break
            selected.append(number)
        return tuple(selected)


def plan_inputs(campaign: Campaign, cases: Iterable[int] | None) -> InputPlan:
    """Plan the shared inputs of some of a campaign's cases; all shared inputs if `cases` is None (unknown cases).

    Raises CampaignError if the cache's limit is not a number, or its folder cannot be created.
    """
    scenario, base = campaign.scenario, campaign.base_parameters()
    numbers = scenario.shared_inputs(base) if cases is None else find_shared_inputs(campaign, cases)
    if not numbers:
        return InputPlan((), {}, 0)
    reports_inputs = isinstance(scenario, SelectsInputs)
    try:
        folder = cache_directory("terrain")
        limit = limit_bytes(folder, cached_bytes(folder))
        sizes = {
            number: scenario.missing_bytes(base, number) if isinstance(scenario, SelectsInputs) else 0
            for number in numbers
        }
    except OSError as error:
        raise CampaignError(f"the cache cannot be used: {error}") from error
    except ValueError as error:
        raise CampaignError(str(error)) from error
    present = tuple(number for number in numbers if reports_inputs and sizes[number] == 0)
    return InputPlan(present, {number: size for number, size in sizes.items() if number not in present}, limit)


def find_shared_inputs(campaign: Campaign, cases: Iterable[int]) -> tuple[int, ...]:
    """Find the inputs that several cases use; all shared inputs if the scenario does not report those of a case.

    The sampled values depend only on the number of the case. The search ends when all inputs have occurred twice: for
    64 terrains after about 400 cases, each of which takes two milliseconds.
    """
    scenario = campaign.scenario
    all_inputs = scenario.shared_inputs(campaign.base_parameters())
    if not all_inputs or not isinstance(scenario, SelectsInputs):
        return all_inputs
    uses = dict.fromkeys(all_inputs, 0)
    for case in cases:
        for number in _find_case_inputs(campaign, scenario, case):
            if number in uses:
                uses[number] += 1
        if min(uses.values()) > 1:
            break
    return tuple(number for number, count in uses.items() if count > 1)


def _find_case_inputs(campaign: Campaign, scenario: SelectsInputs, case: int) -> set[int]:
    """Find the inputs of a case; none if its values cannot be sampled: the row of the case will contain the reason."""
    try:
        return set(scenario.case_inputs(campaign.parameters(case), case))
    except ValueError:
        return set()


def list_compilations(scenario: str | None = None) -> list[tuple[str, str, tuple[str, ...]]]:
    """List the campaigns that compile the kernels of a scenario's system, or of all systems.

    Returns the scenario, the campaign, and the settings that make its cases small.
    """
    compilations = (
        item
        for system in systems()
        if scenario is None or scenario in system.scenarios
        for item in system.compilation_campaigns.items()
    )
    return [(load_campaign(name, settings).configuration.scenario, name, settings) for name, settings in compilations]


def compile_campaign(name: str, settings: Sequence[str]) -> None:
    """Run one small case of a campaign, which compiles the kernels of its scenario."""
    campaign = load_campaign(name, settings)
    campaign.scenario.run(campaign.parameters(0), campaign.streams(0))
    mark_ready(campaign.configuration.scenario)


def compile_kernels(executor: Executor, scenario: str, note: Callable[[str], None]) -> None:
    """Compile the kernels of a scenario in a worker, unless they are compiled on this machine.

    Otherwise the first case of each worker would compile them, and an algorithm's computation time would include it.
    """
    if kernels_are_ready(scenario):
        return
    missing = [item for item in list_compilations(scenario) if not kernels_are_ready(item[0])]
    if not missing:
        return
    note(COMPILATION_NOTE)
    start_s, work = time.monotonic(), Work(partial(_compile_item, missing), range(len(missing)))
    errors = [result.error for result in chain.from_iterable(executor.run(work)) if result.error is not None]
    for error in errors:
        note(f"numeric kernels could not be compiled: {error}; each worker's first case compiles them")
    if not errors:
        note(f"numeric kernels are compiled, {time.monotonic() - start_s:.0f} s")


def _compile_item(compilations: Sequence[tuple[str, str, tuple[str, ...]]], number: int) -> None:
    _scenario, name, settings = compilations[number]
    compile_campaign(name, settings)


@dataclass(frozen=True)
class CampaignEstimate:
    """Estimated time and disk space of a campaign.

    - trials, unfinished: number of trial cases, and number of these that did not finish
    - case_s, case_range_s: mean wall-clock time of a trial case on one worker, and its range
    - inputs, input_s, inputs_bytes: number of shared inputs (terrains) to be built, mean time to build one, and total
      bytes on disk (0 if the scenario does not report them); cache_limit_bytes: size limit of their cache
    - time_s: time of the complete campaign with the requested workers, if each has a processor core
    - rows_bytes, products_bytes: bytes on disk of SQLite file and table, and of the stored products within their budget
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


def estimate_campaign(campaign: Campaign, jobs: int) -> CampaignEstimate:
    """Estimate a campaign from evenly spaced trial cases in one worker; only their shared inputs remain on disk."""
    configuration, total = campaign.configuration, campaign.configuration.total_cases
    plan = plan_inputs(campaign, range(total))
    trials: list[CompletedCase] = []
    times: list[float] = []
    build_times: list[float] = []
    trial_count = min(_MAX_TRIALS, total)
    with create_executor(ExecutorConfig()) as executor:
        start_s = time.monotonic()
        for case in (index * total // trial_count for index in range(trial_count)):
            # at least two: the first one includes the start of the worker and possibly the compilation of kernels
            if len(trials) > 1 and time.monotonic() - start_s > _MAX_TRIAL_TIME_S:
                break
            build_times += _build_inputs(campaign, executor, plan, case)
            case_start_s = time.monotonic()
            ((completed,),) = run_cases(executor, configuration, [case], selection=ALL_PRODUCTS)
            trials.append(completed)
            times.append(time.monotonic() - case_start_s)
    times = times[1:] or times
    case_s, input_s = statistics.fmean(times), statistics.fmean(build_times or [0.0])
    row_bytes = statistics.fmean(len(json.dumps(list(trial.row.values()))) for trial in trials)
    product_bytes = statistics.fmean(trial.products.size if trial.products else 0 for trial in trials)
    retain = configuration.retain
    # the number of failed cases is unknown before the campaign, so the upper bound (all cases) is used
    stored_cases = {"none": 0, "worst": retain.worst, "every": -(-total // retain.every), "all": total, "failed": total}
    products = min(total, stored_cases[retain.products] + int(retain.showcase != "none")) * product_bytes
    return CampaignEstimate(
        trials=len(trials),
        unfinished=sum(trial.row["outcome"] in ENGINE_FAILURES for trial in trials),
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


def _build_inputs(campaign: Campaign, executor: Executor, plan: InputPlan, case: int) -> list[float]:
    """Build the missing shared inputs of a case; return the time of each.

    If the scenario does not report the inputs of a case, only the first input is built, for case 0.
    """
    configuration, scenario = campaign.configuration, campaign.scenario
    if isinstance(scenario, SelectsInputs):
        base, numbers = campaign.base_parameters(), _find_case_inputs(campaign, scenario, case)
        missing = [number for number in plan.to_build if number in numbers and scenario.missing_bytes(base, number)]
    else:
        missing = list(plan.to_build)[:1] if case == 0 else []
    task = partial(prepare_input, configuration_text(configuration))
    times = []
    for number in missing:
        start_s = time.monotonic()
        limits = work_limits(configuration.limits, configuration.limits.prepare_time_s)
        list(executor.run(Work(task, [number], limits, load=create_loader(configuration))))
        times.append(time.monotonic() - start_s)
    return times
