"""Components that a campaign selects by name: its scenario, algorithms and custom parts (docs/custom-parts.md)."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from marsyard.algorithms.exchange import PREFIXES, ExecutableLimits
from marsyard.campaigns.definition.campaign_file import CampaignDefinition
from marsyard.campaigns.definition.parameter_paths import find_value, leaves, paths_overlap
from marsyard.scenarios.interface import HasAlgorithms, HasParts, Scenario
from marsyard.scenarios.offline_algorithms import is_offline
from marsyard.scenarios.systems import UnknownScenarioError, scenario


def list_algorithms(definition: CampaignDefinition) -> tuple[str, ...]:
    """List the algorithms in a definition, under test, then compared; then further ones in its dispersions."""
    keys = _algorithm_keys(definition)
    trees = _list_trees(definition, keys)
    return tuple(dict.fromkeys(name for tree in trees for key in keys for name in _list_names(tree, key)))


def list_compared_algorithms(definition: CampaignDefinition) -> tuple[str, ...]:
    """List the algorithms that are compared with that under test, in a definition or its dispersions."""
    keys = _algorithm_keys(definition)[1:]
    return tuple(name for tree in _list_trees(definition, keys) for key in keys for name in _list_names(tree, key))


def _algorithm_keys(definition: CampaignDefinition) -> tuple[str, ...]:
    """Return the paths of the algorithm under test and of the compared ones; empty if the scenario selects none."""
    selected_scenario = find_scenario(definition.scenario)
    if not isinstance(selected_scenario, HasAlgorithms):
        return ()
    return tuple(".".join((*selected_scenario.algorithm_table, name)) for name in ("algorithm", "compared"))


def _list_trees(definition: CampaignDefinition, keys: Collection[str]) -> list[Any]:
    """List the parameters, and trees with the values of dispersions that can contain a name at one of the paths."""
    trees: list[Any] = [definition.parameters]
    for path, dispersion in definition.dispersions.items():
        if dispersion.formulas or not any(paths_overlap(path, key) for key in keys):
            continue
        for tree in dispersion.extremes():
            for name in reversed(path.split(".")):
                tree = {name: tree}
            trees.append(tree)
    return trees


def _list_names(tree: Any, key: str) -> list[str]:
    """List the names at a path in a tree: a text, or a list of texts."""
    value = find_value(tree, key)
    values = leaves(list(value) if isinstance(value, tuple) else value)
    return [name for _, name in values if name and isinstance(name, str)]


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
    kinds = selected_scenario.part_keys
    names = (
        (kind, name)
        for tree in _list_trees(definition, kinds)
        for key, kind in kinds.items()
        for name in _list_names(tree, key)
    )
    return tuple(dict.fromkeys(kind.path(name) for kind, name in names))


def find_scenario(name: object) -> Scenario | None:
    """Return the scenario with a name; None if the name is invalid or unknown."""
    try:
        return scenario(name) if isinstance(name, str) and name else None
    except UnknownScenarioError:
        return None
