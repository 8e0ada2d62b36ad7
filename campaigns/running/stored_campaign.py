"""Load the campaign of a stored folder."""

from pathlib import Path

from pydantic import ValidationError

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import CampaignDefinition
from marsyard.campaigns.definition.toml_models import key_text, validation_problems
from marsyard.campaigns.errors import DefinitionError, Problem
from marsyard.campaigns.store.origin import check_origin
from marsyard.scenarios.systems import UnknownScenarioError, scenario


def load_stored_campaign(directory: Path, definition: CampaignDefinition) -> Campaign:
    """Create the campaign of a stored definition; imports its scenario and algorithms.

    Raises CampaignError if the folder was created elsewhere and names code, and DefinitionError if the scenario or
    an algorithm cannot be imported, or a parameter is invalid.
    """
    check_origin(directory, definition)
    try:
        campaign = Campaign(definition, scenario(definition.scenario))
        campaign.base_parameters()
    except (UnknownScenarioError, ValidationError) as error:
        problems = [("scenario", str(error))]
        if isinstance(error, ValidationError):
            errors = validation_problems(error, campaign.scenario.parameters_type)
            problems = [(key_text(("parameters", *key)), message) for key, message in errors]
        hint = "custom modules are imported from the current folder: start the command in the campaign's first folder"
        problems.append(("", f"nothing was run or changed; {hint}"))
        raise DefinitionError([Problem(str(directory), *problem) for problem in problems]) from error
    return campaign
