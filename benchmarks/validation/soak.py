"""Soak test: a campaign with faulty cases, killed and resumed, compared with the same campaign without faults."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.validation.hostile import FAULTS, HostileParameters, draw_fault
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

#: Environment variable that identifies the processes of the campaign.
_MARK = "MARSYARD_SOAK"

#: Maximum time per case, seconds; a case normally needs a tenth of it.
_MAX_CASE_S = 20.0

#: Maximum time until processes of a killed campaign have ended, seconds.
_MAX_SHUTDOWN_S = 10.0


@dataclass(frozen=True)
class SoakResult:
    """Result of a soak test.

    Attributes
    ----------
    kills
        Number of kills before the end of a run.
    ended
        Whether the last run ended by itself.
    seconds
        Duration of all runs.
    faults
        Fault of each case; empty for cases without fault.
    wrong_outcomes, changed
        Cases with an unexpected outcome; valid cases whose row differs from the undisturbed campaign.
    processes, files
        Remaining processes and temporary files after the last run.
    """

    kills: int
    ended: bool
    seconds: float
    faults: tuple[str, ...]
    wrong_outcomes: tuple[str, ...]
    changed: tuple[int, ...]
    processes: int
    files: int


def run_soak_test(
    folder: Path, cases: int, kills: int, misbehaving: float, killed_after_s: tuple[float, float]
) -> SoakResult:
    """Run the soak test in a folder, with and without faults.

    Parameters
    ----------
    folder
        Empty folder.
    cases, misbehaving
        Number of cases, and fraction of misbehaving cases.
    kills, killed_after_s
        Number of kills, and minimum and maximum of the uniform time before each kill.
    """
    temporary = folder / "tmp"
    temporary.mkdir()
    environment = {**os.environ, _MARK: str(folder), "TMPDIR": str(temporary)}
    (folder / "soak.toml").write_text(f"cases = {cases}\n{CAMPAIGN_TEXT}")
    healthy = _run(folder, "healthy", 0.0, environment, cases)
    start_s = time.monotonic()
    killed = _run_with_kills(folder, misbehaving, kills, killed_after_s, environment)
    ended = _run(folder, "soaked", None, environment, cases) == 0 or (folder / "soaked" / "cases.parquet").exists()
    seconds = time.monotonic() - start_s
    deadline = time.monotonic() + _MAX_SHUTDOWN_S
    while _find_processes(folder) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert healthy == 0, "the undisturbed campaign failed"
    rows = {name: read_rows(folder / name / "cases.parquet") for name in ("healthy", "soaked")}
    campaign = load_campaign(str(folder / "soak.toml"), [f"misbehaving={misbehaving}"])
    faults = tuple(_draw_fault(campaign, case) for case in range(cases))
    pairs = list(zip(faults, rows["soaked"], rows["healthy"], strict=True))
    return SoakResult(
        kills=killed,
        ended=ended,
        seconds=seconds,
        faults=faults,
        wrong_outcomes=tuple(
            f"case {row['case']} ({fault or 'healthy'}): {row['outcome']}: {row['error'][:200]}"
            for fault, row, _ in pairs
            if row["outcome"] != (FAULTS[fault][1] if fault else "VALID")
        ),
        changed=tuple(
            int(row["case"])
            for _, row, undisturbed in pairs
            if row["outcome"] == "VALID" and differing_columns(row, undisturbed)
        ),
        processes=len(_find_processes(folder)),
        files=len(list(temporary.iterdir())),
    )


def _build_command(folder: Path, name: str, misbehaving: float | None) -> list[str]:
    """Build the command that runs the campaign with a fraction of misbehaving cases, or resumes it (None)."""
    program = [sys.executable, "-m", "marsyard"]
    if misbehaving is None:
        return [*program, "resume", str(folder / name), "--jobs", "2"]
    settings = ["--set", f"misbehaving={misbehaving}", "--jobs", "2", "--out", str(folder / name)]
    return [*program, "run", str(folder / "soak.toml"), *settings]


def _run(folder: Path, name: str, misbehaving: float | None, environment: Mapping[str, str], cases: int) -> int:
    """Run or resume a campaign without interruption; return the exit status."""
    no_output = subprocess.DEVNULL
    command = _build_command(folder, name, misbehaving)
    return subprocess.run(
        command, env=environment, stdout=no_output, stderr=no_output, timeout=60.0 + cases * _MAX_CASE_S, check=False
    ).returncode


def _run_with_kills(
    folder: Path, misbehaving: float, kills: int, after_s: tuple[float, float], environment: Mapping[str, str]
) -> int:
    """Run and resume the campaign, killing each run; return the number of runs killed before their end."""
    rng = np.random.default_rng(21)
    killed = 0
    for number in range(kills):
        command = _build_command(folder, "soaked", None if number else misbehaving)
        no_output = subprocess.DEVNULL
        with subprocess.Popen(command, env=environment, stdout=no_output, stderr=no_output) as runner:
            while not (folder / "soaked" / "cases.sqlite").exists() and runner.poll() is None:
                time.sleep(0.02)
            time.sleep(rng.uniform(*after_s))
            killed += runner.poll() is None
            runner.kill()
    return killed


def _find_processes(folder: Path) -> list[int]:
    """Ids of living processes whose environment contains the mark of the soak test."""
    mark = f"{_MARK}={folder}".encode()
    ids = []
    for process in Path("/proc").glob("[1-9]*"):
        with suppress(OSError):
            if mark in (process / "environ").read_bytes():
                ids.append(int(process.name))
    return ids


def _draw_fault(campaign: Any, case: int) -> str:
    parameters = campaign.parameters(case)
    assert isinstance(parameters, HostileParameters)
    return draw_fault(parameters, campaign.streams(case))


def check_isolation(quick: bool) -> Iterator[Measure]:
    """Run the soak test and compare it with the same campaign without faults."""
    cases, kills, misbehaving = (60, 1, 0.4) if quick else (300, 3, 0.4)
    with TemporaryDirectory() as name:
        result = run_soak_test(Path(name), cases, kills, misbehaving, (5.0, 40.0))
    healthy = result.faults.count("")
    kinds = len(set(result.faults)) - 1
    how = f"{cases} cases, {cases - healthy} of which misbehave in {kinds} ways; killed {result.kills} times"
    yield Measure("soak: campaigns that did not end by themselves", float(not result.ended), "", 0, how)
    yield Measure("soak: outcomes that do not match the fault of the case", len(result.wrong_outcomes), "", 0, how)
    yield Measure(
        "soak: rows of valid cases that differ from the campaign without faults", len(result.changed), "", 0, how
    )
    yield Measure("soak: remaining processes", result.processes, "", 0, how)
    yield Measure("soak: remaining temporary files", result.files, "", 0, how)
    yield Measure("soak: time of the campaign", result.seconds, "s", None, how)
    for text in result.wrong_outcomes:
        print(text)


CHECKS = (Check("soak", "Campaigns", check_isolation),)
