"""Template of a new campaign of descents."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from marsyard.scenarios.descent.parameters import binned_size_for
from marsyard.scenarios.template import CampaignTemplate, Choices
from marsyard.sim.camera import read_camera


def _binned_size(choices: Choices) -> Mapping[str, Any]:
    return {"binned_size": binned_size_for(*read_camera(choices.camera).size)} if choices.camera else {}


VELOCITY = CampaignTemplate(
    file=Path(__file__).with_name("new.toml.j2"),
    scale="descent",
    site="gusev",
    bound=5.0,
    bound_text="horizontal velocity within this many m/s (5 of the DIMES requirement)",
    values=_binned_size,
)
