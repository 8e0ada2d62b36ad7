"""Dense structure (points of the ground) by matches along epipolar segments (section II.C), and its scale.

Sections and equations are those of Johnson, Montgomery & Matthies, "Vision Guided Landing".
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.arrays import Flags, Points2
from marsyard.algorithms.hda.kernels import matching
from marsyard.algorithms.hda.motion import CameraMotion
from marsyard.algorithms.hda.options import HdaOptions
from marsyard.algorithms.hda.preparation import prepare_views
from marsyard.algorithms.hda.scene import CameraView, Views, points_at_depth, project_points, undistort

#: Minimum number of grid points along the width of the narrowest hazard (option `refine_grid`): a map cell is then at
#: most a sixth of this width, and its averages reduce the height of the hazard by less than a tenth.
GRID_POINTS_PER_HAZARD = 6
#: Offsets of the pixels matched around the laser spot; their median depth is the depth of the spot.
SPOT_OFFSETS_PX = np.arange(-4.0, 5.0, 2.0)
#: Minimum number of matches in the spot.
MIN_SPOT_MATCHES = 5


class MatchStatus(IntEnum):
    """Result of a structure match: accepted, or the failed check.

    The checks are correlation, depth bounds and forward-backward consistency.
    """

    ACCEPTED = 0
    DISSIMILAR = 1
    OUT_OF_BOUNDS = 2
    INCONSISTENT = 3


@dataclass(frozen=True)
class Matches:
    """Structure matches between the images.

    - first: Pixels (u, v) of the first image whose epipolar segment lies inside the second image
    - starts, ends: End points (u, v) of the segments, at the smallest and the largest depth
    - second: Matched pixels (u, v) of the second image
    - depths: Triangulated depths in the first camera's frame, metres
    - statuses: Values of `MatchStatus`
    - points: Points of the accepted matches in the first camera's frame, metres
    """

    first: Points2
    starts: Points2
    ends: Points2
    second: Points2
    depths: Float[np.ndarray, "n"]
    statuses: UInt8[np.ndarray, "n"]
    points: Float[np.ndarray, "m 3"]

    @property
    def accepted(self) -> Flags:
        """Whether each match passed all checks."""
        return np.asarray(self.statuses == MatchStatus.ACCEPTED)


def depth_bounds(depth_range_m: tuple[float, float], margin: float) -> tuple[float, float]:
    """Depth range of the features, widened by the fraction `margin`."""
    return (1.0 - margin) * depth_range_m[0], (1.0 + margin) * depth_range_m[1]


def grid_spacing_px(view: CameraView, depth_range_m: tuple[float, float], options: HdaOptions) -> int:
    """Spacing of the grid, pixels: `grid_px`, or less if `refine_grid` requires it at the mean of the depth range."""
    if not options.refine_grid:
        return options.grid_px
    width_m = options.narrowest_hazard * options.max_roughness_m
    resolving = int(view.focal_px * width_m / (GRID_POINTS_PER_HAZARD * 0.5 * sum(depth_range_m)))
    return max(min(options.grid_px, resolving), 1)


def pixel_lattice(size: tuple[int, int], spacing_px: int, border_px: int) -> Points2:
    """Pixels (u, v) of a centred grid over an image of size (columns, rows), inside the border."""
    axes = []
    for extent in size:
        span = max(extent - 1 - 2 * border_px, 0)
        axes.append(border_px + (span % spacing_px) // 2 + np.arange(span // spacing_px + 1) * float(spacing_px))
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)


def epipolar_segments(
    second: CameraView,
    second_from_first: RigidTransform,
    coordinates: Points2,
    bounds_m: tuple[float, float],
    border_px: int,
) -> tuple[Points2, Points2, Flags]:
    """Compute the end points of epipolar segments (Eqs. 6-8), and whether both lie inside the border.

    `coordinates` are normalised image coordinates in the first image, `bounds_m` the depths of the end points.
    """
    ends = []
    valid = np.ones(len(coordinates), dtype=bool)
    for depth in bounds_m:
        points = second_from_first.apply(points_at_depth(coordinates, np.full(len(coordinates), depth)))
        pixels, visible = project_points(second.camera, points)
        with np.errstate(invalid="ignore"):
            inside = (pixels >= border_px) & (pixels <= np.array(second.camera.size) - 1.0 - border_px)
        valid &= visible & inside.all(axis=1)
        ends.append(pixels)
    return ends[0], ends[1], valid


def triangulate(first: Points2, second: Points2, second_from_first: RigidTransform) -> Float[np.ndarray, "n"]:
    """Depths z in the first camera's frame that best fit z' h' = z R h + t, metres; NaN for parallel rays.

    Least squares over both depths (Weng, Ahuja & Huang 1993); h and h' are homogeneous normalised image coordinates.
    The variables a and b are R h and h'.
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

    The match is the minimum sum of absolute differences (Eq. 9) on the segment, refined by the biquadratic peak of the
    correlations around it. (The paper has "the maximum SAD value"; the best match is the minimum.) Pixels whose segment
    is partly outside the second image are omitted. Accepted matches pass the limits on correlation and depth and, with
    `max_forward_backward_px`, the check of forward-backward consistency.
    """
    border = options.search_half_px + 1  # one pixel more for the neighbours of the peak
    coordinates = undistort(views[0].camera, pixels)
    starts, ends, valid = epipolar_segments(views[1], second_from_first, coordinates, bounds_m, border)
    pair, pair_motion = prepare_views(views, second_from_first, 0.5 * sum(bounds_m), options)
    pair_starts, pair_ends, pair_valid = epipolar_segments(pair[1], pair_motion, coordinates, bounds_m, border)
    valid &= pair_valid
    pixels, coordinates, starts, ends = pixels[valid], coordinates[valid], starts[valid], ends[valid]
    rounded = pixels.astype(np.int64)
    images = pair[0].counts, pair[1].counts
    matches = matching.match_along_epipolar_segments(
        *images, rounded, pair_starts[valid], pair_ends[valid], options.search_half_px
    )
    matched_pixels, correlations = matching.refine_positions(
        *images, rounded[:, ::-1], (matches - rounded)[:, ::-1], options.search_half_px
    )
    second_coordinates = undistort(pair[1].camera, matched_pixels)
    depths = triangulate(coordinates, second_coordinates, pair_motion)
    statuses = np.full(len(pixels), MatchStatus.ACCEPTED, dtype=np.uint8)
    statuses[~((depths > bounds_m[0]) & (depths < bounds_m[1]))] = MatchStatus.OUT_OF_BOUNDS
    statuses[~(correlations >= options.min_match_correlation)] = MatchStatus.DISSIMILAR
    if options.max_forward_backward_px is not None:
        indices = np.flatnonzero(statuses == MatchStatus.ACCEPTED)
        accepted_matches = (rounded[indices], matches[indices], coordinates[indices])
        errors_px = forward_backward_error(pair, pair_motion, *accepted_matches, bounds_m, options.search_half_px)
        statuses[indices[errors_px > options.max_forward_backward_px]] = MatchStatus.INCONSISTENT
    is_accepted = statuses == MatchStatus.ACCEPTED
    points = points_at_depth(coordinates[is_accepted], depths[is_accepted])
    if pair[1].camera is not views[1].camera:
        # back from the resampled image to the second image
        rotation = second_from_first.rotation * pair_motion.rotation.inv()
        rays = rotation.apply(np.column_stack([second_coordinates, np.ones(len(second_coordinates))]))
        matched_pixels = views[1].camera.project(rays)[0]
    return Matches(pixels, starts, ends, matched_pixels, depths, statuses, points)


def forward_backward_error(
    views: Views,
    second_from_first: RigidTransform,
    pixels: Int[np.ndarray, "n 2"],
    matches: Int[np.ndarray, "n 2"],
    coordinates: Points2,
    bounds_m: tuple[float, float],
    half_px: int,
) -> Float[np.ndarray, "n"]:
    """Forward-backward error, pixels: distance of each pixel of the first image from the reverse match of its match.

    `coordinates` are the normalised image coordinates of `pixels`. The reverse search covers the depth bounds in the
    second camera's frame, clipped to the first image.
    """
    first, second = views
    count, first_from_second = len(coordinates), second_from_first.inv()
    depths = [second_from_first.apply(points_at_depth(coordinates, np.full(count, z)))[:, 2] for z in bounds_m]
    match_coordinates = undistort(second.camera, matches.astype(np.float64))
    points = [first_from_second.apply(points_at_depth(match_coordinates, z)) for z in depths]
    ends = [project_points(first.camera, end_points)[0] for end_points in points]
    starts, stops = (clip_to_image(first.camera.size, pixels.astype(np.float64), end, half_px + 1.0) for end in ends)
    reverse_matches = matching.match_along_epipolar_segments(
        second.counts, first.counts, matches, starts, stops, half_px
    )
    return np.asarray(np.hypot(*(reverse_matches - pixels).T))


def clip_to_image(size: tuple[int, int], origins: Points2, ends: Points2, border_px: float) -> Points2:
    """Clip the end points of lines at the border of an image of size (columns, rows); `origins` lie inside it."""
    directions = np.nan_to_num(ends - origins)
    limits = np.where(directions > 0.0, np.array(size) - 1.0 - border_px, border_px)
    with np.errstate(divide="ignore", invalid="ignore"):
        fraction = np.where(directions == 0.0, 1.0, (limits - origins) / directions)
    return np.asarray(origins + np.clip(fraction.min(axis=1), 0.0, 1.0)[:, None] * directions)


def dense_structure(
    views: Views, second_from_first: RigidTransform, depth_range_m: tuple[float, float], options: HdaOptions
) -> Matches:
    """Match a grid of pixels within the widened depth range of the features."""
    spacing = grid_spacing_px(views[0], depth_range_m, options)
    pixels = pixel_lattice(views[0].camera.size, spacing, options.search_half_px + 1)
    return match_pixels(views, second_from_first, pixels, depth_bounds(depth_range_m, options.depth_margin), options)


def scale_factor(
    views: Views, motion: CameraMotion, coordinates: Points2, range_m: float, options: HdaOptions
) -> float:
    """Scale factor of the motion that makes the depth on the optical axis equal to the laser range.

    Pixels around the laser spot are matched along their epipolar segments. With too few matches the depth is that of
    the plane fit to the features' inverse depths (`coordinates` are their normalised image coordinates). The paper sets
    the initial depths from the range and does not correct the scale afterwards.
    """
    spot, _ = views[0].camera.project(np.array([[0.0, 0.0, 1.0]]))
    du, dv = np.meshgrid(SPOT_OFFSETS_PX, SPOT_OFFSETS_PX)
    pixels = np.rint(spot) + np.column_stack([du.ravel(), dv.ravel()])
    border_px = options.search_half_px + 1
    inside = np.all((pixels >= border_px) & (pixels < np.array(views[0].camera.size) - border_px), axis=1)
    bounds = depth_bounds(motion.depth_range_m, options.depth_margin)
    spot_matches = match_pixels(views, motion.second_from_first, pixels[inside], bounds, options)
    depths = spot_matches.depths[spot_matches.accepted]
    if len(depths) >= MIN_SPOT_MATCHES:
        return range_m / float(np.median(depths))
    design_matrix = np.column_stack([coordinates, np.ones(len(coordinates))])[motion.inliers]
    plane = np.linalg.lstsq(design_matrix, 1.0 / motion.depths[motion.inliers], rcond=None)[0]
    # the third coefficient is the inverse depth on the optical axis
    return range_m * float(plane[2])
