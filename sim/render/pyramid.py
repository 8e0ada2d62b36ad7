"""A surface's levels as compiled kernels take them: as many for every surface."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from marsyard.sim.terrain import Surface

#: Levels that kernels take. They are compiled for a number of arrays: for every other one they would be compiled anew,
#: which takes a minute. Terrains of 2**15 samples along a side have as many.
LEVELS = 12
#: Bounds of the height of each level.
Ceilings = tuple[Float32[np.ndarray, "_ _"], ...]
#: In place of the bounds of a surface's height where they are not worth their time: nothing is known to be clear.
NO_CEILING = np.full((1, 1), np.inf, dtype=np.float32)


def pyramid(surface: Surface) -> tuple[tuple[Float32[np.ndarray, "_ _ 2"], ...], int]:
    """The levels of a surface, the last of them repeated, and the number of the last."""
    levels = surface.levels
    return levels + levels[-1:] * (LEVELS - len(levels)), len(levels) - 1


def ceilings(surface: Surface, wanted: bool) -> Ceilings:
    """Upper bounds of the height of the same levels, or none."""
    if not wanted:
        return (NO_CEILING,) * LEVELS
    found = surface.ceilings
    return found + found[-1:] * (LEVELS - len(found))
