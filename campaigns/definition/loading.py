"""Load a campaign: read its file, apply the command-line options, and report all problems together.

Dispersions and the columns of requirements are checked against the scenario before any case runs.
"""

from __future__ import annotations

import itertools
import json
import math
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from marsyard.campaigns.definition.campaign import Campaign, find_value, leaves, value_at
from marsyard.campaigns.definition.configuration import (
    POPULATIONS,
    CampaignConfiguration,
    Key,
    Requirement,
    current_path,
    key_text,
    read_tables,
    use_current_names,
    validation_problems,
)
from marsyard.campaigns.definition.identity import find_scenario, list_algorithms
from marsyard.campaigns.definition.requirements import fill_requirements
from marsyard.campaigns.errors import ConfigurationError, Problem, unknown_name_message
from marsyard.campaigns.sampling.design import ADAPTIVE, MATRICES
from marsyard.campaigns.sampling.dispersions import Choice, Fixed, Grid
from marsyard.scenarios.estimators import labels
from marsyard.scenarios.interface import HasAlgorithms, HasParts, Scenario
from marsyard.scenarios.parts.named import SCORE
from marsyard.scenarios.systems import RowColumns, UnknownScenarioError, row_columns, scenario, systems


def catalogue() -> dict[str, Path]:
    """Return the campaign files of all systems by campaign name, sorted."""
    return dict(sorted((name, path) for system in systems() for name, path in system.campaigns.items()))


#: Keys of the file that `--set` accepts; any other key is a parameter.
_FILE_KEYS = (
    *("parameters", "dispersions", "design", "retain", "limits"),
    *("cases", "seed", "name", "description", "scenario", "correlations"),
)
#: Number of cases whose sampled values are validated before the campaign starts; ranges are always checked.
_CHECKED_CASES = 32
#: Maximum number of dispersed parameters in the formulas of a dispersion, since all combinations of their extremes are
#: checked.
_MAX_VARYING = 8
#: Types of columns in requirements, as named in messages.
FLAGS, NUMBERS = "column of true and false", "column of numbers"
#: Columns that the campaign engine adds to those of the scenario.
_ENGINE_FLAGS, _ENGINE_NUMBERS = ("answered",), ("wall_time_s", "cpu_time_s")
Model = TypeVar("Model", bound=BaseModel)


