"""Sites: planet and atmosphere, ground reflectance, and terrain parameters at two scales."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from marsyard.sim.parameters import Fraction, Parameters, Positive, bounded_field
from marsyard.sim.terrain.environment import Environment
from marsyard.sim.terrain.parameters import TerrainParameters

#: Size of the coarsest cells of albedo texture of the ground and of rocks, m. Assumed: two samples of a descent's
#: terrain at the default spacing, which resolves coarser variation; and a part of the face of a large rock.
GROUND_TEXTURE_M, ROCK_TEXTURE_M = 3.0, 0.2
#: Lower bound of the cells of texture, m: that of the micro-relief (`marsyard.sim.render.micro_relief`).
FINEST_TEXTURE_M = 0.001


class SitePhotometry(Parameters):
    """Parameters of the Lunar-Lambert law with an opposition surge; see `marsyard.sim.render.Photometry`."""

    lunar_fraction: Annotated[float, Field(ge=0.0, le=1.0, description="L: 0 Lambert, 1 Lommel-Seeliger")] = 0.55
    surge_amplitude: Annotated[float, Field(ge=0.0, le=3.0, description="B0: amplitude of the surge")] = 0.7
    surge_width: Annotated[float, Field(gt=0.0, le=1.0, description="h: angular width of the surge")] = 0.06
    rock_albedo: Annotated[float, Field(gt=0.0, lt=1.0, description="albedo of rocks")] = 0.15
    dust_albedo: Annotated[float, Field(gt=0.0, lt=1.0, description="albedo of dust on rocks")] = 0.3
    dust_cover: Annotated[Fraction, Field(description="fraction of level faces of rocks that dust covers")] = 0.0
    source: Annotated[str, Field(description="source of these values")] = "assumed"


class PhotometryChanges(Parameters):
    """Changes of a site's photometry (`SitePhotometry`)."""

    lunar_fraction: Annotated[
        float | None, Field(ge=0.0, le=1.0, description="L: 0 Lambert, 1 Lommel-Seeliger; default: the site's")
    ] = None
    surge_amplitude: Annotated[
        float | None, Field(ge=0.0, le=3.0, description="B0: amplitude of the surge; default: the site's")
    ] = None


class SiteTexture(Parameters):
    """Albedo variation finer than the terrain's samples: octaves of noise in the natural logarithm of albedo.

    The coarsest octave is the first; the cell size is halved with each octave.
    """

    coarsest_m: Annotated[Positive, Field(description="size of the coarsest octave's cells, m")]
    amplitudes: Annotated[tuple[float, ...], Field(description="amplitude of each octave")]


class SiteCover(Parameters):
    """Sharp borders between bedrock and the sand that covers it, finer than the terrain's samples.

    The albedo of a sample is a mean over sand and bedrock; a point of the ground is either. The logarithm of albedo,
    with texture, increases by ``contrast (1 + tanh((log albedo - border) / softness))``: 0 on sand, and twice the
    contrast on bedrock.
    """

    border: Annotated[float, bounded_field(-1.0, 1.0, "logarithm of albedo at the border divided by the ground's mean")]
    contrast: Annotated[Fraction, Field(description="half of the increase of the logarithm of albedo of bedrock")]
    softness: Annotated[Positive, Field(description="change of this logarithm over which sand becomes bedrock")]


class SitePebbles(Parameters):
    """Pebbles and granules that are too many and too small for triangles.

    The number of pebbles larger than D is in proportion to D**-exponent, as for fragmented rock, with exponents of 1.9
    to 2.6 (Turcotte 1997, table 3.2). The law of Golombek & Rapp (1997), with an exponent of 1 at these sizes, was
    fitted to rocks above 3 cm. Ground darker than the mean of the terrain has more pebbles, brighter ground fewer.
    """

    coverage: Annotated[float, bounded_field(0.0, 0.4, "fraction of the ground that pebbles cover")]
    largest_m: Annotated[Positive, Field(description="largest diameter, m")] = 0.048
    smallest_m: Annotated[Positive, Field(description="smallest diameter, m")] = 0.002
    exponent: Annotated[float, bounded_field(1.0, 3.0, "exponent of the cumulative number of pebbles")] = 2.5
    height_ratio: Annotated[float, bounded_field(0.05, 1.0, "height divided by diameter; assumed")] = 0.4
    log_albedo: Annotated[float, bounded_field(-1.5, 1.5, "mean logarithm of albedo divided by the ground's")] = 0.0
    log_albedo_sd: Annotated[float, bounded_field(0.0, 1.0, "standard deviation of this logarithm; assumed")] = 0.2


