"""Finds a campaign's file, reads it, applies overrides, and checks it as a whole: all that is wrong is said at once."""

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
from marsyard.campaigns.definition.checking import sampling_problems
from marsyard.campaigns.definition.configuration import CampaignConfiguration, Key, key_text, problems_of, read_tables
from marsyard.campaigns.definition.metrics import metric_problems
from marsyard.campaigns.definition.requirements import completed
from marsyard.campaigns.errors import ConfigurationError, Problem, not_allowed
from marsyard.campaigns.sampling.correlation import KINDS
from marsyard.scenarios.interface import Scenario, TakesAlgorithms
from marsyard.scenarios.registry import UnknownScenarioError, scenario

_TABLES = ("parameters", "dispersions", "design", "retain", "limits")
_PLAIN = ("cases", "seed", "name", "description", "scenario", "correlations")


Model = TypeVar("Model", bound=BaseModel)


@dataclass(frozen=True)
class _Document:
    """A campaign's text as read, and from where each key that was set on the command line came."""

    where: str
    tables: Mapping[str, Any]
    overridden: Mapping[tuple[str, ...], str]

    def problem(self, key: Key, message: str) -> Problem:
        """States a problem where it was written: in the file, or in an option of the command line."""
        for path, option in self.overridden.items():
            shared = min(len(key), len(path))
            if shared and key[:shared] == path[:shared]:
                return Problem(option, key_text(key), message)
        return Problem(self.where, key_text(key), message)


def find_campaign(name_or_path: str) -> Path:
    """The file of a campaign given by its name in the catalogue or by the path of a TOML file.

    Raises
    ------
    ConfigurationError
        Where there is none.
    """
    path = Path(name_or_path)
    if path.suffix == ".toml" or len(path.parts) > 1:
        if not path.is_file():
            raise ConfigurationError([Problem(str(path), "", "is a folder" if path.is_dir() else "no such file")])
        return path
    known = catalogue()
    if name_or_path not in known:
        raise ConfigurationError(
            [Problem("", "", f"{not_allowed('campaign', name_or_path, known)}, or the path of a TOML file")]
        )
    return known[name_or_path]


def load_campaign(
    name_or_path: str,
    overrides: Sequence[str] = (),
    cases: int | None = None,
    seed: int | None = None,
    algorithms: Sequence[str] = (),
) -> Campaign:
    """Reads a campaign and checks it whole.

    Parameters
    ----------
    name_or_path
        A name from the catalogue, or the path of a TOML file.
    overrides
        ``KEY=VALUE`` each: KEY a dotted path into the parameters or one of the file's own keys (`cases`, `seed`, ...),
        VALUE in TOML's notation or plain text. A dispersed parameter set so is no longer dispersed.
    cases, seed
        Instead of the file's.
    algorithms
        Instead of the file's algorithms: the one that is judged, then those that are compared with it.

    Raises
    ------
    ConfigurationError
        Names every problem by file (or option), key and what is allowed.
    """
    path = find_campaign(name_or_path)
    tables = read_tables(path)
    overridden: dict[tuple[str, ...], str] = {}
    for override in overrides:
        tables = _override(tables, override, overridden)
    if algorithms:
        tables = _choose(tables, algorithms, str(path), overridden)
    for key, option, value in (("cases", "-n", cases), ("seed", "--seed", seed)):
        if value is not None:
            tables[key] = value
            overridden[(key,)] = f"{option} {value}"
    return replace(
        _checked(_Document(str(path), tables, overridden)),
        command=_command(name_or_path, overrides, cases, seed, algorithms),
    )


def _command(
    name_or_path: str, overrides: Sequence[str], cases: int | None, seed: int | None, algorithms: Sequence[str]
) -> tuple[str, ...]:
    """The words of the command that loads the same campaign and runs it."""
    words = ["marsyard", "run", name_or_path]
    words += [] if cases is None else ["-n", str(cases)]
    words += [] if seed is None else ["--seed", str(seed)]
    for option, values in (("--algorithm", algorithms), ("--set", overrides)):
        words += [word for value in values for word in (option, value)]
    return tuple(words)


def _override(tables: Mapping[str, Any], override: str, overridden: dict[tuple[str, ...], str]) -> dict[str, Any]:
    """The tables with one ``KEY=VALUE`` put in; notes under which key it went."""
    option = f"--set {override}"
    key, separator, value = override.partition("=")
    if not separator or not key.strip() or "\n" in override:
        raise ConfigurationError([Problem(option, "", "expected KEY=VALUE, such as --set render.backend=egl")])
    try:
        stated = _parse(key, value.strip())
    except (ValueError, RecursionError) as error:
        raise ConfigurationError([Problem(option, "", f"'{key}' is not a dotted key: {error}")]) from error
    first = next(iter(stated))
    if first not in (*_TABLES, *_PLAIN):
        stated = {"parameters": stated}
    return _put(tables, stated, option, overridden)


