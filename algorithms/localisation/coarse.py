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

import numpy as np
from jaxtyping import Float

from marsyard.algorithms.arrays import Vector2
from marsyard.algorithms.localisation.coarse_matching import (
    ImagePatch,
    OffsetCandidate,
    correlate_patch,
    find_candidate_offsets,
    select_patches,
    verify_candidate,
)
from marsyard.algorithms.localisation.consistency import (
    OffsetErrors,
    OffsetTest,
    PatchGeometry,
    check_offsets,
    estimate_position_error,
    offset_covariance,
)
from marsyard.algorithms.localisation.inertial_state import POSITION
from marsyard.algorithms.localisation.interface import MapProduct
from marsyard.algorithms.localisation.map_sampling import bin_map, elevation_at
from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.algorithms.localisation.posed_image import PosedImage
from marsyard.algorithms.localisation.rectification import GroundView, rectify_to_plane, view_ground


class CoarseRefusal(Enum):
    """Reasons why the coarse stage reports no position; expected refusals."""

    TOO_FEW_PATCHES = "the images have too few patches with contrast on the map"
    NO_CONSENSUS = "too few patches agree on an offset of the position"
    AMBIGUOUS = "another offset of the position has a similar support"
    BORDER = "the offset lies at the border of the search area"
    INCONSISTENT = "the offsets of the patches do not fit the errors that the state's covariance allows"


@dataclass(frozen=True)
class CoarseFix:
    """Horizontal offset of the true position from the estimated one, the same for all images.

    - offset_m: true minus estimated position (east, north)
    - covariance: of the offset, m^2, by the stated errors of state, altitudes, map and matching
    """

    offset_m: Vector2
    covariance: Float[np.ndarray, "2 2"]


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
    patches: list[ImagePatch] = []
    for number, view in enumerate(views):
        rectified = rectify_to_plane(view, grid, options.max_off_nadir_rad)
        patches += select_patches(rectified, grid, number, options)
    if len(patches) < options.min_consistent_patches:
        return CoarseRefusal.TOO_FEW_PATCHES
    sd_m = float(np.sqrt(np.diag(covariance)[POSITION][:2].max()))
    # differences from the mean keep the precision of float32 sums
    appearance = grid.appearance - grid.appearance.mean()
    # an offset contains the map's registration error; offsets near the border of the search area are refused
    search_m = min(options.search_radius_m, options.search_sigmas * sd_m) + options.relief_tolerance_m
    search_m += options.search_sigmas * map_product.registration_sd_m
    radius = int(np.ceil(search_m / grid.pixel_m))
    surfaces = np.stack([correlate_patch(patch, appearance, radius) for patch in patches])
    peaks = find_candidate_offsets(surfaces, radius, grid.pixel_m, options)
    candidates = [verify_candidate(peak, patches, views, grid, appearance, options) for peak in peaks]
    return _accept_best_candidate(candidates, patches, views, grid, radius, covariance, options)


def _accept_best_candidate(
    candidates: list[OffsetCandidate],
    patches: Sequence[ImagePatch],
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
    # candidates that converged to the same offset are not alternatives
    min_distance_m = 2.0 * options.relief_tolerance_m
    others = [other for other in ranked if np.linalg.norm(other.offset_m - best.offset_m) > min_distance_m]
    second = max((other.support for other in others), default=0.0)
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
    return CoarseFix(offset, offset_errors)


def _describe_patches(
    best: OffsetCandidate,
    patches: Sequence[ImagePatch],
    views: Sequence[GroundView],
    grid: MapProduct,
    options: LvsOptions,
) -> tuple[PatchGeometry, OffsetErrors]:
    """Return the geometry of the consistent patches, and the errors of altitudes, map and matching."""
    rows = np.flatnonzero(best.consistent)
    members = [patches[k] for k in rows.tolist()]
    images = np.array([patch.image for patch in members])
    corners = np.array([patch.corner for patch in members], dtype=np.float64)
    sides = np.array([patch.side for patch in members], dtype=np.float64)
    # centres of the patches for the estimated position, and where they were found on the map
    predicted_m = grid.origin_m + grid.pixel_m * (corners + 0.5 * (sides[:, np.newaxis] - 1.0))
    found_m = predicted_m + best.offsets_m[rows]
    below = np.array([elevation_at(grid, view.image.position_m[:2] + best.offset_m) for view in views])
    heights = np.array([elevation_at(grid, point_m) for point_m in found_m]) - below[images]
    cameras = np.stack([view.camera.c for view in views])[images]
    lines = np.column_stack([predicted_m, heights]) - cameras
    times = np.array([view.image.time_s for view in views])
    geometry = PatchGeometry(images, found_m, sides * grid.pixel_m, lines, times[-1] - times[images])
    errors = OffsetErrors(
        height_m=np.hypot(options.altitude_sd * cameras[:, 2], grid.elevation_sd_m),
        distortion_m=grid.distortion_sd_m,
        elevation_m=grid.elevation_sd_m,
        # an error that is uniform over a coarse pixel
        matching_m=grid.pixel_m / float(np.sqrt(12.0)),
    )
    return geometry, errors
