"""The helicopter field test of DIMES as a system under test."""

from __future__ import annotations

from marsyard.scenarios.system import SCENARIOS_FOLDER, System

FIELD_TEST = System(
    name="fieldtest",
    title="Field test of DIMES on a helicopter",
    summary="Horizontal velocity of a helicopter from triples of pictures over desert ground.",
    scenarios={"fieldtest": "marsyard.scenarios.fieldtest.scenario:FieldTestScenario"},
    tasks=("marsyard.scenarios.estimators:VELOCITY",),
    catalogue=SCENARIOS_FOLDER / "catalogue" / "dimes-fieldtest.toml",
    columns=SCENARIOS_FOLDER / "columns.toml",
    report="marsyard.reports.dimes.presentation:FIELD_TEST",
)
