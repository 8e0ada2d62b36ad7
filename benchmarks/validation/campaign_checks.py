"""Checks of campaigns: rows do not depend on the executor or on interruptions, and misbehaving cases are isolated."""

import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.validation.chaos import FAULTS, draw_fault
from benchmarks.validation.records import Check, Measure
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.running.engine import run_campaign
from marsyard.campaigns.running.replay import differing_columns, replay
from marsyard.campaigns.store.table import read_rows

#: Campaign file of the scenario with random faults (`chaos`).
CAMPAIGN_TEXT = """
name = "chaos"
scenario = "benchmarks.validation.chaos:ChaosScenario"
cases = 100
seed = 9
[retain]
showcase = "none"
[limits]
case_time_s = 6
memory_gb = 0.4
"""

#: Minimum and maximum of the uniform time before each kill, seconds.
KILL_TIMES_S = (0.2, 6.0)


class SilentProgress:
    """Progress display without output."""

    def begin(self, stage: str, total: int) -> None:
        pass

    def step(self) -> None:
        pass

    def note(self, text: str) -> None:
        pass


def check_rows(quick: bool) -> Iterator[Measure]:
    """Compare the rows of all ways to run a campaign with those of one worker, for faulty and for rendered cases."""
    faulty_fraction, cases, kills = (0.03, 60, 3) if quick else (0.03, 400, 10)
    with TemporaryDirectory() as directory:
        folder = Path(directory)
        overrides = [f"faulty_fraction={faulty_fraction}", f"cases={cases}"]
        population = f"cases, {100 * faulty_fraction:g} % of which misbehave"
        yield from _compare_executors(str(_write_campaign(folder)), folder / "chaos", overrides, kills, population)
        overrides = ["cases=8" if quick else "cases=40", "retain.showcase=none"]
        yield from _compare_executors("dimes-smoke", folder / "rendered", overrides, kills, "rendered descents")


def _compare_executors(
    campaign: str, folder: Path, overrides: Sequence[str], kills: int, population: str
) -> Iterator[Measure]:
    """Compare the rows of each executor, of interrupted runs and of replays with those of one worker.

    `overrides` change the campaign file; `population` describes the cases in the table of results.
    """
    folder.mkdir()
    expected_rows = _run_campaign(campaign, folder / "one", ExecutorConfig(1), overrides)
    cases = len(expected_rows)
    replay_cases = range(0, cases, max(cases // 8, 1))
    cluster = ExecutorConfig(cluster="local:2")
    runs: dict[str, Callable[[], list[dict[str, Any]]]] = {
        "two workers": lambda: _run_campaign(campaign, folder / "two", ExecutorConfig(2), overrides),
        "a Dask cluster of two": lambda: _run_campaign(campaign, folder / "cluster", cluster, overrides),
        f"a runner killed {kills} times": lambda: _run_with_kills(campaign, folder / "killed", overrides, kills),
        "single replays": lambda: [dict(replay(folder / "one", case).row) for case in replay_cases],
    }
    for name, run in runs.items():
        rows = run()
        differing_count = sum(bool(differing_columns(row, expected_rows[int(row["case"])])) for row in rows)
        missing_count = (len(replay_cases) if name == "single replays" else cases) - len(rows)
        how = f"{len(rows)} of {cases} {population}; all columns except times"
        claim = f"{population}: rows of {name} that are missing or differ from those of one worker"
        yield Measure(claim, differing_count + missing_count, "", 0, how)


def check_survival(quick: bool) -> Iterator[Measure]:
    """Compare a campaign with random faults with the same campaign without faults."""
    cases, faulty_fraction = (60, 0.15) if quick else (400, 0.03)
    with TemporaryDirectory() as directory:
        folder = Path(directory)
        file = _write_campaign(folder)
        elapsed_s, rows = {}, {}
        for fraction in (0.0, faulty_fraction):
            start_s = time.monotonic()
            rows[fraction] = _run_campaign(
                file,
                folder / f"{fraction}",
                ExecutorConfig(2),
                [f"faulty_fraction={fraction}", f"cases={cases}", "work_s=0.4"],
            )
            elapsed_s[fraction] = time.monotonic() - start_s
        campaign = load_campaign(str(file), [f"faulty_fraction={faulty_fraction}"])
        faults = [draw_fault(campaign.parameters(case), campaign.streams(case)) for case in range(cases)]
        faulty_rows, reference_rows = rows[faulty_fraction], rows[0.0]
        wrong_count = sum(
            row["outcome"] != FAULTS.get(fault, "VALID") for row, fault in zip(faulty_rows, faults, strict=True)
        )
        healthy_cases = [case for case, fault in enumerate(faults) if not fault]
        changed_count = sum(bool(differing_columns(faulty_rows[case], reference_rows[case])) for case in healthy_cases)
        counts = ", ".join(f"{faults.count(fault)} {fault}" for fault in FAULTS)
        how = f"{cases} cases of 0.4 s on two workers; {counts}"
        yield Measure("outcomes that do not match the fault of the case", wrong_count, "", 0, how)
        healthy_how = f"{how}; {len(healthy_cases)} without fault"
        yield Measure("cases without fault whose rows changed", changed_count, "", 0, healthy_how)
        limits_s = faults.count("loop") * campaign.definition.limits.case_time_s
        ratio = (elapsed_s[faulty_fraction] - limits_s) / elapsed_s[0.0]
        yield Measure(
            "time minus time limits, divided by the time without faults",
            ratio,
            "",
            1.5,
            f"{how}; limits: {limits_s:g} s",
        )


def _write_campaign(folder: Path) -> Path:
    """Write `CAMPAIGN_TEXT` to a file."""
    path = folder / "chaos.toml"
    path.write_text(CAMPAIGN_TEXT)
    return path


def _run_campaign(
    campaign: str | Path, directory: Path, executor: ExecutorConfig, overrides: Sequence[str]
) -> list[dict[str, Any]]:
    """Run a campaign with changed overrides; return its rows."""
    run_campaign(load_campaign(str(campaign), overrides), directory, executor, SilentProgress())
    return read_rows(directory / "cases.parquet")


def _run_with_kills(campaign: str, directory: Path, overrides: Sequence[str], kills: int) -> list[dict[str, Any]]:
    """Run a campaign that is killed at random times and resumed each time; return its rows."""
    rng = np.random.default_rng(7)
    program = [sys.executable, "-m", "marsyard"]
    command = [*program, "run", campaign, "--out", str(directory), "--jobs", "2"]
    command += [argument for override in overrides for argument in ("--set", override)]
    for _ in range(kills):
        runner = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while not (directory / "campaign.json").exists() and runner.poll() is None:
            time.sleep(0.01)
        time.sleep(rng.uniform(*KILL_TIMES_S))
        runner.kill()
        runner.wait()
        command = [*program, "resume", str(directory), "--jobs", "2", "--allow-changed"]
    # the exit status is 1, because some cases crash
    subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False)
    return read_rows(directory / "cases.parquet")


CHECKS = (Check("rows", "Campaigns", check_rows), Check("survival", "Campaigns", check_survival))
