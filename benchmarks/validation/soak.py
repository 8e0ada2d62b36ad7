"""Soak test of the campaign engine: a campaign with faulty cases is killed and resumed several times.

Its results are compared with the same campaign without faults. `benchmarks.validation.hostile` defines the faults.
"""

import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.validation.hostile import FAULTS, draw_fault
from benchmarks.validation.records import Check, Measure
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.running.replay import differing_columns
from marsyard.campaigns.store.table import read_rows

CAMPAIGN_TEXT = """
name = "soak"
scenario = "benchmarks.validation.hostile:HostileScenario"
seed = 21
[retain]
showcase = "none"
[limits]
case_time_s = 10
memory_gb = 0.3
output_mb = 0.2
[[requirements]]
id = "NUMBER"
statement = "The number is below 100."
metric = "number"
bound = 100.0
probability = 0.5
confidence = 0.9
population = "all"
"""

#: Environment variable that identifies the processes of a soak test; its value is the folder of the test.
_PROCESS_VARIABLE = "MARSYARD_SOAK"

#: Maximum mean time per case of an uninterrupted run, seconds; a case normally needs a tenth of it.
_MAX_CASE_S = 20.0

#: Maximum time until processes of a killed campaign have ended, seconds.
_MAX_SHUTDOWN_S = 10.0


@dataclass(frozen=True)
class SoakResult:
    """Result of a soak test.

    - kills: number of runs that were killed before their end
    - finished: whether the last run finished the campaign
    - seconds: duration of all runs
    - faults: fault of each case; empty for cases without fault
    - wrong_outcomes: descriptions of cases with an unexpected outcome
    - changed_cases: valid cases whose row differs from the undisturbed campaign
    - remaining_processes, remaining_files: numbers of processes and temporary files after the last run
    """

    kills: int
    finished: bool
    seconds: float
    faults: tuple[str, ...]
    wrong_outcomes: tuple[str, ...]
    changed_cases: tuple[int, ...]
    remaining_processes: int
    remaining_files: int


def run_soak_test(
    folder: Path, cases: int, kills: int, fault_fraction: float, kill_delay_s: tuple[float, float]
) -> SoakResult:
    """Run the soak test in an empty folder, with and without faults.

    - cases, fault_fraction: number of cases, and fraction of cases with a fault
    - kills, kill_delay_s: number of kills, and minimum and maximum of the uniform time before each kill
    """
    temporary = folder / "tmp"
    temporary.mkdir()
    environment = {**os.environ, _PROCESS_VARIABLE: str(folder), "TMPDIR": str(temporary)}
    (folder / "soak.toml").write_text(f"cases = {cases}\n{CAMPAIGN_TEXT}")
    undisturbed_status = _run(folder, "healthy", 0.0, environment, cases)
    start_s = time.monotonic()
    successful_kills = _run_with_kills(folder, fault_fraction, kills, kill_delay_s, environment)
    # the exit status is not 0 if cases crashed
    finished = _run(folder, "soaked", None, environment, cases) == 0 or (folder / "soaked" / "cases.parquet").exists()
    seconds = time.monotonic() - start_s
    deadline = time.monotonic() + _MAX_SHUTDOWN_S
    while _find_processes(folder) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert undisturbed_status == 0, "the undisturbed campaign failed"
    rows = {name: read_rows(folder / name / "cases.parquet") for name in ("healthy", "soaked")}
    campaign = load_campaign(str(folder / "soak.toml"), [f"misbehaving={fault_fraction}"])
    faults = tuple(draw_fault(campaign.parameters(case), campaign.streams(case)) for case in range(cases))
    pairs = list(zip(faults, rows["soaked"], rows["healthy"], strict=True))
    # `FAULTS` contains a function and the expected outcome of each fault
    return SoakResult(
        kills=successful_kills,
        finished=finished,
        seconds=seconds,
        faults=faults,
        wrong_outcomes=tuple(
            f"case {row['case']} ({fault or 'healthy'}): {row['outcome']}: {row['error'][:200]}"
            for fault, row, _ in pairs
            if row["outcome"] != (FAULTS[fault][1] if fault else "VALID")
        ),
        changed_cases=tuple(
            int(row["case"])
            for _, row, undisturbed in pairs
            if row["outcome"] == "VALID" and differing_columns(row, undisturbed)
        ),
        remaining_processes=len(_find_processes(folder)),
        remaining_files=len(list(temporary.iterdir())),
    )