def _choose(
    tables: Mapping[str, Any], algorithms: Sequence[str], where: str, overridden: dict[tuple[str, ...], str]
) -> dict[str, Any]:
    """The tables with other algorithms put in; as they are where there is no such scenario, which is told later."""
    options = [f"--algorithm {spec}" for spec in algorithms]
    name = tables.get("scenario")
    try:
        found = scenario(name) if isinstance(name, str) and name else None
    except UnknownScenarioError:
        found = None
    if found is None:
        return dict(tables)
    if not isinstance(found, TakesAlgorithms):
        raise ConfigurationError([Problem(options[0], "", f"the scenario of {where} has no choice of algorithms")])
    chosen = dict(tables)
    stated: tuple[tuple[str, Any, str], ...] = (
        ("algorithm", algorithms[0], options[0]),
        ("compared", list(algorithms[1:]), " ".join(options[1:]) or options[0]),
    )
    for key, value, option in stated:
        inner: dict[str, Any] = {key: value}
        for part in reversed(("parameters", *found.algorithm_table)):
            inner = {part: inner}
        chosen = _put(chosen, inner, option, overridden)
    return chosen


def _put(
    tables: Mapping[str, Any], stated: Mapping[str, Any], option: str, overridden: dict[tuple[str, ...], str]
) -> dict[str, Any]:
    """The tables with what an option states put over them; what it fixes is no longer dispersed."""
    merged = _merge(tables, stated)
    paths = _paths_set(stated)
    overridden.update(dict.fromkeys(paths, option))
    fixed = {".".join(path[1:]) for path in paths if path[0] == "parameters"}
    dispersions = merged.get("dispersions")
    if fixed and isinstance(dispersions, dict):
        kept = {path: stated for path, stated in dispersions.items() if not _under(path, fixed)}
        gone = set(dispersions).difference(kept)
        merged["dispersions"] = kept
        if gone and isinstance(merged.get("correlations"), list):
            groups = [_without_members(group, gone) for group in merged["correlations"]]
            merged["correlations"] = [group for group in groups if group != {}]
    return merged


def _without_members(group: Any, gone: set[str]) -> Any:
    """A correlated group without the dispersions that are gone; empty where none is left; as it is where it is none."""
    names = group.get("parameters") if isinstance(group, Mapping) else None
    if not isinstance(names, list):
        return group
    places = [place for place, name in enumerate(names) if name not in gone]
    try:
        matrices = {kind: [[rows[i][j] for j in places] for i in places] for kind in KINDS if (rows := group.get(kind))}
    except (IndexError, KeyError, TypeError):
        return group
    return {**group, "parameters": [names[place] for place in places], **matrices} if places else {}


def _parse(key: str, value: str) -> dict[str, Any]:
    """One assignment, its value in TOML's notation or, where it is none, as plain text."""
    try:
        return tomllib.loads(f"{key} = {value}")
    except ValueError:
        return tomllib.loads(f"{key} = {json.dumps(value)}")


def _under(path: str, fixed: set[str]) -> bool:
    """Whether a path is one of those fixed, inside one of them, or a table that holds one of them."""
    return any(f"{path}.".startswith(f"{other}.") or other.startswith(f"{path}.") for other in fixed)


def _paths_set(tables: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """The keys at which an override holds a value."""
    paths: list[tuple[str, ...]] = []
    for name, inner in tables.items():
        if isinstance(inner, Mapping) and inner:
            paths += [(name, *path) for path in _paths_set(inner)]
        else:
            paths.append((name,))
    return paths


def _merge(tables: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """Tables with others' values put over theirs."""
    merged = dict(tables)
    for name, value in other.items():
        mine = merged.get(name)
        merged[name] = _merge(mine, value) if isinstance(mine, Mapping) and isinstance(value, Mapping) else value
    return merged


def _checked(document: _Document) -> Campaign:
    """The campaign that a document states, its parameters complete with their defaults."""
    tables, unnamed = completed(document.tables)
    problems = [document.problem(key, message) for key, message in unnamed]
    if problems:
        raise ConfigurationError(problems)
    configuration = _validated(CampaignConfiguration, document, tables, (), problems)
    found = _scenario(document, problems)
    parameters = None
    if found is not None:
        stated = document.tables.get("parameters", {})
        if isinstance(stated, Mapping):
            parameters = _validated(found.parameters_type, document, stated, ("parameters",), problems)
    if configuration is None or found is None or parameters is None:
        raise ConfigurationError(problems)
    complete = parameters.model_dump(mode="json", round_trip=True)
    campaign = Campaign(configuration.model_copy(update={"parameters": complete}), found)
    found_wrong = [*sampling_problems(campaign), *metric_problems(campaign)]
    problems += [document.problem(key, message) for key, message in found_wrong]
    if problems:
        raise ConfigurationError(problems)
    return campaign


def _validated(
    model: type[Model], document: _Document, tables: Mapping[str, Any], prefix: Key, problems: list[Problem]
) -> Model | None:
    """The model that tables state, or None with the problems noted."""
    try:
        return model.model_validate(tables)
    except ValidationError as error:
        problems += [document.problem((*prefix, *key), message) for key, message in problems_of(error, model)]
        return None


def _scenario(document: _Document, problems: list[Problem]) -> Scenario | None:
    """The scenario that a document names, or None with the problem noted."""
    name = document.tables.get("scenario")
    if not isinstance(name, str) or not name:
        return None
    try:
        return scenario(name)
    except UnknownScenarioError as error:
        problems.append(document.problem(("scenario",), str(error)))
        return None
