"""Checks of campaigns: rows do not depend on the executor or on interruptions, and misbehaving cases are isolated."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.validation.chaos import DEEDS, ChaosParameters, draw_fault
from benchmarks.validation.records import Check, Measure
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.execution.workers import ExecutorConfig
from marsyard.campaigns.running.engine import run_campaign
from marsyard.campaigns.running.replay import differing_columns, replay
from marsyard.campaigns.store.table import read_rows

FILE = """
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

#: Minimum and maximum of the uniform time between kills, seconds.
KILLED_AFTER_S = (0.2, 6.0)


class Silence:
    """A progress watch without output."""

    def begin(self, stage: str, total: int) -> None:
        pass

    def step(self) -> None:
        pass

    def note(self, text: str) -> None:
        pass


def same_rows(quick: bool) -> Iterator[Measure]:
    """Compare rows of all ways to run a campaign with rows of one worker, for misbehaving and rendered cases."""
    share, cases, kills = (0.03, 60, 3) if quick else (0.03, 400, 10)
    with TemporaryDirectory() as name:
        folder = Path(name)
        settings = [f"share={share}", f"cases={cases}"]
        what = f"cases, {100 * share:g} % of which misbehave"
        yield from _in_every_way(str(_write_campaign(folder)), folder / "chaos", settings, kills, what)
        rendered = ["cases=8" if quick else "cases=40", "retain.showcase=none"]
        yield from _in_every_way("dimes-smoke", folder / "rendered", rendered, kills, "rendered descents")


def _in_every_way(campaign: str, folder: Path, settings: Sequence[str], kills: int, what: str) -> Iterator[Measure]:
    folder.mkdir()
    expected = _rows_of(campaign, folder / "one", ExecutorConfig(1), settings)
    cases = len(expected)
    replayed = range(0, cases, max(cases // 8, 1))
    cluster = ExecutorConfig(cluster="local:2")
    ways: dict[str, Callable[[], list[dict[str, Any]]]] = {
        "two workers": lambda: _rows_of(campaign, folder / "two", ExecutorConfig(2), settings),
        "a Dask cluster of two": lambda: _rows_of(campaign, folder / "cluster", cluster, settings),
        f"a runner killed {kills} times": lambda: _run_with_kills(campaign, folder / "killed", settings, kills),
        "single replays": lambda: [dict(replay(folder / "one", case).row) for case in replayed],
    }
    for way, run in ways.items():
        rows = run()
        differing = sum(bool(differing_columns(row, expected[int(row["case"])])) for row in rows)
        missing = (len(replayed) if way == "single replays" else cases) - len(rows)
        how = f"{len(rows)} of {cases} {what}; all columns but times"
        yield Measure(f"{what}: rows of {way} that differ from one worker's, or lack", differing + missing, "", 0, how)


def survival(quick: bool) -> Iterator[Measure]:
    """Compare a campaign with randomly misbehaving cases with an undisturbed one."""
    cases, share = (60, 0.15) if quick else (400, 0.03)
    with TemporaryDirectory() as name:
        folder = Path(name)
        file = _write_campaign(folder)
        took, rows = {}, {}
        for part in (0.0, share):
            began = time.monotonic()
            rows[part] = _rows_of(
                file, folder / f"{part}", ExecutorConfig(2), [f"share={part}", f"cases={cases}", "work_s=0.4"]
            )
            took[part] = time.monotonic() - began
        campaign = load_campaign(str(file), [f"share={share}"])
        deeds = [_draw_fault(campaign, case) for case in range(cases)]
        wrong = sum(row["outcome"] != DEEDS.get(done, "VALID") for row, done in zip(rows[share], deeds, strict=True))
        healthy = [k for k, done in enumerate(deeds) if not done]
        changed = sum(bool(differing_columns(rows[share][k], rows[0.0][k])) for k in healthy)
        loops = deeds.count("loop")
        counts = ", ".join(f"{deeds.count(done)} {done}" for done in DEEDS)
        how = f"{cases} cases of 0.4 s on two workers; {counts}"
        yield Measure("outcomes that are not those of the deed", wrong, "", 0, how)
        yield Measure("healthy cases whose rows changed", changed, "", 0, f"{how}; {len(healthy)} healthy")
        limits_s = loops * campaign.configuration.limits.case_time_s
        ratio = (took[share] - limits_s) / took[0.0]
        yield Measure(
            "time beyond the limits, over the undisturbed", ratio, "", 1.5, f"{how}; {limits_s:g} s of limits"
        )


def _draw_fault(campaign: Any, case: int) -> str:
    parameters = campaign.parameters(case)
    assert isinstance(parameters, ChaosParameters)
    return draw_fault(parameters, campaign.streams(case))


def _write_campaign(folder: Path) -> Path:
    path = folder / "chaos.toml"
    path.write_text(FILE)
    return path


def _rows_of(
    campaign: str | Path, directory: Path, executor: ExecutorConfig, settings: Sequence[str]
) -> list[dict[str, Any]]:
    run_campaign(load_campaign(str(campaign), settings), directory, executor, Silence())
    return read_rows(directory / "cases.parquet")


def _run_with_kills(campaign: str, directory: Path, settings: Sequence[str], kills: int) -> list[dict[str, Any]]:
    """Rows of a campaign that is killed at random times and resumed each time."""
    rng = np.random.default_rng(7)
    program = [sys.executable, "-m", "marsyard"]
    command = [*program, "run", campaign, "--out", str(directory), "--jobs", "2"]
    command += [part for setting in settings for part in ("--set", setting)]
    for _ in range(kills):
        runner = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while not (directory / "campaign.json").exists() and runner.poll() is None:
            time.sleep(0.01)
        time.sleep(rng.uniform(*KILLED_AFTER_S))
        runner.kill()
        runner.wait()
        command = [*program, "resume", str(directory), "--jobs", "2", "--allow-changed"]
    # exit status 1 because some cases crash
    subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False)
    return read_rows(directory / "cases.parquet")


CHECKS = (Check("rows", "Campaigns", same_rows), Check("survival", "Campaigns", survival))
