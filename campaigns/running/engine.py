"""Runs a campaign into a folder, and goes on with one: prepares what cases share, runs them, stores what they give."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from pydantic import ValidationError

from marsyard.campaigns.definition.algorithms import describe_algorithms
from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.configuration import POPULATIONS, CampaignConfiguration, Limits
from marsyard.campaigns.definition.identity import Identity, identity_of
from marsyard.campaigns.errors import CampaignError, ConfigurationError, Problem, StoreError, not_allowed
from marsyard.campaigns.execution.cases import (
    CompletedCase,
    configuration_text,
    prepare_input,
    prepare_limits,
    run_cases,
)
from marsyard.campaigns.execution.crew import Crew, hire
from marsyard.campaigns.execution.work import Work, Workers
from marsyard.campaigns.outcomes import RETRYABLE, UNFINISHED
from marsyard.campaigns.running.compilation import compilation_reported
from marsyard.campaigns.running.inputs import plan_inputs
from marsyard.campaigns.running.replay import replay_with
from marsyard.campaigns.running.stored import loaded_campaign
from marsyard.campaigns.store import record
from marsyard.campaigns.store.columns import Row
from marsyard.campaigns.store.lock import folder_lock
from marsyard.campaigns.store.retention import ProductStore, keep_while_running
from marsyard.campaigns.store.rows import ROWS_FILE, RowStore, create_store
from marsyard.campaigns.store.table import TABLE_FILE, write_table
from marsyard.campaigns.store.worst import showcase_case, worst_cases
from marsyard.scenarios.systems import StatedColumns, stated_columns
from marsyard.sim.kernel_cache import note_ready

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


@dataclass(frozen=True)
class _Work:
    """A campaign that is being run: in which folder, by whom, into which store, and who is told."""

    campaign: Campaign
    directory: Path
    crew: Crew
    store: RowStore
    watch: Watch

    @property
    def configuration(self) -> CampaignConfiguration:
        return self.campaign.configuration


def run_campaign(campaign: Campaign, directory: Path, crew: Crew, watch: Watch) -> None:
    """Runs a campaign into a folder that holds none.

    The rows are in `cases.sqlite` as they complete; when all are there `cases.parquet` is made from it.

    Raises
    ------
    CampaignError
        Where the folder is taken or cannot be written, or a requirement asks for a column that cases do not have.
    KeyboardInterrupt
        Passed on after the rows are safe and the record says so.
    """
    record.claim(directory)
    with folder_lock(directory):
        record.claim(directory)
        identity = identity_of(campaign.configuration)
        algorithms = describe_algorithms(campaign)
        create_store(directory / ROWS_FILE, {"identity": identity.configuration})
        record.begin(
            directory,
            campaign.configuration,
            identity,
            crew.describe(),
            command=campaign.command,
            algorithms=algorithms,
        )
        with RowStore(directory / ROWS_FILE) as store:
            _run(_Work(campaign, directory, crew, store, watch), ())


def resume_campaign(
    directory: Path,
    crew: Crew,
    watch: Watch,
    *,
    retry: Sequence[str] = (),
    case_time_s: float | None = None,
    allow_changed: bool = False,
) -> None:
    """Runs the cases of a stored campaign that have no row yet; finished ones stay as they are.

    Parameters
    ----------
    directory
        The campaign's folder.
    crew, watch
        Who runs it, and who is told.
    retry
        Words of `RETRYABLE`: cases with these outcomes are run again; their old rows stay until the new ones are there.
    case_time_s
        Instead of the campaign's own limit, from now on.
    allow_changed
        Whether to go on where code or versions are others than the campaign was run with so far; the record says so.

    Raises
    ------
    CampaignError
        Where the folder holds no campaign that can be gone on with; nothing is changed in it then.
    """
    with folder_lock(_with_record(directory)):
        configuration = record.stored_configuration(directory)
        if case_time_s is not None:
            configuration = _with_case_time(configuration, case_time_s)
        _go_on(_Folder(directory, configuration), crew, watch, "resume", retry=retry, allow_changed=allow_changed)


def append_cases(directory: Path, cases: int, crew: Crew, watch: Watch, *, allow_changed: bool = False) -> None:
    """Adds a block of cases behind those of a finished campaign, and runs them; those that are there stay.

    Raises
    ------
    CampaignError
        As `resume_campaign` does, where the campaign is not finished, or where its design cannot have such a block.
    """
    with folder_lock(_with_record(directory)):
        state = record.read(directory)["state"]
        if state != "finished":
            raise CampaignError(f"{directory} is not finished ({state}): marsyard resume {directory}")
        configuration = _with_block(directory, record.stored_configuration(directory), cases)
        _go_on(_Folder(directory, configuration), crew, watch, "append", allow_changed=allow_changed)


def with_block(directory: Path, cases: int) -> Campaign:
    """A stored campaign with another block of cases, which is not run. Raises CampaignError as `append_cases` does."""
    configuration = _with_block(directory, record.stored_configuration(directory), cases)
    return loaded_campaign(directory, configuration)


def _with_record(directory: Path) -> Path:
    """The folder, if it holds a campaign: nothing, not even a lock, is put into one that does not."""
    record.read(directory)
    return directory


@dataclass(frozen=True)
class _Folder:
    """A stored campaign and the configuration that it has from now on."""

    directory: Path
    configuration: CampaignConfiguration


def _go_on(
    folder: _Folder, crew: Crew, watch: Watch, command: str, *, retry: Sequence[str] = (), allow_changed: bool
) -> None:
    """Runs what a stored campaign lacks."""
    directory, configuration = folder.directory, folder.configuration
    stored = record.read(directory)
    campaign = loaded_campaign(directory, configuration)
    known, identity = _stored_identity(directory, stored), identity_of(configuration)
    changes = _identity_changes(directory, known, identity, allow_changed)
    if known.inputs is None and identity.inputs:
        watch.note(
            f"whether these files have changed so far is not known, as no hash was kept: {', '.join(identity.inputs)}"
        )
    with RowStore(directory / ROWS_FILE, thorough=True) as store:
        _check_together(directory, stored, store)
        before = store.count()
        again = store.with_outcomes(RETRYABLE[word] for word in retry)
        if not again and _is_complete(directory, stored, configuration, store):
            watch.note(f"the campaign is finished: all {before} cases have rows; nothing is run")
            return
        said: dict[str, Any] = {"state": "running", "exit_code": None, "finished_utc": None}
        said["sessions"] = [*stored["sessions"], record.session(command, crew.describe(), before)]
        if changes:
            said["changes"] = [*stored["changes"], {"utc": record.utc_now(), "cases_before": before, "in": changes}]
            said["algorithms"] = describe_algorithms(campaign)
        if changes or known.inputs is None:
            said["identity"] = identity.plain()
        said.update(cases=configuration.total_cases, configuration=configuration.model_dump(mode="json"))
        record.update(directory, said)
        _note_other_machine(stored["environment"], said["sessions"][-1]["environment"], watch)
        _run(_Work(campaign, directory, crew, store, watch), again)


def _is_complete(
    directory: Path, stored: dict[str, Any], configuration: CampaignConfiguration, store: RowStore
) -> bool:
    """Whether a campaign ended, its table is there, and no case of its configuration lacks a row."""
    ended = stored["state"] == "finished" and (directory / TABLE_FILE).is_file()
    return ended and not store.missing(configuration.total_cases)


def _note_other_machine(before: dict[str, Any], now: dict[str, Any], watch: Watch) -> None:
    """Says where rows may differ in their last bits from those that another processor gave."""
    if any(before.get(key) != now[key] for key in ("machine", "processor", "processor_features")):
        was = before.get("processor")
        watch.note(f"the campaign began on another processor ({was}): rows may differ from its rows in their last bits")


def _stored_identity(directory: Path, stored: dict[str, Any]) -> Identity:
    """The identity that a campaign has been run with so far."""
    if "identity" not in stored:
        raise StoreError(f"{directory} was run by an earlier version, which kept no rows to go on from; run it anew")
    return Identity.read(stored["identity"])


def _identity_changes(directory: Path, known: Identity, identity: Identity, allow_changed: bool) -> list[str]:
    """In what program and input files differ from those of the campaign so far; refused unless that is allowed."""
    changes = known.differences(identity)
    if changes and not allow_changed:
        listed = "\n  ".join(changes)
        raise CampaignError(
            f"{directory} was run with another program, configuration or input files; rows would not belong together. "
            f"Changed:\n  {listed}\nTo go on nevertheless, and have it recorded: --allow-changed"
        )
    return changes


def _with_case_time(configuration: CampaignConfiguration, case_time_s: float) -> CampaignConfiguration:
    """The configuration with another time limit."""
    try:
        limits = Limits.model_validate({**configuration.limits.model_dump(), "case_time_s": case_time_s})
    except ValidationError as error:
        raise CampaignError(f"--case-time {case_time_s}: {error.errors()[0]['msg'].lower()}") from error
    return configuration.model_copy(update={"limits": limits})


def _with_block(directory: Path, configuration: CampaignConfiguration, cases: int) -> CampaignConfiguration:
    """The configuration with another block of cases behind those there are."""
    appended = configuration.model_copy(update={"appended": (*configuration.appended, cases)})
    problems = [f"{message}" for _, message in appended.sampling_problems()]
    if cases < 1 or problems:
        raise CampaignError(f"{cases} cases cannot be added to {directory}: {'; '.join(problems) or 'at least 1'}")
    return appended


def _check_together(directory: Path, stored: dict[str, Any], store: RowStore) -> None:
    """Refuses a store and a record of two campaigns."""
    about = store.about.get("identity")
    known = [stored["identity"]["configuration"]]
    if about not in known and not stored["changes"]:
        raise StoreError(f"{directory}: {ROWS_FILE} and {record.RECORD_FILE} belong to different campaigns")


def _run(work: _Work, again: Sequence[int]) -> None:
    """Runs what has no row, and `again`; makes the table, keeps products, and says in the record how far it came."""
    with _recorded(work), hire(work.crew) as workers:
        missing = work.store.missing(work.configuration.total_cases)
        if missing or again:
            with compilation_reported(work.configuration.scenario, work.watch) as first_case_ended:
                _prepare(work, workers, itertools.chain(*missing, again))
                _run_cases(work, workers, [*missing, again], first_case_ended)
        measures = [asked.metric for asked in work.configuration.requirements if asked.bound is not None]
        write_table(work.directory / TABLE_FILE, work.store, measures)
        _keep_worst(work, workers)


@contextmanager
def _recorded(work: _Work) -> Iterator[None]:
    """Has the record say how far the campaign came, however that ends."""
    try:
        yield
    except BaseException:
        # the disk may be full: then the record goes on saying that the campaign runs, and the lock that it does not
        with suppress(StoreError):
            record.update(work.directory, {"state": "interrupted", **_progress(work.store)})
        raise
    record.update(work.directory, {"state": "finished", **_progress(work.store)})


def _progress(store: RowStore) -> dict[str, Any]:
    """How far a campaign came, as it stands in the record."""
    return {
        "finished_utc": record.utc_now(),
        "cases_finished": store.count(),
        "cases_crashed": store.unfinished(),
    }


def _run_cases(
    work: _Work, workers: Workers, parts: Sequence[Sequence[int]], first_case_ended: Callable[[], None]
) -> None:
    """Runs cases; stores their rows, a transaction for what ended together, and products before their rows."""
    total = sum(len(part) for part in parts)
    configuration, watch = work.configuration, work.watch
    products = ProductStore(work.directory, configuration.retain.budget_gb)
    keep = keep_while_running(configuration)
    cases = itertools.chain.from_iterable(parts)
    watch.begin("cases", total)
    checked = False
    for ended in run_cases(workers, configuration, cases, keep=keep, total=total):
        for completed in ended:
            _keep_products(products, completed, watch)
        work.store.add(completed.row for completed in ended)
        finished = next((one.row for one in ended if one.row["outcome"] not in UNFINISHED), None)
        if not checked and finished is not None:
            check_metrics(configuration, finished, work.directory)
            note_ready(configuration.scenario)
            first_case_ended()
            checked = True
        for _ in ended:
            watch.step()


def _keep_products(products: ProductStore, completed: CompletedCase, watch: Watch) -> None:
    """Keeps what a case delivered, as far as there is room."""
    if completed.note:
        watch.note(completed.note)
    if completed.products is None or products.full:
        return
    case = int(completed.row["case"])
    if not products.save(case, completed.products, completed.row):
        watch.note(f"the budget for kept products (retain.budget_gb) is used up: none is kept from case {case} on")


def _prepare(work: _Work, workers: Workers, cases: Iterable[int]) -> None:
    """Builds what these cases share; where that fails the cases that need it will say so in their rows."""
    configuration, watch = work.configuration, work.watch
    plan = plan_inputs(work.campaign, cases)
    inputs = plan.to_prepare
    if plan.build_bytes > plan.limit_bytes:
        watch.note(
            f"the terrains to be built take {plan.build_bytes / 1e9:.1f} GB, more than the cache may "
            f"({plan.limit_bytes / 1e9:.1f} GB): some are built more than once; MARSYARD_CACHE_GB sets the limit"
        )
    if not inputs:
        return
    watch.begin("preparing", len(inputs))
    task = partial(prepare_input, configuration_text(configuration))
    for ended in workers.run(Work(task, inputs, prepare_limits(configuration.limits), len(inputs))):
        for done in ended:
            if done.error is not None:
                said = f"{type(done.error).__name__}: {done.error}"
                watch.note(f"shared input {done.item} could not be prepared: {said}")
            elif done.result:
                watch.note(done.result)
            watch.step()


def check_metrics(configuration: CampaignConfiguration, row: Row, directory: Path) -> None:
    """Holds what requirements ask for against the columns of a finished case, before more cases are spent on them.

    Columns that a scenario states may be absent from a row: they are held against that statement when the campaign is
    loaded (`marsyard.campaigns.definition.metrics`).

    Raises
    ------
    ConfigurationError
        Where a requirement asks for a column that is not there, or is of another kind: numbers for a metric with a
        bound, true and false for a metric without one and for a population.
    """
    stated = stated_columns(configuration.scenario) or StatedColumns((), ())
    flags = [name for name, value in row.items() if isinstance(value, bool)]
    numbers = [name for name, value in row.items() if isinstance(value, int | float) and name not in (*flags, "case")]
    problems = []
    for place, requirement in enumerate(configuration.requirements):
        key = f"requirements[{place}]"
        asked = {*requirement.metric_columns, *requirement.population_columns} - {*row}
        absent = [name for name in asked if stated.has_flag(name) or stated.has_number(name)]
        kind, allowed = ("column of numbers", numbers) if requirement.bound is not None else (FLAG, flags)
        for name in requirement.metric_columns:
            if name not in allowed and name not in absent:
                message = not_allowed(kind, name, allowed)
                problems.append(Problem(configuration.name, f"{key}.metric", message))
        for name in requirement.population_columns:
            if name not in flags and name not in absent:
                message = not_allowed(FLAG, name, (*POPULATIONS, *flags))
                problems.append(Problem(configuration.name, f"{key}.population", message))
    if problems:
        stopped = Problem(str(directory), "", "the campaign was stopped; the rows so far are kept")
        raise ConfigurationError([*problems, stopped])


def _keep_worst(work: _Work, workers: Workers) -> None:
    """Runs the showcase, and the worst cases where they are asked for, again for their products."""
    retain = work.configuration.retain
    case = showcase_case(work.configuration, work.directory / TABLE_FILE, work.store)
    worst = worst_cases(work.configuration, work.directory / TABLE_FILE) if retain.products == "worst" else ()
    cases = list(dict.fromkeys([*([] if case is None else [case]), *worst]))
    if not cases:
        return
    work.watch.begin("showcase", len(cases))
    products = ProductStore(work.directory, retain.budget_gb)
    for number in cases:
        _keep_replayed(work, workers, products, number)
        work.watch.step()
    record.update(work.directory, {"showcase": case})


def _keep_replayed(work: _Work, workers: Workers, products: ProductStore, case: int) -> None:
    """Runs a case again and keeps its products; says so where its row did not come out as before."""
    replayed = replay_with(workers, work.configuration, case, work.store.row(case))
    if replayed.differing:
        record.update(work.directory, {"showcase_differs": list(replayed.differing)})
        work.watch.note(f"case {case} run again came out differently in: {', '.join(replayed.differing)}")
    _keep_products(products, CompletedCase(replayed.row, replayed.products, replayed.note), work.watch)
