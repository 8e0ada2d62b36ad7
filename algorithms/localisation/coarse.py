"""Coarse stage: horizontal position of the lander by matching large patches of a few images over the whole map.

The error of the inertial position is constant over the few seconds between the images. Each patch is rectified with
the estimated attitude and the altimeter's height, and correlated with the map at every offset of the position:

1. Each patch, rectified to a horizontal plane, gives a correlation surface over the offset. Candidates are maxima of
   the sum of the surfaces. Before, a maximum filter widens each surface, because relief shifts patches differently.
2. For each candidate, the patches are rectified again onto the map's elevation there, and matched near the candidate.
   Patches whose offsets agree within a small tolerance are consistent; the sum of their scores is the support. The
   candidate with the largest support is accepted if it has enough consistent patches and no other a similar support.
3. The offsets of the accepted candidate are tested against the errors that the state's covariance allows
   (`consistency`). Patches with a wrong attitude agree on a wrong offset, but not within the stated errors.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import cv2
import numpy as np
from jaxtyping import Float, Int

from marsyard.algorithms.arrays import Flags, Points2, Raster, Vector, Vector2
from marsyard.algorithms.image.correlation import biquadratic_offset, highest_peak, second_peak
from marsyard.algorithms.image.interest import harris_interest, structure_tensor
from marsyard.algorithms.localisation.consistency import (
    Consistency,
    OffsetErrors,
    OffsetTest,
    PatchGeometry,
    check_offsets,
    estimate_position_error,
    offset_covariance,
)
from marsyard.algorithms.localisation.inertial_state import POSITION
from marsyard.algorithms.localisation.interface import MapProduct
from marsyard.algorithms.localisation.map_sampling import elevation_at
from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.algorithms.localisation.posed_image import PosedImage
from marsyard.algorithms.localisation.rectification import (
    GroundView,
    RectifiedImage,
    bin_map,
    rectify_patches,
    rectify_to_plane,
    view_ground,
)

#: Support of the structure tensor for the contrast of a patch, coarse pixels, and spacing of candidate patches.
_CONTRAST_SUPPORT_PX = 5
_PATCH_STEP_PX = 8
#: Minimum distance of two patches of an image, in sides of a patch; largest side of a patch, as a fraction of the side
#: of the image's footprint.
_PATCH_SPACING = 0.75
_FOOTPRINT_FRACTION = 0.4
#: Minimum standard deviation of a patch relative to its mean: below it, only noise and rounding remain (assumed).
_MIN_PATCH_CONTRAST = 1e-3

#: Correlation over offsets (rows, columns).
Surface = Float[np.ndarray, "_ _"]


class CoarseRefusal(Enum):
    """Reasons why the coarse stage reports no position; expected refusals."""

    TOO_FEW_PATCHES = "the images have too few patches with contrast on the map"
    NO_CONSENSUS = "too few patches agree on an offset of the position"
    AMBIGUOUS = "another offset of the position has a similar support"
    BORDER = "the offset lies at the border of the search area"
    INCONSISTENT = "the offsets of the patches do not fit the errors that the state's covariance allows"


@dataclass(frozen=True)
class CoarseMatches:
    """Matches of the patches at the accepted offset, for figures. Positions are horizontal, in the world frame.

    - images: index of each patch's image
    - predicted_m: centres of the patches for the estimated position
    - map_m: positions where they were found on the map
    - scores: normalised correlations
    - consistent: patches that agree with the accepted offset
    - side_m: side of a patch
    """

    images: Int[np.ndarray, "n"]
    predicted_m: Points2
    map_m: Points2
    scores: Vector
    consistent: Flags
    side_m: Float[np.ndarray, "n"]


@dataclass(frozen=True)
class CoarseFix:
    """Horizontal offset of the true position from the estimated one, the same for all images.

    - offset_m: true minus estimated position (east, north)
    - covariance: of the offset, m^2, by the stated errors of state, altitudes, map and matching
    - matches: the patches' matches
    - support, second_support: sums of the scores of the consistent patches of the best and of the second candidate
    - consistency: test of the consistent patches' offsets
    """

    offset_m: Vector2
    covariance: Float[np.ndarray, "2 2"]
    matches: CoarseMatches
    support: float
    second_support: float
    consistency: Consistency | None = None


@dataclass(frozen=True)
class _Patch:
    """Patch of a rectified image: corner (column, row) on the map's grid, values, number of its image."""

    corner: tuple[int, int]
    values: Raster
    image: int

    @property
    def side(self) -> int:
        return len(self.values)


@dataclass(frozen=True)
class _Candidate:
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
        return int(np.count_nonzero(self.consistent))

    @property
    def support(self) -> float:
        return float(self.scores[self.consistent].sum())


