"""Terrain from a seed: a fractal ground with albedo variation, landforms upon it, and impact craters."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from marsyard.sim.terrain.embedding import detail_below, embed, lay_in
from marsyard.sim.terrain.landforms.craters import EJECTA_REACH_RADII, draw_craters
from marsyard.sim.terrain.landforms.ground import Ground
from marsyard.sim.terrain.landforms.kernels import pack, stamp_craters
from marsyard.sim.terrain.parameters import LANDFORMS, TerrainParameters
from marsyard.sim.terrain.spectrum import Spectrum
from marsyard.sim.terrain.substreams import substream
from marsyard.sim.terrain.surface import Surface


def synthesise(parameters: TerrainParameters, rng: np.random.Generator) -> Surface:
    """The terrain of these parameters drawn from this stream; the same stream gives the same bytes.

    Every part draws from its own substream, named after it: whether a landform is there, and how it is set, changes
    no other. One thread does all, so the bytes do not depend on how many there are.
    """
    ground = Ground(
        _relief(parameters, substream(rng, "relief")), _tone(parameters, substream(rng, "albedo")), parameters.spacing_m
    )
    real = None
    if parameters.source is not None:
        real = embed(parameters.source, ground.side, ground.spacing_m)
        detail = detail_below(ground, real) if parameters.source.roughen else None
    for name in LANDFORMS:
        landform = getattr(parameters, name)
        if landform is not None:
            landform.apply(ground, substream(rng, name))
    if parameters.craters_per_km2 > 0.0:
        craters = draw_craters(parameters, substream(rng, "craters"))
        stamp_craters(ground.height, ground.tone, ground.spacing_m, craters, EJECTA_REACH_RADII)
    if real is not None:
        lay_in(ground, real, detail)
    return _surface(ground, parameters.albedo)


def _relief(parameters: TerrainParameters, rng: np.random.Generator) -> Float32[np.ndarray, "rows columns"]:
    spectrum = Spectrum.power_law(parameters.samples, parameters.spacing_m, parameters.hurst, parameters.outer_scale_m)
    wanted = np.tan(np.radians(parameters.rms_slope_deg))
    return spectrum.field(rng, scale=wanted / spectrum.line_slope_rms(parameters.slope_baseline_m))


def _tone(parameters: TerrainParameters, rng: np.random.Generator) -> Float32[np.ndarray, "rows columns"]:
    """Natural logarithm of the fractal albedo over its mean."""
    spectrum = Spectrum.power_law(
        parameters.samples, parameters.spacing_m, parameters.albedo_hurst, parameters.outer_scale_m
    )
    return spectrum.field(rng, scale=parameters.albedo_contrast)


def _surface(ground: Ground, albedo: float) -> Surface:
    """Packs the work grids; the albedo's mean over the terrain is the stated one."""
    relative = np.exp(ground.tone, out=ground.tone)
    samples = np.empty((ground.side, ground.side, 2), dtype=np.float32)
    pack(ground.height, relative, albedo / float(relative.mean(dtype=np.float64)), samples)
    return Surface.from_samples(samples, ground.spacing_m)
