"""Measure the overhead of campaigns: time per case, memory of the parent process, writing a table of a million rows."""

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import pyarrow.compute as pc
import pyarrow.parquet as pq
from joblib import Parallel, delayed
from pydantic import BaseModel, ConfigDict

from benchmarks.timing import Measurement
from benchmarks.validation.chaos import WithoutSharedInputs
from marsyard.algorithms.processes import resident_bytes
from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import CampaignDefinition, Retain
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.running.engine import run_campaign
from marsyard.campaigns.store.rows import RowStore, create_store
from marsyard.campaigns.store.table import write_table
from marsyard.scenarios.interface import CaseResult, Scalar
from marsyard.sim.streams import Streams

#: Columns of numbers in the table of a million rows.
COLUMNS = 30


class BusyParameters(BaseModel):
    """Parameters of `BusyScenario`: processor time of a case, s."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    busy_s: float = 0.0


class BusyScenario(WithoutSharedInputs):
    """Scenario that occupies the processor for `busy_s` and computes nothing."""

    name = "busy"
    parameters_type = BusyParameters

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        assert isinstance(parameters, BusyParameters)
        end = time.process_time() + parameters.busy_s
        while parameters.busy_s and time.process_time() < end:
            pass
        return CaseResult("VALID", True, {"number": streams.case})


class Stopwatch:
    """Progress display that records time and memory of the parent process at given numbers of finished cases.

    - records: wall-clock time (s) and memory (MB), by number of finished cases
    """

    def __init__(self, case_counts: tuple[int, ...]) -> None:
        self.records: dict[int, tuple[float, float]] = {}
        self._case_counts = case_counts
        self._finished_cases = 0
        self._is_counting = False

    def begin(self, stage: str, total: int) -> None:
        self._is_counting = stage == "cases"

    def step(self) -> None:
        self._finished_cases += self._is_counting
        if self._is_counting and self._finished_cases in self._case_counts:
            self.records[self._finished_cases] = (time.perf_counter(), resident_bytes([os.getpid()]) / 1e6)

    def note(self, text: str) -> None:
        print(f"note: {text}")


@dataclass(frozen=True)
class CaseCost:
    """Wall-clock time per case, of which inside the scenario, and growth of the parent process's memory."""

    wall_s: float
    inside_case_s: float
    memory_growth_mb: float


def measure(repeats: int = 3) -> list[Measurement]:
    """Measure the overhead of the engine, that is the time outside the scenario.

    The overhead is computed from wall-clock times of the same run, so that other programs affect both in the same way.
    """
    empty = [measure_case_cost(0.0, 2_000, 12_000) for _ in range(repeats)]
    busy = [measure_case_cost(0.05, 20, 140) for _ in range(repeats)]
    long_run = measure_case_cost(0.0, 10_000, 100_000)
    return [
        Measurement(
            "engine: overhead of an empty case (ms)",
            [1e3 * (cost.wall_s - cost.inside_case_s) for cost in empty],
            limit=2.0,
        ),
        Measurement(
            "engine: overhead of a case of 50 ms (%)",
            [100.0 * (cost.wall_s / cost.inside_case_s - 1.0) for cost in busy],
            limit=3.0,
        ),
        Measurement(
            "engine: memory growth of the campaign process from 10,000 to 100,000 cases (MB)",
            [long_run.memory_growth_mb],
            limit=10.0,
        ),
        *_measure_empty_campaign(),
        Measurement(
            "engine: speed-up by two workers, rendered cases (ratio)",
            [measure_speed_up() for _ in range(repeats)],
            minimum=1.9,
        ),
        Measurement(
            "dimes-gusev on two workers (cases per wall s)",
            [measure_rate("dimes-gusev", ["location.bank=8"]) for _ in range(repeats)],
            minimum=3.3,
        ),
        Measurement(
            f"engine: conversion of 1,000,000 rows of {COLUMNS} numbers to Parquet (s)",
            [measure_table_s(1_000_000)],
            limit=30.0,
        ),
    ]


