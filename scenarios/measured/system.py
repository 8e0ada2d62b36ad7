"""Recorded pictures with measured poses as a system under test."""

from __future__ import annotations

from marsyard.scenarios.system import SCENARIOS_FOLDER, System

MEASURED = System(
    name="measured",
    title="Recorded pictures",
    summary="Algorithms on real pictures, compared with the measured poses.",
    scenarios={
        "measured-velocity": "marsyard.scenarios.measured.scenarios:MeasuredVelocityScenario",
        "measured-landing": "marsyard.scenarios.measured.scenarios:MeasuredLandingScenario",
        "measured-matching": "marsyard.scenarios.measured.scenarios:MatchingScenario",
    },
    tasks=("marsyard.scenarios.estimators:VELOCITY", "marsyard.scenarios.estimators:LANDING"),
    columns=SCENARIOS_FOLDER / "columns.toml",
    ingest="marsyard.scenarios.measured.ingest:ingest_campaign",
    report="marsyard.reports.measured.presentation:MEASURED",
)
