"""Components that a campaign selects by name: its scenario, algorithms and custom parts (docs/custom-parts.md)."""

from __future__ import annotations

from collections.abc import Mapping

from marsyard.algorithms.exchange import PREFIXES, ExecutableLimits
from marsyard.campaigns.definition.campaign_file import CampaignDefinition
from marsyard.campaigns.definition.parameter_paths import find_value
from marsyard.scenarios.interface import HasAlgorithms, HasParts, Scenario
from marsyard.scenarios.offline_algorithms import is_offline
from marsyard.scenarios.systems import UnknownScenarioError, scenario


def list_algorithms(definition: CampaignDefinition) -> tuple[str, ...]:
    """List the algorithms in a definition or its dispersions: under test, then compared."""
    selected_scenario = find_scenario(definition.scenario)
    if not isinstance(selected_scenario, HasAlgorithms):
        return ()
    tested_key, compared_key = (
        ".".join((*selected_scenario.algorithm_table, name)) for name in ("algorithm", "compared")
    )
    specs = [find_value(definition.parameters, tested_key), *find_value(definition.parameters, compared_key)]
    if tested_key in definition.dispersions:
        specs += definition.dispersions[tested_key].extremes()
    return tuple(dict.fromkeys(str(spec) for spec in specs if spec))


def algorithm_process_limits(definition: CampaignDefinition) -> tuple[float, float]:
    """Return the time (s) and memory (bytes) that the algorithms in processes of their own may use for one case."""
    selected_scenario = find_scenario(definition.scenario)
    if not isinstance(selected_scenario, HasAlgorithms):
        return 0.0, 0.0
    found = find_value(definition.parameters, ".".join((*selected_scenario.algorithm_table, "executable")))
    limits = ExecutableLimits.model_validate(found if isinstance(found, Mapping) else {})
    shipped = selected_scenario.task.shipped
    custom = [spec for spec in list_algorithms(definition) if spec not in shipped and not is_offline(spec)]
    count = len([spec for spec in custom if limits.isolated or spec.startswith(tuple(PREFIXES))])
    return count * (limits.loading_s + limits.total_s), count * limits.memory_gb * 1e9


def list_parts(definition: CampaignDefinition) -> tuple[str, ...]:
    """List the import paths (``module:name``) of the custom parts in a definition or its dispersions."""
    selected_scenario = find_scenario(definition.scenario)
    if not isinstance(selected_scenario, HasParts):
        return ()
    parameter_trees = [definition.parameters]
    for path, dispersion in definition.dispersions.items():
        # the value of the dispersion is a part, or a table that contains one
        if any(f"{key}.".startswith(f"{path}.") for key in selected_scenario.part_keys):
            for tree in dispersion.extremes():
                for name in reversed(path.split(".")):
                    tree = {name: tree}
                parameter_trees.append(tree)
    paths: dict[str, None] = {}
    for tree in parameter_trees:
        for key, kind in selected_scenario.part_keys.items():
            value = find_value(tree, key)
            specs = [value] if isinstance(value, str) else [str(item) for item in value or ()]
            paths.update(dict.fromkeys(map(kind.path, specs)))
    return tuple(paths)


def find_scenario(name: object) -> Scenario | None:
    """Return the scenario with a name; None if the name is invalid or unknown."""
    try:
        return scenario(name) if isinstance(name, str) and name else None
    except UnknownScenarioError:
        return None
