"""A campaign of cases that misbehave in every way, killed and resumed, against an undisturbed one of healthy cases."""

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

from benchmarks.validation.hostile import DEEDS, HostileParameters, deed
from benchmarks.validation.records import Check, Measure
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.running.replay import differing_columns
from marsyard.campaigns.store.table import read_rows

FILE = """
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

#: Variable in the environment of the runner, by which the processes that it starts are found.
_MARK = "MARSYARD_SOAK"

#: Seconds that the whole may take for each case; it takes a tenth of that where nothing waits for ever.
_GUARD_S = 20.0

#: Seconds for processes to go once their runner was killed.
_GOING_S = 10.0


@dataclass(frozen=True)
class Soak:
    """What came of a soak.

    Attributes
    ----------
    kills
        How often the runner was killed before it had ended.
    ended
        Whether the last runner ended by itself.
    seconds
        That the whole took.
    deeds
        What each case did; empty where it was healthy.
    wrong_outcomes, changed
        Cases with another outcome than their deed's; cases that answered with another row than the undisturbed ones.
    processes, files
        Processes alive, and temporary files there, once the last runner had ended.
    """

    kills: int
    ended: bool
    seconds: float
    deeds: tuple[str, ...]
    wrong_outcomes: tuple[str, ...]
    changed: tuple[int, ...]
    processes: int
    files: int


def soak(folder: Path, cases: int, kills: int, misbehaving: float, killed_after_s: tuple[float, float]) -> Soak:
    """Runs the campaign in a folder.

    Parameters
    ----------
    folder
        An empty one.
    cases, misbehaving
        How many cases, and the fraction of them that misbehave.
    kills, killed_after_s
        How often the runner is killed, and after how long: drawn evenly between two times.
    """
    temporary = folder / "tmp"
    temporary.mkdir()
    environment = {**os.environ, _MARK: str(folder), "TMPDIR": str(temporary)}
    (folder / "soak.toml").write_text(f"cases = {cases}\n{FILE}")
    healthy = _run(folder, "healthy", 0.0, environment, cases)
    began = time.monotonic()
    killed = _killed(folder, misbehaving, kills, killed_after_s, environment)
    ended = _run(folder, "soaked", None, environment, cases) == 0 or (folder / "soaked" / "cases.parquet").exists()
    seconds = time.monotonic() - began
    deadline = time.monotonic() + _GOING_S
    while _processes(folder) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert healthy == 0, "the undisturbed campaign failed"
    rows = {name: read_rows(folder / name / "cases.parquet") for name in ("healthy", "soaked")}
    campaign = load_campaign(str(folder / "soak.toml"), [f"misbehaving={misbehaving}"])
    deeds = tuple(_deed(campaign, case) for case in range(cases))
    pairs = list(zip(deeds, rows["soaked"], rows["healthy"], strict=True))
    return Soak(
        kills=killed,
        ended=ended,
        seconds=seconds,
        deeds=deeds,
        wrong_outcomes=tuple(
            f"case {row['case']} ({done or 'healthy'}): {row['outcome']}: {row['error'][:200]}"
            for done, row, _ in pairs
            if row["outcome"] != (DEEDS[done][1] if done else "VALID")
        ),
        changed=tuple(
            int(row["case"])
            for _, row, undisturbed in pairs
            if row["outcome"] == "VALID" and differing_columns(row, undisturbed)
        ),
        processes=len(_processes(folder)),
        files=len(list(temporary.iterdir())),
    )


def _command(folder: Path, name: str, misbehaving: float | None) -> list[str]:
    program = [sys.executable, "-m", "marsyard"]
    if misbehaving is None:
        return [*program, "resume", str(folder / name), "--jobs", "2"]
    settings = ["--set", f"misbehaving={misbehaving}", "--jobs", "2", "--out", str(folder / name)]
    return [*program, "run", str(folder / "soak.toml"), *settings]


def _run(folder: Path, name: str, misbehaving: float | None, environment: Mapping[str, str], cases: int) -> int:
    """Exit status of a runner that is left alone; it ends with 1 where cases did not come to their end."""
    silent = subprocess.DEVNULL
    command = _command(folder, name, misbehaving)
    return subprocess.run(
        command, env=environment, stdout=silent, stderr=silent, timeout=60.0 + cases * _GUARD_S, check=False
    ).returncode


def _killed(
    folder: Path, misbehaving: float, kills: int, after_s: tuple[float, float], environment: Mapping[str, str]
) -> int:
    """Runs and resumes the campaign, killing each runner; returns how many had not ended by themselves."""
    rng = np.random.default_rng(21)
    killed = 0
    for number in range(kills):
        command = _command(folder, "soaked", None if number else misbehaving)
        silent = subprocess.DEVNULL
        with subprocess.Popen(command, env=environment, stdout=silent, stderr=silent) as runner:
            while not (folder / "soaked" / "cases.sqlite").exists() and runner.poll() is None:
                time.sleep(0.02)
            time.sleep(rng.uniform(*after_s))
            killed += runner.poll() is None
            runner.kill()
    return killed


def _processes(folder: Path) -> list[int]:
    """Processes that live and were started by a runner of the soak, or by one of those."""
    mark = f"{_MARK}={folder}".encode()
    found = []
    for process in Path("/proc").glob("[1-9]*"):
        with suppress(OSError):
            if mark in (process / "environ").read_bytes():
                found.append(int(process.name))
    return found


def _deed(campaign: Any, case: int) -> str:
    parameters = campaign.parameters(case)
    assert isinstance(parameters, HostileParameters)
    return deed(parameters, campaign.streams(case))


def isolation(quick: bool) -> Iterator[Measure]:
    """Cases that misbehave in every way among healthy ones; the runner killed three times, and resumed."""
    cases, kills, share = (60, 1, 0.4) if quick else (300, 3, 0.4)
    with TemporaryDirectory() as name:
        found = soak(Path(name), cases, kills, share, (5.0, 40.0))
    healthy = found.deeds.count("")
    kinds = len(set(found.deeds)) - 1
    how = f"{cases} cases, {cases - healthy} of which misbehave in {kinds} ways; killed {found.kills} times"
    yield Measure("soak: campaigns that did not end by themselves", float(not found.ended), "", 0, how)
    yield Measure("soak: outcomes that are not those of the deed", len(found.wrong_outcomes), "", 0, how)
    yield Measure("soak: rows of cases that answered, changed by others", len(found.changed), "", 0, how)
    yield Measure("soak: processes left", found.processes, "", 0, how)
    yield Measure("soak: temporary files left", found.files, "", 0, how)
    yield Measure("soak: time of the campaign", found.seconds, "s", None, how)
    for text in found.wrong_outcomes:
        print(text)


CHECKS = (Check("soak", "Campaigns", isolation),)
