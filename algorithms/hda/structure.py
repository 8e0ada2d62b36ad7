"""Dense structure: epipolar segments, the match along each, triangulation (section II.C)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.hda.kernels import matching
from marsyard.algorithms.hda.options import HdaOptions
from marsyard.algorithms.hda.view import View, pixels_of, points_at, undistorted


class Fate(IntEnum):
    """What became of a structure match; the first reason to drop it counts."""

    ACCEPTED = 0
    UNLIKE = 1
    OUT_OF_BOUNDS = 2
    NOT_RETURNED = 3


@dataclass(frozen=True)
class Matches:
    """Pixels of the first picture and where they were found in the second.

    Attributes
    ----------
    first
        Pixels (u, v) whose epipolar segment lies in the second picture, with room for the windows.
    starts, ends
        Their segments' ends, at the least and the greatest depth.
    second
        Where they were found.
    correlations
        Eq. 3 there.
    depths
        By triangulation, metres, in the first camera's frame.
    fates
        Values of `Fate`: whether each match is believed, and why not: too low a correlation, a depth out of bounds, or
        another pixel found on the way back.
    points
        Points of the accepted ones in the first camera's frame, metres.
    """

    first: Float[np.ndarray, "n 2"]
    starts: Float[np.ndarray, "n 2"]
    ends: Float[np.ndarray, "n 2"]
    second: Float[np.ndarray, "n 2"]
    correlations: Float[np.ndarray, "n"]
    depths: Float[np.ndarray, "n"]
    fates: UInt8[np.ndarray, "n"]
    points: Float[np.ndarray, "m 3"]

    @property
    def accepted(self) -> Bool[np.ndarray, "n"]:
        """Whether each match is believed."""
        return np.asarray(self.fates == Fate.ACCEPTED)


def depth_bounds(depth_range_m: tuple[float, float], margin: float) -> tuple[float, float]:
    """Depths between which structure is looked for: those of the features, widened by a share of themselves."""
    return (1.0 - margin) * depth_range_m[0], (1.0 + margin) * depth_range_m[1]


def pixel_lattice(size: tuple[int, int], spacing_px: int, border_px: int) -> Float[np.ndarray, "n 2"]:
    """Pixels (u, v) of a grid over a picture of (columns, rows), in its middle, that keep from the border."""
    axes = []
    for extent in size:
        room = max(extent - 1 - 2 * border_px, 0)
        axes.append(border_px + (room % spacing_px) // 2 + np.arange(room // spacing_px + 1) * float(spacing_px))
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)


def epipolar_segments(
    second: View,
    second_from_first: RigidTransform,
    places: Float[np.ndarray, "n 2"],
    bounds_m: tuple[float, float],
    border_px: int,
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"], Bool[np.ndarray, "n"]]:
    """Ends of the epipolar segments of undistorted coordinates (Eqs. 6-8), and whether both have room."""
    ends = []
    room = np.ones(len(places), dtype=bool)
    for depth in bounds_m:
        moved = second_from_first.apply(points_at(places, np.full(len(places), depth)))
        pixels, seen = pixels_of(second.camera, moved)
        with np.errstate(invalid="ignore"):
            # A whole pixel less: segments are walked at rounded places.
            far = (pixels >= border_px) & (pixels <= np.array(second.camera.size) - 1.0 - border_px)
        room &= seen & far.all(axis=1)
        ends.append(pixels)
    return ends[0], ends[1], room


def triangulated(
    first: Float[np.ndarray, "n 2"], second: Float[np.ndarray, "n 2"], second_from_first: RigidTransform
) -> Float[np.ndarray, "n"]:
    """Depths z in the first camera's frame that best fit z' h' = z R h + t, metres; NaN for parallel lines of sight.

    Least squares over both depths (Weng, Ahuja & Huang 1993); h and h' are the undistorted coordinates with a one.
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
    views: tuple[View, View],
    second_from_first: RigidTransform,
    pixels: Float[np.ndarray, "n 2"],
    bounds_m: tuple[float, float],
    options: HdaOptions,
) -> Matches:
    """Matches of whole pixels of the first picture along their epipolar segments.

    The least sum of absolute differences (Eq. 9) on the segment, then the top of the biquadratic through the
    correlations about it. (The paper says "the maximum SAD value"; the best match is the least.) Pixels whose segment
    leaves the second picture are dropped; matches with too low a correlation or a depth out of bounds are not accepted,
    nor, with `max_return_px`, those that do not find their way back.
    """
    first, second = views
    border = options.search_half_px + 1
    places = undistorted(first.camera, pixels)
    starts, ends, room = epipolar_segments(second, second_from_first, places, bounds_m, border)
    pixels, places, starts, ends = pixels[room], places[room], starts[room], ends[room]
    whole = pixels.astype(np.int64)
    found = matching.search_segments(first.counts, second.counts, whole, starts, ends, options.search_half_px)
    matched, correlations = matching.refine_shifts(
        first.counts, second.counts, whole[:, ::-1], (found - whole)[:, ::-1], options.search_half_px
    )
    depths = triangulated(places, undistorted(second.camera, matched), second_from_first)
    fates = np.full(len(pixels), Fate.ACCEPTED, dtype=np.uint8)
    fates[~((depths > bounds_m[0]) & (depths < bounds_m[1]))] = Fate.OUT_OF_BOUNDS
    fates[~(correlations >= options.min_match_correlation)] = Fate.UNLIKE
    if options.max_return_px is not None:
        left = np.flatnonzero(fates == Fate.ACCEPTED)
        way = return_distance(
            views, second_from_first, whole[left], found[left], places[left], bounds_m, options.search_half_px
        )
        fates[left[way > options.max_return_px]] = Fate.NOT_RETURNED
    accepted = fates == Fate.ACCEPTED
    return Matches(
        pixels, starts, ends, matched, correlations, depths, fates, points_at(places[accepted], depths[accepted])
    )


