"""Landforms of the wind: dunes and ripples, and sand in the lee of relief."""

from typing import Annotated

import numpy as np
from numpy.random import Generator
from pydantic import Field

from marsyard.sim.parameters import Fraction, NonNegative, Parameters, Positive, bounded_field
from marsyard.sim.terrain.landforms.ground import Grid, TerrainGround, resample
from marsyard.sim.terrain.landforms.kernels.wind import Bedforms, add_dunes, cast_lee
from marsyard.sim.terrain.landforms.random_fields import draw_smooth_fields

SAMPLES_ON_SLIP_FACE = 2.1  #: Minimum number of samples along the slope of a slip face.


class Dunes(Parameters):
    """A train of transverse bedforms: a gentle windward slope, and a leeward slip face with an apron at its foot.

    Dunes and ripples differ in size. Wind ripples do not avalanche: their lee slope is about 20 deg (Sharp 1963). The
    slip face of a dune has the angle of repose, 30-34 deg for dry sand (Bagnold 1941). Crests wander and end in
    defects, as in interacting bedforms of different wavelengths (Werner & Kocurek 1999).
    """

    wavelength_m: Annotated[Positive, Field(description="distance from crest to crest, m")] = 110.0
    height_m: Annotated[Positive, Field(description="RMS height of crest over trough, m")] = 5.0
    wind_from_deg: Annotated[float, Field(ge=0.0, lt=360.0, description="azimuth from which the wind blows")] = 270.0
    repose_deg: Annotated[float, Field(ge=10.0, le=36.0, description="slope of the faces away from the wind")] = 32.0
    crest_length: Annotated[float, Field(ge=0.5, le=50.0, description="length of crests, wavelengths")] = 4.0
    regularity: Annotated[
        float, Field(ge=0.3, le=20.0, description="length over which the spacing persists, wavelengths")
    ] = 1.5
    albedo_contrast: Annotated[float, bounded_field(-1.0, 1.0, "ln(albedo of crests / of troughs)")] = 0.05
    sharpness: Annotated[Fraction, Field(description="0: round crests of dunes, 1: peaked ones of coarse ripples")] = (
        0.0
    )

    def apply(self, ground: TerrainGround, rng: Generator) -> None:
        """Add the dunes."""
        ground.add(self.create_layer(ground, rng))

    def create_layer(self, ground: TerrainGround, rng: Generator) -> TerrainGround:
        """Create the dunes, with the wave vector that is periodic on the terrain and nearest to the parameters."""
        # the wave vector points downwind; azimuth is clockwise from north, x is east
        downwind = np.radians(90.0 - (self.wind_from_deg + 180.0))
        waves_per_side = ground.period_m / self.wavelength_m * np.array([np.cos(downwind), np.sin(downwind)])
        whole_waves = np.round(waves_per_side)
        if not whole_waves.any():
            raise ValueError(
                f"the wavelength_m of dunes, ripples or bedforms is {self.wavelength_m:g}; it must be shorter than the "
                f"terrain's side, {ground.period_m:g} m"
            )
        wave_vector = 2.0 * np.pi * whole_waves / ground.period_m
        # amplitudes of the fields fall to 1/e at the wavenumber 2 / length
        across_m, along_m = (
            length * self.wavelength_m / np.sqrt(2.0) for length in (self.crest_length, self.regularity)
        )
        modulation = draw_smooth_fields(ground.period_m, across_m, along_m, float(downwind), rng)
        step = max(modulation.shape[0] // ground.side, 1)
        modulation = np.ascontiguousarray(modulation[::step, ::step])
        max_slope = float(np.tan(np.radians(self.repose_deg)))
        slip_face_m = self.height_m / max_slope
        samples = SAMPLES_ON_SLIP_FACE * (1.0 + 3.0 * self.sharpness)
        layer = ground.coarser(min(slip_face_m / samples, ground.period_m / modulation.shape[0]))
        kx, ky = (float(wavenumber) for wavenumber in wave_vector)
        bedforms = Bedforms(kx, ky, self.height_m, max_slope, self.albedo_contrast, self.sharpness)
        add_dunes(layer.height, layer.log_albedo, layer.spacing_m, modulation, bedforms)
        return layer


class Drifts(Parameters):
    """Sand in the lee of relief: in craters, behind rims and crests, and at the foot of scarps.

    Behind a crest the wind shelters the ground below a surface that falls with `lee_slope_deg`; a separated flow
    reattaches after some ten heights of the obstacle. Sand covers the fraction ``d**2 / (1 + d**2)`` of ground that is
    d times `depth_m` below this surface. It can have bedforms.
    """

    wind_from_deg: Annotated[float, Field(ge=0.0, lt=360.0, description="azimuth from which the wind blows")] = 270.0
    wind_spread_deg: Annotated[NonNegative, Field(description="SD of this azimuth between terrains, deg")] = 10.0
    lee_slope_deg: Annotated[float, Field(gt=0.0, le=30.0, description="slope of the lee behind a crest")] = 6.0
    depth_m: Annotated[Positive, Field(description="depth in the lee at which sand covers half the ground, m")] = 3.0
    filled: Annotated[Fraction, Field(description="fraction of the lee's depth that the sand fills")] = 0.3
    log_albedo: Annotated[float, bounded_field(-1.0, 1.0, "ln(albedo of the sand / of the ground)")] = -0.2
    bedforms: Annotated[Dunes | None, Field(description="bedforms on the sand; None: smooth")] = None
    detail_m: Annotated[Positive, Field(description="spacing of the grid of the lee, m")] = 8.0

    def apply(self, ground: TerrainGround, rng: Generator) -> None:
        """Add the sand and its bedforms."""
        downwind = np.radians(270.0 - self.wind_from_deg - self.wind_spread_deg * rng.standard_normal())
        layer = ground.coarser(self.detail_m)
        step = ground.side // layer.side
        height = np.ascontiguousarray(ground.height[::step, ::step])
        depth = compute_lee(height, layer.spacing_m, float(downwind), float(np.tan(np.radians(self.lee_slope_deg))))
        depth -= height
        square = np.square(depth / np.float32(self.depth_m))
        coverage = square / (square + np.float32(1.0))
        np.multiply(coverage, np.float32(self.log_albedo), out=layer.log_albedo)
        np.multiply(coverage, np.float32(self.filled) * depth, out=layer.height)
        ground.add(layer)
        if self.bedforms is not None:
            bedforms = self.bedforms.create_layer(ground, rng)
            coverage = resample(coverage, bedforms.side)
            bedforms.height[...] *= coverage
            bedforms.log_albedo[...] *= coverage
            ground.add(bedforms)


def compute_lee(height: Grid, spacing_m: float, downwind_rad: float, slope: float) -> Grid:
    """Compute the surface that bounds the lee of periodic ground: nowhere below the ground, falling with `slope`.

    `downwind_rad` is the direction to which the wind blows, counter-clockwise from x.
    """
    x, y = np.cos(downwind_rad), np.sin(downwind_rad)
    is_along_rows = abs(y) >= abs(x)
    forward, sideways = (y, x) if is_along_rows else (x, y)
    order = np.s_[::1] if forward > 0.0 else np.s_[::-1]
    grid = np.ascontiguousarray((height if is_along_rows else height.T)[order])
    lee = cast_lee(grid, float(sideways / abs(forward)), float(slope * spacing_m / abs(forward)))[order]
    return np.array(lee if is_along_rows else lee.T)
