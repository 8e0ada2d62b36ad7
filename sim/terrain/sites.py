"""Sites: an environment, how its ground scatters light, and its terrain at the scales at which it is looked at.

Figures of the field test's sites and of the MER landing sites: DIMES field test paper, section III.A.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any

from pydantic import Field

from marsyard.sim.parameters import Parameters
from marsyard.sim.terrain.environment import Environment
from marsyard.sim.terrain.parameters import TerrainParameters


class SitePhotometry(Parameters):
    """Parameters of the Lunar-Lambert law with an opposition surge, as `marsyard.sim.render.Photometry` takes them."""

    lunar_share: Annotated[float, Field(ge=0.0, le=1.0, description="L: 0 Lambert, 1 Lommel-Seeliger")] = 0.55
    surge_amplitude: Annotated[float, Field(ge=0.0, le=3.0, description="B0")] = 0.7
    surge_width: Annotated[float, Field(gt=0.0, le=1.0, description="h")] = 0.06
    rock_albedo: Annotated[float, Field(gt=0.0, lt=1.0, description="albedo of rocks")] = 0.15
    source: Annotated[str, Field(description="where these come from")] = "assumed"


class SiteTexture(Parameters):
    """Albedo finer than the terrain's posts: octaves of noise, as `marsyard.sim.render.Texture` takes them.

    Amplitudes are of the natural logarithm of albedo, the coarsest octave first; each octave is half as large as the
    one before.
    """

    coarsest_m: Annotated[float, Field(gt=0.0, description="size of the coarsest octave's cells, m")]
    amplitudes: Annotated[tuple[float, ...], Field(description="amplitude of each octave")]


def texture(coarsest_m: float, finest_m: float, amplitude: float, decay: float = 1.0) -> SiteTexture:
    """Octaves from one size to another, each `decay` times as strong as the one before."""
    octaves: list[float] = []
    size = coarsest_m
    while size >= finest_m:
        octaves.append(round(amplitude * decay ** len(octaves), 5))
        size /= 2.0
    return SiteTexture(coarsest_m=coarsest_m, amplitudes=tuple(octaves))


class Site(Parameters):
    """A place to land, drive or fly.

    `descent` is its terrain from parachute heights (posts of metres over kilometres), `ground` from a mast or a
    helicopter (posts of centimetres over 100-200 m); a site has at least one.
    """

    name: str
    description: str
    environment: Environment
    photometry: SitePhotometry = SitePhotometry()
    ground_texture: SiteTexture
    rock_texture: SiteTexture
    descent: TerrainParameters | None = None
    ground: TerrainParameters | None = None

    def terrain(self, scale: str | None = None, changes: Mapping[str, Any] | None = None) -> TerrainParameters:
        """The terrain at a scale, 'descent' or 'ground', with some parameters set anew; by default the coarsest scale.

        `changes` are those of `TerrainParameters.changed`: fewer samples for a large bank, a `source` of real terrain
        in the site's surround. Raises ValueError where the site has no terrain at that scale, or a change is wrong.
        """
        if scale not in (None, "descent", "ground"):
            raise ValueError(f"'{scale}' is no scale of terrain; allowed: descent, ground")
        wanted = (self.descent or self.ground) if scale is None else getattr(self, scale)
        if not isinstance(wanted, TerrainParameters):
            raise ValueError(f"site {self.name} has no terrain at the scale '{scale}'")
        return wanted.changed(changes) if changes else wanted


@dataclass(frozen=True)
class PaperFigures:
    """What the field test paper says of a site; ranges as (least, most). None where it says nothing.

    Slopes hold for baselines of 30 m and 90 m.
    """

    albedo: tuple[float, float]
    mean_slope_deg: tuple[float, float]
    relief_m: tuple[float, float] | None
    contrast: str


_FIELD_SLOPE, _MARS_SLOPE, _MARS_ALBEDO = (2.0, 3.0), (1.0, 2.0), (0.1, 0.3)

#: Section III.A of the field test paper. MER landing sites are given together.
PAPER: dict[str, PaperFigures] = {
    "pisgah": PaperFigures((0.1, 0.1), _FIELD_SLOPE, None, "very little; like synthesised images of most MER sites"),
    "kelso": PaperFigures((0.5, 0.5), _FIELD_SLOPE, (200.0, float("inf")), "repetitive"),
    "ivanpah": PaperFigures((0.4, 0.4), _FIELD_SLOPE, None, "bland; the smoothest of the field sites"),
    "gusev": PaperFigures(_MARS_ALBEDO, _MARS_SLOPE, None, "MOC: a lower limit, seen through dust"),
    "meridiani": PaperFigures(_MARS_ALBEDO, _MARS_SLOPE, None, "MOC: a lower limit, seen through dust"),
}


@cache
def sites() -> dict[str, Site]:
    """All presets by name."""
    from marsyard.sim.terrain.presets import PRESETS

    return {site.name: site for site in PRESETS}


def site(name: str) -> Site:
    """The preset of this name. Raises ValueError, naming those there are."""
    known = sites()
    if name not in known:
        raise ValueError(f"no site is called '{name}'; allowed: {', '.join(known)}")
    return known[name]
