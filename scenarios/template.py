"""Templates of campaign files: `marsyard new` writes a commented file from them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # its import takes longer than `marsyard list`
    from jinja2 import Environment


#: Minimum number of terrains of a new campaign's bank, enough for cases appended later and for studies.
MIN_TERRAINS = 100_000


@dataclass(frozen=True)
class Choices:
    """A user's choices for a new campaign.

    - name, site: name of the campaign, and site of the terrain
    - camera, detector, flight: the user's files, or empty
    - axes: world axes of the flight file
    - bound: maximum error, or minimum fraction, of the requirement
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

    - file: receives the fields of `Choices`, `bank` (number of terrains) and the entries of `values`; its filter
      ``toml`` formats a value as TOML. It may extend ``campaign.toml.j2``.
    - scale: scale of the site's terrain, ``descent`` or ``ground``
    - site, bound: default site, and default bound of the requirement
    - bound_text: meaning of the bound, for the dialogue
    - max_bound: upper limit of the bound, exclusive
    - unsupported_options: why an option (``camera``, ``detector``, ``flight``) is not accepted, by option
    - values: function that returns further values for the file. Raises ValueError if a user's file is invalid.
    """

    file: Path
    scale: str
    site: str
    bound: float
    bound_text: str
    max_bound: float = math.inf
    unsupported_options: Mapping[str, str] = field(default_factory=dict)
    values: Callable[[Choices], Mapping[str, Any]] = lambda _: {}

    def text(self, choices: Choices) -> str:
        """Return the text of the campaign file. Raises ValueError if an option is not accepted."""
        reasons = [reason for option, reason in self.unsupported_options.items() if getattr(choices, option)]
        if reasons:
            raise ValueError(reasons[0])
        from marsyard.sim.terrain import MAX_TERRAINS

        template = toml_environment(self.file.parent, Path(__file__).resolve().parent).get_template(self.file.name)
        bank = min(MAX_TERRAINS, max(MIN_TERRAINS, choices.cases))
        return template.render(asdict(choices), bank=bank, **self.values(choices))


def _format_toml(value: Any) -> str:
    """Format a value as TOML, which has two differences from JSON: no surrogates in escapes, and no raw U+007F."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def toml_environment(*folders: Path) -> Environment:
    """Return the environment of TOML templates in folders; the filter ``toml`` formats a value as TOML."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(folders),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,  # noqa: S701  (TOML, whose strings the filter quotes)
    )
    environment.filters["toml"] = _format_toml
    return environment
