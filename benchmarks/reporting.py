"""Time, memory and size of reports of large and small campaigns, and of a dashboard of a thousand campaigns."""

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
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from playwright.sync_api import Page, expect, sync_playwright

from benchmarks.timing import Measurement
from marsyard.campaigns.definition.campaign_file import CampaignDefinition, Requirement
from marsyard.campaigns.definition.identity import Identity
from marsyard.campaigns.definition.requirements import shipped_requirements
from marsyard.campaigns.store.record import update, write_first_record
from marsyard.reports.campaign_report import write_report
from marsyard.reports.signature import sign_report

#: Number of random columns that are added, so that a row has as many columns (99) as one of `dimes-gusev`.
ADDITIONAL_COLUMNS = 82
#: Number of cases that are generated at a time.
_BLOCK_CASES = 50_000


@dataclass(frozen=True)
class Cost:
    """Cost of a command: core-seconds, wall-clock seconds, and maximum resident memory."""

    core_s: float
    wall_s: float
    memory_gb: float


def measure(cases: int = 1_000_000, campaigns: int = 1_000) -> list[Measurement]:
    """Measure reports and dashboards, in core-seconds where possible, because these do not depend on other programs."""
    with TemporaryDirectory() as folder:
        large, medium, small = (synthetic_campaign(Path(folder, f"of-{count}"), count) for count in (cases, 1_000, 24))
        large_cost, medium_cost, small_cost = (run_marsyard("report", str(run)) for run in (large, medium, small))
        shared_cost = run_marsyard("report", str(synthetic_campaign(Path(folder, "shared"), cases, terrains=1_000)))
        page_with_images = write_report(_write_campaign_with_images(Path(folder, "loc-light"), 300))
        page = large / "report.html"
        site = _copy_campaigns(Path(folder, "many"), small, campaigns)
        first_cost = run_marsyard("dashboard", str(site.parent / "runs"), "--out", str(site))
        second_cost = run_marsyard("dashboard", str(site.parent / "runs"), "--out", str(site))
        index = site / "index.html"
        tooltip_s, filter_s = time_page(page, hover_over_case), time_page(index, filter_campaigns)
        return [
            Measurement(f"report of {cases:,} cases", [large_cost.core_s], limit=30.0),
            Measurement(f"report of {cases:,} cases: memory (GB)", [large_cost.memory_gb], limit=2.0),
            Measurement(
                f"report of {cases:,} cases: size of the HTML page (MB)", [page.stat().st_size / 1e6], limit=10.0
            ),
            Measurement(
                f"report of {cases:,} cases: time to open the page and show a tooltip (wall s)", tooltip_s, limit=3.0
            ),
            Measurement("report of 1,000 cases", [medium_cost.core_s], limit=6.0),
            Measurement(f"report of {cases:,} cases on 1,000 shared terrains", [shared_cost.core_s], limit=30.0),
            Measurement("report of 24 cases", [small_cost.core_s], limit=8.0),
            Measurement(
                "report of loc-light, 300 cases: size of the HTML page (MB)",
                [page_with_images.stat().st_size / 1e6],
                limit=5.0,
            ),
            Measurement(f"dashboard of {campaigns:,} campaigns", [first_cost.core_s], limit=20.0),
            Measurement(
                f"dashboard of {campaigns:,} campaigns: second call, no campaign changed", [second_cost.core_s]
            ),
            Measurement(
                f"dashboard of {campaigns:,} campaigns: size of the index page (MB)",
                [index.stat().st_size / 1e6],
                limit=10.0,
            ),
            Measurement(
                f"dashboard of {campaigns:,} campaigns: time to open and filter the index page (wall s)",
                filter_s,
                limit=3.0,
            ),
        ]


def synthetic_campaign(
    directory: Path, cases: int, seed: int = 1, site: str = "gusev", terrains: int | None = None
) -> Path:
    """Write a stored campaign of synthetic descents with as many columns as real ones; None: a terrain per case."""
    rng = np.random.default_rng(seed)
    directory.mkdir(parents=True)
    writer: pq.ParquetWriter | None = None
    for start in range(0, cases, _BLOCK_CASES):
        block = _draw_rows(rng, start, min(_BLOCK_CASES, cases - start), terrains)
        writer = writer or pq.ParquetWriter(directory / "cases.parquet", block.schema)
        writer.write_table(block)
    if writer is not None:
        writer.close()
    _write_record(directory, cases, seed, site)
    return directory