def _measure_empty_campaign(cases: int = 100_000) -> list[Measurement]:
    """Measure a campaign of empty cases on two workers, and a joblib loop over the same cases without storage."""
    definition = CampaignDefinition(
        name="empty", scenario="benchmarks.engine:BusyScenario", cases=cases, retain=Retain(showcase="none")
    )
    campaign = Campaign(definition, BusyScenario())
    with TemporaryDirectory() as folder:
        start_s = time.perf_counter()
        run_campaign(campaign, Path(folder, "run"), ExecutorConfig(2), Stopwatch(()))
        campaign_s = time.perf_counter() - start_s
    start_s = time.perf_counter()
    Parallel(2)(delayed(_run_case)(campaign, case) for case in range(cases))
    loop_s = time.perf_counter() - start_s
    return [
        Measurement(f"engine: {cases:,} empty cases, two workers (wall s)", [campaign_s], limit=60.0),
        Measurement(f"joblib loop without storage: {cases:,} empty cases, two workers (wall s)", [loop_s]),
    ]


def _run_case(campaign: Campaign, case: int) -> CaseResult:
    """Run one case without the engine."""
    return campaign.scenario.run(campaign.parameters(case), campaign.streams(case))


def measure_case_cost(busy_s: float, first: int, last: int) -> CaseCost:
    """Run a campaign on one worker; measure from case `first` to case `last`, so that start-up is excluded."""
    definition = CampaignDefinition(
        name="busy",
        scenario="benchmarks.engine:BusyScenario",
        # additional cases, because workers run small batches at the end
        cases=last + (last - first) // 10,
        parameters={"busy_s": busy_s},
        retain=Retain(showcase="none"),
    )
    stopwatch = Stopwatch((first, last))
    with TemporaryDirectory() as folder:
        run_campaign(Campaign(definition, BusyScenario()), Path(folder, "run"), ExecutorConfig(1), stopwatch)
        seconds = pq.read_table(Path(folder, "run", "cases.parquet"), columns=["wall_time_s"])["wall_time_s"]
        inside_case_s = pc.mean(seconds.slice(first, last - first)).as_py()
    (start_s, start_mb), (end_s, end_mb) = stopwatch.records[first], stopwatch.records[last]
    return CaseCost((end_s - start_s) / (last - first), inside_case_s, end_mb - start_mb)


def measure_rate(campaign_name: str, overrides: Sequence[str] = (), cases: int = 120, jobs: int = 2) -> float:
    """Measure the rate of a campaign of rendered cases, cases per second (wall-clock time); needs idle cores.

    The first 24 cases (start-up of the workers) and the last 8 (small batches) are excluded.
    """
    first, last = 24, cases - 8
    stopwatch = Stopwatch((first, last))
    with TemporaryDirectory() as folder:
        campaign = load_campaign(campaign_name, [*overrides, "retain.showcase=none"], cases)
        run_campaign(campaign, Path(folder, "run"), ExecutorConfig(jobs), stopwatch)
    return (last - first) / (stopwatch.records[last][0] - stopwatch.records[first][0])


def measure_speed_up() -> float:
    """Measure the speed-up of two workers with rendered cases; needs idle cores."""
    one, two = (measure_rate("dimes-smoke", jobs=jobs) for jobs in (1, 2))
    return two / one


def measure_table_s(rows: int) -> float:
    """Measure the processor time to write a table with full-precision numbers."""
    first_columns: dict[str, Scalar] = {"outcome": "VALID", "answered": True}
    last_columns: dict[str, Scalar] = {"wall_time_s": 0.1, "cpu_time_s": 0.1, "error": "", "traceback": ""}
    with TemporaryDirectory() as folder:
        path = Path(folder, "cases.sqlite")
        create_store(path, {})
        with RowStore(path) as store:
            for start in range(0, rows, 1000):
                store.add(
                    {
                        "case": case,
                        **first_columns,
                        **{f"x{k}": (case + k) / 7.0 for k in range(COLUMNS)},
                        **last_columns,
                    }
                    for case in range(start, start + 1000)
                )
            start_s = time.process_time()
            write_table(Path(folder, "cases.parquet"), store)
            return time.process_time() - start_s


if __name__ == "__main__":
    for row in measure():
        print(f"{row.name:<60}{row.median:9.3f}  {row.limit_text}")
