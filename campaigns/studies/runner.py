"""Run and continue studies (`rare`, `search`, `budget`, `robust`), which choose the points of their cases.

A point consists of standard normal numbers and a number of random streams (`marsyard.campaigns.sampling.study_points`).

A study is a deterministic function of its parameters and of the rows of its cases. To continue an interrupted study, it
is run again from its start. Cases with a stored row are not run again: their rows are read.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import CampaignDefinition, Requirement
from marsyard.campaigns.definition.identity import Identity, create_identity
from marsyard.campaigns.definition.parameter_paths import value_at
from marsyard.campaigns.errors import CampaignError, unknown_name_message
from marsyard.campaigns.execution.executors import ExecutorConfig, create_executor
from marsyard.campaigns.json_numbers import convert_to_json
from marsyard.campaigns.running.compilation import compile_kernels
from marsyard.campaigns.running.progress import ProgressObserver
from marsyard.campaigns.running.shared_inputs import prepare_inputs
from marsyard.campaigns.running.stored_campaign import create_files, load_stored_campaign
from marsyard.campaigns.sampling.design import ADAPTIVE, Design
from marsyard.campaigns.sampling.dispersions import CyclicInteger, GridDispersion, list_sequences
from marsyard.campaigns.store import record
from marsyard.campaigns.store.lock import folder_lock, lock_new_folder
from marsyard.campaigns.store.origin import check_rows
from marsyard.campaigns.store.rows import ROWS_FILE, RowStore
from marsyard.campaigns.store.table import TABLE_FILE, numeric_metrics, write_table
from marsyard.campaigns.studies.point_runner import PointRunner
from marsyard.campaigns.studies.results import BudgetResult, RareResult, RobustResult, SearchResult
from marsyard.campaigns.studies.study_record import STUDY_KEY, StudyKind
from marsyard.scenarios.interface import HasRecordedCases

Parameters = TypeVar("Parameters")
Result = TypeVar("Result", bound=RareResult | SearchResult | BudgetResult | RobustResult)


@dataclass(frozen=True)
class StudySession(Generic[Parameters, Result]):
    """Start or continuation of a study.

    - kind, parameters: kind and parameters of the study
    - study: class of the running study, whose method `run` receives the observer and returns the result
    - executor, observer: parameters of the workers, and receiver of progress reports
    """

    kind: StudyKind[Parameters, Result]
    parameters: Parameters
    study: Callable[[Campaign, Parameters, PointRunner], Any]
    executor: ExecutorConfig
    observer: ProgressObserver


def prepare_campaign(campaign: Campaign, max_cases: int, streams: int | None = None) -> Campaign:
    """Return the campaign with the design `adaptive` and at most `max_cases` cases.

    - streams: number of random streams of the study, by default one per case
    Raises CampaignError for recorded cases, and like `_check_dispersions`.
    """
    definition = campaign.definition
    if isinstance(campaign.scenario, HasRecordedCases):
        raise CampaignError(
            f"campaign '{definition.name}' has recorded cases, which no study can draw or change; allowed: simulated "
            "cases"
        )
    _check_dispersions(definition, streams or max_cases)
    if not campaign.drawn_paths:
        raise CampaignError(f"campaign '{definition.name}' has no random dispersion")
    changes = {"design": Design(kind=ADAPTIVE), "cases": max_cases, "appended": (), "max_cases": None}
    # no command: `marsyard run` does not repeat a study
    return replace(campaign, definition=definition.model_copy(update=changes), command=())


def _check_dispersions(definition: CampaignDefinition, streams: int) -> None:
    """Raise CampaignError if a dispersion is neither a standard normal variable nor the number of a terrain `in-turn`.

    Such a number belongs to the random streams, and follows their number; it must not repeat within all of them.
    """
    sequences = list_sequences(definition.model_dump(mode="json")["dispersions"])
    for path, dispersion in definition.dispersions.items():
        remedy = f"fix it with --set {path}=VALUE, or give it a random distribution"
        if isinstance(dispersion, GridDispersion):
            raise CampaignError(f"dispersions.{path}: is a distribution 'grid', which has no probabilities; {remedy}")
        if path in sequences:
            reason = "is a distribution 'in-turn' of a number that selects no terrain, or that a formula uses"
            raise CampaignError(f"dispersions.{path}: {reason}; {remedy}")
        if isinstance(dispersion, CyclicInteger):
            inputs = {name: value_at(definition.parameters, name) for name in dispersion.names}
            size = dispersion.insert_values(inputs).size
            if size < streams:
                reason = f"the {size} values of the distribution 'in-turn' repeat within {streams} cases"
                raise CampaignError(f"dispersions.{path}: {reason}; extend its range, {remedy}")


def find_requirement(campaign: Campaign, requirement_id: str) -> Requirement:
    """Find a requirement of the campaign by its id. Raises CampaignError for an unknown id."""
    requirements = {item.id: item for item in campaign.definition.requirements}
    if requirement_id not in requirements:
        raise CampaignError(f"--requirement: {unknown_name_message('requirement', requirement_id, requirements)}")
    return requirements[requirement_id]


def check_margin(requirement: Requirement) -> None:
    """Raise CampaignError for a requirement whose violations have no continuous margin."""
    if requirement.bound is None and requirement.margin is None:
        raise CampaignError(
            f"{requirement.id}: the metric '{requirement.metric}' is only true or false. Select a requirement with a "
            "number as metric, or give it a `margin`: a column of numbers that are negative if and only if it is false"
        )


def start_study(
    campaign: Campaign, max_cases: int, directory: Path, session: StudySession[Any, Result], streams: int | None = None
) -> Result:
    """Create the folder of a study, and run it; `streams` is the number of its random streams, by default of its cases.

    Raises CampaignError for an unsuitable campaign or folder.
    """
    study_campaign = prepare_campaign(campaign, max_cases, streams)
    with lock_new_folder(directory):
        create_files(study_campaign, directory, session.executor)
        record.update(directory, {STUDY_KEY: session.kind.encode(session.parameters)})
        return _run_study(study_campaign, directory, session)


def continue_study(directory: Path, session: StudySession[Any, Result], additional_cases: int = 0) -> Result:
    """Continue a stored study; the session's parameters replace the stored ones, and the limit of cases increases.

    Raises CampaignError if the program has changed, or the study cannot have the additional cases.
    """
    with folder_lock(directory):
        definition = record.stored_definition(directory)
        if additional_cases:
            blocks = (*definition.appended, additional_cases)
            definition = definition.model_copy(update={"appended": blocks})
            _check_dispersions(definition, definition.total_cases)
        campaign = load_stored_campaign(directory, definition)
        check_identity(campaign, directory)
        check_rows(directory)
        stored = record.read(directory)
        description = record.describe_session("resume", session.executor.describe(), int(stored["cases_finished"]))
        changes: dict[str, Any] = {"state": "running", "finished_utc": None}
        changes["sessions"] = [*stored["sessions"], description]
        changes.update(cases=definition.total_cases, definition=definition.model_dump(mode="json"))
        record.update(directory, {**changes, STUDY_KEY: session.kind.encode(session.parameters)})
        return _run_study(campaign, directory, session)


def _run_study(campaign: Campaign, directory: Path, session: StudySession[Any, Result]) -> Result:
    """Run a study from its start; stored rows are not run again. Store its result and the table of its cases."""
    observer = session.observer
    with RowStore(directory / ROWS_FILE, thorough=True) as store:
        try:
            with create_executor(session.executor) as executor:
                compile_kernels(executor, campaign.definition.scenario, observer.note)
                prepare_inputs(campaign, executor, observer, None)
                runner = PointRunner(campaign, directory, store, executor, observer)
                result: Result = session.study(campaign, session.parameters, runner).run(observer)
        finally:
            # the study is finished only when its table and its result are written, below
            counts = {"cases_finished": store.count(), "cases_crashed": store.count_unfinished()}
            record.update(directory, {"state": "interrupted", "finished_utc": record.utc_now(), **counts})
        write_table(directory / TABLE_FILE, store, numeric_metrics(campaign.definition.requirements))
    study = {**session.kind.encode(session.parameters), "result": convert_to_json(asdict(result))}
    record.update(directory, {"state": "finished", "exit_code": result.exit_code, STUDY_KEY: study})
    return result


def check_identity(campaign: Campaign, directory: Path) -> None:
    """Raise CampaignError if program, definition or input files differ from those of a stored study or campaign."""
    changes = Identity.read(record.read(directory)["identity"]).differences(create_identity(campaign.definition))
    if changes:
        text = "\n  ".join(changes)
        reason = "was run with another program, definition or input files; its rows would not be comparable"
        raise CampaignError(f"{directory} {reason}. Changed:\n  {text}\nStart a new study in another folder")