def _write_campaign_with_images(directory: Path, cases: int, rendered: int = 8) -> Path:
    """Run descents of `loc-light` and store the products of all; add rows with other numbers to a number of cases."""
    options = ["--set", "retain.products=all", "--jobs", "1", "--out", str(directory)]
    run_marsyard("run", "loc-light", "-n", str(rendered), *options)
    rows = pd.read_parquet(directory / "cases.parquet")
    many = pd.concat([rows] * -(-cases // rendered), ignore_index=True).head(cases)
    noise = np.random.default_rng(1).normal(1.0, 0.2, (cases, 1))
    numbers = many.select_dtypes("float64").columns
    many[numbers] *= noise
    many["case"] = np.arange(cases)
    many.to_parquet(directory / "cases.parquet")
    record = json.loads((directory / "campaign.json").read_text())
    record |= {"cases": cases, "cases_finished": cases}
    (directory / "campaign.json").write_text(json.dumps(record), encoding="utf-8")
    (directory / "cases.sqlite").unlink()
    return directory


def _draw_rows(rng: np.random.Generator, start: int, count: int, terrains: int | None) -> pa.Table:
    """Draw the rows of `count` cases from case number `start`; 95 % of them have an answer."""
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
        # each case has its own terrain, as in the included campaigns, or shares it with others
        "terrain": np.arange(start, start + count) if terrains is None else rng.integers(0, terrains, count),
        "sun_elevation_deg": rng.uniform(20.0, 60.0, count),
        "horizontal_speed_m_s": rng.uniform(0.0, 30.0, count),
        "off_nadir_max_deg": off_nadir_deg,
        **{f"dispersion_{number}": rng.normal(size=count) for number in range(ADDITIONAL_COLUMNS)},
        "image_hash": [f"{case:064x}" for case in range(start, start + count)],
        "wall_time_s": rng.uniform(1.0, 2.0, count),
        "cpu_time_s": rng.uniform(1.0, 2.0, count),
        "error": np.full(count, ""),
        "traceback": np.full(count, ""),
    }
    return pa.table(columns)


def _write_record(directory: Path, cases: int, seed: int, site: str) -> None:
    """Write `campaign.json` of a finished campaign; dates and commits differ between seeds."""
    names, shared = ("DIMES-VEL", "DIMES-HARM"), shipped_requirements()
    requirements = tuple(Requirement.model_validate(shared[name].to_table()) for name in names)
    definition = CampaignDefinition(
        name=f"dimes-{site}",
        scenario="descent",
        cases=cases,
        seed=seed,
        parameters={"site": site},
        requirements=requirements,
    )
    write_first_record(directory, definition, Identity("", "", {}, {}), "none", origin={})
    started = f"2026-{1 + seed // 28 % 12:02}-{1 + seed % 28:02}T00:00:00Z"
    finished = {"state": "finished", "cases_finished": cases, "finished_utc": "2026-12-31T00:00:00Z"}
    update(directory, {**finished, "started_utc": started, "git_commit": f"{seed % 7:040x}"})


def _copy_campaigns(folder: Path, original_run: Path, campaigns: int) -> Path:
    """Copy a campaign and its report several times, with different landing sites and dates.

    The copies are in the folder `runs`. Returns the folder for the dashboard's pages.
    """
    for number in range(campaigns):
        run = folder / "runs" / f"run-{number:04}"
        shutil.copytree(original_run, run, copy_function=os.link)
        site = ("gusev", "meridiani", "isidis")[number % 3]
        # new files, because those of the original run are hard links
        for name in ("campaign.json", "report.json"):
            (run / name).unlink()
        _write_record(run, 24, number, site)
        (run / "report.json").write_text(json.dumps(_rename_report(original_run, site)), encoding="utf-8")
        sign_report(run, run)
    return folder / "site"


def _rename_report(original_run: Path, site: str) -> dict[str, Any]:
    """Return the content of `report.json` with the campaign's name for this landing site."""
    report: dict[str, Any] = json.loads((original_run / "report.json").read_text(encoding="utf-8"))
    return {**report, "campaign": f"dimes-{site}"}


def run_marsyard(*arguments: str) -> Cost:
    """Run a `marsyard` command in a separate process and measure its cost.

    A small process starts the command, because Linux counts the memory of the parent for the child until `exec`.
    """
    start_s = time.perf_counter()
    result = subprocess.run(
        [sys.executable, "-c", _MEASURING_PROGRAM, *arguments],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        timeout=3600,
    )
    status, core_s, memory_gb = json.loads(result.stdout)
    # 0, 1 and 3 are verdicts; other values are errors
    if status not in (0, 1, 3):
        raise RuntimeError(f"marsyard {' '.join(arguments)} ended with {status}")
    return Cost(core_s, time.perf_counter() - start_s, memory_gb)


#: Program that runs a `marsyard` command and prints its exit status, core-seconds and maximum memory (GB).
_MEASURING_PROGRAM = """
import json, os, sys
discard_output = [(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)]
command = [sys.executable, "-m", "marsyard", *sys.argv[1:]]
_, status, usage = os.wait4(os.posix_spawn(sys.executable, command, os.environ, file_actions=discard_output), 0)
print(json.dumps([os.waitstatus_to_exitcode(status), usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024 / 1e9]))
"""


def time_page(path: Path, action: Callable[[Page], None], repeats: int = 5) -> list[float]:
    """Measure the time from opening a page in Debian's Chromium to the end of an action."""
    browser = next((program for name in ("chromium", "chromium-browser") if (program := shutil.which(name))), None)
    times = []
    with sync_playwright() as playwright:
        # root in a container cannot start the sandbox; the pages are trusted
        chromium = playwright.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        for _ in range(repeats):
            page = chromium.new_page(viewport={"width": 1280, "height": 900})
            start_s = time.perf_counter()
            page.goto(path.resolve().as_uri(), wait_until="commit")
            action(page)
            times.append(time.perf_counter() - start_s)
            page.close()
        chromium.close()
    return times


def hover_over_case(page: Page) -> None:
    """Point at a case in the plot and wait for its tooltip."""
    page.locator(".explorer-plot circle.point").nth(5).hover(force=True)
    page.locator(".explorer-tip").wait_for(state="visible")


def filter_campaigns(page: Page) -> None:
    """Select a site and wait until the table contains only its campaigns."""
    page.locator("select[name=site]").select_option("isidis")
    expect(page.locator("#count")).to_have_text(re.compile(r"^\d{1,3} of \d+,?\d* campaigns"))


if __name__ == "__main__":
    for row in measure():
        print(f"{row.name:<62}{row.median:9.3f}  {row.limit_text}")
