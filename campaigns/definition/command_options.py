"""Command-line options that change the tables of a campaign file: `--set` and `--algorithm`."""

import json
import tomllib
from collections.abc import Mapping, Sequence
from typing import Any

from marsyard.campaigns.definition.components import find_scenario
from marsyard.campaigns.errors import DefinitionError, Problem
from marsyard.campaigns.sampling.correlation import MATRICES
from marsyard.scenarios.interface import HasAlgorithms

#: Keys of the file that `--set` accepts; any other key is a parameter.
_FILE_KEYS = (
    *("parameters", "dispersions", "design", "retain", "limits"),
    *("cases", "seed", "name", "description", "scenario", "correlations"),
)


def parse_override(override: str, option: str) -> dict[str, Any]:
    """Parse ``KEY=VALUE`` into nested tables of a campaign file; a value that is not TOML is a text."""
    key, separator, value = override.partition("=")
    if not separator or not key.strip() or "\n" in override:
        raise DefinitionError([Problem(option, "", "expected KEY=VALUE, such as --set render.backend=egl")])
    try:
        try:
            values = tomllib.loads(f"{key} = {value.strip()}")
        except ValueError:
            values = tomllib.loads(f"{key} = {json.dumps(value.strip())}")
    except (ValueError, RecursionError) as error:
        raise DefinitionError([Problem(option, "", f"'{key}' is not a dotted key: {error}")]) from error
    return values if next(iter(values)) in _FILE_KEYS else {"parameters": values}


def select_algorithms(
    tables: dict[str, Any], algorithms: Sequence[str], source: str, options_by_key: dict[tuple[str, ...], str]
) -> dict[str, Any]:
    """Replace the algorithms in the tables; no change for an unknown scenario, which is reported later."""
    options = [f"--algorithm {spec}" for spec in algorithms]
    selected_scenario = find_scenario(tables.get("scenario"))
    if selected_scenario is None:
        return tables
    if not isinstance(selected_scenario, HasAlgorithms):
        raise DefinitionError([Problem(options[0], "", f"the scenario of {source} has no selectable algorithms")])
    changes: tuple[tuple[str, Any, str], ...] = (
        ("algorithm", algorithms[0], options[0]),
        ("compared", list(algorithms[1:]), " ".join(options[1:]) or options[0]),
    )
    for key, value, option in changes:
        nested_table: dict[str, Any] = {key: value}
        for part in reversed(("parameters", *selected_scenario.algorithm_table)):
            nested_table = {part: nested_table}
        tables = apply_option(tables, nested_table, option, options_by_key)
    return tables


def apply_option(
    tables: Mapping[str, Any], changes: Mapping[str, Any], option: str, options_by_key: dict[tuple[str, ...], str]
) -> dict[str, Any]:
    """Merge the tables with those of an option; parameters that the option sets are not dispersed."""
    merged = merge_tables(tables, changes)
    paths = list_paths(changes)
    options_by_key.update(dict.fromkeys(paths, option))
    parameter_paths = [".".join(path[1:]) for path in paths if path[0] == "parameters"]
    dispersions = merged.get("dispersions")
    if isinstance(dispersions, dict):
        path_pairs = ((path, key) for path in dispersions for key in parameter_paths)
        removed_paths = {
            path for path, key in path_pairs if f"{path}.".startswith(f"{key}.") or key.startswith(f"{path}.")
        }
        merged["dispersions"] = {path: item for path, item in dispersions.items() if path not in removed_paths}
        if removed_paths and isinstance(merged.get("correlations"), list):
            groups = [_remove_members(group, removed_paths) for group in merged["correlations"]]
            merged["correlations"] = [group for group in groups if group != {}]
    return merged


def _remove_members(group: Any, removed_paths: set[str]) -> Any:
    """Remove dispersions from a correlated group; an empty table if none remains; an invalid group is unchanged."""
    names = group.get("parameters") if isinstance(group, Mapping) else None
    if not isinstance(names, list):
        return group
    indices = [index for index, name in enumerate(names) if name not in removed_paths]
    try:
        matrices = {
            kind: [[rows[i][j] for j in indices] for i in indices] for kind in MATRICES if (rows := group.get(kind))
        }
    except (IndexError, KeyError, TypeError):
        return group
    return {**group, "parameters": [names[index] for index in indices], **matrices} if indices else {}


def list_paths(tables: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """List the paths of all values in nested tables."""
    paths: list[tuple[str, ...]] = []
    for name, inner in tables.items():
        is_table = isinstance(inner, Mapping) and inner
        paths += [(name, *path) for path in list_paths(inner)] if is_table else [(name,)]
    return paths


def merge_tables(tables: Mapping[str, Any], updates: Mapping[str, Any]) -> dict[str, Any]:
    """Merge nested tables; values of `updates` replace those of `tables`."""
    merged = dict(tables)
    for name, value in updates.items():
        current = merged.get(name)
        if isinstance(current, Mapping) and isinstance(value, Mapping):
            value = merge_tables(current, value)
        merged[name] = value
    return merged