def return_distance(
    views: tuple[View, View],
    second_from_first: RigidTransform,
    pixels: Int[np.ndarray, "n 2"],
    found: Int[np.ndarray, "n 2"],
    places: Float[np.ndarray, "n 2"],
    bounds_m: tuple[float, float],
    half_px: int,
) -> Float[np.ndarray, "n"]:
    """How far from each pixel of the first picture the one lies that its match in the second finds there.

    Pixels are whole, `places` their undistorted coordinates. What the match sees is looked for at the depths in the
    second camera's frame that the bounds are there, as far as the first picture goes: the search has as many rivals as
    on the way there, and a patch that only resembles another finds the other.
    """
    first, second = views
    ends = [second_from_first.apply(points_at(places, np.full(len(places), depth)))[:, 2] for depth in bounds_m]
    back = undistorted(second.camera, found.astype(np.float64))
    reached = [pixels_of(first.camera, second_from_first.inv().apply(points_at(back, depths)))[0] for depths in ends]
    near, far = (within(first.camera.size, pixels.astype(np.float64), end, half_px + 1.0) for end in reached)
    returned = matching.search_segments(second.counts, first.counts, found, near, far, half_px)
    return np.asarray(np.hypot(*(returned - pixels).T))


def within(
    size: tuple[int, int], inside: Float[np.ndarray, "n 2"], ends: Float[np.ndarray, "n 2"], border_px: float
) -> Float[np.ndarray, "n 2"]:
    """Ends of lines from places inside of a picture of (columns, rows), cut where they come too near to its border."""
    away = np.nan_to_num(ends - inside)
    limits = np.where(away > 0.0, np.array(size) - 1.0 - border_px, border_px)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(away == 0.0, 1.0, (limits - inside) / away)
    return np.asarray(inside + np.clip(share.min(axis=1), 0.0, 1.0)[:, None] * away)


def dense_structure(
    views: tuple[View, View],
    second_from_first: RigidTransform,
    depth_range_m: tuple[float, float],
    options: HdaOptions,
) -> Matches:
    """Matches of a grid of pixels, searched between the widened depths of the features."""
    pixels = pixel_lattice(views[0].camera.size, options.grid_px, options.search_half_px + 1)
    return match_pixels(views, second_from_first, pixels, depth_bounds(depth_range_m, options.depth_margin), options)
