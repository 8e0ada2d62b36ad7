"""Template of tracking campaigns."""

from __future__ import annotations

from pathlib import Path

from marsyard.scenarios.template import CampaignTemplate

_NO_CAMERA_FILE = (
    "--camera and --detector: tracking uses the stereo cameras of a mast; see camera.preset and camera.custom"
)

TRACKING = CampaignTemplate(
    file=Path(__file__).resolve().parent / "new.toml.j2",
    scale="ground",
    site="mars-yard",
    bound=0.03,
    bound_text="maximum error of the target's position at the goal, m",
    unsupported_options={
        "camera": _NO_CAMERA_FILE,
        "detector": _NO_CAMERA_FILE,
        "flight": "--flight: only descents accept a recorded trajectory, and tracking is not a descent",
    },
)
