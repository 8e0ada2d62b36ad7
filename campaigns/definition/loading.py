"""Load a campaign: read its file, apply the options of the command line, and report all problems together.

The options `--set` and `--algorithm` change the tables of the file.
"""

import json
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import CampaignDefinition
from marsyard.campaigns.definition.checks import find_campaign_problems
from marsyard.campaigns.definition.components import find_scenario
from marsyard.campaigns.definition.parameter_paths import paths_overlap
from marsyard.campaigns.definition.requirements import fill_requirements
from marsyard.campaigns.definition.toml_models import Key, Model, key_text, read_tables, validation_problems
from marsyard.campaigns.errors import DefinitionError, Problem, unknown_name_message
from marsyard.campaigns.sampling.correlation import MATRICES
from marsyard.scenarios.interface import HasAlgorithms
from marsyard.scenarios.systems import UnknownScenarioError, catalogue, scenario

#: Keys of the file that `--set` accepts; any other key is a parameter.
_FILE_KEYS = (
    *("parameters", "dispersions", "design", "retain", "limits"),
    *("cases", "seed", "name", "description", "scenario", "correlations"),
)


def find_campaign(name_or_path: str) -> Path:
    """Return the file of a campaign, from its name in the catalogue or from the path of a TOML file.

    Raises DefinitionError if there is no such file.
    """
    path = Path(name_or_path)
    if path.suffix == ".toml" or len(path.parts) > 1:
        if not path.is_file():
            raise DefinitionError([Problem(str(path), "", "is a folder" if path.is_dir() else "no such file")])
        return path
    files = catalogue()
    if name_or_path not in files:
        message = f"{unknown_name_message('campaign', name_or_path, files)}, or the path of a TOML file"
        raise DefinitionError([Problem("", "", message)])
    return files[name_or_path]


def load_campaign(
    name_or_path: str,
    overrides: Sequence[str] = (),
    cases: int | None = None,
    seed: int | None = None,
    algorithms: Sequence[str] = (),
) -> Campaign:
    """Read and check a campaign.

    - name_or_path: a name from the catalogue, or the path of a TOML file
    - overrides: options ``KEY=VALUE``. KEY is a dotted path of a parameter or a top-level key of the file; VALUE is in
      TOML syntax or plain text. An overridden parameter is not dispersed
    - cases, seed, algorithms: replace those of the file; the first algorithm is under test, the others are compared

    Raises DefinitionError with all problems: file (or option), key and allowed values.
    """
    path = find_campaign(name_or_path)
    tables = read_tables(path)
    options_by_key: dict[tuple[str, ...], str] = {}
    command = ["marsyard", "run", name_or_path]
    for override in overrides:
        option = f"--set {override}"
        tables = _apply_option(tables, _parse_override(override, option), option, options_by_key)
    if algorithms:
        tables = _select_algorithms(tables, algorithms, str(path), options_by_key)
    for key, option, value in (("cases", "-n", cases), ("seed", "--seed", seed)):
        if value is not None:
            tables[key] = value
            options_by_key[(key,)] = f"{option} {value}"
            command += [option, str(value)]
    for option, values in (("--algorithm", algorithms), ("--set", overrides)):
        command += [word for value in values for word in (option, value)]
    return replace(_validate(str(path), tables, options_by_key), command=tuple(command), file=path)


def create_campaign(tables: Mapping[str, Any], source: str) -> Campaign:
    """Create a campaign from tables of the form of a campaign file.

    source: name of the tables in messages
    Raises DefinitionError with all problems: key and allowed values.
    """
    return _validate(source, dict(tables), {})


def replace_algorithms(campaign: Campaign, algorithms: Sequence[str]) -> Campaign:
    """Return a campaign with other algorithms: the first is under test, the others are compared.

    Raises DefinitionError if the scenario has no selectable algorithms, or rejects them.
    """
    if not algorithms:
        return campaign
    source = f"campaign '{campaign.definition.name}'"
    tables = _select_algorithms(campaign.definition.model_dump(mode="json", exclude_none=True), algorithms, source, {})
    return replace(campaign, definition=create_campaign(tables, source).definition)


def _validate(source: str, tables: Mapping[str, Any], options_by_key: Mapping[tuple[str, ...], str]) -> Campaign:
    """Create a campaign from the tables of a file; missing parameters have default values."""
    problems: list[Problem] = []

    def add_problems(new_problems: Iterable[tuple[Key, str]], prefix: Key = ()) -> None:
        """Add problems at keys; their location is the file, or the command-line option that sets the key."""
        for key, message in new_problems:
            key, location = (*prefix, *key), source
            for path, option in options_by_key.items():
                common_length = min(len(key), len(path))
                if common_length and key[:common_length] == path[:common_length]:
                    location = option
                    break
            problems.append(Problem(location, key_text(key), message))

    def validate(model: type[Model], tables: Mapping[str, Any], prefix: Key = ()) -> Model | None:
        try:
            return model.model_validate(tables)
        except ValidationError as error:
            add_problems(validation_problems(error, model), prefix)
            return None

    tables, requirement_problems = fill_requirements(tables)
    add_problems(requirement_problems)
    if problems:
        raise DefinitionError(problems)
    definition, selected_scenario, parameters = validate(CampaignDefinition, tables), None, None
    try:
        if isinstance(name := tables.get("scenario"), str) and name:
            selected_scenario = scenario(name)
    except UnknownScenarioError as error:
        add_problems([(("scenario",), str(error))])
    values = tables.get("parameters", {})
    if selected_scenario is not None and isinstance(values, Mapping):
        parameters = validate(selected_scenario.parameters_type, values, ("parameters",))
    if definition is None or selected_scenario is None or parameters is None:
        raise DefinitionError(problems)
    complete_parameters = parameters.model_dump(mode="json", round_trip=True)
    campaign = Campaign(definition.model_copy(update={"parameters": complete_parameters}), selected_scenario)
    add_problems(find_campaign_problems(campaign))
    if problems:
        raise DefinitionError(problems)
    return campaign


def _parse_override(override: str, option: str) -> dict[str, Any]:
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


def _select_algorithms(
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
        tables = _apply_option(tables, nested_table, option, options_by_key)
    return tables


def _apply_option(
    tables: Mapping[str, Any], changes: Mapping[str, Any], option: str, options_by_key: dict[tuple[str, ...], str]
) -> dict[str, Any]:
    """Merge the tables with those of an option; parameters that the option sets are not dispersed."""
    merged = _merge_tables(tables, changes)
    paths = _list_paths(changes)
    options_by_key.update(dict.fromkeys(paths, option))
    parameter_paths = [".".join(path[1:]) for path in paths if path[0] == "parameters"]
    dispersions = merged.get("dispersions")
    if isinstance(dispersions, dict):
        path_pairs = ((path, key) for path in dispersions for key in parameter_paths)
        removed_paths = {path for path, key in path_pairs if paths_overlap(path, key)}
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


def _list_paths(tables: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """List the paths of all values in nested tables."""
    paths: list[tuple[str, ...]] = []
    for name, inner in tables.items():
        is_table = isinstance(inner, Mapping) and inner
        paths += [(name, *path) for path in _list_paths(inner)] if is_table else [(name,)]
    return paths


def _merge_tables(tables: Mapping[str, Any], updates: Mapping[str, Any]) -> dict[str, Any]:
    """Merge nested tables; values of `updates` replace those of `tables`."""
    merged = dict(tables)
    for name, value in updates.items():
        current = merged.get(name)
        if isinstance(current, Mapping) and isinstance(value, Mapping):
            value = _merge_tables(current, value)
        merged[name] = value
    return merged
