"""Dense structure by matches along epipolar segments (section II.C), and the scale from the laser altimeter."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.arrays import Flags, Points2
from marsyard.algorithms.hda.kernels import matching
from marsyard.algorithms.hda.motion import Motion, View, Views, points_at_depth, project_points, undistort
from marsyard.algorithms.hda.options import HdaOptions


class Fate(IntEnum):
    """Result of a structure match; the first failed check counts."""

    ACCEPTED = 0
    DISSIMILAR = 1
    OUT_OF_BOUNDS = 2
    NOT_RETURNED = 3


@dataclass(frozen=True)
class Matches:
    """Structure matches between the images.

    - first: Pixels (u, v) of the first image whose epipolar segment fits the second image
    - starts, ends: Ends of the segments, at the smallest and the largest depth
    - second: Matched pixels (u, v) of the second image
    - correlations: Eq. 3 at the match
    - depths: By triangulation, metres, in the first camera's frame
    - fates: Values of `Fate`
    - points: Points of the accepted matches in the first camera's frame, metres
    """

    first: Points2
    starts: Points2
    ends: Points2
    second: Points2
    correlations: Float[np.ndarray, "n"]
    depths: Float[np.ndarray, "n"]
    fates: UInt8[np.ndarray, "n"]
    points: Float[np.ndarray, "m 3"]

    @property
    def accepted(self) -> Flags:
        """Whether each match passed all checks."""
        return np.asarray(self.fates == Fate.ACCEPTED)


def depth_bounds(depth_range_m: tuple[float, float], margin: float) -> tuple[float, float]:
    """Depth range of the features, widened by the fraction `margin`."""
    return (1.0 - margin) * depth_range_m[0], (1.0 + margin) * depth_range_m[1]


def pixel_lattice(size: tuple[int, int], spacing_px: int, border_px: int) -> Points2:
    """Pixels (u, v) of a centred grid over an image of size (columns, rows), inside the border."""
    axes = []
    for extent in size:
        room = max(extent - 1 - 2 * border_px, 0)
        axes.append(border_px + (room % spacing_px) // 2 + np.arange(room // spacing_px + 1) * float(spacing_px))
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)


def epipolar_segments(
    second: View, second_from_first: RigidTransform, places: Points2, bounds_m: tuple[float, float], border_px: int
) -> tuple[Points2, Points2, Flags]:
    """Ends of the epipolar segments of undistorted coordinates (Eqs. 6-8), and whether both are inside the border."""
    ends = []
    room = np.ones(len(places), dtype=bool)
    for depth in bounds_m:
        moved = second_from_first.apply(points_at_depth(places, np.full(len(places), depth)))
        pixels, visible = project_points(second.camera, moved)
        with np.errstate(invalid="ignore"):
            inside = (pixels >= border_px) & (pixels <= np.array(second.camera.size) - 1.0 - border_px)
        room &= visible & inside.all(axis=1)
        ends.append(pixels)
    return ends[0], ends[1], room


def triangulate(first: Points2, second: Points2, second_from_first: RigidTransform) -> Float[np.ndarray, "n"]:
    """Depths z in the first camera's frame that best fit z' h' = z R h + t, metres; NaN for parallel rays.

    Least squares over both depths (Weng, Ahuja & Huang 1993); h and h' are homogeneous undistorted coordinates.
    """
    a = second_from_first.rotation.apply(np.column_stack([first, np.ones(len(first))]))
    b = np.column_stack([second, np.ones(len(second))])
    t = second_from_first.translation
    aa, bb, ab = (np.sum(x * y, axis=1) for x, y in ((a, a), (b, b), (a, b)))
    determinant = aa * bb - ab * ab
    with np.errstate(divide="ignore", invalid="ignore"):
        depths = (ab * (b @ t) - bb * (a @ t)) / determinant
    return np.where(determinant > 1e-12 * aa * bb, depths, np.nan)


def match_pixels(
    views: Views, second_from_first: RigidTransform, pixels: Points2, bounds_m: tuple[float, float], options: HdaOptions
) -> Matches:
    """Match whole pixels of the first image along their epipolar segments.

    The smallest sum of absolute differences (Eq. 9) on the segment, then the top of the biquadratic through the
    correlations about it. (The paper says "the maximum SAD value"; the best match is the smallest.) Pixels whose
    segment leaves the second image are dropped. Accepted matches pass the limits on correlation and depth and, with
    `max_return_px`, the check of the reverse match.
    """
    first, second = views
    border = options.search_half_px + 1
    places = undistort(first.camera, pixels)
    starts, ends, room = epipolar_segments(second, second_from_first, places, bounds_m, border)
    pixels, places, starts, ends = pixels[room], places[room], starts[room], ends[room]
    rounded = pixels.astype(np.int64)
    matches = matching.search_segments(first.counts, second.counts, rounded, starts, ends, options.search_half_px)
    matched, correlations = matching.refine_shifts(
        first.counts, second.counts, rounded[:, ::-1], (matches - rounded)[:, ::-1], options.search_half_px
    )
    depths = triangulate(places, undistort(second.camera, matched), second_from_first)
    fates = np.full(len(pixels), Fate.ACCEPTED, dtype=np.uint8)
    fates[~((depths > bounds_m[0]) & (depths < bounds_m[1]))] = Fate.OUT_OF_BOUNDS
    fates[~(correlations >= options.min_match_correlation)] = Fate.DISSIMILAR
    if options.max_return_px is not None:
        left = np.flatnonzero(fates == Fate.ACCEPTED)
        way = return_distance(
            views, second_from_first, rounded[left], matches[left], places[left], bounds_m, options.search_half_px
        )
        fates[left[way > options.max_return_px]] = Fate.NOT_RETURNED
    accepted = fates == Fate.ACCEPTED
    return Matches(
        pixels, starts, ends, matched, correlations, depths, fates, points_at_depth(places[accepted], depths[accepted])
    )


def return_distance(
    views: Views,
    second_from_first: RigidTransform,
    pixels: Int[np.ndarray, "n 2"],
    found: Int[np.ndarray, "n 2"],
    places: Points2,
    bounds_m: tuple[float, float],
    half_px: int,
) -> Float[np.ndarray, "n"]:
    """Distance of each pixel of the first image from the reverse match of its match.

    Pixels are whole, `places` their undistorted coordinates. The reverse search covers the depth bounds in the second
    camera's frame, clipped to the first image.
    """
    first, second = views
    ends = [second_from_first.apply(points_at_depth(places, np.full(len(places), depth)))[:, 2] for depth in bounds_m]
    back = undistort(second.camera, found.astype(np.float64))
    reached = [
        project_points(first.camera, second_from_first.inv().apply(points_at_depth(back, depths)))[0] for depths in ends
    ]
    near, far = (clip_to_image(first.camera.size, pixels.astype(np.float64), end, half_px + 1.0) for end in reached)
    returned = matching.search_segments(second.counts, first.counts, found, near, far, half_px)
    return np.asarray(np.hypot(*(returned - pixels).T))


def clip_to_image(size: tuple[int, int], inside: Points2, ends: Points2, border_px: float) -> Points2:
    """Ends of lines from positions inside an image of size (columns, rows), clipped at the border."""
    away = np.nan_to_num(ends - inside)
    limits = np.where(away > 0.0, np.array(size) - 1.0 - border_px, border_px)
    with np.errstate(divide="ignore", invalid="ignore"):
        fraction = np.where(away == 0.0, 1.0, (limits - inside) / away)
    return np.asarray(inside + np.clip(fraction.min(axis=1), 0.0, 1.0)[:, None] * away)


def dense_structure(
    views: Views, second_from_first: RigidTransform, depth_range_m: tuple[float, float], options: HdaOptions
) -> Matches:
    """Matches of a grid of pixels, searched within the widened depth range of the features."""
    pixels = pixel_lattice(views[0].camera.size, options.grid_px, options.search_half_px + 1)
    return match_pixels(views, second_from_first, pixels, depth_bounds(depth_range_m, options.depth_margin), options)


#: Offsets of the pixels matched about the laser's spot; their median depth is that of the spot.
SPOT_OFFSETS_PX = np.arange(-4.0, 5.0, 2.0)
#: Minimum number of matches in the spot.
MIN_SPOT_MATCHES = 5


def scale_factor(views: Views, motion: Motion, places: Points2, range_m: float, options: HdaOptions) -> float:
    """Factor on all lengths of the motion that makes the depth on the optical axis equal the laser's range.

    Pixels about the laser's spot are matched as structure is; with too few matches the plane through the features'
    inverse depths gives the depth (`places` are their undistorted coordinates). The paper sets the initial depths by
    the range and does not correct the scale afterwards.
    """
    spot, _ = views[0].camera.project(np.array([[0.0, 0.0, 1.0]]))
    across, down = np.meshgrid(SPOT_OFFSETS_PX, SPOT_OFFSETS_PX)
    pixels = np.rint(spot) + np.column_stack([across.ravel(), down.ravel()])
    room = options.search_half_px + 1
    inside = np.all((pixels >= room) & (pixels < np.array(views[0].camera.size) - room), axis=1)
    bounds = depth_bounds(motion.depth_range_m, options.depth_margin)
    spot_matches = match_pixels(views, motion.second_from_first, pixels[inside], bounds, options)
    depths = spot_matches.depths[spot_matches.accepted]
    if len(depths) >= MIN_SPOT_MATCHES:
        return range_m / float(np.median(depths))
    design = np.column_stack([places, np.ones(len(places))])[motion.inliers]
    plane = np.linalg.lstsq(design, 1.0 / motion.depths[motion.inliers], rcond=None)[0]
    return range_m * float(plane[2])
