"""Loading of a campaign: read its file, apply the options of the command line, and report all problems at once."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.catalogue import catalogue
from marsyard.campaigns.definition.checking import metric_problems, sampling_problems
from marsyard.campaigns.definition.configuration import CampaignConfiguration, Key, key_text, problems_of, read_tables
from marsyard.campaigns.definition.requirements import completed
from marsyard.campaigns.errors import ConfigurationError, Problem, not_allowed
from marsyard.campaigns.sampling.correlation import KINDS
from marsyard.scenarios.interface import HasAlgorithms, Scenario
from marsyard.scenarios.registry import UnknownScenarioError, scenario

#: Keys of the file that `--set` may name; any other key is one of the parameters.
_FILE_KEYS = (
    *("parameters", "dispersions", "design", "retain", "limits"),
    *("cases", "seed", "name", "description", "scenario", "correlations"),
)

Model = TypeVar("Model", bound=BaseModel)


@dataclass(frozen=True)
class _Document:
    """Tables of a campaign file, and the command-line option behind each overridden key."""

    where: str
    tables: Mapping[str, Any]
    overridden: Mapping[tuple[str, ...], str]

    def problem(self, key: Key, message: str) -> Problem:
        """Problem at a key, located in the file or in an option of the command line."""
        for path, option in self.overridden.items():
            shared = min(len(key), len(path))
            if shared and key[:shared] == path[:shared]:
                return Problem(option, key_text(key), message)
        return Problem(self.where, key_text(key), message)


def find_campaign(name_or_path: str) -> Path:
    """File of a campaign given by its name in the catalogue or by the path of a TOML file.

    Raises ConfigurationError where there is none.
    """
    path = Path(name_or_path)
    if path.suffix == ".toml" or len(path.parts) > 1:
        if not path.is_file():
            raise ConfigurationError([Problem(str(path), "", "is a folder" if path.is_dir() else "no such file")])
        return path
    files = catalogue()
    if name_or_path not in files:
        message = f"{not_allowed('campaign', name_or_path, files)}, or the path of a TOML file"
        raise ConfigurationError([Problem("", "", message)])
    return files[name_or_path]


def load_campaign(
    name_or_path: str,
    overrides: Sequence[str] = (),
    cases: int | None = None,
    seed: int | None = None,
    algorithms: Sequence[str] = (),
) -> Campaign:
    """Read a campaign and check it as a whole.

    name_or_path: a name from the catalogue, or the path of a TOML file.
    overrides: ``KEY=VALUE`` each. KEY is a dotted path into the parameters or one of the file's own keys (`cases`,
    `seed`), VALUE is in TOML's notation or plain text. An overridden parameter is no longer dispersed.
    cases, seed: replace those of the file.
    algorithms: replace those of the file: the judged one, then those compared with it.
    Raises ConfigurationError that lists every problem by file (or option), key and allowed values.
    """
    path = find_campaign(name_or_path)
    tables = read_tables(path)
    overridden: dict[tuple[str, ...], str] = {}
    for override in overrides:
        tables = _apply_override(tables, override, overridden)
    if algorithms:
        tables = _select_algorithms(tables, algorithms, str(path), overridden)
    for key, option, value in (("cases", "-n", cases), ("seed", "--seed", seed)):
        if value is not None:
            tables[key] = value
            overridden[(key,)] = f"{option} {value}"
    words = ["marsyard", "run", name_or_path]
    words += [] if cases is None else ["-n", str(cases)]
    words += [] if seed is None else ["--seed", str(seed)]
    for option, values in (("--algorithm", algorithms), ("--set", overrides)):
        words += [word for value in values for word in (option, value)]
    return replace(_validate(_Document(str(path), tables, overridden)), command=tuple(words))


def _apply_override(tables: Mapping[str, Any], override: str, overridden: dict[tuple[str, ...], str]) -> dict[str, Any]:
    """Tables with one ``KEY=VALUE`` applied; notes its keys in `overridden`."""
    option = f"--set {override}"
    key, separator, value = override.partition("=")
    if not separator or not key.strip() or "\n" in override:
        raise ConfigurationError([Problem(option, "", "expected KEY=VALUE, such as --set render.backend=egl")])
    value = value.strip()
    try:
        try:
            stated = tomllib.loads(f"{key} = {value}")
        except ValueError:
            stated = tomllib.loads(f"{key} = {json.dumps(value)}")
    except (ValueError, RecursionError) as error:
        raise ConfigurationError([Problem(option, "", f"'{key}' is not a dotted key: {error}")]) from error
    if next(iter(stated)) not in _FILE_KEYS:
        stated = {"parameters": stated}
    return _apply_option(tables, stated, option, overridden)


def _select_algorithms(
    tables: Mapping[str, Any], algorithms: Sequence[str], where: str, overridden: dict[tuple[str, ...], str]
) -> dict[str, Any]:
    """Tables with other algorithms; unchanged for an unknown scenario, which is reported later."""
    options = [f"--algorithm {spec}" for spec in algorithms]
    name = tables.get("scenario")
    try:
        selected = scenario(name) if isinstance(name, str) and name else None
    except UnknownScenarioError:
        selected = None
    if selected is None:
        return dict(tables)
    if not isinstance(selected, HasAlgorithms):
        raise ConfigurationError([Problem(options[0], "", f"the scenario of {where} has no choice of algorithms")])
    changed = dict(tables)
    stated: tuple[tuple[str, Any, str], ...] = (
        ("algorithm", algorithms[0], options[0]),
        ("compared", list(algorithms[1:]), " ".join(options[1:]) or options[0]),
    )
    for key, value, option in stated:
        inner: dict[str, Any] = {key: value}
        for part in reversed(("parameters", *selected.algorithm_table)):
            inner = {part: inner}
        changed = _apply_option(changed, inner, option, overridden)
    return changed


def _apply_option(
    tables: Mapping[str, Any], stated: Mapping[str, Any], option: str, overridden: dict[tuple[str, ...], str]
) -> dict[str, Any]:
    """Tables merged with those of an option; parameters that it sets are no longer dispersed."""
    merged = _merge(tables, stated)
    paths = _paths_set(stated)
    overridden.update(dict.fromkeys(paths, option))
    fixed = {".".join(path[1:]) for path in paths if path[0] == "parameters"}
    dispersions = merged.get("dispersions")
    if fixed and isinstance(dispersions, dict):
        kept = {path: one for path, one in dispersions.items() if not any(_overlap(path, other) for other in fixed)}
        removed = set(dispersions).difference(kept)
        merged["dispersions"] = kept
        if removed and isinstance(merged.get("correlations"), list):
            groups = [_without_members(group, removed) for group in merged["correlations"]]
            merged["correlations"] = [group for group in groups if group != {}]
    return merged


def _without_members(group: Any, removed: set[str]) -> Any:
    """Correlated group without removed dispersions; empty where none is left; unchanged where it is not valid."""
    names = group.get("parameters") if isinstance(group, Mapping) else None
    if not isinstance(names, list):
        return group
    kept = [index for index, name in enumerate(names) if name not in removed]
    try:
        matrices = {kind: [[rows[i][j] for j in kept] for i in kept] for kind in KINDS if (rows := group.get(kind))}
    except (IndexError, KeyError, TypeError):
        return group
    return {**group, "parameters": [names[index] for index in kept], **matrices} if kept else {}


def _overlap(path: str, other: str) -> bool:
    """Whether two paths are equal, or one contains the other."""
    return f"{path}.".startswith(f"{other}.") or other.startswith(f"{path}.")


def _paths_set(tables: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Keys at which nested tables hold a value."""
    paths: list[tuple[str, ...]] = []
    for name, inner in tables.items():
        nested = isinstance(inner, Mapping) and inner
        paths += [(name, *path) for path in _paths_set(inner)] if nested else [(name,)]
    return paths


