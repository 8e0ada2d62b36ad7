"""Campaign engine: run a campaign in a folder, resume it, or append cases; store rows and products."""

import itertools
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from marsyard.campaigns.definition.algorithm_descriptions import describe_algorithms
from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import CampaignDefinition, CaseLimits
from marsyard.campaigns.definition.checks import NUMBERS, find_repeated_cases, find_unknown_columns
from marsyard.campaigns.definition.evidence import Evidence, EvidenceKind
from marsyard.campaigns.definition.identity import Identity, create_identity
from marsyard.campaigns.definition.toml_models import key_text
from marsyard.campaigns.errors import CampaignError, DefinitionError, Problem, StoreError
from marsyard.campaigns.execution.cases import CompletedCase, run_cases
from marsyard.campaigns.execution.executors import ExecutorConfig, create_executor
from marsyard.campaigns.execution.work import Executor
from marsyard.campaigns.outcomes import ENGINE_FAILURES, RETRYABLE
from marsyard.campaigns.running.compilation import compile_kernels
from marsyard.campaigns.running.progress import ProgressObserver
from marsyard.campaigns.running.replay import replay_in_executor
from marsyard.campaigns.running.shards import SHARD_KEY, SHARD_STATE, Shard, read_shard
from marsyard.campaigns.running.shared_inputs import prepare_inputs
from marsyard.campaigns.running.stored_campaign import create_files, load_stored_campaign
from marsyard.campaigns.sampling.design import ADAPTIVE
from marsyard.campaigns.store import record
from marsyard.campaigns.store.confirmation_record import locate_record
from marsyard.campaigns.store.confirmations import extend_confirmation
from marsyard.campaigns.store.lock import folder_lock, lock_new_folder
from marsyard.campaigns.store.origin import check_rows
from marsyard.campaigns.store.product_selection import create_product_selection, find_showcase, find_worst_cases
from marsyard.campaigns.store.products import ProductStore
from marsyard.campaigns.store.rows import ROWS_FILE, Row, RowStore
from marsyard.campaigns.store.table import TABLE_FILE, is_current, numeric_metrics, write_table
from marsyard.scenarios.columns import Columns
from marsyard.scenarios.declared_columns import row_columns


@dataclass(frozen=True)
class _CampaignRun:
    """A campaign to run, with its folder, the parameters of its workers, and the receiver of its progress.

    shard: part of the campaign that runs; None for all cases
    """

    campaign: Campaign
    directory: Path
    executor: ExecutorConfig
    observer: ProgressObserver
    shard: Shard | None = None

    @property
    def cases(self) -> range:
        """Numbers of the cases to run."""
        total = self.campaign.definition.total_cases
        return range(total) if self.shard is None else self.shard.cases(total)


def run_campaign(
    campaign: Campaign,
    directory: Path,
    executor: ExecutorConfig,
    observer: ProgressObserver,
    shard: Shard | None = None,
) -> None:
    """Run a campaign, or a shard of it, in a new folder.

    Rows are stored in `cases.sqlite` as soon as cases end; `cases.parquet` is written after the last case.
    Raises CampaignError if the folder contains a campaign or is not writable, or a column of a requirement is missing.
    On KeyboardInterrupt, rows and record are stored before the exception is raised again.
    """
    with lock_new_folder(directory):
        create_files(campaign, directory, executor)
        if shard is not None:
            record.update(directory, {SHARD_KEY: str(shard)})
        with RowStore(directory / ROWS_FILE) as store:
            _execute(_CampaignRun(campaign, directory, executor, observer, shard), store, ())


def finish_campaign(directory: Path, executor: ExecutorConfig, observer: ProgressObserver) -> None:
    """Run the missing cases of a campaign without checks of its identity; write the table and the showcase."""
    with folder_lock(directory), RowStore(directory / ROWS_FILE) as store:
        campaign = load_stored_campaign(directory, record.stored_definition(directory))
        _execute(_CampaignRun(campaign, directory, executor, observer), store, ())


