"""Runs a campaign into a folder: prepares what cases share, runs the cases, stores the rows, keeps the showcase."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from campaigns import record
from campaigns.configuration import CRASHED, POPULATIONS, CampaignConfiguration
from campaigns.errors import ConfigurationError, Problem, not_allowed
from campaigns.execution import Row, configuration_text, prepare_input, run_cases
from campaigns.replay import case_directory, replay_with, save_replay
from campaigns.sampling import Campaign
from campaigns.store import ROWS_FILE, TABLE_FILE, RowStore, write_table
from campaigns.workers import Workers

#: What a requirement without a bound, and a population, ask a column to be.
FLAG = "column of true and false"


class Watch(Protocol):
    """What is told of a running campaign."""

    def begin(self, stage: str, total: int) -> None:
        """A stage of so many steps begins."""
        ...

    def step(self) -> None:
        """A step of the stage has ended."""
        ...

    def note(self, text: str) -> None:
        """Something that the user should know, but that stops nothing."""
        ...


def run_campaign(campaign: Campaign, directory: Path, jobs: int, watch: Watch) -> None:
    """Runs a campaign into a folder that holds none.

    While it runs the rows are in `cases.sqlite`. When it ends `cases.parquet` holds them in the order of the cases,
    and the SQLite file is removed. When it is interrupted `cases.parquet` holds the rows that there are, and the SQLite
    file stays.

    Raises
    ------
    CampaignError
        Where the folder is taken or cannot be written, or a requirement asks for a column that cases do not have.
    KeyboardInterrupt
        Passed on after the rows are safe and the record says so.
    """
    record.begin(directory, campaign, jobs)
    configuration = campaign.configuration
    with Workers(jobs) as workers:
        with RowStore(directory / ROWS_FILE) as store:
            try:
                _run_into(store, campaign, directory, workers, watch)
            except BaseException:
                _conclude(store, configuration, directory, "interrupted")
                raise
            rows = _conclude(store, configuration, directory, "finished")
        (directory / ROWS_FILE).unlink()
        _keep_showcase(configuration, directory, workers, rows, watch)


def _run_into(store: RowStore, campaign: Campaign, directory: Path, workers: Workers, watch: Watch) -> None:
    """Runs the cases and stores their rows."""
    configuration = campaign.configuration
    _prepare(campaign, workers, watch)
    watch.begin("cases", configuration.cases)
    checked = False
    for completed in run_cases(workers, configuration_text(campaign), range(configuration.cases)):
        store.add(completed.row)
        if not checked and completed.row["outcome"] != CRASHED:
            check_metrics(configuration, completed.row, directory)
            checked = True
        watch.step()


def _conclude(store: RowStore, configuration: CampaignConfiguration, directory: Path, state: str) -> list[Row]:
    """Writes the table of the rows that are stored, and into the record how far the campaign came."""
    rows = list(store.rows())
    measures = [requirement.metric for requirement in configuration.requirements if requirement.bound is not None]
    write_table(directory / TABLE_FILE, rows, measures)
    crashed = sum(row["outcome"] == CRASHED for row in rows)
    counts = {"cases_finished": len(rows), "cases_crashed": crashed}
    record.update(directory, {"state": state, "finished_utc": record.utc_now(), **counts})
    return rows


def _prepare(campaign: Campaign, workers: Workers, watch: Watch) -> None:
    """Builds what cases share; where that fails the cases that need it will say so in their rows."""
    inputs = campaign.scenario.shared_inputs(campaign.base_parameters())
    if not inputs:
        return
    watch.begin("preparing", len(inputs))
    for done in workers.run(partial(prepare_input, configuration_text(campaign)), inputs):
        if done.error is not None:
            watch.note(f"shared input {done.item} could not be prepared: {type(done.error).__name__}: {done.error}")
        watch.step()


def check_metrics(configuration: CampaignConfiguration, row: Row, directory: Path) -> None:
    """Holds what requirements ask for against the columns of a finished case, before more cases are spent on them.

    Raises
    ------
    ConfigurationError
        Where a requirement asks for a column that is not there, or is of another kind: numbers for a metric with a
        bound, true and false for a metric without one and for a population.
    """
    flags = [name for name, value in row.items() if isinstance(value, bool)]
    numbers = [name for name, value in row.items() if isinstance(value, int | float) and name not in (*flags, "case")]
    numbers = [name for name in numbers if "time" not in name]
    problems = []
    for place, requirement in enumerate(configuration.requirements):
        key = f"requirements[{place}]"
        kind, allowed = ("column of numbers", numbers) if requirement.bound is not None else (FLAG, flags)
        if requirement.metric not in allowed:
            message = not_allowed(kind, requirement.metric, allowed)
            problems.append(Problem(configuration.name, f"{key}.metric", message))
        for name in requirement.population_columns:
            if name not in flags:
                message = not_allowed(FLAG, name, (*POPULATIONS, *flags))
                problems.append(Problem(configuration.name, f"{key}.population", message))
    if problems:
        stopped = Problem(str(directory), "", "the campaign was stopped; the rows so far are kept")
        raise ConfigurationError([*problems, stopped])


def showcase_case(configuration: CampaignConfiguration, rows: Sequence[Row]) -> int | None:
    """The case whose products are kept for the report; None where none is asked for or fit to be shown."""
    completed = [row for row in rows if row["outcome"] != CRASHED]
    if configuration.retain.showcase == "none" or not completed:
        return None
    metric = next((asked.metric for asked in configuration.requirements if asked.bound is not None), None)
    scored = [(abs(float(row[metric])), row) for row in completed if row["answered"] and metric and metric in row]
    known = [(size, row) for size, row in scored if size == size]
    if configuration.retain.showcase == "first" or not known:
        return int(completed[0]["case"])
    worst = max(known, key=lambda scored_row: scored_row[0])
    return int(worst[1]["case"])


def _keep_showcase(
    configuration: CampaignConfiguration, directory: Path, workers: Workers, rows: Sequence[Row], watch: Watch
) -> None:
    """Runs the showcase again for its products; says so where it did not come out as before."""
    case = showcase_case(configuration, rows)
    if case is None:
        return
    watch.begin("showcase", 1)
    replayed = replay_with(workers, configuration, case, rows[case])
    changes: dict[str, Any] = {"showcase": case}
    if replayed.differing:
        changes["showcase_differs"] = list(replayed.differing)
        watch.note(f"case {case} run again came out differently in: {', '.join(replayed.differing)}")
    try:
        save_replay(case_directory(directory, case), replayed)
    except TypeError as error:
        watch.note(f"the products of case {case} could not be kept: {error}")
        return
    record.update(directory, changes)
    watch.step()
