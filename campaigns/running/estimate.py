"""Estimate of a campaign's time and disk space from a few trial cases."""

from __future__ import annotations

import json
import statistics
import time
from dataclasses import dataclass
from functools import partial

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.configuration import CampaignConfiguration
from marsyard.campaigns.execution.cases import (
    CompletedCase,
    configuration_text,
    prepare_input,
    prepare_limits,
    run_cases,
)
from marsyard.campaigns.execution.work import Executor, Work
from marsyard.campaigns.execution.workers import ExecutorConfig, create_executor
from marsyard.campaigns.outcomes import UNFINISHED
from marsyard.campaigns.running.inputs import plan_inputs
from marsyard.campaigns.store.retention import KEEP_ALL
from marsyard.scenarios.interface import SelectsInputs

#: Maximum number of trial cases; the first is excluded from the mean, since it loads code and terrains.
_MAX_TRIALS = 9
#: Seconds after which no further trial case is begun.
_TRIAL_S = 20.0
#: Bytes of SQLite and of the table for each byte of a row's text: pages, index and compressed columns.
_ROW_OVERHEAD = 1.6


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
    configuration = campaign.configuration
    plan = plan_inputs(campaign, range(configuration.total_cases))
    inputs = len(plan.to_build)
    with create_executor(ExecutorConfig()) as executor:
        trials, built = _trials(campaign, executor)
    input_s = statistics.fmean(built) if built else 0.0
    times = [seconds for _, seconds in (trials[1:] or trials)]
    case_s = statistics.fmean(times)
    size = statistics.fmean(len(json.dumps(list(one.row.values()))) for one, _ in trials)
    product = statistics.fmean(one.products.size if one.products else 0 for one, _ in trials)
    rows = configuration.total_cases
    kept = _kept_cases(configuration) * product
    return Estimate(
        trials=len(trials),
        unfinished=sum(one.row["outcome"] in UNFINISHED for one, _ in trials),
        case_s=case_s,
        case_range_s=(min(times), max(times)),
        inputs=inputs,
        input_s=input_s,
        inputs_bytes=plan.build_bytes,
        cache_limit_bytes=plan.limit_bytes,
        time_s=(rows * case_s + inputs * input_s) / jobs,
        rows_bytes=rows * size * _ROW_OVERHEAD,
        products_bytes=min(kept, configuration.retain.budget_gb * 1e9),
    )


def _trials(campaign: Campaign, executor: Executor) -> tuple[list[tuple[CompletedCase, float]], list[float]]:
    """Trial cases with their times, and the times of the shared inputs built for them."""
    trials: list[tuple[CompletedCase, float]] = []
    built: list[float] = []
    configuration = campaign.configuration
    total = configuration.total_cases
    number = min(_MAX_TRIALS, total)
    began = time.monotonic()
    for index in range(number):
        start = time.monotonic()
        if trials and start - began > _TRIAL_S:
            break
        case = index * total // number
        built += _build_inputs(campaign, executor, case)
        start = time.monotonic()
        ((completed,),) = run_cases(executor, configuration, [case], keep=KEEP_ALL)
        trials.append((completed, time.monotonic() - start))
    return trials, built


def _build_inputs(campaign: Campaign, executor: Executor, case: int) -> list[float]:
    """Build the missing shared inputs of a case; return the time of each.

    Where the scenario does not state the inputs of a case, the first input stands for all, and is built for case 0.
    """
    missing = list(plan_inputs(campaign, [case]).to_build)
    if not isinstance(campaign.scenario, SelectsInputs):
        missing = missing[:1] if case == 0 else []
    limits = prepare_limits(campaign.configuration.limits)
    task = partial(prepare_input, configuration_text(campaign.configuration))
    times = []
    for number in missing:
        began = time.monotonic()
        list(executor.run(Work(task, [number], limits)))
        times.append(time.monotonic() - began)
    return times


def _kept_cases(configuration: CampaignConfiguration) -> float:
    """Number of cases with kept products; all of them where only their rows will decide."""
    retain, total = configuration.retain, configuration.total_cases
    show = int(retain.showcase != "none")
    number = {"none": 0, "worst": retain.worst, "every": -(-total // retain.every), "all": total, "failed": total}
    return min(total, number[retain.products] + show)