class Hill(Parameters):
    """A hill on the horizon of a site; the direction is that from the origin of the site's terrain."""

    azimuth_deg: Annotated[float, Field(ge=0.0, lt=360.0, description="azimuth of its middle, clockwise from north")]
    distance_m: Annotated[Positive, Field(description="distance of its middle, m")]
    width_m: Annotated[Positive, Field(description="width across the line of sight, m")]
    depth_m: Annotated[Positive, Field(description="extent along the line of sight, m")]
    height_m: Annotated[Positive, Field(description="height above the plain, m")]


class Site(Parameters):
    """A site with its environment, photometry and terrain.

    `descent` is the terrain for images of a descent (spacing of metres over kilometres). `ground` is the terrain for
    images of a rover or a helicopter (spacing of centimetres over 100-200 m). A site has at least one of them. Pebbles
    are visible at the scale of the ground only, and so are borders of sand (`cover`).
    """

    name: str
    description: str
    environment: Environment
    photometry: SitePhotometry = SitePhotometry()
    ground_texture: SiteTexture
    rock_texture: SiteTexture
    pebbles: SitePebbles | None = None
    cover: SiteCover | None = None
    descent: TerrainParameters | None = None
    ground: TerrainParameters | None = None
    hills: tuple[Hill, ...] = ()

    def with_dust(self, optical_depth: float | None) -> Site:
        """Return the site with another optical depth of the atmosphere; None: no change."""
        if optical_depth is None:
            return self
        environment = self.environment.model_copy(update={"optical_depth": optical_depth})
        return self.model_copy(update={"environment": environment})

    def with_photometry(self, changes: PhotometryChanges) -> Site:
        """Return the site with another reflectance law of ground and rocks."""
        photometry = self.photometry.model_copy(update=changes.model_dump(exclude_none=True))
        return self.model_copy(update={"photometry": photometry})

    def terrain(self, scale: str | None = None, changes: Mapping[str, Any] | None = None) -> TerrainParameters:
        """Return the terrain parameters at a scale, 'descent' or 'ground'; the default is the coarsest scale.

        `changes` are those of `TerrainParameters.with_changes`, for example fewer samples, or a DTM as `source`. Raises
        ValueError if the site has no terrain at this scale, or a change is invalid.
        """
        if scale not in (None, "descent", "ground"):
            raise ValueError(f"'{scale}' is not a valid scale of terrain; allowed: descent, ground")
        terrain = (self.descent or self.ground) if scale is None else getattr(self, scale)
        if not isinstance(terrain, TerrainParameters):
            raise ValueError(f"site {self.name} has no terrain at the scale '{scale}'")
        return terrain.with_changes(changes) if changes else terrain


@cache
def sites() -> dict[str, Site]:
    """Return all sites in ``sites.toml`` by name."""
    tables = tomllib.loads(Path(__file__).with_name("sites.toml").read_text("utf-8"))
    sites_by_name = {}
    for name, entry in tables["sites"].items():
        entry["environment"] = _merge_base(tables["environments"][entry["environment"]], tables["environments"])
        for scale in {"descent", "ground"} & set(entry):
            entry[scale] = _merge_base(entry[scale], tables["grounds"])
        entry["ground_texture"] = _create_texture(GROUND_TEXTURE_M, **entry["ground_texture"])
        entry["rock_texture"] = _create_texture(ROCK_TEXTURE_M, **entry["rock_texture"])
        sites_by_name[name] = Site(name=name, **entry)
    return sites_by_name


def _create_texture(coarsest_m: float, amplitude: float, decay: float) -> SiteTexture:
    """Create octaves down to `FINEST_TEXTURE_M`; `amplitude` of the first is multiplied by `decay` with each octave."""
    octaves = range(int(np.log2(coarsest_m / FINEST_TEXTURE_M)) + 1)
    return SiteTexture(coarsest_m=coarsest_m, amplitudes=tuple(round(amplitude * decay**n, 5) for n in octaves))


def _merge_base(entry: dict[str, Any], bases: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Merge an entry with the values of its base."""
    values = {key: value for key, value in entry.items() if key != "base"}
    return {**_merge_base(bases[entry["base"]], bases), **values} if "base" in entry else values


def site(name: str) -> Site:
    """Return the site with this name. Raises ValueError if there is none; the message lists the sites."""
    if name not in sites():
        raise ValueError(f"no site is called '{name}'; allowed: {', '.join(sites())}")
    return sites()[name]