def find_campaign(name_or_path: str) -> Path:
    """Return the file of a campaign, from its name in the catalogue or from the path of a TOML file.

    Raises ConfigurationError if there is no such file.
    """
    path = Path(name_or_path)
    if path.suffix == ".toml" or len(path.parts) > 1:
        if not path.is_file():
            raise ConfigurationError([Problem(str(path), "", "is a folder" if path.is_dir() else "no such file")])
        return path
    files = catalogue()
    if name_or_path not in files:
        message = f"{unknown_name_message('campaign', name_or_path, files)}, or the path of a TOML file"
        raise ConfigurationError([Problem("", "", message)])
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

    Raises ConfigurationError with all problems: file (or option), key and allowed values.
    """
    path = find_campaign(name_or_path)
    tables = read_tables(path)
    selected_scenario = find_scenario(tables.get("scenario"))
    if selected_scenario is not None:
        tables = use_current_names(tables, selected_scenario)
    options_by_key: dict[tuple[str, ...], str] = {}
    command = ["marsyard", "run", name_or_path]
    for override in overrides:
        option = f"--set {override}"
        tables = _apply_option(tables, _parse_override(override, option, selected_scenario), option, options_by_key)
    if algorithms:
        tables = _select_algorithms(tables, algorithms, str(path), options_by_key)
    for key, option, value in (("cases", "-n", cases), ("seed", "--seed", seed)):
        if value is not None:
            tables[key] = value
            options_by_key[(key,)] = f"{option} {value}"
            command += [option, str(value)]
    for option, values in (("--algorithm", algorithms), ("--set", overrides)):
        command += [word for value in values for word in (option, value)]
    return replace(_validate(str(path), tables, options_by_key), command=tuple(command))


def create_campaign(tables: Mapping[str, Any], source: str = "the campaign") -> Campaign:
    """Create a campaign from tables of the form of a campaign file.

    source: name of the tables in messages
    Raises ConfigurationError with all problems: key and allowed values.
    """
    selected_scenario = find_scenario(tables.get("scenario"))
    complete = dict(tables) if selected_scenario is None else use_current_names(dict(tables), selected_scenario)
    return _validate(source, complete, {})


def _parse_override(override: str, option: str, selected_scenario: Scenario | None) -> dict[str, Any]:
    """Parse ``KEY=VALUE`` into nested tables of a campaign file; a value that is not TOML is a text."""
    key, separator, value = override.partition("=")
    if not separator or not key.strip() or "\n" in override:
        raise ConfigurationError([Problem(option, "", "expected KEY=VALUE, such as --set render.backend=egl")])
    if selected_scenario is not None and key.split(".")[0].strip() not in _FILE_KEYS:
        key = current_path(selected_scenario.parameters_type, key.strip())
    try:
        try:
            values = tomllib.loads(f"{key} = {value.strip()}")
        except ValueError:
            values = tomllib.loads(f"{key} = {json.dumps(value.strip())}")
    except (ValueError, RecursionError) as error:
        raise ConfigurationError([Problem(option, "", f"'{key}' is not a dotted key: {error}")]) from error
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
        raise ConfigurationError([Problem(options[0], "", f"the scenario of {source} has no selectable algorithms")])
    settings: tuple[tuple[str, Any, str], ...] = (
        ("algorithm", algorithms[0], options[0]),
        ("compared", list(algorithms[1:]), " ".join(options[1:]) or options[0]),
    )
    for key, value, option in settings:
        nested_table: dict[str, Any] = {key: value}
        for part in reversed(("parameters", *selected_scenario.algorithm_table)):
            nested_table = {part: nested_table}
        tables = _apply_option(tables, nested_table, option, options_by_key)
    return tables


def replace_algorithms(campaign: Campaign, algorithms: Sequence[str]) -> Campaign:
    """Return a campaign with other algorithms: the first is under test, the others are compared.

    Raises ConfigurationError if the scenario has no selectable algorithms, or rejects them.
    """
    if not algorithms:
        return campaign
    selected, configuration, source = (
        campaign.scenario,
        campaign.configuration,
        f"campaign '{campaign.configuration.name}'",
    )
    if not isinstance(selected, HasAlgorithms):
        raise ConfigurationError([Problem(source, "", "its scenario has no selectable algorithms")])
    settings: dict[str, Any] = {"algorithm": algorithms[0], "compared": list(algorithms[1:])}
    for part in reversed(selected.algorithm_table):
        settings = {part: settings}
    paths = {".".join(path) for path in _list_paths(settings)}
    values = _merge(configuration.parameters, settings)
    try:
        parameters = selected.parameters_type.model_validate(values).model_dump(mode="json", round_trip=True)
    except ValidationError as error:
        found = validation_problems(error, selected.parameters_type)
        raise ConfigurationError(
            [Problem(source, key_text(("parameters", *key)), text) for key, text in found]
        ) from error
    dispersions = {path: item for path, item in configuration.dispersions.items() if path not in paths}
    changed = configuration.model_copy(update={"parameters": parameters, "dispersions": dispersions})
    return replace(campaign, configuration=changed)


def _apply_option(
    tables: Mapping[str, Any], settings: Mapping[str, Any], option: str, options_by_key: dict[tuple[str, ...], str]
) -> dict[str, Any]:
    """Merge the tables with those of an option; parameters that the option sets are not dispersed."""
    merged = _merge(tables, settings)
    paths = _list_paths(settings)
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


def _list_paths(tables: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """List the paths of all values in nested tables."""
    paths: list[tuple[str, ...]] = []
    for name, inner in tables.items():
        is_table = isinstance(inner, Mapping) and inner
        paths += [(name, *path) for path in _list_paths(inner)] if is_table else [(name,)]
    return paths


def _merge(tables: Mapping[str, Any], updates: Mapping[str, Any]) -> dict[str, Any]:
    """Merge nested tables; values of `updates` replace those of `tables`."""
    merged = dict(tables)
    for name, value in updates.items():
        current = merged.get(name)
        merged[name] = _merge(current, value) if isinstance(current, Mapping) and isinstance(value, Mapping) else value
    return merged


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
        raise ConfigurationError(problems)
    configuration, selected_scenario, parameters = validate(CampaignConfiguration, tables), None, None
    try:
        if isinstance(name := tables.get("scenario"), str) and name:
            selected_scenario = scenario(name)
    except UnknownScenarioError as error:
        add_problems([(("scenario",), str(error))])
    values = tables.get("parameters", {})
    if selected_scenario is not None and isinstance(values, Mapping):
        parameters = validate(selected_scenario.parameters_type, values, ("parameters",))
    if configuration is None or selected_scenario is None or parameters is None:
        raise ConfigurationError(problems)
    complete_parameters = parameters.model_dump(mode="json", round_trip=True)
    campaign = Campaign(configuration.model_copy(update={"parameters": complete_parameters}), selected_scenario)
    add_problems([*_check_sampling(campaign), *_check_metrics(campaign), *_check_calibration(campaign)])
    if problems:
        raise ConfigurationError(problems)
    return campaign


def _check_sampling(campaign: Campaign) -> list[tuple[Key, str]]:
    """List problems of the campaign's dispersions: keys, and messages with the allowed values."""
    if campaign.configuration.design.kind == ADAPTIVE:
        return [
            (("design", "kind"), "adaptive is for studies (marsyard rare); allowed: random, latin-hypercube, sobol")
        ]
    problems = [*campaign.configuration.find_sampling_problems(), *_check_names(campaign)] or _check_ranges(campaign)
    if problems or not campaign.configuration.dispersions:
        return problems
    for case in range(min(campaign.configuration.cases, _CHECKED_CASES)):
        try:
            error_text = _find_validation_error(campaign, campaign.draws(case))
        except ValueError as error:
            error_text = _extract_message(error)
        if error_text:
            return [(("dispersions",), f"the sampled values of case {case} are invalid in combination: {error_text}")]
    return []


