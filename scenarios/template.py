"""Templates of campaign files: `marsyard new` writes a commented file from them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from marsyard.scenarios.system import SCENARIOS_FOLDER

#: Number of terrains of a new campaign's bank: enough for appended cases, and the maximum of a bank.
MIN_TERRAINS, MAX_TERRAINS = 10_000, 100_000


@dataclass(frozen=True)
class Choices:
    """A user's choices for a new campaign.

    - name, site: the campaign's name, and the terrain's site
    - camera, detector, flight: files of the user, or empty
    - axes: world axes of the flight's file
    - bound: maximum error, or minimum fraction, that the requirement states
    - cases: number of cases
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
    """A Jinja template of a campaign file.

    - file: gets the fields of `Choices`, `bank` (number of terrains) and the entries of `values`; the filter ``toml``
      formats a value as TOML. It may extend ``campaign.toml.j2``.
    - scale: scale of the site's terrain, ``descent`` or ``ground``
    - site, bound: defaults
    - bound_text: meaning of the bound, for the dialogue
    - max_bound: upper limit of the bound, exclusive
    - refused: reasons why options (``camera``, ``detector``, ``flight``) are not accepted
    - values: further values for the file. Raises ValueError where a user's file cannot be used.
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
        """Return the text of the campaign file. Raises ValueError where an option is not accepted."""
        refusal = next((why for option, why in self.refused.items() if getattr(choices, option)), None)
        if refusal is not None:
            raise ValueError(refusal)
        template = toml_environment(self.file.parent, SCENARIOS_FOLDER).get_template(self.file.name)
        bank = min(MAX_TERRAINS, max(MIN_TERRAINS, choices.cases))
        return template.render(asdict(choices), bank=bank, **self.values(choices))


def toml_environment(*folders: Path) -> Environment:
    """Return the environment of TOML templates in folders; the filter ``toml`` formats a value as TOML."""
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
