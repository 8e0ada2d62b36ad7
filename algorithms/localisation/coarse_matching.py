"""Matching of large patches for the coarse stage: selection, correlation with the map, candidate offsets, verification.

An offset is the true minus the estimated horizontal position (east, north), metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from marsyard.algorithms.arrays import Flags, Points2, Raster, Vector, Vector2
from marsyard.algorithms.image.interest import harris_interest, structure_tensor
from marsyard.algorithms.image.peaks import biquadratic_offset, highest_peak, second_peak
from marsyard.algorithms.localisation.interface import MapProduct
from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.algorithms.localisation.rectification import GroundView, RectifiedImage, rectify_patches

#: Support of the structure tensor for the contrast of a patch, coarse pixels, and spacing of candidate patches.
_CONTRAST_SUPPORT_PX = 5
_PATCH_STEP_PX = 8
#: Minimum distance of two patches of an image, in sides of a patch; largest side of a patch, as a fraction of the side
#: of the image's footprint.
_PATCH_SPACING = 0.75
_FOOTPRINT_FRACTION = 0.4
#: Minimum standard deviation of a patch relative to its mean: below it, only noise and rounding remain (assumed).
_MIN_PATCH_CONTRAST = 1e-3
#: Fraction of valid pixels above which a square counts as complete: the mean of ones has rounding errors.
_COMPLETE = 0.9999
#: Correlation over offsets (rows, columns).
Surface = Float[np.ndarray, "_ _"]


@dataclass(frozen=True)
class ImagePatch:
    """Patch of a rectified image: corner (column, row) on the map's grid, values, number of its image."""

    corner: tuple[int, int]
    values: Raster
    image: int

    @property
    def side(self) -> int:
        """Side, map pixels."""
        return len(self.values)


def select_patches(rectified: RectifiedImage, grid: MapProduct, number: int, options: LvsOptions) -> list[ImagePatch]:
    """Select the patches with the highest contrast, apart from each other, inside image and map."""
    extent = float(np.sqrt(np.count_nonzero(rectified.valid)))
    side = min(options.patch_px, int(_FOOTPRINT_FRACTION * extent))
    if side < options.min_patch_px:
        return []
    mean = float(rectified.values[rectified.valid].mean())
    if not mean > 0.0:
        return []
    values = np.where(rectified.valid, rectified.values - np.float32(mean), np.float32(0.0))
    interest = harris_interest(*structure_tensor(values, _CONTRAST_SUPPORT_PX))
    contrasts = cv2.boxFilter(interest.astype(np.float32), cv2.CV_32F, (side, side), anchor=(0, 0))
    filled = cv2.boxFilter(rectified.valid.astype(np.float32), cv2.CV_32F, (side, side), anchor=(0, 0)) > _COMPLETE
    rows = np.arange(0, values.shape[0] - side + 1, _PATCH_STEP_PX)
    columns = np.arange(0, values.shape[1] - side + 1, _PATCH_STEP_PX)
    map_columns, map_rows = columns + rectified.corner[0], rows + rectified.corner[1]
    on_map_columns = (map_columns >= 0) & (map_columns + side <= grid.appearance.shape[1])
    on_map_rows = (map_rows >= 0) & (map_rows + side <= grid.appearance.shape[0])
    lattice = np.ix_(rows, columns)
    scores = np.where(filled[lattice] & on_map_rows[:, np.newaxis] & on_map_columns, contrasts[lattice], -1.0)
    patches: list[ImagePatch] = []
    while len(patches) < options.patches_per_image and scores.max(initial=-1.0) > 0.0:
        i, j = np.unravel_index(int(np.argmax(scores)), scores.shape)
        row, column = int(rows[i]), int(columns[j])
        square = values[row : row + side, column : column + side]
        if square.std() >= _MIN_PATCH_CONTRAST * mean:
            patches.append(ImagePatch((int(map_columns[j]), int(map_rows[i])), square, number))
        near_rows = np.abs(rows - row) < _PATCH_SPACING * side
        near_columns = np.abs(columns - column) < _PATCH_SPACING * side
        scores[near_rows[:, np.newaxis] & near_columns] = -1.0
    return patches