def resume_campaign(
    directory: Path,
    executor: ExecutorConfig,
    observer: ProgressObserver,
    *,
    retry: Sequence[str] = (),
    case_time_s: float | None = None,
    allow_changed: bool = False,
) -> None:
    """Run the cases of a stored campaign that have no row yet; the rows of finished cases do not change.

    - retry: keys of `RETRYABLE`; cases with these outcomes run again, and their new rows replace the old rows; the
      attempts of old and new rows are added
    - case_time_s: time limit of the remaining cases instead of the campaign's
    - allow_changed: continue with another program or other versions, and record the differences

    Raises CampaignError if the folder contains no campaign that can be continued; the folder is then unchanged.
    """
    record.read(directory)  # no lock file is created in a folder without a campaign
    with folder_lock(directory):
        definition = record.stored_definition(directory)
        _reject_study(directory, definition)
        if case_time_s is not None:
            try:
                limits = CaseLimits.model_validate({**definition.limits.model_dump(), "case_time_s": case_time_s})
            except ValidationError as error:
                raise CampaignError(f"--case-time {case_time_s}: {error.errors()[0]['msg'].lower()}") from error
            definition = definition.model_copy(update={"limits": limits})
        campaign = load_stored_campaign(directory, definition)
        shard = read_shard(record.read(directory))
        _continue_campaign(_CampaignRun(campaign, directory, executor, observer, shard), "resume", allow_changed, retry)


def append_cases(
    directory: Path, cases: int, executor: ExecutorConfig, observer: ProgressObserver, *, allow_changed: bool = False
) -> None:
    """Append a block of cases to a finished campaign, and run it.

    Raises CampaignError like `resume_campaign`, for an unfinished campaign, and for a block that does not fit the
    sampling design.
    """
    record.read(directory)  # no lock file is created in a folder without a campaign
    with folder_lock(directory):
        state = record.read(directory)["state"]
        if state != "finished":
            raise CampaignError(f"{directory} is not finished ({state}): marsyard resume {directory}")
        campaign = campaign_with_block(directory, cases)
        _continue_campaign(_CampaignRun(campaign, directory, executor, observer), "append", allow_changed)


def campaign_with_block(directory: Path, cases: int) -> Campaign:
    """Load a stored campaign with a block of `cases` additional cases. Raises CampaignError like `append_cases`."""
    definition = record.stored_definition(directory)
    _reject_study(directory, definition)
    extended_definition = definition.model_copy(update={"appended": (*definition.appended, cases)})
    problems = [message for _, message in extended_definition.find_sampling_problems()]
    if cases < 1 or problems:
        raise CampaignError(f"{cases} cases cannot be added to {directory}: {'; '.join(problems) or 'at least 1'}")
    campaign = load_stored_campaign(directory, extended_definition)
    for _, message in find_repeated_cases(campaign):
        raise CampaignError(f"{cases} cases cannot be added to {directory}: {message}")
    return campaign


def _reject_study(directory: Path, definition: CampaignDefinition) -> None:
    """Raise CampaignError for the folder of a study, whose cases a campaign cannot continue."""
    if definition.design.kind == ADAPTIVE:
        raise CampaignError(f"{directory} contains a study, which chooses its cases; this command is for campaigns")