def _check_calibration(campaign: Campaign) -> list[tuple[Key, str]]:
    """List unknown parameters among the calibrated options: keys, and messages with the allowed parameters."""
    calibration, problems = campaign.configuration.calibration, []
    parameters = dict(leaves(campaign.configuration.parameters))
    for index, run in enumerate(() if calibration is None else calibration.runs):
        for number, path in enumerate(run.options):
            if path not in parameters and not any(leaf.startswith(f"{path}.") for leaf in parameters):
                key: Key = ("calibration", "runs", index, "options", number)
                problems.append((key, _describe_unknown(path, parameters)))
    return problems


def _check_names(campaign: Campaign) -> list[tuple[Key, str]]:
    """List unknown parameters in dispersions or formulas, and cycles of formulas."""
    parameters = dict(leaves(campaign.configuration.parameters))
    dispersions = campaign.configuration.dispersions
    problems: list[tuple[Key, str]] = []
    for path, dispersion in dispersions.items():
        has_values = not isinstance(dispersion, Grid) or dispersion.values is not None
        allows_tables = isinstance(dispersion, Choice | Fixed | Grid) and has_values
        if path not in parameters and not any(leaf.startswith(f"{path}.") for leaf in parameters):
            problems.append((("dispersions", path), _describe_unknown(path, parameters)))
        elif path not in parameters and not allows_tables:
            message = "is a table; disperse one of its values, or use 'choice' or 'grid' over tables"
            problems.append((("dispersions", path), message))
        for key, name in ((key, name) for key, formula in dispersion.formulas.items() for name in formula.names):
            parent = next((table for table in dispersions if name.startswith(f"{table}.")), None)
            if parent is not None:
                message = f"'{name}' cannot be used: its table '{parent}' is dispersed as a whole"
            else:
                message = "" if name in parameters else _describe_unknown(name, parameters)
            problems += [(("dispersions", path, *key), message)] if message else []
    if not problems:
        try:
            campaign.order  # noqa: B018  (evaluates the property)
        except ValueError as error:
            problems.append((("dispersions",), str(error)))
    return problems


def _describe_unknown(path: str, parameters: Iterable[str]) -> str:
    """Create the message about an unknown path: it lists the parameters in the innermost existing table of the path."""
    allowed = names = list(parameters)
    table = path
    while table:
        table = table.rpartition(".")[0]
        prefix = f"{table}." if table else ""
        entries = [name.removeprefix(prefix).partition(".") for name in names if name.startswith(prefix)]
        if entries:
            allowed = list(dict.fromkeys(f"{prefix}{key}{'.*' if dot else ''}" for key, dot, _ in entries))
            break
    return unknown_name_message("parameter", path, names, allowed)


def _check_ranges(campaign: Campaign) -> list[tuple[Key, str]]:
    """List invalid parameter values and undefined formulas at the limits of the dispersions."""
    problems: list[tuple[Key, str]] = []
    extremes: dict[str, list[Any]] = {}
    for path in campaign.order:
        if any(name in campaign.marginals and name not in extremes for name in campaign.marginals[path].names):
            continue  # the problem of a dispersion in its formulas is already in the list
        try:
            values = _check_extremes(campaign, path, extremes)
        except ValueError as error:
            problems.append((("dispersions", path), _extract_message(error)))
            continue
        numbers = [value for value in values if isinstance(value, int | float) and not isinstance(value, bool)]
        all_numbers = len(numbers) == len(values)
        extremes[path] = list(dict.fromkeys((min(numbers), max(numbers)))) if all_numbers else values
    return problems


