"""The template of a new campaign of landings."""

from __future__ import annotations

from pathlib import Path

from marsyard.scenarios.template import CampaignTemplate

LANDING = CampaignTemplate(
    file=Path(__file__).with_name("new.toml.j2"),
    scale="ground",
    site="heli-hazardous",
    bound=0.99,
    bound_text="fraction of chosen sites that must be safe",
    max_bound=1.0,
    refused={"flight": "--flight: only descents fly a file's trajectory, and landing is none"},
)
