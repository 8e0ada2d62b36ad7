"""Templates of new campaigns, one for each system: `marsyard new` writes a commented file from them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from marsyard.scenarios.system import SCENARIOS_FOLDER

#: Terrains of a new campaign's bank: enough for cases that are appended, and as many as a bank may have.
MIN_TERRAINS, MAX_TERRAINS = 10_000, 100_000


@dataclass(frozen=True)
class Choices:
    """What a new campaign is made from.

    Attributes
    ----------
    name, site
        The campaign's name, and the terrain's site.
    camera, detector, flight
        Files of the user, or empty.
    axes
        World axes of the flight's file.
    bound
        Maximum error, or minimum fraction, that the requirement states.
    cases
        Number of cases.
    """

    name: str
    site: str
    camera: str
    detector: str
    flight: str
    axes: str
    bound: float
    cases: int


@dataclass(frozen=True)
class CampaignTemplate:
    """A campaign file with places for a user's choices.

    Attributes
    ----------
    file
        The file in Jinja's language. It gets the fields of `Choices`, `bank` (number of terrains) and what `values`
        adds; the filter ``toml`` writes a value in TOML's notation. It may extend ``campaign.toml.j2``.
    scale
        The attribute of a site's terrain that it needs: ``descent`` or ``ground``.
    site, bound
        Defaults.
    bound_text
        What the bound is, for the dialogue.
    max_bound
        The bound is below this.
    refused
        Why an option (``camera``, ``detector``, ``flight``) is not accepted, by the option.
    values
        Further values for the file. Raises ValueError where a user's file cannot be used.
    """

    file: Path
    scale: str
    site: str
    bound: float
    bound_text: str
    max_bound: float = math.inf
    refused: Mapping[str, str] = field(default_factory=dict)
    values: Callable[[Choices], Mapping[str, Any]] = lambda _: {}

    def text(self, choices: Choices) -> str:
        """The campaign file. Raises ValueError where an option is not accepted."""
        refusal = next((why for option, why in self.refused.items() if getattr(choices, option)), None)
        if refusal is not None:
            raise ValueError(refusal)
        template = toml_environment(self.file.parent, SCENARIOS_FOLDER).get_template(self.file.name)
        bank = min(MAX_TERRAINS, max(MIN_TERRAINS, choices.cases))
        return template.render(asdict(choices), bank=bank, **self.values(choices))


def toml_environment(*folders: Path) -> Environment:
    """Templates of TOML files in folders; the filter ``toml`` writes a value in TOML's notation."""
    environment = Environment(
        loader=FileSystemLoader(folders),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,  # noqa: S701  (TOML, whose strings the filter quotes)
    )
    environment.filters["toml"] = json.dumps
    return environment
