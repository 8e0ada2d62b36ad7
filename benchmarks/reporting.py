"""Time, memory and size of reports of large and small campaigns, and of a dashboard of a thousand campaigns."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from playwright.sync_api import Page, expect, sync_playwright

from benchmarks.timing import Measurement
from marsyard.campaigns.definition.requirements import shipped_requirements
from marsyard.campaigns.store.record import SCHEMA

#: Additional columns of numbers; a row of `dimes-gusev` has 99 columns.
FURTHER = 82
#: Cases that are generated together.
_BLOCK = 50_000


@dataclass(frozen=True)
class Cost:
    """Cost of a command: core-seconds, wall-clock seconds, and maximum resident memory."""

    core_s: float
    wall_s: float
    memory_gb: float


def measure(cases: int = 1_000_000, campaigns: int = 1_000) -> list[Measurement]:
    """Figures of reports and dashboard in core-seconds, which do not depend on other programs."""
    with TemporaryDirectory() as folder:
        large, small = (synthetic_campaign(Path(folder, f"of-{count}"), count) for count in (cases, 24))
        of_large, of_small = (marsyard("report", str(run)) for run in (large, small))
        page = large / "report.html"
        site = _many(Path(folder, "many"), small, campaigns)
        fresh = marsyard("dashboard", str(site.parent / "runs"), "--out", str(site))
        again = marsyard("dashboard", str(site.parent / "runs"), "--out", str(site))
        index = site / "index.html"
        shown, filtered = time_page(page, hover_a_case), time_page(index, filter_campaigns)
        return [
            Measurement(f"report of {cases:,} cases", [of_large.core_s], limit=30.0),
            Measurement(f"report of {cases:,} cases: memory (GB)", [of_large.memory_gb], limit=2.0),
            Measurement(f"report of {cases:,} cases: page (MB)", [page.stat().st_size / 1e6], limit=10.0),
            Measurement("the same, from opening until a tooltip appears (wall s)", shown, limit=3.0),
            Measurement("report of 24 cases", [of_small.core_s], limit=8.0),
            Measurement(f"dashboard of {campaigns:,} campaigns", [fresh.core_s]),
            Measurement("the same, written again without changes", [again.core_s]),
            Measurement("the same: index (MB)", [index.stat().st_size / 1e6], limit=10.0),
            Measurement("the same, from opening until filtered (wall s)", filtered, limit=3.0),
        ]


def synthetic_campaign(directory: Path, cases: int, seed: int = 1, site: str = "gusev") -> Path:
    """Write a stored campaign of synthetic descents with as many columns as real ones."""
    rng = np.random.default_rng(seed)
    directory.mkdir(parents=True)
    writer: pq.ParquetWriter | None = None
    for start in range(0, cases, _BLOCK):
        block = _rows(rng, start, min(_BLOCK, cases - start))
        writer = writer or pq.ParquetWriter(directory / "cases.parquet", block.schema)
        writer.write_table(block)
    if writer is not None:
        writer.close()
    (directory / "campaign.json").write_text(json.dumps(_record(cases, seed, site)), encoding="utf-8")
    return directory


def _rows(rng: np.random.Generator, start: int, count: int) -> pa.Table:
    valid = rng.random(count) < 0.95
    off_nadir_deg = rng.uniform(0.0, 30.0, count)
    error = rng.normal(0.0, 0.5 + off_nadir_deg[:, None] / 30.0, (count, 2))
    error[~valid] = np.nan
    causes = rng.choice(["NO_TEMPLATE_AREA", "NO_VALID_TRACK", "IMU_MISMATCH"], count)
    columns: dict[str, Any] = {
        "case": np.arange(start, start + count),
        "outcome": np.where(valid, "VALID", causes),
        "answered": valid,
        "feasible_overlap": np.ones(count, dtype=np.bool_),
        "velocity_error_m_s": np.hypot(*error.T),
        "velocity_error_x_m_s": error[:, 0],
        "velocity_error_y_m_s": error[:, 1],
        "terrain": rng.integers(0, 1000, count),
        "sun_elevation_deg": rng.uniform(20.0, 60.0, count),
        "horizontal_speed_m_s": rng.uniform(0.0, 30.0, count),
        "off_nadir_max_deg": off_nadir_deg,
        **{f"dispersion_{number}": rng.normal(size=count) for number in range(FURTHER)},
        "image_hash": [f"{case:064x}" for case in range(start, start + count)],
        "wall_time_s": rng.uniform(1.0, 2.0, count),
        "cpu_time_s": rng.uniform(1.0, 2.0, count),
        "error": np.full(count, ""),
        "traceback": np.full(count, ""),
    }
    return pa.table(columns)


def _record(cases: int, seed: int, site: str) -> dict[str, Any]:
    asked = [shipped_requirements()[name].model_dump(mode="json") for name in ("DIMES-VEL", "DIMES-HARM")]
    configuration = {"name": f"dimes-{site}", "scenario": "descent", "cases": cases, "seed": seed}
    return {
        "schema": SCHEMA,
        "name": f"dimes-{site}",
        "state": "finished",
        "started_utc": f"2026-{1 + seed // 28 % 12:02}-{1 + seed % 28:02}T00:00:00Z",
        "finished_utc": "2026-12-31T00:00:00Z",
        "cases": cases,
        "seed": seed,
        "requirements": asked,
        "configuration": {**configuration, "parameters": {"site": site}, "requirements": asked},
        "git_commit": f"{seed % 7:040x}",
    }


def _many(folder: Path, pattern: Path, campaigns: int) -> Path:
    """Copy a reported campaign several times with separate records. Returns the site folder."""
    for number in range(campaigns):
        run = folder / "runs" / f"run-{number:04}"
        shutil.copytree(pattern, run, copy_function=os.link)
        site = ("gusev", "meridiani", "isidis")[number % 3]
        for name, changed in (("campaign.json", _record(24, number, site)), ("report.json", _twin(pattern, site))):
            (run / name).unlink()
            (run / name).write_text(json.dumps(changed), encoding="utf-8")
    return folder / "site"


def _twin(pattern: Path, site: str) -> dict[str, Any]:
    twin: dict[str, Any] = json.loads((pattern / "report.json").read_text(encoding="utf-8"))
    return {**twin, "campaign": f"dimes-{site}"}


def marsyard(*arguments: str) -> Cost:
    """Cost of a `marsyard` command in a separate process.

    A small process starts the command, because at `exec` Linux counts the memory of the parent for the child.
    """
    began = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", _MEASURING, *arguments], stdout=subprocess.PIPE, text=True, check=True, timeout=3600
    )
    status, core_s, memory_gb = json.loads(done.stdout)
    if status not in (0, 1, 3):
        raise RuntimeError(f"marsyard {' '.join(arguments)} ended with {status}")
    return Cost(core_s, time.perf_counter() - began, memory_gb)


_MEASURING = """
import json, os, sys
quietly = [(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)]
words = [sys.executable, "-m", "marsyard", *sys.argv[1:]]
_, status, used = os.wait4(os.posix_spawn(sys.executable, words, os.environ, file_actions=quietly), 0)
print(json.dumps([os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / 1e9]))
"""


def time_page(path: Path, done: Callable[[Page], None], repeats: int = 5) -> list[float]:
    """Time from opening a page in Debian's Chromium to the end of an action."""
    browser = next((found for name in ("chromium", "chromium-browser") if (found := shutil.which(name))), None)
    times = []
    with sync_playwright() as playwright:
        # root in a container cannot start the sandbox; the pages are trusted
        launched = playwright.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        for _ in range(repeats):
            page = launched.new_page(viewport={"width": 1280, "height": 900})
            began = time.perf_counter()
            page.goto(path.resolve().as_uri(), wait_until="commit")
            done(page)
            times.append(time.perf_counter() - began)
            page.close()
        launched.close()
    return times


def hover_a_case(page: Page) -> None:
    """Point at a case in the plot and wait for its tooltip."""
    page.locator(".explorer-plot circle.point").nth(5).hover(force=True)
    page.locator(".explorer-tip").wait_for(state="visible")


def filter_campaigns(page: Page) -> None:
    """Select a site and wait until the table contains only its campaigns."""
    page.locator("select[name=site]").select_option("isidis")
    expect(page.locator("#count")).to_have_text(re.compile(r"^\d{1,3} of \d+,?\d* campaigns"))


if __name__ == "__main__":
    for row in measure():
        print(f"{row.name:<62}{row.median:9.3f}  {row.limit_text:<8}{'' if row.is_within_limit else '  MISSED'}")
