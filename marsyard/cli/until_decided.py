"""Run campaigns until their verdicts are decided (`--until-decided`)."""

from dataclasses import replace
from pathlib import Path

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.running.engine import append_cases, run_campaign
from marsyard.campaigns.running.progress import ProgressObserver
from marsyard.campaigns.store import record
from marsyard.reports.evaluation import evaluate_run
from marsyard.reports.looks import next_look
from marsyard.reports.sampling_design import read_sampling_design
from marsyard.reports.statistics.sequential import planned_looks
from marsyard.reports.verdicts import ESTIMATE
from marsyard.reports.wording import count


def run_until_decided(
    campaign: Campaign, directory: Path, executor: ExecutorConfig, observer: ProgressObserver
) -> None:
    """Run a campaign until its verdicts are decided, with at most the configured number of cases.

    See `marsyard.reports.statistics.sequential`. Raises CampaignError for dependent draws, or if no requirement has a
    confidence level.
    """
    definition = campaign.definition
    design = read_sampling_design(definition.model_dump(mode="json"))
    if not design.independent:
        raise CampaignError(f"--until-decided: {design.no_probability_reason}")
    if all(requirement.decide_by == ESTIMATE for requirement in definition.requirements):
        raise CampaignError("--until-decided: the campaign has no requirement with a confidence level")
    max_cases = definition.total_cases
    first_block = definition.model_copy(
        update={"cases": planned_looks(max_cases)[0].cases, "appended": (), "max_cases": max_cases}
    )
    command = (*campaign.command, "--until-decided")
    run_campaign(replace(campaign, definition=first_block, command=command), directory, executor, observer)
    continue_until_decided(directory, executor, observer)


def continue_until_decided(directory: Path, executor: ExecutorConfig, observer: ProgressObserver) -> None:
    """Append cases at the planned interim evaluations until the campaign is decided."""
    while True:
        definition = record.stored_definition(directory)
        if definition.max_cases is None:
            return
        evaluation, cases = evaluate_run(directory), definition.total_cases
        # a decided verdict that is withheld for its kind of evidence needs no further cases
        verdicts = [replace(item, status=item.withheld_status or item.status) for item in evaluation.verdicts]
        next_cases = next_look(verdicts, evaluation.sampling, cases)
        if next_cases is None:
            observer.note(f"stopped after {cases} of at most {count(definition.max_cases, 'case')}")
            return
        append_cases(directory, next_cases - cases, executor, observer)