def find_coarse_position(
    images: Sequence[PosedImage],
    height_above_ground_m: Sequence[float],
    map_product: MapProduct,
    covariance: Float[np.ndarray, "9 9"],
    options: LvsOptions,
) -> CoarseFix | CoarseRefusal:
    """Find the common horizontal offset of the images' estimated positions by matching large patches to the map.

    - height_above_ground_m: height of the body's origin above the ground below it at each image, from the altimeter
    - covariance: of the errors of position (m), velocity (m/s) and attitude (rad, world axes) at the last image
    """
    grid = bin_map(map_product, options.coarse_binning)
    views = [
        view_ground(image, float(height), grid.pixel_m)
        for image, height in zip(images, height_above_ground_m, strict=True)
        if height > 0.0
    ]
    patches: list[_Patch] = []
    for number, view in enumerate(views):
        rectified = rectify_to_plane(view, grid, options.max_off_nadir_rad)
        patches += _select_patches(rectified, grid, number, options)
    if len(patches) < options.min_consistent_patches:
        return CoarseRefusal.TOO_FEW_PATCHES
    sd_m = float(np.sqrt(np.diag(covariance)[POSITION][:2].max()))
    # differences from the mean keep the precision of float32 sums
    appearance = grid.appearance - grid.appearance.mean()
    # an offset contains the map's registration error; offsets near the border of the search area are refused
    search_m = min(options.search_radius_m, options.search_sigmas * sd_m) + options.relief_tolerance_m
    search_m += options.search_sigmas * map_product.registration_sd_m
    radius = int(np.ceil(search_m / grid.pixel_m))
    surfaces = np.stack([_correlate_patch(patch, appearance, radius) for patch in patches])
    peaks = _candidate_offsets(surfaces, radius, grid.pixel_m, options)
    candidates = [_verify_candidate(peak, patches, views, grid, appearance, options) for peak in peaks]
    return _accept_best_candidate(candidates, patches, views, grid, radius, covariance, options)


def _select_patches(rectified: RectifiedImage, grid: MapProduct, number: int, options: LvsOptions) -> list[_Patch]:
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
    filled = cv2.boxFilter(rectified.valid.astype(np.float32), cv2.CV_32F, (side, side), anchor=(0, 0)) > 0.9999
    rows = np.arange(0, values.shape[0] - side + 1, _PATCH_STEP_PX)
    columns = np.arange(0, values.shape[1] - side + 1, _PATCH_STEP_PX)
    map_columns, map_rows = columns + rectified.corner[0], rows + rectified.corner[1]
    on_map_columns = (map_columns >= 0) & (map_columns + side <= grid.appearance.shape[1])
    on_map_rows = (map_rows >= 0) & (map_rows + side <= grid.appearance.shape[0])
    lattice = np.ix_(rows, columns)
    scores = np.where(filled[lattice] & on_map_rows[:, np.newaxis] & on_map_columns, contrasts[lattice], -1.0)
    patches: list[_Patch] = []
    while len(patches) < options.patches_per_image and scores.max(initial=-1.0) > 0.0:
        i, j = np.unravel_index(int(np.argmax(scores)), scores.shape)
        row, column = int(rows[i]), int(columns[j])
        square = values[row : row + side, column : column + side]
        if square.std() >= _MIN_PATCH_CONTRAST * mean:
            patches.append(_Patch((int(map_columns[j]), int(map_rows[i])), square, number))
        near_rows = np.abs(rows - row) < _PATCH_SPACING * side
        near_columns = np.abs(columns - column) < _PATCH_SPACING * side
        scores[near_rows[:, np.newaxis] & near_columns] = -1.0
    return patches


def _correlate_patch(patch: _Patch, appearance: Raster, radius: int) -> Float[np.ndarray, "n n"]:
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