def correlate_patch(patch: ImagePatch, appearance: Raster, radius: int) -> Float[np.ndarray, "n n"]:
    """Normalised correlation of a patch at all offsets up to `radius` (rows, columns); -1 outside map and circle."""
    column, row = patch.corner
    rows, columns = appearance.shape
    side, full = patch.side, 2 * radius + 1
    low_row, low_column = max(row - radius, 0), max(column - radius, 0)
    high_row, high_column = min(row + side + radius, rows), min(column + side + radius, columns)
    surface = np.full((full, full), -1.0, np.float32)
    window = np.ascontiguousarray(appearance[low_row:high_row, low_column:high_column], dtype=np.float32)
    template = (patch.values - patch.values.mean()).astype(np.float32)
    values = cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED)
    first_row, first_column = low_row - row + radius, low_column - column + radius
    surface[first_row : first_row + values.shape[0], first_column : first_column + values.shape[1]] = values
    steps = np.arange(-radius, radius + 1)
    surface[steps[:, np.newaxis] ** 2 + steps**2 > radius**2] = -1.0
    return np.where(np.isfinite(surface), surface, np.float32(-1.0))


@dataclass(frozen=True)
class OffsetCandidate:
    """Verified candidate: mean offset, and offset, score and consistency of each patch.

    - repetition: second-highest local maximum of the patches' mean correlation near the candidate, relative to the
      maximum
    """

    offset_m: Vector2
    offsets_m: Points2
    scores: Vector
    consistent: Flags
    repetition: float = 0.0

    @property
    def count(self) -> int:
        """Number of consistent patches."""
        return int(np.count_nonzero(self.consistent))

    @property
    def support(self) -> float:
        """Sum of the scores of the consistent patches."""
        return float(self.scores[self.consistent].sum())


def find_candidate_offsets(
    surfaces: Float[np.ndarray, "patches n n"], radius: int, pixel_m: float, options: LvsOptions
) -> list[Vector2]:
    """Offsets (east, north) with the largest support of the patches' surfaces, at most `coarse_candidates`, metres.

    A patch supports an offset by its highest correlation within the tolerance, if this is close to its maximum over the
    search area.
    """
    tolerance = max(int(np.ceil(options.coarse_tolerance_m / pixel_m)), 1)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * tolerance + 1, 2 * tolerance + 1))
    support = np.zeros(surfaces.shape[1:], np.float32)
    for surface in surfaces:
        limit = max(options.coarse_min_score, options.alternative_score * float(surface.max()))
        values = cv2.dilate(surface, kernel)
        support += np.where(values >= limit, values, np.float32(0.0))
    # where the support is equal over an area, the blurred support selects the area's centre
    smooth = support + 1e-3 * cv2.blur(support, (2 * tolerance + 1, 2 * tolerance + 1))
    offsets: list[Vector2] = []
    rows, columns = np.mgrid[: smooth.shape[0], : smooth.shape[1]]
    while len(offsets) < options.coarse_candidates and float(smooth.max()) > 0.0:
        row, column = (int(i) for i in np.unravel_index(int(np.argmax(smooth)), smooth.shape))
        offsets.append(pixel_m * np.array([column - radius, row - radius], dtype=np.float64))
        smooth[(rows - row) ** 2 + (columns - column) ** 2 <= (2 * tolerance) ** 2] = 0.0
    return offsets


