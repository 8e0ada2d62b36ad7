"""Transverse dunes and ripples."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from marsyard.sim.terrain.landforms.ground import Ground, LandformParameters, smooth_pair
from marsyard.sim.terrain.landforms.kernels import Bedforms, add_dunes

#: Samples a slip face should have along its slope.
SAMPLES_ON_SLIP_FACE = 2.1


class Dunes(LandformParameters):
    """A train of transverse bedforms: gentle towards the wind, a slip face with an apron at its foot away from it.

    Dunes and ripples differ in size, and ripples of wind, which do not avalanche, fall at about 20 deg where dunes rest
    at the angle of repose (Sharp 1963). Crests wander and end in defects, as they do where bedforms of a range of
    wavelengths interact (Werner & Kocurek 1999). Dry sand rests at 30-34 deg (Bagnold 1941).
    """

    wavelength_m: Annotated[float, Field(gt=0.0, description="distance from crest to crest, m")] = 110.0
    height_m: Annotated[float, Field(gt=0.0, description="RMS height of crest over trough, m")] = 5.0
    wind_from_deg: Annotated[float, Field(ge=0.0, lt=360.0, description="azimuth the wind comes from")] = 270.0
    repose_deg: Annotated[float, Field(ge=10.0, le=36.0, description="slope of the faces away from the wind")] = 32.0
    crest_length: Annotated[float, Field(ge=0.5, le=50.0, description="length of crests, wavelengths")] = 4.0
    regularity: Annotated[float, Field(ge=0.3, le=20.0, description="wavelengths over which spacing persists")] = 1.5
    albedo_contrast: Annotated[
        float, Field(ge=-1.0, le=1.0, description="logarithm of crests' albedo over troughs'")
    ] = 0.05

    def apply(self, ground: Ground, rng: np.random.Generator) -> None:
        """Adds the dunes. The wave is the nearest one, in length and direction, that fits into the period."""
        # the wave travels downwind; azimuth is clockwise from north, x is east
        downwind = np.radians(90.0 - (self.wind_from_deg + 180.0))
        waves = ground.period_m / self.wavelength_m * np.array([np.cos(downwind), np.sin(downwind)])
        whole = np.round(waves)
        if not whole.any():
            raise ValueError(
                f"dunes.wavelength_m is {self.wavelength_m:g}; the terrain's side is {ground.period_m:g} m"
            )
        wave = 2.0 * np.pi * whole / ground.period_m
        modulation = smooth_pair(
            ground.period_m,
            self.crest_length * self.wavelength_m / np.sqrt(2.0),
            self.regularity * self.wavelength_m / np.sqrt(2.0),
            float(downwind),
            rng,
        )
        finer = max(modulation.shape[0] // ground.side, 1)
        modulation = np.ascontiguousarray(modulation[::finer, ::finer])
        steepest = float(np.tan(np.radians(self.repose_deg)))
        part = ground.coarser(
            min(self.height_m / steepest / SAMPLES_ON_SLIP_FACE, ground.period_m / modulation.shape[0])
        )
        bedforms = Bedforms(float(wave[0]), float(wave[1]), self.height_m, steepest, self.albedo_contrast)
        add_dunes(part.height, part.tone, part.spacing_m, modulation, bedforms)
        ground.add(part)
