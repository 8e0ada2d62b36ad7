"""Throughput of a campaign on many Dask workers: ``python -m benchmarks.scale_out`` draws docs/images/scale-out.svg.

A campaign on W threads of Dask workers is a closed network of queues. Each thread runs a batch of b cases, b t_case
long; the batch then passes the scheduler (service time s) and the program that stores the rows (service time
c + b r), and the next batch returns to the thread. Two batches per thread are in the network. Its throughput is at
most

    X(W) = min(W / t_case, b / s, b / (c + b r))                                                                  (1)

cases per second. The service times are measured with batches of trivial cases on one scheduler and one worker, each in
a process of its own; the processor time of each process counts. A simulation of the network, with exponential service
times and cases of random duration, is compared with (1).
"""

import heapq
import json
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import matplotlib as mpl
import numpy as np
import psutil
from matplotlib.figure import Figure
from pydantic import BaseModel

from benchmarks.engine import BusyScenario, Stopwatch
from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import CampaignDefinition, Retain
from marsyard.campaigns.execution.batches import MAX_BATCH, batch_duration_s
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.running.engine import run_campaign
from marsyard.scenarios.interface import CaseResult
from marsyard.sim.streams import Streams

RESULTS = Path(__file__).parent / "results" / "scale_out.json"
FIGURE = Path(__file__).parents[1] / "docs" / "images" / "scale-out.svg"
#: Numbers of worker threads of the model.
THREADS = (10, 30, 100, 300, 1000, 3000, 10_000)
#: Core-seconds of a case, by campaign (docs/performance.md).
CASES_S = {"dimes-gusev": 0.8, "vtt-montecarlo": 3.4, "loc-jezero": 12.0}
#: Simulated batches per thread, at least, and coefficient of variation of a case's duration.
_BATCHES_PER_THREAD, _CASE_CV = 20, 0.3
#: Number of columns of the rows of the measurement: about that of a descent.
_COLUMNS = 150
#: Numbers of cases of the measurements, with one case per batch and with the largest batches.
_SINGLE_CASES, _MANY_CASES = (300, 1800), (5000, 35_000)


@dataclass(frozen=True)
class ServiceTimes:
    """Measured processor times, s.

    - scheduler_s: of the scheduler, per batch
    - program_s, row_s: of the program that stores the rows, per batch and per row
    """

    scheduler_s: float
    program_s: float
    row_s: float


def bound(threads: int, case_s: float, batch: int, times: ServiceTimes) -> float:
    """Return the bound (1), cases per second."""
    return min(threads / case_s, batch / times.scheduler_s, batch / (times.program_s + batch * times.row_s))


