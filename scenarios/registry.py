"""The scenarios that campaign files can name: those that ship with Marsyard, and a user's own by dotted path."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import cast

from marsyard.scenarios.dotted import found_at
from marsyard.scenarios.interface import Scenario

#: Where each scenario's class is found; imported only when asked for.
SCENARIOS: Mapping[str, str] = {
    "descent": "marsyard.scenarios.descent:DescentScenario",
    "fieldtest": "marsyard.scenarios.fieldtest:FieldTestScenario",
    "rover": "marsyard.scenarios.rover:RoverScenario",
    "rover-drive": "marsyard.scenarios.rover:SharedDriveScenario",
    "landing": "marsyard.scenarios.landing:LandingScenario",
    "measured-velocity": "marsyard.scenarios.measured.descent:MeasuredVelocityScenario",
    "measured-landing": "marsyard.scenarios.measured.landing:MeasuredLandingScenario",
    "measured-matching": "marsyard.scenarios.measured.matching:MatchingScenario",
}


class UnknownScenarioError(LookupError):
    """No scenario has that name, or none is found where a dotted path points."""


def scenario_names() -> list[str]:
    """Names of the scenarios that ship with Marsyard."""
    return sorted(SCENARIOS)


def scenario(name: str) -> Scenario:
    """The scenario of a name, or of a path ``module:Class`` to a class that implements `Scenario`.

    Raises
    ------
    UnknownScenarioError
        Where there is none; the message says what is allowed.
    """
    path = name if ":" in name else SCENARIOS.get(name)
    if path is None:
        near = difflib.get_close_matches(name, SCENARIOS, n=1)
        hint = f" (did you mean '{near[0]}'?)" if near else ""
        allowed = ", ".join(scenario_names())
        raise UnknownScenarioError(
            f"unknown scenario '{name}'{hint}; allowed: {allowed}, or your own as 'module:Class'"
        )
    return _from_path(path)


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
