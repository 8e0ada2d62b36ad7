"""Impact craters, from fresh to degraded."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

if TYPE_CHECKING:
    from marsyard.sim.terrain.parameters import TerrainParameters

EJECTA_REACH_RADII = 3.0
#: Depth from the rim crest to the floor over diameter: 0.2 for fresh simple craters (Pike 1977; Robbins & Hynek 2012
#: for Mars), down to what is barely seen. Small Martian craters are mostly degraded (Golombek et al. 2014).
FRESH_DEPTH, DEGRADED_DEPTH = 0.2, 0.04
#: Height of the rim crest above the surroundings over diameter: 0.04 fresh (Pike 1977); diffusion lowers it faster
#: than the bowl.
FRESH_RIM, DEGRADED_RIM = 0.04, 0.004
#: Height over which the rim is rounded, as a share of the depth.
SHARPEST_RIM, ROUNDEST_RIM = 0.08, 0.9
#: Share of the original bowl's depth that is filled in the most degraded craters.
DEEPEST_FILL = 0.45
#: Ejecta keep their own brightness only while a crater is this fresh.
BRIGHT_ABOVE = 0.75


def draw_craters(parameters: TerrainParameters, rng: np.random.Generator) -> Float64[np.ndarray, "craters 15"]:
    """Craters, the largest first, with the rows that `kernels.stamp_craters` takes.

    Their number is Poisson; diameters follow the truncated power law ``N(>D) ~ D**-exponent``. Freshness f is drawn as
    ``u**2``, u uniform: a crater is degraded for most of its life. Outlines are out of round by a few per cent.
    """
    smallest, largest = parameters.crater_diameter_min_m, parameters.crater_diameter_max_m
    if largest <= smallest:
        raise ValueError(
            f"crater_diameter_max_m is {largest:g}; it must be larger than crater_diameter_min_m, {smallest:g}"
        )
    period = parameters.samples * parameters.spacing_m
    count = int(rng.poisson(parameters.craters_per_km2 * (period / 1000.0) ** 2))
    exponent = parameters.crater_exponent
    share_above = rng.uniform((largest / smallest) ** -exponent, 1.0, count)
    diameter = np.sort(smallest * share_above ** (-1.0 / exponent))[::-1]
    fresh = rng.uniform(0.0, 1.0, count) ** 2
    place = rng.uniform(0.0, period, (count, 2))
    rim = diameter * _between(DEGRADED_RIM, FRESH_RIM, fresh)
    depth = diameter * _between(DEGRADED_DEPTH, FRESH_DEPTH, fresh) - rim
    rounding = depth * _between(ROUNDEST_RIM, SHARPEST_RIM, fresh)
    fill = DEEPEST_FILL * (1.0 - fresh)
    bright = parameters.crater_ejecta_contrast * np.maximum(fresh - BRIGHT_ABOVE, 0.0) / (1.0 - BRIGHT_ABOVE)
    bright *= rng.choice([-1.0, 1.0], count)
    outline = rng.standard_normal((count, 6)) * np.repeat([0.025, 0.02, 0.012], 2)
    phase = rng.uniform(0.0, 2.0 * np.pi, count)
    return np.column_stack([place, diameter / 2.0, depth, rim, rounding, fill, bright, outline, phase])


def _between(degraded: float, fresh: float, share: Float64[np.ndarray, "craters"]) -> Float64[np.ndarray, "craters"]:
    return np.asarray(degraded + (fresh - degraded) * share)
