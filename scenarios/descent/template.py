"""Template of descent campaigns."""

from __future__ import annotations

from pathlib import Path

from marsyard.algorithms.dimes.binning import binned_size_for
from marsyard.scenarios.template import CampaignTemplate
from marsyard.sim.camera import read_camera

VELOCITY = CampaignTemplate(
    file=Path(__file__).resolve().parent / "new.toml.j2",
    scale="descent",
    site="gusev",
    bound=5.0,
    bound_text="maximum error of the horizontal velocity, m/s (DIMES requirement: 5)",
    values=lambda choices: (
        {"binned_size": binned_size_for(*read_camera(choices.camera).size)} if choices.camera else {}
    ),
)
