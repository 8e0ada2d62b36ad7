"""Plan file of `marsyard nightly`: the campaigns and checks of each night, and the root seed of a night."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import MAX_CASES
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.definition.toml_models import read_table
from marsyard.sim.parameters import Parameters

#: The plan that is installed with Marsyard.
PLAN_FILE = Path(__file__).resolve().parents[1] / "scenarios" / "nightly.toml"

Texts = Annotated[tuple[str, ...], Field(strict=False)]


class PlannedCampaign(Parameters):
    """One campaign of the plan, with values that override its campaign file."""

    campaign: Annotated[str, Field(min_length=1)]
    cases: Annotated[int, Field(strict=True, ge=1, le=MAX_CASES)] | None = None
    override: Texts = Field(default=(), alias="set")
    algorithms: Texts = ()

    def load(self, seed: int, night: int, folder: Path) -> Campaign:
        """Load the campaign with the root seed of a night; relative paths start in `folder`, the folder of the plan."""
        path = folder / self.campaign
        name = str(path) if path.is_file() else self.campaign
        return load_campaign(name, self.override, self.cases, night_seed(seed, night), self.algorithms)


class PlannedCheck(Parameters):
    """A program to run each night after the campaigns, in the folder of the plan: speed benchmarks, for example."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][\w.-]*$", description="name on the page, and of its log file")]
    command: Annotated[tuple[str, ...], Field(strict=False, min_length=1, description="program and its arguments")]
    time_limit_s: Annotated[float, Field(gt=0.0)] = 3600.0


class Plan(Parameters):
    """Plan of the campaigns and checks to run each night, read from a TOML file."""

    seed: Annotated[int, Field(strict=True, ge=0, le=2**63 - 1)] = Field(
        default=0, description="seed from which the root seed of each night is derived: each night draws new cases"
    )
    campaigns: Annotated[tuple[PlannedCampaign, ...], Field(strict=False, min_length=1)]
    checks: Annotated[tuple[PlannedCheck, ...], Field(strict=False)] = ()

    @model_validator(mode="after")
    def _check_names(self) -> Plan:
        names = [entry.campaign for entry in self.campaigns]
        if len(set(names)) < len(names):
            raise ValueError("the plan contains a campaign twice; copy it to a second file with another name")
        if len({check.name for check in self.checks}) < len(self.checks):
            raise ValueError("the name of a check is used twice")
        return self


def read_plan(path: Path) -> Plan:
    """Read the plan from a file. Raises DefinitionError if the file is not readable or not valid."""
    return read_table(path, Plan)


def night_seed(seed: int, night: int) -> int:
    """Derive the root seed of a night (56 bits) by hashing the plan's seed and the night's number."""
    digest = hashlib.sha256(f"{seed}:{night}".encode()).digest()
    return int.from_bytes(digest[:7], "little")


def hash_definition(campaign: Campaign) -> str:
    """Hash a campaign's definition; only nights with equal definitions are compared.

    Seed, description, retained products, limits and number of cases are excluded.
    """
    excluded_keys = {"seed", "description", "retain", "limits", "cases"}
    definition = campaign.definition.model_dump(mode="json", exclude=excluded_keys)
    return hashlib.sha256(json.dumps(definition, sort_keys=True).encode()).hexdigest()
