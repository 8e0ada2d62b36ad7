"""The scenarios that campaign files can name: those of the systems, and a user's own by ``module:Class``."""

from __future__ import annotations

import difflib
from typing import cast

from marsyard.scenarios.dotted import found_at
from marsyard.scenarios.interface import Scenario
from marsyard.scenarios.systems import problems, scenario_paths


class UnknownScenarioError(LookupError):
    """No scenario has that name, or none is found where a dotted path points."""


def scenario_names() -> list[str]:
    """Names of the scenarios of all systems."""
    return sorted(scenario_paths())


def scenario(name: str) -> Scenario:
    """The scenario of a name, or of a path ``module:Class`` to a class that implements `Scenario`.

    Raises
    ------
    UnknownScenarioError
        Where there is none; the message says what is allowed.
    """
    path = name if ":" in name else scenario_paths().get(name)
    if path is None:
        near = difflib.get_close_matches(name, scenario_names(), n=1)
        hint = f" (did you mean '{near[0]}'?)" if near else ""
        allowed = ", ".join(scenario_names())
        message = f"unknown scenario '{name}'{hint}; allowed: {allowed}, or your own as 'module:Class'"
        raise UnknownScenarioError("; ".join((message, *problems())))
    return _from_path(path)


def scenario_source(name: str) -> str:
    """``module:Class`` of a scenario whose code is not Marsyard's; the name itself of any other."""
    path = scenario_paths().get(name, name)
    return name if path.startswith("marsyard.") else path


def _from_path(path: str) -> Scenario:
    """An instance of the class at ``module:Class``."""
    try:
        found = found_at(path)
    except ImportError as error:
        raise UnknownScenarioError(f"no scenario at '{path}': {error}") from error
    missing = [part for part in ("parameters_type", "shared_inputs", "prepare", "run") if not hasattr(found, part)]
    if missing:
        raise UnknownScenarioError(f"'{path}' is not a scenario: it has no {', '.join(missing)}")
    return cast(Scenario, found())
