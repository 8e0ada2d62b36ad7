"""Selection of templates: the candidates of highest interest that do not share ground (section II.A)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from algorithms.dimes.binning import View
from algorithms.dimes.options import DimesOptions
from algorithms.dimes.overlap import Candidates
from algorithms.image.interest import harris_interest, local_mean

#: Fraction of the full scale below which a mean signal no longer divides the interest: darkness is not contrast.
DARK_FRACTION = 0.01


def contrast_map(view: View, support: int) -> Float[np.ndarray, "rows columns"]:
    """Harris interest over a square of `support` pixels over the mean signal there, per pixel, shape (rows, columns).

    Computed on the picture as delivered: only templates and windows are corrected. The frame-transfer ramp is smooth
    along columns and changes the interest little, because Harris asks for structure in both directions.
    """
    mean = np.maximum(local_mean(view.signal, support), DARK_FRACTION * view.calibration.full_scale_dn)
    return np.asarray(harris_interest(view.signal, support) / mean)


def at_pixels(image: Float[np.ndarray, "rows columns"], pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
    """Values of the image at whole pixels (u, v)."""
    whole = np.rint(pixels).astype(int)
    return np.asarray(image[whole[:, 1], whole[:, 0]])


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
    """The chosen candidates' indices, best first, and the contrast of each (see `contrast_map`)."""
    contrasts = at_pixels(contrast_map(view, options.template_px), candidates.pixels)
    chosen = best_candidates(
        contrasts, candidates.pixels, candidates.preferred, options.templates_per_pair, options.exclusion_px
    )
    return chosen, contrasts[chosen]