def _build_command(folder: Path, name: str, fault_fraction: float | None) -> list[str]:
    """Build the command that runs the campaign with a fraction of faulty cases, or resumes it (None)."""
    program = [sys.executable, "-m", "marsyard"]
    if fault_fraction is None:
        return [*program, "resume", str(folder / name), "--jobs", "2"]
    options = ["--set", f"misbehaving={fault_fraction}", "--jobs", "2", "--out", str(folder / name)]
    return [*program, "run", str(folder / "soak.toml"), *options]


def _run(folder: Path, name: str, fault_fraction: float | None, environment: Mapping[str, str], cases: int) -> int:
    """Run or resume a campaign without interruption; return the exit status."""
    no_output = subprocess.DEVNULL
    command = _build_command(folder, name, fault_fraction)
    return subprocess.run(
        command, env=environment, stdout=no_output, stderr=no_output, timeout=60.0 + cases * _MAX_CASE_S, check=False
    ).returncode


def _run_with_kills(
    folder: Path, fault_fraction: float, kills: int, kill_delay_s: tuple[float, float], environment: Mapping[str, str]
) -> int:
    """Start the campaign, then resume it; kill each run. Return the number of runs killed before their end."""
    rng = np.random.default_rng(21)
    successful_kills = 0
    for number in range(kills):
        command = _build_command(folder, "soaked", None if number else fault_fraction)
        no_output = subprocess.DEVNULL
        with subprocess.Popen(command, env=environment, stdout=no_output, stderr=no_output) as runner:
            while not (folder / "soaked" / "cases.sqlite").exists() and runner.poll() is None:
                time.sleep(0.02)
            time.sleep(rng.uniform(*kill_delay_s))
            successful_kills += runner.poll() is None
            runner.kill()
    return successful_kills


def _find_processes(folder: Path) -> list[int]:
    """List the ids of processes whose environment contains the variable of the soak test in this folder."""
    variable = f"{_PROCESS_VARIABLE}={folder}".encode()
    ids = []
    for process in Path("/proc").glob("[1-9]*"):
        with suppress(OSError):
            if variable in (process / "environ").read_bytes():
                ids.append(int(process.name))
    return ids


def check_isolation(quick: bool) -> Iterator[Measure]:
    """Run the soak test and compare it with the same campaign without faults."""
    cases, kills, fault_fraction = (60, 1, 0.4) if quick else (300, 3, 0.4)
    with TemporaryDirectory() as name:
        result = run_soak_test(Path(name), cases, kills, fault_fraction, (5.0, 40.0))
    healthy = result.faults.count("")
    fault_types = len(set(result.faults)) - 1
    how = f"{cases} cases, {cases - healthy} of which misbehave in {fault_types} ways; killed {result.kills} times"
    yield Measure("soak: campaigns that did not end by themselves", float(not result.finished), "1", 0, how)
    yield Measure("soak: outcomes that do not match the fault of the case", len(result.wrong_outcomes), "1", 0, how)
    yield Measure(
        "soak: rows of valid cases that differ from the campaign without faults", len(result.changed_cases), "1", 0, how
    )
    yield Measure("soak: remaining processes", result.remaining_processes, "1", 0, how)
    yield Measure("soak: remaining temporary files", result.remaining_files, "1", 0, how)
    yield Measure("soak: time of the campaign", result.seconds, "s", None, how)
    for text in result.wrong_outcomes:
        print(text)


CHECKS = (Check("soak", "Campaigns", check_isolation),)