def verify_candidate(
    offset_m: Vector2,
    patches: Sequence[ImagePatch],
    views: Sequence[GroundView],
    grid: MapProduct,
    appearance: Raster,
    options: LvsOptions,
) -> OffsetCandidate:
    """Match all patches near a candidate, rectified to the map's elevation there; repeated at the improved offset."""
    tolerance = max(int(np.ceil(options.coarse_tolerance_m / grid.pixel_m)), 1)
    candidate = OffsetCandidate(
        offset_m, np.zeros((len(patches), 2)), np.zeros(len(patches)), np.zeros(len(patches), dtype=bool)
    )
    for half in (2 * tolerance, tolerance):
        offsets, scores = np.zeros((len(patches), 2)), np.full(len(patches), -1.0)
        surfaces: list[Surface] = []
        for number, view in enumerate(views):
            rows = [k for k, patch in enumerate(patches) if patch.image == number]
            if rows:
                members, near = [patches[k] for k in rows], candidate.offset_m
                matches = _match_near(near, members, view, grid, appearance, half, options)
                offsets[rows], scores[rows] = matches.offsets_m, matches.scores
                surfaces += matches.surfaces
        candidate = _find_consensus(candidate.offset_m, offsets, scores, options)
        if not candidate.count:
            return candidate
    return replace(candidate, repetition=_compute_repetition(surfaces, options.relief_tolerance_m / grid.pixel_m))


def _compute_repetition(surfaces: Sequence[Surface], exclusion_px: float) -> float:
    """Ratio of the second-highest local maximum of the mean of surfaces to the maximum; 0 without surfaces."""
    if not surfaces:
        return 0.0
    mean = np.mean(surfaces, axis=0)
    peak = highest_peak(mean)
    return second_peak(mean, peak, exclusion_px) / peak.value if peak.value > 0.0 else 0.0


class NearMatches(NamedTuple):
    """Matches of one image's patches near an offset.

    - offsets_m: offset (east, north) of each patch
    - scores: its normalised correlation; -1 without a match
    - surfaces: surfaces of correlation that the map's border does not cut
    """

    offsets_m: Points2
    scores: Vector
    surfaces: list[Surface]


def _match_near(
    offset_m: Vector2,
    patches: Sequence[ImagePatch],
    view: GroundView,
    grid: MapProduct,
    appearance: Raster,
    half: int,
    options: LvsOptions,
) -> NearMatches:
    """Match one image's patches within `half` coarse pixels of an offset (east, north)."""
    shift = np.rint(offset_m / grid.pixel_m)
    corners = np.array([patch.corner for patch in patches]) + shift
    values, inside = rectify_patches(view, grid, corners, patches[0].side, offset_m)
    offsets, scores = np.zeros((len(patches), 2)), np.full(len(patches), -1.0)
    side = patches[0].side
    surfaces: list[Surface] = []
    for k in np.flatnonzero(inside):
        template = values[k] - values[k].mean()
        column, row = (int(i) for i in corners[k])
        low_column, low_row = max(column - half, 0), max(row - half, 0)
        window = np.ascontiguousarray(
            appearance[low_row : row + side + half, low_column : column + side + half], dtype=np.float32
        )
        surface = cv2.matchTemplate(window, template.astype(np.float32), cv2.TM_CCOEFF_NORMED).astype(np.float64)
        peak = highest_peak(surface)
        if surface.shape == (2 * half + 1, 2 * half + 1):
            surfaces.append(surface)
        if peak.on_border or not np.isfinite(peak.value):
            continue
        found = np.array([peak.row, peak.column]) + biquadratic_offset(surface, peak)
        offsets[k] = offset_m + grid.pixel_m * np.array([low_column + found[1] - column, low_row + found[0] - row])
        scores[k] = peak.value
    return NearMatches(offsets, scores, surfaces)


def _find_consensus(start_m: Vector2, offsets_m: Points2, scores: Vector, options: LvsOptions) -> OffsetCandidate:
    """Find the largest group of patches within the tolerance of one of them, and its mean weighted by the scores."""
    accepted = scores >= options.coarse_min_score
    distances = np.linalg.norm(offsets_m[:, np.newaxis] - offsets_m, axis=-1)
    near = (distances <= options.relief_tolerance_m) & accepted & accepted[:, np.newaxis]
    support = near @ np.maximum(scores, 0.0)
    if not np.any(accepted):
        return OffsetCandidate(start_m, offsets_m, scores, np.zeros(len(scores), dtype=bool))
    members = near[int(np.argmax(support))]
    mean = np.average(offsets_m[members], axis=0, weights=scores[members])
    consistent = accepted & (np.linalg.norm(offsets_m - mean, axis=1) <= options.relief_tolerance_m)
    return OffsetCandidate(mean, offsets_m, scores, consistent)
