"""Replace the algorithms of a loaded campaign."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from pydantic import ValidationError

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.command_options import list_paths, merge_tables
from marsyard.campaigns.definition.toml_models import key_text, validation_problems
from marsyard.campaigns.errors import DefinitionError, Problem
from marsyard.scenarios.interface import HasAlgorithms


def replace_algorithms(campaign: Campaign, algorithms: Sequence[str]) -> Campaign:
    """Return a campaign with other algorithms: the first is under test, the others are compared.

    Raises DefinitionError if the scenario has no selectable algorithms, or rejects them.
    """
    if not algorithms:
        return campaign
    selected, definition, source = (campaign.scenario, campaign.definition, f"campaign '{campaign.definition.name}'")
    if not isinstance(selected, HasAlgorithms):
        raise DefinitionError([Problem(source, "", "its scenario has no selectable algorithms")])
    changes: dict[str, Any] = {"algorithm": algorithms[0], "compared": list(algorithms[1:])}
    for part in reversed(selected.algorithm_table):
        changes = {part: changes}
    paths = {".".join(path) for path in list_paths(changes)}
    values = merge_tables(definition.parameters, changes)
    try:
        parameters = selected.parameters_type.model_validate(values).model_dump(mode="json", round_trip=True)
    except ValidationError as error:
        found = validation_problems(error, selected.parameters_type)
        raise DefinitionError([Problem(source, key_text(("parameters", *key)), text) for key, text in found]) from error
    dispersions = {path: item for path, item in definition.dispersions.items() if path not in paths}
    changed = definition.model_copy(update={"parameters": parameters, "dispersions": dispersions})
    return replace(campaign, definition=changed)