def simulate(threads: int, case_s: float, batch: int, times: ServiceTimes, rng: np.random.Generator) -> float:
    """Simulate the network and return its throughput, cases per second; the first half of the batches is not counted.

    Every thread has a queue of its own: a batch is run by the thread for which it was submitted.
    """
    total = _BATCHES_PER_THREAD * threads
    shape = 1.0 / _CASE_CV**2 * batch  # the duration of a batch is a sum of gamma variables
    waiting, is_busy = np.full(threads, 2), np.zeros(threads, dtype=bool)
    events: list[tuple[float, int, int]] = []  # time, station, thread; stations: 0 threads, 1 scheduler, 2 program
    free_s = {1: 0.0, 2: 0.0}
    means_s = {1: times.scheduler_s, 2: times.program_s + batch * times.row_s}

    def start(now_s: float, thread: int) -> None:
        if waiting[thread] and not is_busy[thread]:
            waiting[thread] -= 1
            is_busy[thread] = True
            heapq.heappush(events, (now_s + batch * case_s * rng.gamma(shape) / shape, 0, thread))

    for thread in range(threads):
        start(0.0, thread)
    finished, half_s = 0, 0.0
    while finished < total:
        now_s, station, thread = heapq.heappop(events)
        if station == 0:
            is_busy[thread] = False
            start(now_s, thread)
        if station < 2:
            server = station + 1
            free_s[server] = max(now_s, free_s[server]) + rng.exponential(means_s[server])
            heapq.heappush(events, (free_s[server], server, thread))
        else:
            finished += 1
            if finished == total // 2:
                half_s = now_s
            waiting[thread] += 1
            start(now_s, thread)
    return (total - total // 2) * batch / (now_s - half_s)


class WideScenario(BusyScenario):
    """Scenario whose rows have as many columns as those of a descent."""

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        values = streams.generator("values").standard_normal(_COLUMNS)
        return CaseResult("VALID", True, {f"column_{number}_m_s": float(value) for number, value in enumerate(values)})


def measure_service_times() -> ServiceTimes:
    """Measure the processor times of scheduler and program per batch and per row."""
    with _cluster() as (address, scheduler):
        single_scheduler_s, single_program_s = _cost_per_case(address, scheduler, 1, _SINGLE_CASES)
        _, many_program_s = _cost_per_case(address, scheduler, MAX_BATCH, _MANY_CASES)
    # a batch of one case costs c + r; a case of a large batch r + c / MAX_BATCH, of which the second part is negligible
    return ServiceTimes(single_scheduler_s, single_program_s - many_program_s, many_program_s)


def _cost_per_case(address: str, scheduler: psutil.Process, batch: int, counts: tuple[int, int]) -> tuple[float, float]:
    """Return the processor times of scheduler and program per case: differences between two campaigns."""
    costs = []
    for count in counts:
        definition = CampaignDefinition(
            name="wide",
            scenario="benchmarks.scale_out:WideScenario",
            description="rows without simulation",
            cases=count,
            retain=Retain(showcase="none", products="none"),
        )
        start_scheduler_s, start_s = sum(scheduler.cpu_times()[:2]), time.process_time()
        with TemporaryDirectory() as folder, patch("marsyard.campaigns.execution.batches.MAX_BATCH", batch):
            campaign = Campaign(definition, WideScenario())
            run_campaign(campaign, Path(folder) / "run", ExecutorConfig(cluster=address), Stopwatch(()))
        costs.append((sum(scheduler.cpu_times()[:2]) - start_scheduler_s, time.process_time() - start_s))
    (scheduler_s, program_s), cases = np.diff(costs, axis=0)[0], counts[1] - counts[0]
    return float(scheduler_s) / cases, float(program_s) / cases


@contextmanager
def _cluster() -> Iterator[tuple[str, psutil.Process]]:
    """Start a scheduler and a worker, each in a process of its own; yield address and scheduler."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    with TemporaryDirectory() as folder:
        scheduler = _start("scheduler", "--host", address, "--no-dashboard")
        worker = _start("worker", address, "--nthreads", "1", "--no-dashboard", "--local-directory", folder)
        try:
            yield address, psutil.Process(scheduler.pid)
        finally:
            for process in (worker, scheduler):
                process.terminate()
                process.wait()


def _start(kind: str, *options: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *options]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def batch_size(case_s: float, threads: int) -> int:
    """Return the number of cases of a batch, as `marsyard.campaigns.execution.batches.Batches` selects it."""
    return max(1, min(int(batch_duration_s(threads) / case_s), MAX_BATCH))


def draw(times: ServiceTimes, simulated: dict[str, list[float]]) -> Figure:
    """Draw the bound (1) as lines and the simulation as points."""
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.subplots()
    grid = np.geomspace(THREADS[0], THREADS[-1], 200)
    for number, (name, case_s) in enumerate(CASES_S.items()):
        colour = f"C{number}"
        limits = [bound(int(threads), case_s, batch_size(case_s, int(threads)), times) for threads in grid]
        axes.plot(grid, limits, color=colour, label=f"{name}: {case_s:g} s per case")
        axes.plot(THREADS, simulated[name], "o", color=colour)
    axes.set(xscale="log", yscale="log", xlabel="Threads of Dask workers", ylabel="Cases per second")
    axes.grid(alpha=0.4)
    axes.legend()
    return figure


def main() -> None:
    """Measure, simulate, store the results and draw the figure."""
    times, rng = measure_service_times(), np.random.default_rng(1)
    simulated = {
        name: [simulate(threads, case_s, batch_size(case_s, threads), times, rng) for threads in THREADS]
        for name, case_s in CASES_S.items()
    }
    ratios = [
        value / bound(threads, case_s, batch_size(case_s, threads), times)
        for name, case_s in CASES_S.items()
        for threads, value in zip(THREADS, simulated[name], strict=True)
    ]
    results = {"times": asdict(times), "threads": THREADS, "cases_per_s": simulated}
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    mpl.rcParams.update({"svg.hashsalt": "marsyard", "svg.fonttype": "none"})
    draw(times, simulated).savefig(FIGURE, metadata={"Date": None})
    print(f"scheduler: {1e3 * times.scheduler_s:.2f} ms per batch")
    print(f"program: {1e3 * times.program_s:.2f} ms per batch, {1e6 * times.row_s:.0f} us per row")
    print(f"simulation / bound: {min(ratios):.2f} to {max(ratios):.2f}")
    for name, values in simulated.items():
        print(name, ", ".join(f"{threads}: {value:.0f}/s" for threads, value in zip(THREADS, values, strict=True)))


if __name__ == "__main__":
    main()
