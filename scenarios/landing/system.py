"""Hazard detection and avoidance as a system under test."""

from __future__ import annotations

from marsyard.scenarios.system import SCENARIOS_FOLDER, System

HDA = System(
    name="hda",
    title="Hazard detection and avoidance (HDA)",
    summary="A safe landing site from two pictures of a moving camera.",
    scenarios={"landing": "marsyard.scenarios.landing.scenario:LandingScenario"},
    tasks=("marsyard.scenarios.estimators:LANDING",),
    catalogue=SCENARIOS_FOLDER / "catalogue" / "hda-*.toml",
    requirements=SCENARIOS_FOLDER / "requirements.toml",
    columns=SCENARIOS_FOLDER / "columns.toml",
    compiled_by={"hda-benign": ("terrain.samples=512",)},
    templates={"landing": "marsyard.scenarios.landing.template:LANDING"},
    report="marsyard.reports.hda.presentation:HDA",
)
