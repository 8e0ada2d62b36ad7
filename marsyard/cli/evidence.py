"""Evidence of a campaign: limits of its requirements before the run, and sequential looks of `run --until-decided`."""

from __future__ import annotations

from pathlib import Path

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.workers import ExecutorConfig
from marsyard.campaigns.running.engine import Watch, append_cases, run_campaign
from marsyard.campaigns.store import record
from marsyard.cli.outcome import read_frame
from marsyard.reports.evaluation import next_look
from marsyard.reports.sampling_design import sampled
from marsyard.reports.statistics.proportions import minimum_sample_size
from marsyard.reports.statistics.sequential import planned_looks
from marsyard.reports.verdicts import ESTIMATE, judge_campaign
from marsyard.reports.wording import count, stated

#: Terrains are counted of at most this many cases; a draw takes milliseconds.
_MAX_DRAWS = 5000


def evidence_limits(campaign: Campaign) -> list[str]:
    """Why requirements cannot be PASS even without a failure, with the remedy; empty where they can.

    Covers requirements that are decided at a confidence, each as of all cases: a smaller population needs more.
    """
    configuration = campaign.configuration
    asked = [one for one in configuration.requirements if one.decide_by != ESTIMATE]
    how = sampled(configuration.model_dump(mode="json"))
    if not asked:
        return []
    if not how.independent:
        return [how.no_probability]
    hardest = max(asked, key=lambda one: minimum_sample_size(one.probability, one.confidence))
    fewest = minimum_sample_size(hardest.probability, hardest.confidence)
    cases = configuration.total_cases
    what = f"{hardest.id}: {stated(hardest.probability)} at {stated(hardest.confidence)} confidence"
    limits = []
    if cases < fewest:
        limits.append(f"{what} takes at least {count(fewest, 'case')} without a failure, and {cases} are asked for.")
    supply = how.terrains
    terrains = min(cases, supply.terrains) if supply is not None and supply.in_turn else _drawn_terrains(campaign)
    # cases with a terrain each are limited by their number alone; others are counted by terrains
    if supply is not None and terrains is not None and terrains < min(cases, fewest):
        limits.append(supply.advice(fewest, hardest.probability, hardest.confidence))
    return limits


def _drawn_terrains(campaign: Campaign) -> int | None:
    """Number of distinct terrains that the cases draw; None without a terrain's dispersion, or for very many cases."""
    configuration = campaign.configuration
    path = next((path for path in ("place.terrain", "world.terrain") if path in configuration.dispersions), None)
    if path is None or configuration.total_cases > _MAX_DRAWS:
        return None
    first = int(configuration.design.nominal)
    return len({campaign.draws(case)[path] for case in range(first, configuration.total_cases)})


def run_until_decided(campaign: Campaign, directory: Path, executor: ExecutorConfig, watch: Watch) -> None:
    """Run a campaign of at most its number of cases; see `marsyard.reports.statistics.sequential`.

    Raises CampaignError for dependent draws, or without a requirement to decide; and as `run_campaign`.
    """
    configuration = campaign.configuration
    how = sampled(configuration.model_dump(mode="json"))
    if not how.independent:
        raise CampaignError(f"--until-decided: {how.no_probability}")
    if all(asked.decide_by == ESTIMATE for asked in configuration.requirements):
        raise CampaignError("--until-decided: the campaign has no requirement that is decided at a confidence")
    limit = configuration.total_cases
    first = configuration.model_copy(
        update={"cases": planned_looks(limit)[0].cases, "appended": (), "most_cases": limit}
    )
    command = (*campaign.command, "--until-decided")
    run_campaign(Campaign(first, campaign.scenario, command), directory, executor, watch)
    continue_until_decided(directory, executor, watch)


def continue_until_decided(directory: Path, executor: ExecutorConfig, watch: Watch) -> None:
    """Add cases to a finished campaign with looks until it is decided."""
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
        append_cases(directory, look - cases, executor, watch)
