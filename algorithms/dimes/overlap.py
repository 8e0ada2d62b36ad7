"""Template candidates in the overlap region of two views, and their selection (section II.A).

Sections are those of Johnson et al., "Field Testing of the MER DIMES". The zero-phase spot (`ground_view`) is masked.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from marsyard.algorithms.arrays import Flags, Points2, Vector, Vector2
from marsyard.algorithms.dimes import ground_view, rectification
from marsyard.algorithms.dimes.options import DimesOptions
from marsyard.algorithms.dimes.views import BinnedView
from marsyard.algorithms.image.interest import harris_interest, structure_tensor

#: Lower limit of the mean signal before division, as a fraction of the full scale.
MIN_SIGNAL_FRACTION = 0.01
#: Number of pixels along each side of an image's border that are projected for its outline.
_BORDER_PIXELS = 8
#: Points along a side of a square's outline: its corners and the middles of its sides, which distortion bends.
OUTLINE_POINTS = 3
#: Points along a side of the lattices over template and search window that must not lie in the zero-phase spot: their
#: spacing is less than the radius of the spot.
_TEMPLATE_POINTS, _WINDOW_POINTS = 4, 7


@dataclass(frozen=True)
class SearchGeometry:
    """Sizes of template and search window in the virtual camera of a pair.

    - max_displacement_m: Largest horizontal displacement expected, and minimum width of the overlap
    - gsd_m: Ground sample distance: one binned pixel of the second view at its nadir
    - template_px: Side of the template
    - search_px: Largest shift searched in each direction
    """

    max_displacement_m: float
    gsd_m: float
    template_px: int
    search_px: int

    @property
    def window_px(self) -> int:
        """Side of the search window."""
        return self.template_px + 2 * self.search_px

    @property
    def template_half_m(self) -> float:
        """Half the side of the template on the ground."""
        return 0.5 * self.template_px * self.gsd_m

    @property
    def window_half_m(self) -> float:
        """Half the side of the search window on the ground."""
        return 0.5 * self.window_px * self.gsd_m


def search_geometry(first: BinnedView, second: BinnedView, options: DimesOptions) -> SearchGeometry:
    """Compute the sizes of template and search window from the second view, the image interval and the options."""
    gsd = float(second.centre[2]) * second.camera.pixel_angle_rad
    max_displacement_m = options.max_speed_m_s * (second.time_s - first.time_s)
    search_px = int(np.ceil(max_displacement_m / gsd)) + options.search_margin_px
    return SearchGeometry(max_displacement_m, gsd, options.template_px, search_px)


def border_pixels(size: tuple[int, int]) -> Points2:
    """Pixels along the border of an image of `size` (columns, rows), in order."""
    steps, zeros, ones = np.arange(_BORDER_PIXELS) / _BORDER_PIXELS, np.zeros(_BORDER_PIXELS), np.ones(_BORDER_PIXELS)
    column_fractions = np.concatenate([steps, ones, 1.0 - steps, zeros])
    row_fractions = np.concatenate([zeros, steps, ones, 1.0 - steps])
    return np.column_stack([column_fractions * (size[0] - 1.0), row_fractions * (size[1] - 1.0)])


def overlap_polygon(first: BinnedView, second: BinnedView, options: DimesOptions) -> Points2:
    """Project the second view's border into the first view at zero horizontal motion.

    Returns pixels (u, v) in order along the border, without invisible points.
    """
    ground, _ = ground_view.ground_from_pixels(second, border_pixels(second.size), options.max_off_nadir_rad)
    pixels, visible = ground_view.pixels_from_ground(first, ground)
    return np.asarray(pixels[visible])


def grid_pixels(size: tuple[int, int], step: int) -> Points2:
    """Coarse grid of candidate pixels (u, v), centred in an image of `size` (columns, rows), row by row."""
    u, v = (np.arange((n - 1) % step // 2, n, step, dtype=np.float64) for n in size)
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


def overlap_width_m(first: BinnedView, second: BinnedView, gsd_m: float, options: DimesOptions) -> float:
    """Compute the diameter of the largest circle of ground in both views at zero motion, outside the zero-phase spot.

    The result is 0 without common ground; its resolution is the ground sample distance `gsd_m`.
    """
    limit, views = options.max_off_nadir_rad, (first, second)
    outlines = [ground_view.ground_from_pixels(view, border_pixels(view.size), limit)[0] for view in views]
    low = np.max([outline.min(axis=0) for outline in outlines], axis=0)
    high = np.min([outline.max(axis=0) for outline in outlines], axis=0)
    if np.any(high <= low):
        return 0.0
    columns, rows = (int(n) for n in np.ceil((high - low) / gsd_m) + 1)
    ground = np.stack(np.meshgrid(low[0] + gsd_m * np.arange(columns), low[1] + gsd_m * np.arange(rows)), axis=-1)
    overlap = np.ones((rows, columns), dtype=np.uint8)
    for view, outline in zip(views, outlines, strict=True):
        # vertices in 1/16 of a cell
        vertices = np.rint(16.0 * (outline - low) / gsd_m).astype(np.int32)
        overlap &= cv2.fillPoly(np.zeros_like(overlap), [vertices], (1,), shift=4).astype(np.uint8)
        overlap &= ground_view.outside_zero_phase(view, ground, options.zero_phase_radius_rad)
    # cells outside the grid belong to the ground outside the overlap
    distances = cv2.distanceTransform(np.pad(overlap, 1), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return 2.0 * gsd_m * float(distances.max())


@dataclass(frozen=True)
class Candidates:
    """Feasible template positions: the template fits the first view, and its centre lies in the overlap region.

    - pixels, ground: Template centres: pixels (u, v) of the first view, and ground points (east, north)
    - preference: Number of conditions that hold; candidates with a larger number precede the others. The template is
      inside the second view at zero motion; so is the complete search window; and the window is outside the zero-phase
      spot. Each condition requires those before it. The template itself is always outside the spot at zero motion.
    """

    pixels: Points2
    ground: Points2
    preference: Int[np.ndarray, "n"]


def template_candidates(
    first: BinnedView, second: BinnedView, geometry: SearchGeometry, options: DimesOptions
) -> Candidates:
    """Find all feasible template positions on the coarse grid.

    There is none if the overlap is narrower than the largest displacement, 30 m/s in 3.75 s (paper: "at least 110 m
    across"). The paper does not require that the complete search window lies inside the second image.
    """
    limit = options.max_off_nadir_rad
    pixels = grid_pixels(first.size, options.grid_step_px)
    ground, visible = ground_view.ground_from_pixels(first, pixels, limit)
    is_wide = overlap_width_m(first, second, geometry.gsd_m, options) >= geometry.max_displacement_m
    feasible = visible & is_wide
    pixels, ground = pixels[feasible], ground[feasible]
    feasible = ground_view.inside_frame(second, ground, 0.0, limit)
    pixels, ground = pixels[feasible], ground[feasible]
    template_half_m, window_half_m = geometry.template_half_m, geometry.window_half_m
    feasible = _lie_in_view(first, ground, template_half_m, options)
    pixels, ground = pixels[feasible], ground[feasible]
    is_valid = np.ones(len(ground), dtype=bool)
    for view in (first, second):
        is_valid &= _are_outside_spot(view, ground, template_half_m, _TEMPLATE_POINTS, options)
    is_inside = _lie_in_view(second, ground, template_half_m, options)
    is_complete = _lie_in_view(second, ground, window_half_m, options)
    is_outside = _are_outside_spot(second, ground, window_half_m, _WINDOW_POINTS, options)
    preference = np.sum([is_inside, is_complete, is_complete & is_outside], axis=0)
    return Candidates(pixels[is_valid], ground[is_valid], preference[is_valid])


def _lie_in_view(view: BinnedView, ground: Points2, half_m: float, options: DimesOptions) -> Flags:
    """Whether squares of half side `half_m` around ground points lie in a view."""
    outlines = ground[:, None] + ground_view.square_outline(half_m, OUTLINE_POINTS)
    return np.asarray(
        ground_view.inside_frame(view, outlines, options.border_px, options.max_off_nadir_rad).all(axis=1)
    )


def _are_outside_spot(view: BinnedView, ground: Points2, half_m: float, per_side: int, options: DimesOptions) -> Flags:
    """Whether squares around ground points are outside of the zero-phase spot, by lattices of `per_side` points."""
    points = ground[:, None] + ground_view.square_lattice(half_m, per_side)
    outside = ground_view.outside_zero_phase(view, points, options.zero_phase_radius_rad)
    return np.asarray(outside.all(axis=1))


def searchable_positions(
    second: BinnedView, centre: Vector2, geometry: SearchGeometry, options: DimesOptions
) -> Bool[np.ndarray, "s s"]:
    """Whether the second view shows the complete template at each position of the search around `centre` (ground)."""
    lattice = rectification.ground_lattice(centre, geometry.window_px, geometry.gsd_m)
    inside = ground_view.inside_frame(second, lattice, options.border_px, options.max_off_nadir_rad)
    half = geometry.template_px // 2
    return np.asarray(ndimage.minimum_filter(inside, size=geometry.template_px)[half:-half, half:-half])


def template_contrasts(view: BinnedView, pixels: Points2, support: int) -> Vector:
    """Harris interest over squares of `support` pixels around whole pixels (u, v), divided by their mean signal.

    The image is not corrected: the frame-transfer smear is smooth along columns and its effect is negligible.
    """
    columns, rows = np.rint(pixels).astype(int).T
    uu, vv, uv = (component[rows, columns] for component in structure_tensor(view.signal, support))
    mean = cv2.blur(view.signal, (support, support))[rows, columns]
    return np.asarray(
        harris_interest(uu, vv, uv) / np.maximum(mean, MIN_SIGNAL_FRACTION * view.calibration.full_scale_dn)
    )


def best_candidates(
    contrasts: Vector, pixels: Points2, preference: Int[np.ndarray, "n"], count: int, exclusion_px: float
) -> list[int]:
    """Indices of up to `count` candidates by decreasing preference, and by decreasing contrast for equal preference.

    Each selected candidate excludes those closer than `exclusion_px` in both column and row.
    """
    available = np.ones(len(contrasts), dtype=bool)
    indices: list[int] = []
    while len(indices) < count and available.any():
        eligible = available & (preference == preference[available].max())
        best = int(np.argmax(np.where(eligible, contrasts, -np.inf)))
        indices.append(best)
        available &= np.abs(pixels - pixels[best]).max(axis=1) >= exclusion_px
    return indices


def select_templates(
    view: BinnedView, candidates: Candidates, options: DimesOptions
) -> tuple[list[int], Float[np.ndarray, "k"]]:
    """Indices of the selected candidates, best first, and their contrasts."""
    contrasts, pixels = template_contrasts(view, candidates.pixels, options.template_px), candidates.pixels
    indices = best_candidates(
        contrasts, pixels, candidates.preference, options.templates_per_pair, options.exclusion_px
    )
    return indices, contrasts[indices]
