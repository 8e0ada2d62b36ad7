"""Synthesis of a terrain from parameters and a random stream."""

import numpy as np
from jaxtyping import Float32

from marsyard.sim.streams import substream
from marsyard.sim.terrain.imported import blend_into_ground, embed, extract_fine_detail
from marsyard.sim.terrain.kernels import interleave_samples
from marsyard.sim.terrain.landforms.craters import add_craters, draw_craters
from marsyard.sim.terrain.landforms.ground import TerrainGround, refine
from marsyard.sim.terrain.landforms.random_fields import FractalField
from marsyard.sim.terrain.landforms.units import FACTOR_STEP
from marsyard.sim.terrain.parameters import TerrainParameters
from marsyard.sim.terrain.surface import ROUGHNESS, TEXTURE, UNIFORM, Surface, empty_pyramid, level_sides, split_levels

#: The landforms in the order in which they are added to the fractal ground; drifts follow the craters.
LANDFORMS = ("fans", "playa", "lava", "swell", "strata", "ramp", "outcrop", "gullies", "dunes", "ripples")


def synthesise(parameters: TerrainParameters, rng: np.random.Generator) -> Surface:
    """Synthesise a terrain from parameters and a random stream; the same stream gives bit-identical samples.

    Each landform has its own named substream: a new or changed landform does not change the others. The synthesis is
    single-threaded, so that the samples do not depend on the number of threads.
    """
    p = parameters
    relief = FractalField.power_law(p.samples, p.spacing_m, p.hurst, p.outer_scale_m)
    rms_slope = np.tan(np.radians(p.rms_slope_deg))
    relief_m = rms_slope / relief.line_slope_rms(p.slope_baseline_m)
    albedo = FractalField.power_law(p.samples, p.spacing_m, p.albedo_hurst, p.outer_scale_m)
    contrast = p.albedo_contrast * float(np.exp(p.contrast_spread * substream(rng, "contrast").standard_normal()))
    craters = draw_craters(p, substream(rng, "craters"))
    # equal random modes: hollows are dark, and crests bright, at all scales
    albedo_rng = substream(rng, "relief" if p.albedo_follows_relief else "albedo")
    if p.units is None:
        height = relief.draw_field(substream(rng, "relief"), relief_m)
        log_albedo = albedo.draw_field(albedo_rng, contrast)
        fine = ground = TerrainGround(height, log_albedo, p.spacing_m)
    else:
        height, fine_relief = relief.draw_split_field(substream(rng, "relief"), relief_m, p.fine_below_m)
        log_albedo, fine_albedo = albedo.draw_split_field(albedo_rng, contrast, p.fine_below_m)
        ground = TerrainGround(height, log_albedo, p.spacing_m)
        fine = TerrainGround(fine_relief, fine_albedo, p.spacing_m)
    dtm = None
    if p.source is not None:
        dtm = embed(p.source, ground.side, ground.spacing_m)
        detail = extract_fine_detail(fine, dtm) if p.source.roughen else None
    for name in LANDFORMS:
        landform = getattr(p, name)
        if landform is not None:
            landform.apply(ground, substream(rng, name))
    factors = UNIFORM
    if p.units is not None:
        factors = p.units.apply(ground, craters, substream(rng, "units"))
        _add_fine_ground(ground, fine, factors, p.relief_log_albedo)
    if len(craters):
        add_craters(ground, craters)
    if p.drifts is not None:
        p.drifts.apply(ground, substream(rng, "drifts"))
    if dtm is not None:
        blend_into_ground(ground, dtm, detail)
    relative_albedo = np.exp(ground.log_albedo, out=ground.log_albedo)
    pyramid = empty_pyramid(ground.side)
    samples = split_levels(pyramid, level_sides(ground.side))[0]
    interleave_samples(
        ground.height, relative_albedo, p.albedo / float(relative_albedo.mean(dtype=np.float64)), samples
    )
    return Surface.from_pyramid(pyramid, ground.spacing_m, factors)


def _add_fine_ground(
    ground: TerrainGround, fine: TerrainGround, factors: Float32[np.ndarray, "side side 3"], relief_log_albedo: float
) -> None:
    """Add fine relief and albedo, scaled by the factors of the surface units, to the ground; changes both in place.

    With `relief_log_albedo` sand fills the hollows of the relief z up to its mean height (assumed), and the log albedo
    of the ground above it rises by `relief_log_albedo` per mean of abs(z).
    """
    height, log_albedo = fine.height, fine.log_albedo
    roughness, texture = (
        refine(np.ascontiguousarray(factors[..., channel]), ground.side) for channel in (ROUGHNESS, TEXTURE)
    )
    if relief_log_albedo:
        np.maximum(height, 0.0, out=height)
        mean = 2.0 * float(height[::FACTOR_STEP, ::FACTOR_STEP].mean(dtype=np.float64))  # of abs(z)
    height *= roughness
    log_albedo *= texture
    ground.add(fine)
    if relief_log_albedo:
        height *= np.float32(relief_log_albedo / mean)
        np.add(ground.log_albedo, height, out=ground.log_albedo)
