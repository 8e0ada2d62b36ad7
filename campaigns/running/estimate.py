"""Estimate of the time and disk space of a campaign before it runs, from a few trial cases."""

import json
import math
import statistics
import time
from dataclasses import dataclass

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.execution.cases import CompletedCase, run_cases
from marsyard.campaigns.execution.executors import ExecutorConfig, create_executor
from marsyard.campaigns.execution.work import Executor
from marsyard.campaigns.outcomes import ENGINE_FAILURES
from marsyard.campaigns.running.shared_inputs import InputPlan, find_case_inputs, plan_inputs, preparation_work
from marsyard.campaigns.store.product_selection import ALL_PRODUCTS
from marsyard.scenarios.interface import SelectsInputs

#: Maximum number of trial cases; the first is excluded from the mean, since it loads code and terrains.
_MAX_TRIALS = 9
#: Seconds after which no further trial case is started.
_MAX_TRIAL_TIME_S = 20.0
#: Bytes of SQLite file and table per byte of a row's JSON text: pages, index and compressed columns.
_ROW_OVERHEAD = 1.6


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
    definition, total = campaign.definition, campaign.definition.total_cases
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
            # one batch with one case
            ((completed,),) = run_cases(executor, definition, [case], selection=ALL_PRODUCTS)
            trials.append(completed)
            times.append(time.monotonic() - case_start_s)
    times = times[1:] or times
    case_s, input_s = statistics.fmean(times), statistics.fmean(build_times or [0.0])
    row_bytes = statistics.fmean(len(json.dumps(list(trial.row.values()))) for trial in trials)
    product_bytes = statistics.fmean(trial.products.size if trial.products else 0 for trial in trials)
    retain = definition.retain
    # the number of failed cases is unknown before the campaign, so the upper bound (all cases) is used
    stored_cases = {
        "none": 0,
        "all": total,
        "failed": total,
        "worst": retain.worst,
        "every": math.ceil(total / retain.every),
    }
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
    scenario = campaign.scenario
    if isinstance(scenario, SelectsInputs):
        base, numbers = campaign.base_parameters(), find_case_inputs(campaign, scenario, case)
        missing = [number for number in plan.to_build if number in numbers and scenario.missing_bytes(base, number)]
    else:
        missing = list(plan.to_build)[:1] if case == 0 else []
    times = []
    for number in missing:
        start_s = time.monotonic()
        list(executor.run(preparation_work(campaign, [number])))
        times.append(time.monotonic() - start_s)
    return times
