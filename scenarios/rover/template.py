"""The template of a new campaign of drives."""

from __future__ import annotations

from pathlib import Path

from marsyard.scenarios.template import CampaignTemplate

_MAST = "--camera and --detector: tracking looks through a mast's stereo pair; see camera.preset and camera.custom"

TRACKING = CampaignTemplate(
    file=Path(__file__).with_name("new.toml.j2"),
    scale="ground",
    site="mars-yard",
    bound=0.03,
    bound_text="position of the target within this many metres at the goal",
    refused={
        "camera": _MAST,
        "detector": _MAST,
        "flight": "--flight: only descents fly a file's trajectory, and tracking is none",
    },
)
