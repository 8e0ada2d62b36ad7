"""Variants of the models of a system: alternatives to assumed or calibrated values (`variants.toml` of its folder)."""

from typing import Annotated, Any

from pydantic import Field

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.parameter_paths import value_at
from marsyard.campaigns.definition.toml_models import read_model
from marsyard.scenarios.systems import find_system
from marsyard.sim.parameters import Parameters


class SystemVariant(Parameters):
    """A named variant of the models of a system.

    - values: values of parameters, by path; factors: factors of the campaign's values, or of the sampled values of a
      dispersed parameter
    - source: why this alternative is possible
    """

    name: Annotated[str, Field(pattern=r"^[a-z0-9-]+$")]
    title: str
    values: dict[str, Any] = Field(default_factory=dict)
    factors: dict[str, float] = Field(default_factory=dict)
    source: str

    def changes(self, campaign: Campaign) -> tuple[dict[str, Any], dict[str, float]]:
        """Return the values by path, and the factors of dispersed parameters.

        Both are empty if the campaign has these values, or lacks one of the parameters.
        """
        parameters, dispersed = campaign.definition.parameters, campaign.definition.dispersions
        try:
            own = {path: value_at(parameters, path) for path in (*self.values, *self.factors)}
        except ValueError:
            return {}, {}
        if any(not isinstance(own[path], int | float) for path in self.factors):
            return {}, {}
        factors = {path: factor for path, factor in self.factors.items() if path in dispersed}
        scaled = {path: factor * own[path] for path, factor in self.factors.items() if path not in dispersed}
        values = self.values | scaled
        is_changed = factors or any(path in dispersed or value != own[path] for path, value in values.items())
        return (values, factors) if is_changed else ({}, {})


class _VariantsFile(Parameters):
    """Contents of a file of variants."""

    variants: Annotated[tuple[SystemVariant, ...], Field(strict=False)]


def system_variants(scenario: str) -> tuple[SystemVariant, ...]:
    """Read the variants of the system of a scenario; empty without any. Raises DefinitionError for an invalid file."""
    system = find_system(scenario)
    path = None if system is None or system.folder is None else system.folder / "variants.toml"
    return read_model(path, _VariantsFile).variants if path is not None and path.is_file() else ()
