"""Matching of the target in a new image: normalised correlation (sections 4.3.2, 4.3.3), or optical flow (baseline).

Sections and equations are those of Kim et al., "Targeted Driving Using Visual Tracking".
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.arrays import Counts, Patch, Vector2, Vector3
from marsyard.algorithms.image.correlation import coarse_to_fine_peak, normalized_correlation
from marsyard.algorithms.image.peaks import Peak, biquadratic_offset
from marsyard.algorithms.image.registration import MARGIN_PX, Warp, build_spline, register_template, similarity_patch
from marsyard.algorithms.vtt.options import VttOptions
from marsyard.algorithms.vtt.prediction import ViewChange, bearing_rad
from marsyard.sim.camera import CameraModel
from marsyard.sim.measurements import MastImage

#: Pyramid levels of Lucas-Kanade below full resolution; with templates of 21 px its search range is about that of the
#: correlation.
FLOW_LEVELS = 3
#: Normalisation to the 8-bit images of OpenCV: standard deviation and mean, grey levels.
SIGMA_GREY, MEAN_GREY = 40.0, 128.0
#: Registrations after the pure shift, in this order, for each option `warp` except ``none``.
_WARPS_BY_OPTION: dict[str, tuple[Warp, ...]] = {"shift": (), "stretch": ("stretch",), "bend": ("stretch", "bend")}


@dataclass(frozen=True)
class Sighting:
    """Image and poses of the last stop with a match: the reference for the next update.

    At the next update the template is resampled from this image with magnification and roll, in a single interpolation
    at the target's sub-pixel position.

    - image: The left image
    - pixel: The target in the left image, full-frame (u, v)
    - position_head: The target in the mast head's frame at that stop, metres
    - camera: The left camera in that frame
    - world_from_head, world_from_rover: Estimated poses of head and rover at that stop
    """

    image: MastImage
    pixel: Vector2
    position_head: Vector3
    camera: CameraModel
    world_from_head: RigidTransform
    world_from_rover: RigidTransform

    @property
    def distance_m(self) -> float:
        """Distance from the camera's centre to the target."""
        return float(np.linalg.norm(self.position_head - self.camera.c))

    @cached_property
    def azimuth_world_rad(self) -> float:
        """Direction from the camera to the target in the estimated world frame, clockwise from north."""
        return bearing_rad(self.world_from_head.as_matrix()[:3, :3] @ (self.position_head - self.camera.c))


@dataclass(frozen=True)
class Match:
    """The target in the new left image.

    - pixel: Full-frame (u, v)
    - score: Normalised correlation (Eq. 11) of the template with the image at `pixel`
    - template: The old image around the target, magnified and rolled
    """

    pixel: Vector2
    score: float
    template: Patch


#: Function that matches the target in a new image near a full-frame pixel; None if the window does not fit.
Matcher = Callable[[Sighting, MastImage, Vector2, ViewChange, VttOptions], Match | None]


def extract_patch(
    image: MastImage, pixel: Vector2, side: int, change: ViewChange | None = None
) -> Float[np.ndarray, "side side"]:
    """Resample a square around a full-frame pixel (sub-pixel position), magnified and rolled by `change`."""
    change = ViewChange() if change is None else change
    # convert only the pixels within half of the patch's diagonal, and the spline's margin, to floating point
    half = int(np.ceil(0.75 * side / min(change.magnification, 1.0))) + MARGIN_PX + 1
    centre = pixel - np.array(image.corner, dtype=np.float64)
    start = np.maximum(np.floor(centre).astype(int) - half, 0)
    region = image.counts[start[1] : max(int(centre[1]) + half, 1), start[0] : max(int(centre[0]) + half, 1)]
    return similarity_patch(region.astype(np.float64), centre - start, side, change.magnification, change.roll_rad)


def search_window(image: MastImage, pixel: Vector2, side: int) -> tuple[Counts, tuple[int, int]]:
    """Extract a square of `side` pixels around a full-frame pixel, clipped to the image.

    Also returns the full-frame pixel (u, v) of its upper left corner.
    """
    start = np.rint(pixel - 0.5 * (side - 1)).astype(int) - np.array(image.corner)
    end = np.maximum(start + side, 0)
    start = np.maximum(start, 0)
    window = image.counts[start[1] : end[1], start[0] : end[0]]
    return window, (int(start[0]) + image.corner[0], int(start[1]) + image.corner[1])


def window_fits(image: MastImage, pixel: Vector2, side: int) -> bool:
    """Whether a square of `side` pixels around a full-frame pixel lies inside the image."""
    local = pixel - np.array(image.corner, dtype=np.float64)
    rows, columns = image.counts.shape
    half_width = 0.5 * (side - 1)
    return bool(np.all(local >= half_width) and np.all(local <= np.array([columns, rows]) - 1.0 - half_width))


@dataclass(frozen=True)
class Refinement:
    """Sub-pixel match.

    - corner: Row and column of the template's upper left pixel in `MastImage.counts`
    - score: Normalised correlation of the shifted template
    - warped_score: Normalised correlation of the warped template
    """

    corner: Vector2
    score: float
    warped_score: float


