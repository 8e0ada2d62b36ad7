"""Sources of error of a scenario's cases; an error budget removes them one by one (`marsyard budget`)."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from marsyard.scenarios.systems import find_system
from marsyard.scenarios.systems import scenario as find_scenario


@dataclass(frozen=True)
class ErrorSource:
    """A source of error.

    - name: short name, unique in its scenario; title: noun phrase for tables and figures
    - parameters: dotted paths of the parameters that cause the error
    - remaining: factor by which numeric parameters are multiplied to remove the error. It is 0 in general, and above 0
      if the on-board filter is tuned with the same parameter: with 0 the filter would assume a perfect sensor
    """

    name: str
    title: str
    parameters: tuple[str, ...]
    remaining: float = 0.0

    def exact_values(self, parameters: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values of the parameters without this error, by path; missing parameters are omitted.

        A number, or each number of a list, is multiplied by `remaining`. A switch becomes false, a table becomes None.
        Raises ValueError for a text.
        """
        values = {path: value for path in self.parameters for value in _find(parameters, path)}
        return {path: _exact_value(path, value, self.remaining) for path, value in values.items()}


def _find(tree: Any, path: str) -> Iterator[Any]:
    """Yield the value at a dotted path, or nothing if there is none."""
    for name in path.split("."):
        if not isinstance(tree, Mapping) or name not in tree:
            return
        tree = tree[name]
    yield tree


def _exact_value(path: str, value: Any, factor: float) -> Any:
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
def error_sources(scenario: str) -> tuple[ErrorSource, ...]:
    """Return the sources of error of a scenario, which is given by its name in campaign files; empty if it has none.

    A system under test defines the sources of its scenarios in a TOML file (`System.error_sources`). A scenario
    ``module:Class`` that belongs to no system defines them in the attribute `error_sources` of its class. Raises
    ValueError for an invalid file.
    """
    system = find_system(scenario)
    if system is None:
        return tuple(getattr(find_scenario(scenario), "error_sources", ()))
    if system.error_sources is None:
        return ()
    try:
        # a table contains sources by name; or `sources_of`, another scenario with the same sources, and `prefix`, the
        # table of their parameters in this scenario
        scenarios = tomllib.loads(system.error_sources.read_text(encoding="utf-8"))
        tables = scenarios.get(scenario, {})
        prefix = tables.get("prefix", "")
        tables = scenarios[tables["sources_of"]] if "sources_of" in tables else tables
        return tuple(
            ErrorSource(
                name,
                str(table["title"]),
                tuple(f"{prefix}{path}" for path in table["parameters"]),
                float(table.get("remaining", 0.0)),
            )
            for name, table in tables.items()
        )
    except (OSError, ValueError, LookupError, TypeError) as error:
        message = f"{system.error_sources}: invalid sources of error: {type(error).__name__}: {error}"
        raise ValueError(message) from error
