"""The image pyramid of the sparse tracker: how many levels, and how large templates and windows are at each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt16

from marsyard.algorithms.hda.options import HdaOptions
from marsyard.algorithms.image.normalized import halved

#: Half width of the window at all levels but the coarsest, and the least of templates and windows anywhere (Eq. 5).
LEAST_HALF_PX = 2


@dataclass(frozen=True)
class LevelSize:
    """Half widths of template and window at a level of the pyramid, pixels of that level."""

    template_half: int
    window_half: int


def level_sizes(template_half: int, window_half: int) -> tuple[LevelSize, ...]:
    """Sizes at each level, finest first (Eqs. 4 and 5).

    Eq. 4's w is taken as the half width that the same letter is in Eq. 5: n = log2(w) - 2 levels above the picture
    leave a window of half width 4 to 8 at the coarsest. Fractions are cut off.
    """
    coarsest = max(int(np.log2(window_half)) - 2, 0)
    sizes = []
    for level in range(coarsest + 1):
        template = max(LEAST_HALF_PX, int(template_half / 2**level + 0.5))
        window = max(LEAST_HALF_PX, int(window_half / 2**level + 0.5)) if level == coarsest else LEAST_HALF_PX
        sizes.append(LevelSize(template, window))
    return tuple(sizes)


def reach_px(options: HdaOptions) -> int:
    """How far from its middle a template reaches at any level, pixels of the picture; one more at the finest."""
    sizes = level_sizes(options.template_half_px, options.window_half_px)
    return max((size.template_half + 1) << level for level, size in enumerate(sizes))


def pyramid(counts: UInt16[np.ndarray, "rows columns"], levels: int) -> tuple[Float[np.ndarray, "_ _"], ...]:
    """The picture and its block averages over 2, 4, ... pixels, finest first, float32."""
    result = [counts.astype(np.float32)]
    for _ in range(levels - 1):
        result.append(halved(result[-1]))
    return tuple(result)