def refine_match(
    template: Patch, image: MastImage, corner: Vector2, offset: Vector2, integer_peak: Peak, options: VttOptions
) -> Refinement:
    """Refine a match by registration: a pure shift, then the affine and quadratic warps that the options select.

    `corner` is the match at the integer peak, `offset` the sub-pixel offset from the peak fit. Without registration
    (`warp` is ``none``), or if the shift cannot be registered, `corner + offset` is returned; if a warp cannot be
    registered, the result of the previous model.
    """
    peak_fit = Refinement(corner=corner + offset, score=integer_peak.value, warped_score=integer_peak.value)
    if options.warp == "none":
        return peak_fit
    start = np.maximum(corner.astype(int) - MARGIN_PX - 2, 0)
    end = corner.astype(int) + len(template) + MARGIN_PX + 2
    region = image.counts[start[0] : end[0], start[1] : end[1]].astype(np.float64)
    spline = build_spline(region, corner + offset - start, len(template))
    shift_match = register_template(template, spline, corner + offset - start, "shift")
    if shift_match is None:
        return peak_fit
    best = shift_match
    for warp in _WARPS_BY_OPTION[options.warp]:
        spline = build_spline(region, best.corner, len(template), previous=spline)
        warp_match = register_template(template, spline, best.corner, warp)
        if warp_match is None:
            break
        best = warp_match
    return Refinement(best.corner + start, shift_match.score, best.score)


def match_by_correlation(
    sighting: Sighting, image: MastImage, predicted_pixel: Vector2, change: ViewChange, options: VttOptions
) -> Match | None:
    """Match the magnified, rolled template in a window by coarse-to-fine normalised correlation (paper's matcher)."""
    template = extract_patch(sighting.image, sighting.pixel, options.template_px, change)
    counts, window_corner = search_window(image, predicted_pixel, options.search_px)
    if min(counts.shape) < options.template_px:
        return None
    window = counts.astype(np.float64)
    peak = coarse_to_fine_peak(template, window, options.coarse_levels, options.coarse_candidates)
    half = 0.5 * (options.template_px - 1)
    corner = np.array([peak.row, peak.column]) + np.array(window_corner[::-1], dtype=np.float64) - image.corner[::-1]
    best = Refinement(corner=corner, score=peak.value, warped_score=peak.value)
    if options.subpixel:
        offset = np.zeros(2)
        if not peak.on_border:
            row, column = peak.row - 1, peak.column - 1
            neighbourhood = window[row : row + options.template_px + 2, column : column + options.template_px + 2]
            offset = biquadratic_offset(normalized_correlation(template, neighbourhood), Peak(1, 1, peak.value, False))
        best = refine_match(template, image, corner, offset, peak, options)
    return Match(best.corner[::-1] + half + image.corner, best.score, template)


def match_by_lucas_kanade(
    sighting: Sighting, image: MastImage, predicted_pixel: Vector2, change: ViewChange, options: VttOptions
) -> Match | None:
    """Match the target by its optical flow from the old image, magnified and rolled, to the new image; a `Matcher`.

    The score is the normalised correlation at the match. If the flow does not converge or leaves the image, the result
    is the predicted pixel with the score 0, or None if that pixel is outside of the image.
    """
    window, corner = search_window(image, predicted_pixel, options.search_px)
    if min(window.shape) < options.template_px:
        return None
    side = options.search_px | 1  # odd
    old_patch = extract_patch(sighting.image, sighting.pixel, side, change)
    half, centre = (options.template_px - 1) // 2, (side - 1) // 2
    template = old_patch[centre - half : centre + half + 1, centre - half : centre + half + 1]
    # OpenCV requires images of equal size: pad a window that was clipped at the frame's border
    rows, columns = window.shape
    new_patch = np.pad(window.astype(np.float64), ((0, side - rows), (0, side - columns)), mode="edge")
    start_point = np.full((1, 1, 2), centre, dtype=np.float32)
    predicted_point = (predicted_pixel - corner).astype(np.float32).reshape(1, 1, 2)
    tracked_point, status, _ = cv2.calcOpticalFlowPyrLK(
        _normalize_to_8_bits(old_patch),
        _normalize_to_8_bits(new_patch),
        start_point,
        predicted_point.copy(),
        winSize=(options.template_px, options.template_px),
        maxLevel=FLOW_LEVELS,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    pixel = np.asarray(tracked_point, dtype=np.float64).reshape(2) + corner
    if not status[0, 0] or not window_fits(image, pixel, options.template_px):
        return Match(predicted_pixel, 0.0, template) if window_fits(image, predicted_pixel, 1) else None
    return Match(pixel, correlation(template, extract_patch(image, pixel, options.template_px)), template)


def correlation(a: Float[np.ndarray, "n m"], b: Float[np.ndarray, "n m"]) -> float:
    """Normalised correlation of two patches, Eq. 11; 0 if either is flat."""
    a, b = a - a.mean(), b - b.mean()
    norms = float(np.sqrt(np.sum(a * a) * np.sum(b * b)))  # product of both norms
    return float(np.sum(a * b)) / norms if norms > 0.0 else 0.0


def _normalize_to_8_bits(image: Float[np.ndarray, "rows columns"]) -> UInt8[np.ndarray, "rows columns"]:
    """Normalise an image's mean and contrast, because exposures differ between stops."""
    contrast = max(float(image.std()), 1e-9)
    return np.asarray(np.clip(MEAN_GREY + SIGMA_GREY * (image - image.mean()) / contrast, 0, 255).astype(np.uint8))