def _continue_campaign(run: _CampaignRun, command: str, allow_changed: bool, retry: Sequence[str] = ()) -> None:
    """Run the missing cases of a stored campaign, and cases with the outcomes in `retry` again."""
    campaign, directory, observer = run.campaign, run.directory, run.observer
    definition, stored = campaign.definition, record.read(directory)
    previous, identity = Identity.read(stored["identity"]), create_identity(definition)
    changes = previous.differences(identity)
    if changes and not allow_changed:
        changes_text = "\n  ".join(changes)
        raise CampaignError(
            f"{directory} was run with another program, definition or input files; rows would not be comparable. "
            f"Changed:\n  {changes_text}\nTo continue nevertheless, with a note in the record: --allow-changed"
        )
    check_rows(directory)
    with RowStore(directory / ROWS_FILE, thorough=True) as store:
        count = store.count()
        retries = store.list_cases_with_outcomes(RETRYABLE[word] for word in retry)
        table = directory / TABLE_FILE
        has_table = table.is_file() and is_current(table, store)
        is_complete = stored["state"] in ("finished", SHARD_STATE) and has_table
        if not retries and is_complete and not _list_missing_cases(run, store):
            observer.note(f"the campaign is finished: all {count} cases have rows; nothing is run")
            return
        evidence = locate_record(Evidence.read(stored.get("evidence")), directory)
        if evidence.kind is EvidenceKind.CONFIRMATION and evidence.claim:
            extend_confirmation(evidence, definition.total_cases, repeats=bool(retries))
        session = record.describe_session(command, run.executor.describe(), count)
        updates: dict[str, Any] = {"state": "running", "exit_code": None, "finished_utc": None}
        updates["sessions"] = [*stored["sessions"], session]
        if changes:
            updates["changes"] = [*stored["changes"], {"utc": record.utc_now(), "cases_before": count, "in": changes}]
            updates["algorithms"] = describe_algorithms(campaign)
            updates["identity"] = asdict(identity)
        updates.update(cases=definition.total_cases, definition=definition.model_dump(mode="json"))
        record.update(directory, updates)
        old, new = stored["environment"], session["environment"]
        if any(old.get(key) != new[key] for key in ("machine", "processor", "processor_features")):
            change = f"the campaign was started on another processor ({old.get('processor')})"
            observer.note(f"{change}: new rows may differ from the earlier rows in their last bits")
        _execute(run, store, retries)


def _execute(run: _CampaignRun, store: RowStore, retries: Sequence[int]) -> None:
    """Run the missing cases and those of `retries`; write the table, store products, and record the progress."""
    definition, table = run.campaign.definition, run.directory / TABLE_FILE

    def record_end(state: str) -> None:
        progress = {"cases_finished": store.count(), "cases_crashed": store.count_unfinished()}
        record.update(run.directory, {"state": state, "finished_utc": record.utc_now(), **progress})

    try:
        with create_executor(run.executor) as executor:
            missing = _list_missing_cases(run, store)
            if missing or retries:
                compile_kernels(executor, definition.scenario, run.observer.note)
                prepare_inputs(run.campaign, executor, run.observer, itertools.chain(*missing, retries))
                _run_cases(run, store, executor, missing, retries)
            write_table(table, store, numeric_metrics(definition.requirements))
            if run.shard is None:
                _rerun_for_products(run, store, executor)
    except BaseException:
        # on a full disk the state in the record stays "running"; the released lock shows that no process runs
        with suppress(StoreError):
            record_end("interrupted")
        raise
    record_end("finished" if run.shard is None else SHARD_STATE)


def _list_missing_cases(run: _CampaignRun, store: RowStore) -> list[range]:
    """List the cases of the run that have no row, as ranges."""
    ranges = store.list_missing_cases(run.campaign.definition.total_cases)
    limited = [range(max(part.start, run.cases.start), min(part.stop, run.cases.stop)) for part in ranges]
    return [part for part in limited if part]


