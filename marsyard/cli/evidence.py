"""What limits the evidence of a campaign before it is run: too few cases, too few terrains, no random draws."""

from __future__ import annotations

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.configuration import CampaignConfiguration
from marsyard.reports.sampled import sampled
from marsyard.reports.statistics.proportions import minimum_sample_size
from marsyard.reports.verdicts import ESTIMATE
from marsyard.reports.wording import count, stated

#: Terrains of at most so many cases are counted; a draw takes milliseconds.
_MOST_DRAWS = 5000


def evidence_limits(campaign: Campaign) -> list[str]:
    """Why requirements cannot read PASS even without a failure, and the change that helps; empty where they can.

    Only requirements that are decided at a confidence are asked, and each as of all cases: a population of fewer takes
    more cases.
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
    # cases that have a terrain each are limited by their number alone; others are counted by terrains
    if supply is not None and terrains is not None and terrains < min(cases, fewest):
        limits.append(supply.advice(fewest, hardest.probability, hardest.confidence))
    return limits


def _drawn_terrains(campaign: Campaign) -> int | None:
    """Distinct terrains that the cases draw; None where cases do not state them, or are very many."""
    configuration: CampaignConfiguration = campaign.configuration
    path = next((path for path in ("place.terrain", "world.terrain") if path in configuration.dispersions), None)
    if path is None or configuration.total_cases > _MOST_DRAWS:
        return None
    first = int(configuration.design.nominal)
    return len({campaign.draws(case)[path] for case in range(first, configuration.total_cases)})
