"""Feature selection, and tracking by correlation over an image pyramid (section II.A).

Sections and equations are those of Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from marsyard.algorithms.arrays import Counts, Flags, Points2, Raster, Vector, Vector2
from marsyard.algorithms.hda.kernels import matching
from marsyard.algorithms.hda.options import HdaOptions, TrackSeed
from marsyard.algorithms.hda.scene import CameraView
from marsyard.algorithms.image.correlation import halve
from marsyard.algorithms.image.interest import structure_tensor
from marsyard.algorithms.image.registration import RegistrationLimits, register_template

#: Half width of the search window at all levels except the coarsest; minimum half width of all templates and windows
#: (Eq. 5), pixels.
MIN_HALF_PX = 2
#: Maximum size of the template at a pyramid level, as a fraction of the shorter image side. A larger template has
#: only a few positions in the image (three at level 6 of 640 x 480 pixels), which cover large displacements, and
#: templates of different features are nearly the same. Without coarse levels, the larger window has more wrong peaks.
MAX_TEMPLATE_FRACTION = 0.25
#: Limits of an alignment: a height change of 20 % stretches the image by 25 %, and the first steps overshoot. The
#: default limits of `RegistrationLimits` rejected 20 % of the correct tracks after a descent by 20 % of the height.
ALIGNMENT_LIMITS = RegistrationLimits(shift_px=2.5, stretch=0.5, steps=30)


@dataclass(frozen=True)
class LevelSize:
    """Half widths of template and search window at a pyramid level, pixels of that level."""

    template_half: int
    window_half: int


def level_sizes(template_half: int, window_half: int, size: tuple[int, int]) -> tuple[LevelSize, ...]:
    """Compute the sizes at each pyramid level, finest level first (Eqs. 4 and 5), for images of size (columns, rows).

    The w of Eq. 4 is assumed to be the half width of Eq. 5. With n = log2(w) - 2 levels, rounded down, the coarsest
    window has a half width of 4 to 8. The levels end before the first coarse one at which the template exceeds
    `MAX_TEMPLATE_FRACTION` of the image; the window of the coarsest remaining level has the half width w at its scale
    (Eq. 5). The finest level always remains.
    """
    levels = max(int(np.log2(window_half)) - 2, 0)
    templates: list[int] = []
    for level in range(levels + 1):
        template = max(MIN_HALF_PX, int(template_half / 2**level + 0.5))
        fits = 2 * template + 1 <= MAX_TEMPLATE_FRACTION * (min(size) >> level)
        # the image itself is always searched
        if fits or level == 0:
            templates.append(template)
        if not fits:
            break
    coarsest = len(templates) - 1
    windows = [MIN_HALF_PX] * coarsest + [max(MIN_HALF_PX, int(window_half / 2**coarsest + 0.5))]
    return tuple(LevelSize(template, window) for template, window in zip(templates, windows, strict=True))


def window_half_px(view: CameraView, options: HdaOptions) -> int:
    """Half width w of the search window (Eqs. 4 and 5), whole pixels: the option of this name, or the expected shift.

    The expected shift is the largest displacement of a feature from the start of its search: that of level ground on
    the optical axis by translation and tilt, plus that of an image corner by rotation about the optical axis and by the
    magnification of a descent; at most the longer side of the image.
    A start from the poses (option `track_seed`) leaves the parallax of ground that is higher than level ground by the
    fraction `depth_margin` of the range.
    """
    if options.window_half_px is not None:
        return options.window_half_px
    columns, rows = view.camera.size
    if options.track_seed is TrackSeed.POSE:
        nearest = 1.0 / (1.0 - options.depth_margin)
        shift_px = view.focal_px * options.max_baseline_fraction * (nearest - 1.0)
    else:
        magnification = 1.0 / (1.0 - options.max_height_change_fraction)
        axis_px = view.focal_px * (magnification * options.max_baseline_fraction + np.tan(options.max_tilt_change_rad))
        corner = magnification - 1.0 + 2.0 * np.sin(0.5 * options.max_roll_change_rad)
        shift_px = float(axis_px + 0.5 * np.hypot(columns, rows) * corner)
    return int(np.clip(np.ceil(shift_px), MIN_HALF_PX, max(columns, rows)))


def pyramid(counts: Counts, levels: int) -> tuple[Float[np.ndarray, "_ _"], ...]:
    """Build the image pyramid: the image and its averages over blocks of 2, 4, ... pixels, finest first, float32."""
    result = [counts.astype(np.float32)]
    for _ in range(levels - 1):
        result.append(halve(result[-1]))
    return tuple(result)


def eigenvalue_test(image: Raster, support: int, min_eigenvalue: float) -> Raster:
    """Interest P of Eq. 2 where both eigenvalues of the structure tensor exceed the minimum l; -inf elsewhere.

    P is (a - l)(c - l) - b b with a > l, for the tensor's entries a (uu), c (vv) and b (uv) (Benedetti & Perona 1998).
    The tensor is the mean, not the sum, over `support` x `support` pixels (Eq. 1 divided by their number).
    """
    a, c, b = structure_tensor(image, support)
    interest = (a - min_eigenvalue) * (c - min_eigenvalue) - b * b
    return np.asarray(np.where((interest > 0.0) & (a > min_eigenvalue), interest, -np.inf), dtype=np.float32)


def select_features(counts: Counts, options: HdaOptions) -> Points2:
    """Select the feature of highest interest in each block of the image; return pixels (u, v), block rows first.

    Blocks without a feature are omitted. The template of a feature fits into the image with a margin of 1 px.
    """
    interest = eigenvalue_test(counts.astype(np.float32), 2 * options.template_half_px + 1, options.min_eigenvalue)
    border = options.template_half_px + 1
    interest[:border] = interest[-border:] = -np.inf
    interest[:, :border] = interest[:, -border:] = -np.inf
    side = options.block_px
    padded_interest = np.pad(interest, [(0, -extent % side) for extent in interest.shape], constant_values=-np.inf)
    block_rows, block_columns = (extent // side for extent in padded_interest.shape)
    blocks = padded_interest.reshape(block_rows, side, block_columns, side).swapaxes(1, 2)
    best = blocks.reshape(*blocks.shape[:2], -1).argmax(axis=-1)
    row, column = (index * side for index in np.indices(best.shape))
    row, column = row + best // side, column + best % side
    has_feature = np.isfinite(blocks.max(axis=(2, 3)))
    return np.column_stack([column[has_feature], row[has_feature]]).astype(np.float64)


@dataclass(frozen=True)
class Tracks:
    """Features of the first image and their tracks.

    - first: Pixels (u, v) in the first image
    - second: Pixels (u, v) in the second image; NaN if no template fits
    - correlations: Eq. 3 at the biquadratic peak; NaN if no template fits
    - accepted: Whether the correlation exceeds the threshold and, with `align`, the alignment succeeded
    """

    first: Points2
    second: Points2
    correlations: Vector
    accepted: Flags


def track_features(
    first: Counts, second: Counts, features: Points2, expected_pixels: Points2, window_half: int, options: HdaOptions
) -> Tracks:
    """Track features by correlation, coarse to fine, within the window around their expected pixels (u, v).

    The window has the half width `window_half`, pixels. Twice the best shift of a level is the start of the search at
    the next finer level. A template that leaves the first image at a coarse level is moved to the nearest position
    inside: neighbouring ground has nearly the same displacement, and the finer levels search the rest. The result is
    the biquadratic peak of the correlations around the best pixel; with `align` it is refined by registration.
    """
    sizes = level_sizes(options.template_half_px, window_half, (first.shape[1], first.shape[0]))
    first_levels, second_levels = (pyramid(counts, len(sizes)) for counts in (first, second))
    # the kernels need (row, column) in the first image; pixels of features and matches are (u, v)
    pixels_rc = np.rint(features[:, ::-1]).astype(np.int64)
    max_shift = float(max(first.shape))
    expected_rc = np.clip(np.nan_to_num(expected_pixels - features, nan=0.0), -max_shift, max_shift)[:, ::-1]
    shifts_rc = np.rint(expected_rc / 2 ** (len(sizes) - 1)).astype(np.int64)
    for level in range(len(sizes) - 1, -1, -1):
        size = sizes[level]
        last_rc = np.array(first_levels[level].shape) - 1 - size.template_half
        positions_rc = np.clip(pixels_rc >> level, size.template_half, last_rc)
        shifts_rc, _ = matching.find_best_shifts(
            first_levels[level], second_levels[level], positions_rc, shifts_rc, size.template_half, size.window_half
        )
        shifts_rc = 2 * shifts_rc if level else shifts_rc
    second_uv, correlations = matching.refine_positions(
        first_levels[0], second_levels[0], pixels_rc, shifts_rc, options.template_half_px
    )
    is_accepted = correlations >= options.min_track_correlation
    if options.align:
        for k in np.flatnonzero(is_accepted):
            match_uv = align_track(first_levels[0], second_levels[0], pixels_rc[k], second_uv[k], options)
            is_accepted[k] = match_uv is not None
            second_uv[k] = second_uv[k] if match_uv is None else match_uv
    return Tracks(features, second_uv, correlations, is_accepted)


def align_track(
    first: Raster, second: Raster, pixel_rc: Int[np.ndarray, "2"], match_uv: Vector2, options: HdaOptions
) -> Vector2 | None:
    """Align the match of a pixel (row, column) of the first image; return its pixel (u, v) in the second image.

    The alignment starts at `match_uv`, with an affine warp. None if it fails or its correlation is too low.
    """
    half = options.template_half_px
    row, column = pixel_rc
    template = first[row - half : row + half + 1, column - half : column + half + 1]
    match = register_template(template, second, match_uv[::-1] - half, "stretch", limits=ALIGNMENT_LIMITS)
    if match is None or match.score < options.min_aligned_correlation:
        return None
    return np.asarray(match.corner[::-1] + half)
