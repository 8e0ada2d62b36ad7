"""Visual target tracking by a rover as a system under test."""

from __future__ import annotations

from marsyard.scenarios.system import SCENARIOS_FOLDER, System

VTT = System(
    name="vtt",
    title="Visual target tracking (VTT)",
    summary="Position of a target that a rover drives at, tracked in the pictures of its mast.",
    scenarios={
        "rover": "marsyard.scenarios.rover.scenario:RoverScenario",
        "rover-drive": "marsyard.scenarios.rover.scenario:SharedDriveScenario",
    },
    tasks=("marsyard.scenarios.estimators:TRACKING",),
    catalogue=SCENARIOS_FOLDER / "catalogue" / "vtt-*.toml",
    requirements=SCENARIOS_FOLDER / "requirements.toml",
    columns=SCENARIOS_FOLDER / "columns.toml",
    compiled_by={"vtt-checkout-2": ("world.samples=512", "start.distance_m=2.4", "target.diameter_m=0.5")},
    templates={"tracking": "marsyard.scenarios.rover.template:TRACKING"},
    report="marsyard.reports.vtt.presentation:VTT",
)