def _run_cases(
    run: _CampaignRun, store: RowStore, executor: Executor, missing: Sequence[Sequence[int]], retries: Sequence[int]
) -> None:
    """Run cases; store products before their rows, and the rows of one batch in one transaction."""
    definition, observer = run.campaign.definition, run.observer
    total = sum(len(group) for group in (*missing, retries))
    products = ProductStore(run.directory, definition.retain.budget_gb)
    cases = itertools.chain(*missing, retries)
    earlier_attempts = {case: int((store.row(case) or {}).get("case_attempts", 1)) for case in retries}
    observer.begin("cases", total)
    is_checked = False
    for batch in run_cases(executor, definition, cases, selection=create_product_selection(definition), total=total):
        batch = [_add_attempts(completed, earlier_attempts) for completed in batch]
        for completed in batch:
            _store_products(products, completed, observer)
        store.add(completed.row for completed in batch)
        finished_row = next((item.row for item in batch if item.row["outcome"] not in ENGINE_FAILURES), None)
        if not is_checked and finished_row is not None:
            check_metrics(definition, finished_row, run.directory)
            is_checked = True
        for _ in batch:
            observer.step()


def _add_attempts(completed: CompletedCase, earlier_attempts: Mapping[int, int]) -> CompletedCase:
    """Add the attempts of the stored row that the new row replaces."""
    row = completed.row
    attempts = int(row["case_attempts"]) + earlier_attempts.get(int(row["case"]), 0)
    return replace(completed, row={**row, "case_attempts": attempts})


def _store_products(products: ProductStore, completed: CompletedCase, observer: ProgressObserver) -> None:
    """Store the products of a case, if it has any and the disk space suffices; report its note."""
    if completed.note:
        observer.note(completed.note)
    if completed.products is None or products.full:
        return
    case = int(completed.row["case"])
    if not products.save(case, completed.products, completed.row):
        observer.note(f"the disk space for products (retain.budget_gb) is used: none are stored from case {case} on")


def check_metrics(definition: CampaignDefinition, row: Row, directory: Path) -> None:
    """Check the columns of the requirements against a finished case, before more cases run.

    Columns that the scenario declares may be missing in the row; they were checked when the campaign was loaded
    (`marsyard.campaigns.definition.loading`). Raises DefinitionError if a column of a requirement is missing or has
    the wrong type: a metric with a bound needs numbers, a metric without a bound and a population need booleans.
    """
    declared_columns = row_columns(definition.scenario) or Columns(())
    flags = [name for name, value in row.items() if isinstance(value, bool)]
    numbers = [name for name, value in row.items() if isinstance(value, int | float) and name not in (*flags, "case")]

    def is_known(name: str, kind: str) -> bool:
        is_declared = name not in row and (declared_columns.has(name, bool) or declared_columns.has(name, float))
        return is_declared or name in (numbers if kind == NUMBERS else flags)

    unknown_columns = find_unknown_columns(definition.requirements, flags, numbers, is_known)
    problems = [Problem(definition.name, key_text(key), message) for key, message in unknown_columns]
    if problems:
        consequence = Problem(str(directory), "", "the campaign was stopped; its rows are stored")
        raise DefinitionError([*problems, consequence])


def _rerun_for_products(run: _CampaignRun, store: RowStore, executor: Executor) -> None:
    """Run the showcase again, and the worst cases if the campaign stores their products, to store the products."""
    definition, table = run.campaign.definition, run.directory / TABLE_FILE
    showcase = find_showcase(definition, table, store)
    cases = [] if showcase is None else [showcase]
    if definition.retain.products == "worst":
        cases += find_worst_cases(definition, table, definition.retain.worst)
    if not cases:
        return
    cases = list(dict.fromkeys(cases))
    run.observer.begin("showcase", len(cases))
    products = ProductStore(run.directory, definition.retain.budget_gb)
    for case in cases:
        rerun = replay_in_executor(executor, definition, case, store.row(case), timeline=case == showcase)
        if rerun.differing:
            record.update(run.directory, {"showcase_differs": list(rerun.differing)})
            run.observer.note(f"case {case}, run again, differs from its stored row in: {', '.join(rerun.differing)}")
        _store_products(products, CompletedCase(rerun.row, rerun.products, rerun.note), run.observer)
        run.observer.step()
    record.update(run.directory, {"showcase": showcase})
