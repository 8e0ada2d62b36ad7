"""What a campaign would take, in time and on disk, from a few of its cases run on trial."""

from __future__ import annotations

import json
import statistics
import time
from dataclasses import dataclass
from functools import partial

from campaigns.definition.campaign import Campaign
from campaigns.definition.configuration import CampaignConfiguration
from campaigns.execution.cases import CompletedCase, configuration_text, prepare_input, prepare_limits, run_cases
from campaigns.execution.crew import Crew, hire
from campaigns.execution.work import Work, Workers
from campaigns.outcomes import UNFINISHED
from campaigns.store.retention import KEEP_ALL

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
    inputs, input_s
        Shared inputs to be prepared, and the time that the first took (little where it was there already).
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
    time_s: float
    rows_bytes: float
    products_bytes: float


def estimate(campaign: Campaign, jobs: int) -> Estimate:
    """Runs the first shared input and some cases on trial, in one worker, and keeps nothing of them.

    The cases are spread evenly over the campaign.
    """
    configuration = campaign.configuration
    inputs = campaign.scenario.shared_inputs(campaign.base_parameters())
    with hire(Crew()) as workers:
        began = time.monotonic()
        if inputs:
            task = partial(prepare_input, configuration_text(configuration))
            list(workers.run(Work(task, inputs[:1], prepare_limits(configuration.limits))))
        input_s = time.monotonic() - began
        trials = _trials(configuration, workers)
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
        inputs=len(inputs),
        input_s=input_s,
        time_s=(rows * case_s + len(inputs) * input_s) / jobs,
        rows_bytes=rows * size * _ROW_OVERHEAD,
        products_bytes=min(kept, configuration.retain.budget_gb * 1e9),
    )


def _trials(configuration: CampaignConfiguration, workers: Workers) -> list[tuple[CompletedCase, float]]:
    """Cases run on trial, and the time that each took."""
    ran: list[tuple[CompletedCase, float]] = []
    total = configuration.total_cases
    number = min(TRIAL_CASES, total)
    began = time.monotonic()
    for place in range(number):
        start = time.monotonic()
        if ran and start - began > TRIAL_S:
            break
        ((completed,),) = run_cases(workers, configuration, [place * total // number], keep=KEEP_ALL)
        ran.append((completed, time.monotonic() - start))
    return ran


def _kept_share(configuration: CampaignConfiguration) -> float:
    """Cases whose products are kept; all of them where only their rows will say."""
    retain, total = configuration.retain, configuration.total_cases
    show = int(retain.showcase != "none")
    number = {"none": 0, "worst": retain.worst, "every": -(-total // retain.every), "all": total, "failed": total}
    return min(total, number[retain.products] + show)
