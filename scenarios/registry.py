"""Look up scenarios: those of the systems by name, and those of a user by ``module:Class``."""

from __future__ import annotations

import difflib
from typing import cast

from marsyard.scenarios.import_path import import_object
from marsyard.scenarios.interface import Scenario
from marsyard.scenarios.systems import problems, scenario_paths


class UnknownScenarioError(LookupError):
    """No scenario has the name, or the path cannot be imported."""


def scenario_names() -> list[str]:
    """Return the names of the scenarios of all systems."""
    return sorted(scenario_paths())


def scenario(name: str) -> Scenario:
    """Create the scenario of a name, or of a class ``module:Class`` that implements `Scenario`.

    Raises UnknownScenarioError, whose message states the allowed names.
    """
    path = name if ":" in name else scenario_paths().get(name)
    if path is None:
        near = difflib.get_close_matches(name, scenario_names(), n=1)
        hint = f" (did you mean '{near[0]}'?)" if near else ""
        allowed = ", ".join(scenario_names())
        message = f"unknown scenario '{name}'{hint}; allowed: {allowed}, or your own as 'module:Class'"
        raise UnknownScenarioError("; ".join((message, *problems())))
    try:
        scenario_type = import_object(path)
    except ImportError as error:
        raise UnknownScenarioError(f"no scenario at '{path}': {error}") from error
    missing = [
        part for part in ("parameters_type", "shared_inputs", "prepare", "run") if not hasattr(scenario_type, part)
    ]
    if missing:
        raise UnknownScenarioError(f"'{path}' is not a scenario: it has no {', '.join(missing)}")
    return cast(Scenario, scenario_type())


def scenario_source(name: str) -> str:
    """Return ``module:Class`` of a scenario of another package; the name of any other."""
    path = scenario_paths().get(name, name)
    return name if path.startswith("marsyard.") else path
