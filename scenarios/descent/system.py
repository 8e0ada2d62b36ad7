"""DIMES as a system: velocity of a lander under its parachute."""

from __future__ import annotations

from pathlib import Path

from marsyard.scenarios.systems import SCENARIOS_FOLDER, System

_FOLDER = Path(__file__).resolve().parent

SYSTEM = System(
    name="dimes",
    title="Descent Image Motion Estimation System (DIMES)",
    summary="Horizontal velocity of a lander under its parachute, from three images.",
    scenarios={"descent": "marsyard.scenarios.descent.scenario:DescentScenario"},
    tasks=("marsyard.scenarios.velocity:VELOCITY",),
    catalogue=_FOLDER / "catalogue" / "*.toml",
    requirements=_FOLDER / "requirements.toml",
    columns=SCENARIOS_FOLDER / "columns.toml",
    error_sources=SCENARIOS_FOLDER / "error_sources.toml",
    compilation_campaigns={"dimes-smoke": ("terrain.samples=512",)},
    templates={"velocity": "marsyard.scenarios.descent.template:VELOCITY"},
    report="marsyard.reports.dimes.presentation:DIMES",
)
