"""`marsyard run --until-decided`: a campaign that looks at its verdicts at fixed times and stops when it can."""

from __future__ import annotations

from pathlib import Path

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.crew import Crew
from marsyard.campaigns.running.engine import Watch, append_cases, run_campaign
from marsyard.campaigns.store import record
from marsyard.cli.outcome import read_frame
from marsyard.reports.evaluation import next_look
from marsyard.reports.sampled import sampled
from marsyard.reports.statistics.sequential import looks_of
from marsyard.reports.verdicts import ESTIMATE, judge_campaign
from marsyard.reports.wording import count


def run_until_decided(campaign: Campaign, directory: Path, crew: Crew, watch: Watch) -> None:
    """Runs a campaign of at most its number of cases; see `marsyard.reports.statistics.sequential`.

    Raises CampaignError where its cases are no independent draws, or no requirement waits to be decided; and as
    `run_campaign` does.
    """
    configuration = campaign.configuration
    how = sampled(configuration.model_dump(mode="json"))
    if not how.independent:
        raise CampaignError(f"--until-decided: {how.no_probability}")
    if all(asked.decide_by == ESTIMATE for asked in configuration.requirements):
        raise CampaignError("--until-decided: the campaign has no requirement that is decided at a confidence")
    most = configuration.total_cases
    first = configuration.model_copy(update={"cases": looks_of(most)[0].cases, "appended": (), "most_cases": most})
    command = (*campaign.command, "--until-decided")
    run_campaign(Campaign(first, campaign.scenario, command), directory, crew, watch)
    go_on_until_decided(directory, crew, watch)


def go_on_until_decided(directory: Path, crew: Crew, watch: Watch) -> None:
    """Adds cases to a finished campaign look by look while it is undecided; none where it has no looks."""
    while True:
        configuration = record.stored_configuration(directory)
        if configuration.most_cases is None:
            return
        plain = configuration.model_dump(mode="json")
        how, cases = sampled(plain), configuration.total_cases
        look = next_look(judge_campaign(read_frame(directory), plain["requirements"], how), how, cases)
        if look is None:
            watch.note(f"stopped after {cases} of at most {count(configuration.most_cases, 'case')}")
            return
        append_cases(directory, look - cases, crew, watch)
