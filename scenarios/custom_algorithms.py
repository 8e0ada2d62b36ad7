"""Algorithms of users: their import paths, descriptions and source files."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Mapping
from contextlib import suppress
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from marsyard.algorithms import exchange
from marsyard.scenarios.imports import import_object, source_files
from marsyard.scenarios.isolation.remote import AlgorithmDescription, describe_in_process
from marsyard.scenarios.offline_algorithms import is_offline
from marsyard.scenarios.systems import systems

#: Entry point group of other packages' algorithms.
GROUP = "marsyard.algorithms"


def custom_path(spec: str, shipped: Collection[str] = ()) -> str:
    """Return the import path of a custom algorithm: of an entry point, or the given one.

    Raises ValueError, with the allowed names in the message, if there is no algorithm of this name.
    """
    if ":" in spec:
        return spec
    if spec in list_installed():
        return list_installed()[spec].value
    allowed = [*shipped, *list_installed()]
    matches = difflib.get_close_matches(spec, allowed, n=1)
    hint = f" (did you mean '{matches[0]}'?)" if matches else ""
    custom = "a custom one as 'module:Class' or 'exec:./program'"
    raise ValueError(f"unknown algorithm '{spec}'{hint}; allowed: {', '.join(allowed)}, or {custom}")


def describe_custom(spec: str, shipped: Collection[str] = ()) -> AlgorithmDescription:
    """Describe a custom algorithm, imported in a process of its own. Raises ValueError if it cannot be imported."""
    path = custom_path(spec, shipped)
    try:
        return describe_in_process(path)
    except ImportError as error:
        problem = (
            f"cannot import algorithm '{spec}'" if spec == path else f"algorithm '{spec}' cannot be loaded from {path}"
        )
        raise ValueError(f"{problem}: {error}") from error


def import_algorithm(path: str) -> Any:
    """Import a custom algorithm in this process. Raises ValueError with the reason."""
    try:
        return import_object(path)
    except ImportError as error:
        raise ValueError(f"cannot import algorithm '{path}': {error}") from error


@cache
def shipped_names() -> frozenset[str]:
    """Return the names of the systems' built-in algorithms."""
    names: set[str] = set()
    for path in dict.fromkeys(path for system in systems() for path in system.tasks):
        with suppress(ImportError):  # the campaigns of the system report the error
            names.update(import_object(path).shipped)
    return frozenset(names)


@cache
def list_installed() -> Mapping[str, EntryPoint]:
    """Return the algorithms of installed packages, sorted by name."""
    return {point.name: point for point in sorted(entry_points(group=GROUP), key=lambda point: point.name)}


def algorithm_sources(spec: str) -> list[tuple[str, Path]]:
    """Return names and paths of the source files of a user's Python algorithm; empty for all other algorithms."""
    path = list_installed()[spec].value if spec in list_installed() else spec
    is_external = is_offline(spec) or spec.startswith(tuple(exchange.PREFIXES))
    is_shipped = ":" not in spec and spec in shipped_names()
    return list(source_files(path)) if ":" in path and not is_external and not is_shipped else []