def _merge(tables: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(tables)
    for name, value in other.items():
        mine = merged.get(name)
        merged[name] = _merge(mine, value) if isinstance(mine, Mapping) and isinstance(value, Mapping) else value
    return merged


def _validate(document: _Document) -> Campaign:
    """Campaign of a document, its parameters completed with their defaults."""
    tables, unresolved = completed(document.tables)
    problems = [document.problem(key, message) for key, message in unresolved]
    if problems:
        raise ConfigurationError(problems)
    configuration = _validate_model(CampaignConfiguration, document, tables, (), problems)
    selected = _find_scenario(document, problems)
    parameters = None
    stated = document.tables.get("parameters", {})
    if selected is not None and isinstance(stated, Mapping):
        parameters = _validate_model(selected.parameters_type, document, stated, ("parameters",), problems)
    if configuration is None or selected is None or parameters is None:
        raise ConfigurationError(problems)
    complete = parameters.model_dump(mode="json", round_trip=True)
    campaign = Campaign(configuration.model_copy(update={"parameters": complete}), selected)
    invalid = [*sampling_problems(campaign), *metric_problems(campaign)]
    problems += [document.problem(key, message) for key, message in invalid]
    if problems:
        raise ConfigurationError(problems)
    return campaign


def _validate_model(
    model: type[Model], document: _Document, tables: Mapping[str, Any], prefix: Key, problems: list[Problem]
) -> Model | None:
    """Model of some tables, or None with its problems appended."""
    try:
        return model.model_validate(tables)
    except ValidationError as error:
        problems += [document.problem((*prefix, *key), message) for key, message in problems_of(error, model)]
        return None


def _find_scenario(document: _Document, problems: list[Problem]) -> Scenario | None:
    """Scenario of a document, or None with its problem appended."""
    name = document.tables.get("scenario")
    if not isinstance(name, str) or not name:
        return None
    try:
        return scenario(name)
    except UnknownScenarioError as error:
        problems.append(document.problem(("scenario",), str(error)))
        return None
