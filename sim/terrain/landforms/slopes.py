"""Broad relief and even slopes on a ground that repeats."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from marsyard.sim.terrain.landforms.ground import Ground, LandformParameters


class Swell(LandformParameters):
    """Broad relief of a stated height: a few waves of the order of the terrain's side, as the mass of a dune field."""

    relief_m: Annotated[float, Field(gt=0.0, description="lowest to highest, m")] = 200.0
    waves: Annotated[int, Field(ge=1, le=8, description="most waves along a side")] = 1

    def apply(self, ground: Ground, rng: np.random.Generator) -> None:
        """Adds the swell."""
        part = ground.coarser(ground.period_m / 64.0)
        turn = 2.0 * np.pi * np.arange(part.side) / part.side
        field = np.zeros((part.side, part.side))
        for m in range(self.waves + 1):
            for n in range(-self.waves, self.waves + 1):
                if (m, n) <= (0, 0):
                    continue
                strength = rng.uniform(0.7, 1.0) / (m * m + n * n) ** 1.25
                phase = rng.uniform(0.0, 2.0 * np.pi)
                field += strength * np.cos(m * turn[None, :] + n * turn[:, None] + phase)
        field *= self.relief_m / np.ptp(field)
        part.height[...] = field
        ground.add(part, tone=False)


class Ramp(LandformParameters):
    """An even slope for driving tests, as part of a ridge, because the ground repeats.

    Along the direction of `uphill` the ground is level, climbs at the stated slope over `length_m`, is level on top and
    descends at the same slope; across it nothing changes. The climb is centred a quarter of the period from the
    terrain's edge (east_m or north_m = 0.25 period), the descent at three quarters. Bends are rounded over a
    tenth of the slope's length.
    """

    slope_deg: Annotated[float, Field(gt=0.0, le=40.0, description="slope of the ramp")] = 8.0
    length_m: Annotated[float, Field(gt=0.0, description="horizontal length of the even slope, m")] = 30.0
    uphill: Annotated[Literal["east", "north"], Field(description="direction in which the first slope climbs")] = "east"

    def apply(self, ground: Ground, rng: np.random.Generator) -> None:
        """Adds the ramp."""
        period = ground.period_m
        longest = 0.45 * period
        if self.length_m > longest:
            raise ValueError(f"ramp.length_m is {self.length_m:g}; at most {longest:g} fit on this terrain")
        place = np.arange(ground.side) * ground.spacing_m
        bend = 0.1 * self.length_m
        climb = np.clip((0.5 * self.length_m + bend / 2.0 - np.abs(place - 0.25 * period)) / bend, 0.0, 1.0)
        fall = np.clip((0.5 * self.length_m + bend / 2.0 - np.abs(place - 0.75 * period)) / bend, 0.0, 1.0)
        rise = climb - fall
        profile = (np.cumsum(rise) - 0.5 * rise) * ground.spacing_m * np.tan(np.radians(self.slope_deg))
        profile = (profile - profile.mean()).astype(np.float32)
        np.add(ground.height, profile[None, :] if self.uphill == "east" else profile[:, None], out=ground.height)
