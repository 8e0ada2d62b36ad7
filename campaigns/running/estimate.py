"""What a campaign would take, in time and on disk, from a few of its cases run on trial."""

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
from marsyard.campaigns.execution.crew import Crew, hire
from marsyard.campaigns.execution.work import Work, Workers
from marsyard.campaigns.outcomes import UNFINISHED
from marsyard.campaigns.running.inputs import plan_inputs
from marsyard.campaigns.store.retention import KEEP_ALL
from marsyard.scenarios.interface import SelectsInputs

#: Cases run on trial, at most; the first is left out of the mean as it loads what the others find.
TRIAL_CASES = 9

#: Seconds after which no further trial case is begun.
TRIAL_S = 20.0

#: Bytes of SQLite and of the table for each byte of a row's text: pages and index above it, and the compressed columns.
_ROW_OVERHEAD = 1.6


@dataclass(frozen=True)
class Estimate:
    """What a campaign would take.

    Attributes
    ----------
    trials, unfinished
        Cases run on trial, and those of them that did not come to their end.
    case_s, case_range_s
        Mean wall-clock time of a trial case on one worker, and the shortest and the longest.
    inputs, input_s, inputs_bytes
        Shared inputs (terrains) of the cases that are not built yet, the mean time that building one took, and what
        they take on disk together (0 where the scenario does not state it).
    cache_limit_bytes
        Size limit of the cache that keeps them.
    time_s
        Of the whole campaign with the crew that was asked for, as long as it has a core for each worker.
    rows_bytes, products_bytes
        On disk: SQLite and table; kept products (within their budget).
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
    """Runs some cases on trial, in one worker, and keeps nothing of them but the shared inputs built for them.

    The cases are spread evenly over the campaign.
    """
    configuration = campaign.configuration
    plan = plan_inputs(campaign, range(configuration.total_cases))
    inputs = len(plan.to_build)
    with hire(Crew()) as workers:
        trials, built = _trials(campaign, workers)
    input_s = statistics.fmean(built) if built else 0.0
    times = [seconds for _, seconds in (trials[1:] or trials)]
    case_s = statistics.fmean(times)
    size = statistics.fmean(len(json.dumps(list(one.row.values()))) for one, _ in trials)
    product = statistics.fmean(one.products.size if one.products else 0 for one, _ in trials)
    rows = configuration.total_cases
    kept = _kept_share(configuration) * product
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


def _trials(campaign: Campaign, workers: Workers) -> tuple[list[tuple[CompletedCase, float]], list[float]]:
    """Cases run on trial with the time that each took, and the times of the shared inputs built for them."""
    ran: list[tuple[CompletedCase, float]] = []
    built: list[float] = []
    configuration = campaign.configuration
    total = configuration.total_cases
    number = min(TRIAL_CASES, total)
    began = time.monotonic()
    for place in range(number):
        start = time.monotonic()
        if ran and start - began > TRIAL_S:
            break
        case = place * total // number
        built += _build_inputs(campaign, workers, case)
        start = time.monotonic()
        ((completed,),) = run_cases(workers, configuration, [case], keep=KEEP_ALL)
        ran.append((completed, time.monotonic() - start))
    return ran, built


def _build_inputs(campaign: Campaign, workers: Workers, case: int) -> list[float]:
    """Builds what a case shares with others and what is not there; returns the time that each input took.

    Of a scenario that does not state what a case uses, the first input stands for all, and is built for case 0.
    """
    missing = list(plan_inputs(campaign, [case]).to_build)
    if not isinstance(campaign.scenario, SelectsInputs):
        missing = missing[:1] if case == 0 else []
    limits = prepare_limits(campaign.configuration.limits)
    task = partial(prepare_input, configuration_text(campaign.configuration))
    times = []
    for number in missing:
        began = time.monotonic()
        list(workers.run(Work(task, [number], limits)))
        times.append(time.monotonic() - began)
    return times


def _kept_share(configuration: CampaignConfiguration) -> float:
    """Cases whose products are kept; all of them where only their rows will say."""
    retain, total = configuration.retain, configuration.total_cases
    show = int(retain.showcase != "none")
    number = {"none": 0, "worst": retain.worst, "every": -(-total // retain.every), "all": total, "failed": total}
    return min(total, number[retain.products] + show)
