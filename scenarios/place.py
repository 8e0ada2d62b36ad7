"""Parameters common to scenarios over a site: terrain and position, sun, dust, and rendering."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from marsyard.sim.parameters import Parameters, bounded_field
from marsyard.sim.render.backend import Backend, default_backend
from marsyard.sim.terrain import MAX_TERRAINS


class Location(Parameters):
    """Terrain and position of the descent."""

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
