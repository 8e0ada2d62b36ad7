"""Create the files of a campaign in its folder, and load the campaign of a stored folder."""

import os
from dataclasses import replace
from pathlib import Path

from pydantic import ValidationError

from marsyard.campaigns.definition.algorithm_descriptions import describe_algorithms
from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import CampaignDefinition
from marsyard.campaigns.definition.claims import hash_requirements
from marsyard.campaigns.definition.identity import create_identity
from marsyard.campaigns.definition.toml_models import key_text, validation_problems
from marsyard.campaigns.errors import DefinitionError, Problem
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.store import record
from marsyard.campaigns.store.confirmations import classify_run, reserve_confirmation
from marsyard.campaigns.store.origin import check_origin, describe_origin
from marsyard.campaigns.store.rows import ROWS_FILE, create_store
from marsyard.scenarios.systems import UnknownScenarioError, scenario


def create_files(campaign: Campaign, directory: Path, executor: ExecutorConfig) -> None:
    """Create the empty store of rows and the first record of a campaign in its folder; reserve a confirmation.

    Raises CampaignError if a file cannot be written, or another run has taken the seed of the confirmation.
    """
    definition = campaign.definition
    identity, algorithms = create_identity(definition), describe_algorithms(campaign)
    requirements = hash_requirements([item.model_dump(mode="json") for item in definition.requirements])
    create_store(directory / ROWS_FILE, {"identity": identity.definition, "requirements": requirements})
    evidence = reserve_confirmation(campaign, directory) if campaign.confirms else classify_run(campaign)
    if evidence.record:
        evidence = replace(evidence, record_from_folder=os.path.relpath(evidence.record, directory.resolve()))
    record.write_first_record(
        directory,
        definition,
        identity,
        executor.describe(),
        command=campaign.command,
        algorithms=algorithms,
        evidence=evidence.to_table(),
        origin=describe_origin(definition),
    )


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
