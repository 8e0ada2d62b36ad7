"""Sources of error of a scenario's cases; an error budget removes them one by one (`marsyard budget`)."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from pydantic import BaseModel

from marsyard.scenarios.systems import scenario as find_scenario
from marsyard.sim.error_sources import ErrorSource
from marsyard.sim.parameters import list_alternatives, list_models


@dataclass(frozen=True)
class ScenarioSource:
    """A source of error of a scenario, and the dotted paths of the parameters that cause it."""

    source: ErrorSource
    parameters: tuple[str, ...]

    @property
    def name(self) -> str:
        """Short name, unique in the scenario."""
        return self.source.name

    @property
    def title(self) -> str:
        """Noun phrase for tables and figures."""
        return self.source.title

    def exact_values(self, parameters: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values of the parameters without this error, by path; missing parameters are omitted.

        A number, or each number of a list, is multiplied by `ErrorSource.remaining`. A switch becomes false, a table
        becomes None. Raises ValueError for a text.
        """
        values = {path: value for path in self.parameters for value in _find(parameters, path)}
        return {path: _exact_value(path, value, self.source.remaining) for path, value in values.items()}


def _find(tree: Any, path: str) -> Iterator[Any]:
    """Yield the value at a dotted path, or nothing if there is none."""
    for name in path.split("."):
        if not isinstance(tree, Mapping) or name not in tree:
            return
        tree = tree[name]
    yield tree


def _exact_value(path: str, value: Any, factor: float) -> Any:
    """Return the value without its error, see `ScenarioSource.exact_values`; `path` is used in the message."""
    if isinstance(value, bool):
        return False
    if isinstance(value, int | float):
        return type(value)(factor * value)
    if isinstance(value, list | tuple):
        return [_exact_value(path, item, factor) for item in value]
    if value is None or isinstance(value, Mapping):
        return None
    raise ValueError(f"{path}: a source of error must be a number, a switch or a table, not {value!r}")


@cache
def error_sources(scenario: str) -> tuple[ScenarioSource, ...]:
    """Return the sources of error of a scenario, which is given by its name or ``module:Class``; empty without any.

    They are the marks (`marsyard.sim.error_sources`) on its parameters.
    """
    paths: dict[ErrorSource, dict[str, None]] = {}
    for path, source in _walk_marks(find_scenario(scenario).parameters_type):
        paths.setdefault(source, {})[path] = None
    return tuple(ScenarioSource(source, tuple(parameters)) for source, parameters in paths.items())


def _walk_marks(
    model: type[BaseModel], prefix: str = "", outer: ErrorSource | None = None
) -> Iterator[tuple[str, ErrorSource]]:
    """Yield the path and source of each marked parameter of a model; `outer` replaces the sources inside."""
    for name, field in model.model_fields.items():
        path, own = f"{prefix}{name}", next((mark for mark in field.metadata if isinstance(mark, ErrorSource)), None)
        alternatives = list_alternatives(field.annotation)
        tables = list_models(field.annotation)
        is_optional_table = bool(tables) and type(None) in alternatives
        if own is not None and (is_optional_table or not tables):
            yield path, outer or own
            continue
        for table in tables:
            yield from _walk_marks(table, f"{path}.", outer or own)
