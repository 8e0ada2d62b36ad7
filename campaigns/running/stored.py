"""The campaign of a stored folder, checked before any of its cases is run again."""

from __future__ import annotations

from pathlib import Path

from pydantic import ValidationError

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.configuration import CampaignConfiguration, key_text, problems_of
from marsyard.campaigns.errors import ConfigurationError, Problem
from marsyard.scenarios.registry import UnknownScenarioError, scenario


def loaded_campaign(directory: Path, configuration: CampaignConfiguration) -> Campaign:
    """The campaign of a stored configuration, with its scenario and algorithms imported.

    Raises
    ------
    ConfigurationError
        Where the scenario or an algorithm is not found from the current folder, or a parameter is not accepted.
    """
    try:
        campaign = Campaign(configuration, scenario(configuration.scenario))
    except UnknownScenarioError as error:
        raise _refused(directory, [("scenario", str(error))]) from error
    try:
        campaign.base_parameters()
    except ValidationError as error:
        found = problems_of(error, campaign.scenario.parameters_type)
        raise _refused(directory, [(key_text(("parameters", *key)), message) for key, message in found]) from error
    return campaign


def _refused(directory: Path, problems: list[tuple[str, str]]) -> ConfigurationError:
    hint = "modules of your own are searched for in the current folder: start the command where the campaign was run"
    stated = [Problem(str(directory), key, message) for key, message in problems]
    return ConfigurationError([*stated, Problem(str(directory), "", f"nothing was run or changed; {hint}")])