def _candidate_offsets(
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


def _verify_candidate(
    offset_m: Vector2,
    patches: Sequence[_Patch],
    views: Sequence[GroundView],
    grid: MapProduct,
    appearance: Raster,
    options: LvsOptions,
) -> _Candidate:
    """Match all patches near a candidate, rectified to the map's elevation there; repeated at the improved offset."""
    tolerance = max(int(np.ceil(options.coarse_tolerance_m / grid.pixel_m)), 1)
    candidate = _Candidate(
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
                offsets[rows], scores[rows] = matches[:2]
                surfaces += matches[2]
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


def _match_near(
    offset_m: Vector2,
    patches: Sequence[_Patch],
    view: GroundView,
    grid: MapProduct,
    appearance: Raster,
    half: int,
    options: LvsOptions,
) -> tuple[Points2, Vector, list[Surface]]:
    """Offsets (east, north) and scores of one image's patches near an offset; the score is -1 if there is no match.

    Also returns the surfaces of correlation that the map's border does not cut.
    """
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
    return offsets, scores, surfaces


def _find_consensus(start_m: Vector2, offsets_m: Points2, scores: Vector, options: LvsOptions) -> _Candidate:
    """Find the largest group of patches within the tolerance of one of them, and its mean weighted by the scores."""
    accepted = scores >= options.coarse_min_score
    distances = np.linalg.norm(offsets_m[:, np.newaxis] - offsets_m, axis=-1)
    near = (distances <= options.relief_tolerance_m) & accepted & accepted[:, np.newaxis]
    support = near @ np.maximum(scores, 0.0)
    if not np.any(accepted):
        return _Candidate(start_m, offsets_m, scores, np.zeros(len(scores), dtype=bool))
    members = near[int(np.argmax(support))]
    mean = np.average(offsets_m[members], axis=0, weights=scores[members])
    consistent = accepted & (np.linalg.norm(offsets_m - mean, axis=1) <= options.relief_tolerance_m)
    return _Candidate(mean, offsets_m, scores, consistent)


def _accept_best_candidate(
    candidates: list[_Candidate],
    patches: Sequence[_Patch],
    views: Sequence[GroundView],
    grid: MapProduct,
    radius: int,
    covariance: Float[np.ndarray, "9 9"],
    options: LvsOptions,
) -> CoarseFix | CoarseRefusal:
    """Accept the candidate with the largest support, or return the reason for refusing it."""
    ranked = sorted(candidates, key=lambda candidate: candidate.support, reverse=True)
    if not ranked or ranked[0].count < max(options.min_consistent_patches, 1):
        return CoarseRefusal.NO_CONSENSUS
    best = ranked[0]
    distances = [float(np.linalg.norm(other.offset_m - best.offset_m)) for other in ranked]
    # candidates that converged to the same offset are not alternatives
    others = [c.support for c, d in zip(ranked, distances, strict=True) if d > 2.0 * options.relief_tolerance_m]
    second = max(others, default=0.0)
    if second > options.max_second_support * best.support or best.repetition > options.alternative_score:
        return CoarseRefusal.AMBIGUOUS
    if np.linalg.norm(best.offset_m) > radius * grid.pixel_m - options.relief_tolerance_m:
        return CoarseRefusal.BORDER
    rows = np.flatnonzero(best.consistent)
    geometry, errors = _describe_patches(best, patches, views, grid, options)
    # a wrong patch has its maximum anywhere in the square window of the verification
    chance = np.pi * options.relief_tolerance_m**2 / (2.0 * options.coarse_tolerance_m) ** 2
    test = OffsetTest(options.patch_outlier_probability, options.false_refusal, chance)
    state_offsets = offset_covariance(geometry, covariance, errors)
    consistency = check_offsets(best.offsets_m[rows], state_offsets, len(patches) - len(rows), test)
    members = consistency.members
    if members.sum() < options.min_consistent_patches or not consistency.is_consistent:
        return CoarseRefusal.INCONSISTENT
    errors = replace(errors, height_m=errors.height_m[members])
    offset, offset_errors = estimate_position_error(
        best.offsets_m[rows[members]], geometry.select(members), covariance, errors
    )
    best = replace(best, offset_m=offset, consistent=np.isin(np.arange(len(patches)), rows[members]))
    return CoarseFix(
        offset_m=offset,
        covariance=offset_errors,
        matches=_collect_matches(best, patches, grid),
        support=best.support,
        second_support=second,
        consistency=consistency,
    )


def _describe_patches(
    best: _Candidate, patches: Sequence[_Patch], views: Sequence[GroundView], grid: MapProduct, options: LvsOptions
) -> tuple[PatchGeometry, OffsetErrors]:
    """Return the geometry of the consistent patches, and the errors of altitudes, map and matching."""
    rows = np.flatnonzero(best.consistent)
    members = [patches[k] for k in rows.tolist()]
    images = np.array([patch.image for patch in members])
    matches = _collect_matches(best, patches, grid)
    below = np.array([elevation_at(grid, view.image.position_m[:2] + best.offset_m) for view in views])
    heights = np.array([elevation_at(grid, found_m) for found_m in matches.map_m[rows]]) - below[images]
    cameras = np.stack([view.camera.c for view in views])[images]
    lines = np.column_stack([matches.predicted_m[rows], heights]) - cameras
    times = np.array([view.image.time_s for view in views])
    geometry = PatchGeometry(images, matches.map_m[rows], matches.side_m[rows], lines, times[-1] - times[images])
    errors = OffsetErrors(
        height_m=np.hypot(options.altitude_sd * cameras[:, 2], grid.elevation_sd_m),
        distortion_m=grid.distortion_sd_m,
        elevation_m=grid.elevation_sd_m,
        # an error that is uniform over a coarse pixel
        matching_m=grid.pixel_m / float(np.sqrt(12.0)),
    )
    return geometry, errors


def _collect_matches(best: _Candidate, patches: Sequence[_Patch], grid: MapProduct) -> CoarseMatches:
    corners = np.array([patch.corner for patch in patches], dtype=np.float64)
    sides = np.array([patch.side for patch in patches], dtype=np.float64)
    predicted = grid.origin_m + grid.pixel_m * (corners + 0.5 * (sides[:, np.newaxis] - 1.0))
    return CoarseMatches(
        images=np.array([patch.image for patch in patches]),
        predicted_m=predicted,
        map_m=predicted + best.offsets_m,
        scores=best.scores,
        consistent=best.consistent,
        side_m=sides * grid.pixel_m,
    )
