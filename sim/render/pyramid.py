"""A surface's levels as compiled kernels take them: as many for every surface."""

from __future__ import annotations

import numpy as np

from marsyard.sim.render.kernels.structs import Array32, Extent, Ground
from marsyard.sim.terrain import Surface

#: Levels that kernels take. They are compiled for a number of arrays: for every other one they would be compiled again,
#: which takes a minute. Terrains of 2**15 samples along a side have as many.
LEVELS = 12
#: In place of the bounds of a surface's height where they are not worth their time: nothing is known to be clear.
NO_CEILING = np.full((1, 1), np.inf, dtype=np.float32)


def pyramid(surface: Surface) -> tuple[Array32, ...]:
    """The levels of a surface, the last of them repeated."""
    return surface.levels + surface.levels[-1:] * (LEVELS - len(surface.levels))


def ground_struct(surface: Surface, extent_m: Extent, *, ceilings: bool) -> Ground:
    """A surface for kernels; upper bounds of the height of its levels only where they are wanted."""
    bounds = surface.ceilings if ceilings else (NO_CEILING,)
    bounds += bounds[-1:] * (LEVELS - len(bounds))
    return Ground(pyramid(surface), bounds, len(surface.levels) - 1, surface.spacing_m, extent_m)
