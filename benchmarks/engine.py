"""Overhead of campaigns: time per case, memory of the parent process, and writing a table of a million rows."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import pyarrow.compute as pc
import pyarrow.parquet as pq
from joblib import Parallel, delayed
from pydantic import BaseModel, ConfigDict

from benchmarks.timing import Measurement
from marsyard.algorithms.processes import resident_bytes
from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.configuration import CampaignConfiguration, Retain
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.execution.workers import ExecutorConfig
from marsyard.campaigns.running.engine import run_campaign
from marsyard.campaigns.store.rows import RowStore, create_store
from marsyard.campaigns.store.table import write_table
from marsyard.scenarios.interface import CaseResult, Scalar
from marsyard.sim.streams import Streams

#: Columns of numbers in the table of a million rows.
COLUMNS = 30


class BusyParameters(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    busy_s: float = 0.0


class BusyScenario:
    """Occupy a processor for a given time, without a score."""

    name = "busy"
    parameters_type = BusyParameters

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        return ()

    def prepare(self, parameters: BaseModel, shared_input: int) -> None:
        """There are no shared inputs."""

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        assert isinstance(parameters, BusyParameters)
        end = time.process_time() + parameters.busy_s
        while parameters.busy_s and time.process_time() < end:
            pass
        return CaseResult("VALID", True, {"number": streams.case})


class Stopwatch:
    """Progress display that records time and memory of the parent at given numbers of cases."""

    def __init__(self, marks: tuple[int, ...]) -> None:
        self.at: dict[int, tuple[float, float]] = {}
        self._marks = marks
        self._done = 0
        self._counts = False

    def begin(self, stage: str, total: int) -> None:
        self._counts = stage == "cases"

    def step(self) -> None:
        self._done += self._counts
        if self._counts and self._done in self._marks:
            self.at[self._done] = (time.perf_counter(), resident_bytes([os.getpid()]) / 1e6)

    def note(self, text: str) -> None:
        print(f"note: {text}")


@dataclass(frozen=True)
class Span:
    """Wall-clock time per case between two marks, the part spent in cases, and growth of memory."""

    case_s: float
    own_s: float
    grown_mb: float


def measure(repeats: int = 3) -> list[Measurement]:
    """Overhead of the engine. Fractions of wall-clock time, so that load of other programs affects both sides."""
    empty = [span(0.0, 2_000, 12_000) for _ in range(repeats)]
    busy = [span(0.05, 20, 140) for _ in range(repeats)]
    long = span(0.0, 10_000, 100_000)
    return [
        Measurement("engine: overhead of an empty case (ms)", [1e3 * (one.case_s - one.own_s) for one in empty], limit=2.0),
        Measurement(
            "engine: overhead of a case of 50 ms (%)",
            [100.0 * (one.case_s / one.own_s - 1.0) for one in busy],
            limit=3.0,
        ),
        Measurement("engine: growth of the parent, 10,000 to 100,000 cases (MB)", [long.grown_mb], limit=10.0),
        *_a_hundred_thousand(),
        Measurement("engine: speed-up by two workers, rendered cases", [gain() for _ in range(repeats)], minimum=1.85),
        Measurement(f"engine: table of 1,000,000 rows of {COLUMNS} numbers (s)", [table_seconds(1_000_000)], limit=30.0),
    ]


def _a_hundred_thousand(cases: int = 100_000) -> list[Measurement]:
    """A complete campaign of empty cases on two workers, and a loop of joblib over the same cases."""
    configuration = CampaignConfiguration(
        name="empty", scenario="benchmarks.engine:BusyScenario", cases=cases, retain=Retain(showcase="none")
    )
    campaign = Campaign(configuration, BusyScenario())
    with TemporaryDirectory() as folder:
        began = time.perf_counter()
        run_campaign(campaign, Path(folder, "run"), ExecutorConfig(2), Stopwatch(()))
        ours = time.perf_counter() - began
    began = time.perf_counter()
    Parallel(2)(delayed(_one)(campaign, case) for case in range(cases))
    loop = time.perf_counter() - began
    return [
        Measurement(f"engine: {cases:,} empty cases, two workers (wall s)", [ours], limit=60.0),
        Measurement("the same in a loop of joblib without storage (wall s)", [loop]),
    ]


def _one(campaign: Campaign, case: int) -> CaseResult:
    return campaign.scenario.run(campaign.parameters(case), campaign.streams(case))


def span(busy_s: float, first: int, last: int) -> Span:
    """Run a campaign on one worker and measure between the marks, so that start-up is excluded."""
    configuration = CampaignConfiguration(
        name="busy",
        scenario="benchmarks.engine:BusyScenario",
        # workers run small batches after the last mark
        cases=last + (last - first) // 10,
        parameters={"busy_s": busy_s},
        retain=Retain(showcase="none"),
    )
    watch = Stopwatch((first, last))
    with TemporaryDirectory() as folder:
        run_campaign(Campaign(configuration, BusyScenario()), Path(folder, "run"), ExecutorConfig(1), watch)
        own = pq.read_table(Path(folder, "run", "cases.parquet"), columns=["wall_time_s"])["wall_time_s"]
        own_s = pc.mean(own.slice(first, last - first)).as_py()
    (began, before), (ended, after) = watch.at[first], watch.at[last]
    return Span((ended - began) / (last - first), own_s, after - before)


def gain(campaign: str = "dimes-smoke", cases: int = 120) -> float:
    """Speed-up of two workers with rendered cases; meaningful on idle cores only.

    Measured between the start-up of all workers and the last batches.
    """
    first, last = 24, cases - 8
    times = []
    for jobs in (1, 2):
        watch = Stopwatch((first, last))
        with TemporaryDirectory() as folder:
            loaded = load_campaign(campaign, ["retain.showcase=none"], cases)
            run_campaign(loaded, Path(folder, "run"), ExecutorConfig(jobs), watch)
        times.append(watch.at[last][0] - watch.at[first][0])
    return times[0] / times[1]


def table_seconds(rows: int) -> float:
    """Processor time to write a table with full-precision numbers."""
    head: dict[str, Scalar] = {"outcome": "VALID", "answered": True}
    tail: dict[str, Scalar] = {"wall_time_s": 0.1, "cpu_time_s": 0.1, "error": "", "traceback": ""}
    with TemporaryDirectory() as folder:
        path = Path(folder, "cases.sqlite")
        create_store(path, {})
        with RowStore(path) as store:
            for start in range(0, rows, 1000):
                store.add(
                    {"case": case, **head, **{f"x{k}": (case + k) / 7.0 for k in range(COLUMNS)}, **tail}
                    for case in range(start, start + 1000)
                )
            began = time.process_time()
            write_table(Path(folder, "cases.parquet"), store)
            return time.process_time() - began


if __name__ == "__main__":
    for row in measure():
        print(f"{row.name:<60}{row.median:9.3f}  {row.limit_text:<8}{'' if row.is_within_limit else '  MISSED'}")
