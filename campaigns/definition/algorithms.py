"""The algorithms under test as a campaign's record names them: class, version, options, and a hash of the sources."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from marsyard.algorithms.exchange import command_of
from marsyard.campaigns.definition.campaign import Campaign, value_at
from marsyard.campaigns.definition.identity import chosen_algorithms, foreign_sources
from marsyard.scenarios.dotted import found_at, sources_at
from marsyard.scenarios.estimators import Task, installed
from marsyard.scenarios.interface import TakesAlgorithms
from marsyard.scenarios.offline import is_offline

#: Digits of a source hash; as many as tell any two sources apart that a reader may hold side by side.
_DIGITS = 16


def describe_algorithms(campaign: Campaign) -> list[dict[str, Any]]:
    """Describe the algorithms that a campaign runs, the one that is judged first.

    Returns
    -------
    A table for each algorithm: `spec` (as the campaign names it), `role` (`judged` or `compared`), `path` (class as
    ``module:name``, or the program's or table's file), `version` (of the installed distribution, or the `version`
    attribute of the class; None where there is neither), `options` and `source_hash` (SHA-256, shortened). Empty where
    the scenario has no choice of algorithms.
    """
    scenario = campaign.scenario
    if not isinstance(scenario, TakesAlgorithms):
        return []
    path = ".".join((*scenario.algorithm_table, "compared"))
    try:
        compared = value_at(campaign.configuration.parameters, path)
    except ValueError:
        compared = ()
    parameters: Any = campaign.base_parameters()
    for name in scenario.algorithm_table:
        parameters = getattr(parameters, name)
    return [
        {
            "spec": spec,
            "role": "compared" if spec in compared else "judged",
            **_described(scenario.task, spec, parameters),
            "source_hash": _source_hash(scenario.task, spec),
        }
        for spec in chosen_algorithms(campaign.configuration)
    ]


def _described(task: Task[Any, Any], spec: str, parameters: BaseModel) -> dict[str, Any]:
    """Class or file, version and options of an algorithm."""
    if spec in task.shipped:
        stated = (value for _, value in parameters if isinstance(value, task.options))
        made = task.shipped[spec](next(stated, task.options()))
        kind = type(made)
        return {
            "path": f"{kind.__module__}:{kind.__qualname__}",
            "version": _distribution_version("marsyard"),
            "options": _plain_options(getattr(made, "options", None)),
        }
    command = command_of(spec)
    if command is not None:
        return {"path": command.words[0], "version": None, "options": {}}
    if is_offline(spec):
        return {"path": spec.partition(":")[2], "version": None, "options": {}}
    point = installed().get(spec)
    path, found = (spec, found_at(spec)) if point is None else (point.value, point.load())
    return {
        "path": path,
        "version": _version(path, found),
        "options": _plain_options(getattr(found, "options", None)),
    }


def _version(path: str, found: object) -> str | None:
    """The version of a user's own algorithm: its distribution's, or its `version` attribute."""
    top = path.partition(":")[0].partition(".")[0]
    named = metadata.packages_distributions().get(top, [])
    versions = (_distribution_version(name) for name in named)
    version = next((one for one in versions if one is not None), None) or getattr(found, "version", None)
    return version if isinstance(version, str) else None


def _distribution_version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _plain_options(options: object) -> dict[str, Any]:
    """Options as JSON has them; empty where there are none, or JSON cannot hold them."""
    try:
        if isinstance(options, BaseModel):
            options = options.model_dump(mode="json")
        elif is_dataclass(options) and not isinstance(options, type):
            options = asdict(options)
        if not isinstance(options, Mapping):
            return {}
        plain: dict[str, Any] = json.loads(json.dumps({str(key): value for key, value in options.items()}, default=str))
    except Exception:  # values of a user's own may raise anything, and no campaign fails for its record's sake
        return {}
    return plain


def _source_hash(task: Task[Any, Any], spec: str) -> str | None:
    """A hash of the names and contents of an algorithm's sources; None where it has none that can be read."""
    sources = list(sources_at("algorithms:") if spec in task.shipped else foreign_sources(spec))
    digest = hashlib.sha256()
    for name, path in sources:
        contents = Path(path).read_bytes()
        digest.update(f"{name}\0{len(contents)}\0".encode())
        digest.update(contents)
    return digest.hexdigest()[:_DIGITS] if sources else None