def _check_extremes(campaign: Campaign, path: str, extremes: Mapping[str, list[Any]]) -> list[Any]:
    """Compute the extreme values of a dispersion for all combinations of extremes of the parameters in its formulas.

    Raises ValueError for the first invalid value.
    """
    dispersion, parameters = campaign.marginals[path], campaign.configuration.parameters
    varying = [name for name in dispersion.names if name in extremes]
    if len(varying) > _MAX_VARYING:
        raise ValueError(f"its formulas contain {len(varying)} varying parameters; allowed: up to {_MAX_VARYING}")
    fixed_values = {name: value_at(parameters, name) for name in dispersion.names if name not in varying}
    extreme_values: list[Any] = []
    for corner in itertools.product(*(extremes[name] for name in varying)):
        values = dict(zip(varying, corner, strict=True))
        distribution = dispersion.insert_values({**fixed_values, **values})
        for value in distribution.extremes():
            error_text = _find_validation_error(campaign, {**values, path: value})
            if error_text:
                condition = "".join(f" where {name} = {number}" for name, number in values.items())
                text = f"{distribution.describe()} includes {value!r}{condition}, which is not valid: {error_text}"
                raise ValueError(text)
            extreme_values.append(value)
    return extreme_values


def _find_validation_error(campaign: Campaign, values: Mapping[str, Any]) -> str:
    """Return the validation error of the parameters with these values; empty if they are valid."""
    infinite_paths = [path for path, value in values.items() if isinstance(value, float) and not math.isfinite(value)]
    if infinite_paths:
        return f"{infinite_paths[0]} must be finite"
    try:
        campaign.with_values(values)
    except ValidationError as error:
        problems = validation_problems(error, campaign.scenario.parameters_type)
        return "; ".join(f"{key_text(key)}: {message}" if key else message for key, message in problems)
    return ""


def _extract_message(error: ValueError) -> str:
    """Return the message of an error, without the additions of pydantic."""
    if isinstance(error, ValidationError):
        return "; ".join(str(detail["msg"]).removeprefix("Value error, ") for detail in error.errors())
    return str(error)


def _check_metrics(campaign: Campaign) -> list[tuple[Key, str]]:
    """List columns of requirements that the scenario does not declare: keys, and messages with the allowed columns.

    Columns of custom scores are accepted by their prefix. Columns of a custom scenario are unknown before a run, so its
    first finished case is checked instead (`marsyard.campaigns.running.engine.check_metrics`).
    """
    try:
        columns = _collect_columns(campaign)
    except ValueError as error:
        return [(("scenario",), str(error))]
    if columns is None:
        return []
    compared = labels(list_algorithms(campaign.configuration))[1:]

    def is_known(name: str, kind: str) -> bool:
        column = next((name.removeprefix(f"{spec}.") for spec in compared if name.startswith(f"{spec}.")), name)
        return columns.has_number(column) if kind == NUMBERS else columns.has_flag(column)

    return find_unknown_columns(campaign.configuration.requirements, columns.flags, columns.numbers, is_known)


def find_unknown_columns(
    requirements: Sequence[Requirement],
    flags: Sequence[str],
    numbers: Sequence[str],
    is_known: Callable[[str, str], bool],
) -> list[tuple[Key, str]]:
    """List columns of requirements with an unknown name or kind: keys, and messages with the allowed columns."""
    problems: list[tuple[Key, str]] = []
    for index, requirement in enumerate(requirements):
        kind, allowed = (FLAGS, flags) if requirement.bound is None else (NUMBERS, numbers)
        columns = [("metric", name, kind, allowed) for name in requirement.metric_columns]
        columns += [("population", name, FLAGS, (*POPULATIONS, *flags)) for name in requirement.population_columns]
        columns += [("margin", requirement.margin, NUMBERS, numbers)] if requirement.margin is not None else []
        for key, name, required_kind, choices in columns:
            if not is_known(name, required_kind):
                problems.append((("requirements", index, key), unknown_name_message(required_kind, name, choices)))
    return problems


def _collect_columns(campaign: Campaign) -> RowColumns | None:
    """Collect the columns of the scenario and of the campaign's parameters; None if they are unknown."""
    configuration = campaign.configuration
    columns = row_columns(configuration.scenario)
    if columns is None:
        return None
    scores: list[str] = []
    keys = campaign.scenario.part_keys if isinstance(campaign.scenario, HasParts) else {}
    for path in (path for path, kind in keys.items() if kind is SCORE):
        if path in configuration.dispersions:
            return None
        scores += [f"{label}_*" for label in labels(find_value(configuration.parameters, path))]
    # boolean columns that the campaign file defines by name
    flags = find_value(configuration.parameters, columns.named_flags) if columns.named_flags else ()
    return replace(
        columns,
        flags=(*columns.flags, *_ENGINE_FLAGS, *(str(flag["name"]) for flag in flags), *scores),
        numbers=(*columns.numbers, *_ENGINE_NUMBERS, *scores),
    )
