"""Template of landing campaigns."""

from __future__ import annotations

from pathlib import Path

from marsyard.scenarios.template import CampaignTemplate

LANDING = CampaignTemplate(
    file=Path(__file__).resolve().parent / "new.toml.j2",
    scale="ground",
    site="heli-hazardous",
    bound=0.99,
    bound_text="minimum fraction of safe sites among the selected sites",
    max_bound=1.0,
    unsupported_options={
        "flight": "--flight: only descents accept a recorded trajectory, and landing is not a descent"
    },
)
