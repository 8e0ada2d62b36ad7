"""A nightly's plan: which campaigns run every night."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.configuration import MAX_CASES, read_table
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.sim.parameters import Parameters

#: The plan that ships with Marsyard.
PLAN_FILE = Path(__file__).resolve().parents[1] / "scenarios" / "nightly.toml"

Texts = Annotated[tuple[str, ...], Field(strict=False)]


class PlannedCampaign(Parameters):
    """A campaign of the plan, with what is said of it instead of its file."""

    campaign: Annotated[str, Field(min_length=1)]
    cases: Annotated[int, Field(strict=True, ge=1, le=MAX_CASES)] | None = None
    override: Texts = Field(default=(), alias="set")
    algorithms: Texts = ()

    def load(self, seed: int, night: int, folder: Path) -> Campaign:
        """The campaign as it runs in a night: paths are from the plan's folder, the root seed is the night's own."""
        path = folder / self.campaign
        name = str(path) if path.is_file() else self.campaign
        return load_campaign(name, self.override, self.cases, night_seed(seed, night), self.algorithms)


class Plan(Parameters):
    """What runs every night."""

    seed: Annotated[int, Field(strict=True, ge=0, le=2**63 - 1)] = Field(
        default=0, description="of which each night's root seed is made, so that nights draw cases of their own"
    )
    campaigns: Annotated[tuple[PlannedCampaign, ...], Field(strict=False, min_length=1)]

    @model_validator(mode="after")
    def _check_names(self) -> Plan:
        names = [one.campaign for one in self.campaigns]
        if len(set(names)) < len(names):
            raise ValueError("a campaign is named twice; give it a file and a name of its own")
        return self


def read_plan(path: Path) -> Plan:
    """The plan in a file.

    Raises ConfigurationError where it cannot be read, or states something else.
    """
    return read_table(path, Plan)


def night_seed(seed: int, night: int) -> int:
    """The root seed of a night."""
    digest = hashlib.sha256(f"{seed}:{night}".encode()).digest()
    return int.from_bytes(digest[:7], "little")


def definition_of(campaign: Campaign) -> str:
    """A hash of what a campaign is, its seed and words aside: nights are compared where it is the same."""
    aside = {"seed", "description", "retain", "limits", "cases"}
    stated = campaign.configuration.model_dump(mode="json", exclude=aside)
    return hashlib.sha256(json.dumps(stated, sort_keys=True).encode()).hexdigest()
