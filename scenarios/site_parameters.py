"""Parameters common to scenarios over a site: terrain and position, sun, dust, and rendering."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, Field, model_validator

from marsyard.sim.parameters import Parameters, bounded_field, merge_parameters
from marsyard.sim.render.backend import Backend, default_backend
from marsyard.sim.terrain import MAX_TERRAINS, TerrainParameters, site, sites


def complete_terrain(
    parameters: Any, default_site: str | None, find: Callable[[str, Mapping[str, Any]], TerrainParameters | None]
) -> Any:
    """Merge the table `terrain` of a scenario's parameters into the terrain of its site, and name this site.

    find: returns the terrain of a site, given by name; None leaves the parameters unchanged
    """
    changes = parameters.get("terrain", {}) if isinstance(parameters, Mapping) else None
    if not isinstance(changes, Mapping):
        return parameters
    name = parameters.get("site", default_site)
    terrain = find(name, parameters) if isinstance(name, str) else None
    if terrain is None:
        return parameters
    return {"terrain_site": name, **parameters, "terrain": merge_parameters(terrain.model_dump(), changes)}


def preset_terrain(name: str, scale: str) -> TerrainParameters | None:
    """Return the terrain of a site at a scale (`descent`, `ground`); None if there is none."""
    return None if getattr(sites().get(name), scale, None) is None else site(name).terrain(scale)


def site_validator(user: str, scale: str) -> AfterValidator:
    """Return a validator of site names: presets with a terrain at the scale; `user` is a noun for messages."""

    def check(name: str | None) -> str | None:
        allowed = [item.name for item in sites().values() if getattr(item, scale) is not None]
        if name is not None and name not in allowed:
            raise ValueError(f"unknown site '{name}' for {user}; allowed: {', '.join(allowed)}")
        return name

    return AfterValidator(check)


class Location(Parameters):
    """Terrain of the bank, and position on it."""

    bank: Annotated[int, bounded_field(1, MAX_TERRAINS, "number of terrains in the terrain bank")] = 4
    bank_seed: Annotated[int, Field(ge=0, description="seed of the bank's terrains")] = 1
    terrain: Annotated[int, Field(ge=0, description="number of the terrain in the bank, from 0")] = 0
    east_m: Annotated[float, Field(description="east coordinate at the first image, on the periodic terrain")] = 0.0
    north_m: Annotated[float, Field(description="north coordinate at the first image, on the periodic terrain")] = 0.0

    @model_validator(mode="after")
    def _check_terrain(self) -> Location:
        if self.terrain >= self.bank:
            raise ValueError(f"terrain {self.terrain} is not in the bank; allowed: 0 to {self.bank - 1}")
        return self


class SunParameters(Parameters):
    """Direction to the sun."""

    azimuth_deg: Annotated[float, bounded_field(-360.0, 720.0, "azimuth of the sun, clockwise from north")] = 270.0
    elevation_deg: Annotated[float, Field(gt=0.0, le=90.0, description="elevation of the sun above the horizon")] = 40.0


#: Optical depth of the atmosphere in a case.
DustOpacity = Annotated[
    float | None, bounded_field(0.0, 10.0, "optical depth of the dusty air; by default that of the site")
]


class RenderParameters(Parameters):
    """Rendering of the images."""

    backend: Backend = Field(default_factory=default_backend, description="OpenGL context provider")
