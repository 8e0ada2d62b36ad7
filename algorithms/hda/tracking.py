"""Features followed into the second picture by correlation, coarse to fine (section II.A)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt16

from marsyard.algorithms.hda.kernels import matching
from marsyard.algorithms.hda.options import HdaOptions
from marsyard.algorithms.hda.pyramid import level_sizes, pyramid
from marsyard.algorithms.image.registration import Limits, registered

#: How far an alignment may go: pictures whose heights differ by a fifth are stretched by a quarter, and the iteration's
#: first steps overshoot that. Within the tracker's own bounds of 0.35, 1.5 px and 12 steps a fifth of the tracks that
#: correlation had found rightly at 20 % less height was refused.
ALIGNMENT = Limits(shift_px=2.5, stretch=0.5, steps=30)


@dataclass(frozen=True)
class Tracks:
    """Features and where they were found again.

    Attributes
    ----------
    first
        Pixels (u, v) of the features in the first picture.
    second
        Where they were found in the second; NaN where no template had room.
    correlations
        Eq. 3 at the top of the biquadratic; NaN likewise.
    accepted
        Whether the correlation is above the threshold and, with `align`, the alignment was believed.
    """

    first: Float[np.ndarray, "n 2"]
    second: Float[np.ndarray, "n 2"]
    correlations: Float[np.ndarray, "n"]
    accepted: Bool[np.ndarray, "n"]


def track_features(
    first: UInt16[np.ndarray, "rows columns"],
    second: UInt16[np.ndarray, "rows columns"],
    features: Float[np.ndarray, "n 2"],
    expected: Float[np.ndarray, "n 2"],
    options: HdaOptions,
) -> Tracks:
    """Tracks of features, searched for within the window about where they are expected (u, v).

    The best shift at a level, doubled, is where the search at the next finer level begins. Tracks end at the top of the
    biquadratic through the correlations about the best pixel or, with `align`, are aligned from there.
    """
    sizes = level_sizes(options.template_half_px, options.window_half_px)
    firsts, seconds = (pyramid(counts, len(sizes)) for counts in (first, second))
    places = np.rint(features[:, ::-1]).astype(np.int64)
    # A shift that is expected so far off that nothing has room there is of no use.
    limit = float(max(first.shape))
    wanted = np.clip(np.nan_to_num(expected - features, nan=0.0), -limit, limit)[:, ::-1]
    shifts = np.rint(wanted / 2 ** (len(sizes) - 1)).astype(np.int64)
    for level in range(len(sizes) - 1, -1, -1):
        size = sizes[level]
        shifts, _ = matching.search_level(
            firsts[level], seconds[level], places >> level, shifts, size.template_half, size.window_half
        )
        shifts = 2 * shifts if level else shifts
    found, correlations = matching.refine_shifts(firsts[0], seconds[0], places, shifts, options.template_half_px)
    accepted = correlations >= options.min_track_correlation
    if options.align:
        for k in np.flatnonzero(accepted):
            match = aligned(firsts[0], seconds[0], places[k], found[k], options)
            accepted[k] = match is not None
            found[k] = found[k] if match is None else match
    return Tracks(features, found, correlations, accepted)


def aligned(
    first: Float[np.ndarray, "rows columns"],
    second: Float[np.ndarray, "rows columns"],
    place: Int[np.ndarray, "2"],
    found: Float[np.ndarray, "2"],
    options: HdaOptions,
) -> Float[np.ndarray, "2"] | None:
    """Pixel (u, v) in the second picture of a place (row, column) in the first, aligned from where it was found.

    The template may be stretched. None where the alignment is not believed or its correlation is too low.
    """
    half = options.template_half_px
    row, column = place
    template = first[row - half : row + half + 1, column - half : column + half + 1]
    match = registered(template, second, found[::-1] - half, "stretch", limits=ALIGNMENT)
    if match is None or match.score < options.min_aligned_correlation:
        return None
    return np.asarray(match.corner[::-1] + half)
