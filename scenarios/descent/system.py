"""The Descent Image Motion Estimation System as a system under test."""

from __future__ import annotations

from marsyard.scenarios.system import SCENARIOS_FOLDER, System

DIMES = System(
    name="dimes",
    title="Descent Image Motion Estimation System (DIMES)",
    summary="Horizontal velocity of a lander under its parachute, from three pictures.",
    scenarios={"descent": "marsyard.scenarios.descent.scenario:DescentScenario"},
    tasks=("marsyard.scenarios.estimators:VELOCITY",),
    catalogue=SCENARIOS_FOLDER / "catalogue" / "dimes-*.toml",
    requirements=SCENARIOS_FOLDER / "requirements.toml",
    columns=SCENARIOS_FOLDER / "columns.toml",
    compiled_by={"dimes-smoke": ("terrain.samples=512",)},
    templates={"velocity": "marsyard.scenarios.descent.template:VELOCITY"},
    report="marsyard.reports.dimes.presentation:DIMES",
)
