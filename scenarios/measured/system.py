"""Recorded images as a system: other systems' algorithms on real images, compared with measured poses."""

from marsyard.scenarios.systems import System

SYSTEM = System(
    name="measured",
    title="Recorded images",
    summary="Algorithms on real images, compared with the measured poses.",
    scenarios={
        "measured-velocity": "marsyard.scenarios.measured.velocity:MeasuredVelocityScenario",
        "measured-landing": "marsyard.scenarios.measured.landing:MeasuredLandingScenario",
        "measured-matching": "marsyard.scenarios.measured.matching:MatchingScenario",
        "measured-map": "marsyard.scenarios.measured.over_map:OverMapScenario",
    },
    tasks=("marsyard.scenarios.velocity:VELOCITY", "marsyard.scenarios.landing_task:LANDING"),
    columns={
        "measured-velocity": "marsyard.scenarios.measured.columns:VELOCITY_COLUMNS",
        "measured-landing": "marsyard.scenarios.measured.columns:LANDING_COLUMNS",
        "measured-matching": "marsyard.scenarios.measured.columns:MATCHING_COLUMNS",
        "measured-map": "marsyard.scenarios.measured.columns:MAP_COLUMNS",
    },
    ingest="marsyard.scenarios.measured.ingest:ingest_campaign",
    report="marsyard.reports.measured.presentation:MEASURED",
)
