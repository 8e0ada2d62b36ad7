"""Hazard detection and avoidance as a system: a helicopter selects its landing site."""

from __future__ import annotations

from pathlib import Path

from marsyard.scenarios.systems import SCENARIOS_FOLDER, System

_FOLDER = Path(__file__).resolve().parent

SYSTEM = System(
    name="hda",
    title="Hazard detection and avoidance (HDA)",
    summary="A safe landing site from two images of a moving camera.",
    scenarios={"landing": "marsyard.scenarios.landing.scenario:LandingScenario"},
    tasks=("marsyard.scenarios.landing_site:LANDING",),
    catalogue=_FOLDER / "catalogue" / "*.toml",
    requirements=_FOLDER / "requirements.toml",
    columns=SCENARIOS_FOLDER / "columns.toml",
    error_sources=SCENARIOS_FOLDER / "error_sources.toml",
    compilation_campaigns={"hda-benign": ("terrain.samples=512",)},
    templates={"landing": "marsyard.scenarios.landing.template:LANDING"},
    report="marsyard.reports.hda.presentation:HDA",
)
