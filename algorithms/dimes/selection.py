"""Selection of templates: the candidates of highest interest that do not share ground (section II.A)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from marsyard.algorithms.dimes.binning import View
from marsyard.algorithms.dimes.options import DimesOptions
from marsyard.algorithms.dimes.overlap import Candidates
from marsyard.algorithms.image.interest import harris_interest, local_mean, structure_tensor

#: Fraction of the full scale below which a mean signal no longer divides the interest: darkness is not contrast.
DARK_FRACTION = 0.01


def contrasts(view: View, pixels: Float[np.ndarray, "n 2"], support: int) -> Float[np.ndarray, "n"]:
    """Harris interest over a square of `support` pixels about whole pixels (u, v), over the mean signal there.

    Computed on the picture as delivered: only templates and windows are corrected. The frame-transfer ramp is smooth
    along columns and changes the interest little, because Harris asks for structure in both directions.
    """
    columns, rows = np.rint(pixels).astype(int).T
    uu, vv, uv = (part[rows, columns] for part in structure_tensor(view.signal, support))
    mean = local_mean(view.signal, support)[rows, columns]
    return np.asarray(harris_interest(uu, vv, uv) / np.maximum(mean, DARK_FRACTION * view.calibration.full_scale_dn))


def best_candidates(
    contrasts: Float[np.ndarray, "n"],
    pixels: Float[np.ndarray, "n 2"],
    preferred: Bool[np.ndarray, "n"],
    count: int,
    exclusion_px: float,
) -> list[int]:
    """Indices of up to `count` candidates: each the one of highest contrast that is left, preferred ones first.

    After each choice the candidates nearer than `exclusion_px` to it in both column and row are struck out.
    """
    left = np.ones(len(contrasts), dtype=bool)
    chosen: list[int] = []
    while len(chosen) < count and left.any():
        pool = left & preferred if np.any(left & preferred) else left
        best = int(np.argmax(np.where(pool, contrasts, -np.inf)))
        chosen.append(best)
        left &= np.abs(pixels - pixels[best]).max(axis=1) >= exclusion_px
    return chosen


def select_templates(
    view: View, candidates: Candidates, options: DimesOptions
) -> tuple[list[int], Float[np.ndarray, "k"]]:
    """The chosen candidates' indices, best first, and the contrast of each (see `contrasts`)."""
    found = contrasts(view, candidates.pixels, options.template_px)
    chosen = best_candidates(
        found, candidates.pixels, candidates.preferred, options.templates_per_pair, options.exclusion_px
    )
    return chosen, found[chosen]
