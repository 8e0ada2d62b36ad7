"""Algorithms under test as described in a campaign's record: class, version, options, and a hash of the sources."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from marsyard.algorithms.exchange import parse_command
from marsyard.campaigns.definition.campaign import Campaign, value_at
from marsyard.campaigns.definition.identity import custom_sources, hash_sources, selected_algorithms
from marsyard.scenarios.estimators import Task, installed
from marsyard.scenarios.import_path import import_object, source_files
from marsyard.scenarios.interface import HasAlgorithms
from marsyard.scenarios.offline import is_offline


def describe_algorithms(campaign: Campaign) -> list[dict[str, Any]]:
    """Describe the algorithms that a campaign runs, the judged one first; empty where the scenario takes none.

    Keys of each entry: `spec` (the campaign's name for it), `role` (`judged` or `compared`), `path` (class as
    ``module:name``, or the file of the program or table), `version` (of the installed distribution, or the class's
    `version` attribute; None where there is neither), `options` and `source_hash` (SHA-256, 16 digits).
    """
    scenario = campaign.scenario
    if not isinstance(scenario, HasAlgorithms):
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
            **_describe(scenario.task, spec, parameters),
            "source_hash": _source_hash(scenario.task, spec),
        }
        for spec in selected_algorithms(campaign.configuration)
    ]


def _describe(task: Task[Any, Any], spec: str, parameters: BaseModel) -> dict[str, Any]:
    """Class or file, version and options of an algorithm."""
    if spec in task.shipped:
        stated = (value for _, value in parameters if isinstance(value, task.options))
        algorithm = task.shipped[spec](next(stated, task.options()))
        kind = type(algorithm)
        path, version = f"{kind.__module__}:{kind.__qualname__}", _distribution_version("marsyard")
        return {"path": path, "version": version, "options": _plain_options(getattr(algorithm, "options", None))}
    command = parse_command(spec)
    if command is not None or is_offline(spec):
        path = spec.partition(":")[2] if command is None else command.words[0]
        return {"path": path, "version": None, "options": {}}
    point = installed().get(spec)
    path, target = (spec, import_object(spec)) if point is None else (point.value, point.load())
    options = _plain_options(getattr(target, "options", None))
    return {"path": path, "version": _custom_version(path, target), "options": options}


def _custom_version(path: str, target: object) -> str | None:
    """Version of a custom algorithm: that of its distribution, or its `version` attribute."""
    top = path.partition(":")[0].partition(".")[0]
    versions = (_distribution_version(name) for name in metadata.packages_distributions().get(top, []))
    version = next((one for one in versions if one is not None), None) or getattr(target, "version", None)
    return version if isinstance(version, str) else None


def _distribution_version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _plain_options(options: object) -> dict[str, Any]:
    """Options as JSON values; empty where there are none, or JSON cannot hold them."""
    try:
        if isinstance(options, BaseModel):
            options = options.model_dump(mode="json")
        elif is_dataclass(options) and not isinstance(options, type):
            options = asdict(options)
        if not isinstance(options, Mapping):
            return {}
        plain: dict[str, Any] = json.loads(json.dumps({str(key): value for key, value in options.items()}, default=str))
    except Exception:  # custom values may raise anything, and the record must not stop a campaign
        return {}
    return plain


def _source_hash(task: Task[Any, Any], spec: str) -> str | None:
    """Hash of the names and contents of an algorithm's sources; None where no source can be read."""
    sources = list(source_files("algorithms:") if spec in task.shipped else custom_sources(spec))
    return hash_sources((name, Path(path)) for name, path in sources)[:16] if sources else None
