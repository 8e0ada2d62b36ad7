"""Tracks of a grid of templates in one pair of views, from which the inclination of the ground is fitted (`tilt`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from marsyard.algorithms.arrays import Flags, Points2, Vector2, Vector3
from marsyard.algorithms.dimes import ground_view, overlap, rectification
from marsyard.algorithms.dimes.options import DimesOptions
from marsyard.algorithms.dimes.views import BinnedView
from marsyard.algorithms.dimes.zero_phase import outside_zero_phase
from marsyard.algorithms.image.registration import WindowSpline, register_template, spline_coefficients

#: Distance of templates from the border of both images, pixels: range of the registration and support of its spline.
MARGIN_PX = 4


@dataclass(frozen=True)
class GroundTracks:
    """Tracks of a grid of templates in one pair of views.

    - first, second: Matched ground points (east, north) relative to the nadir point of each view, metres, on level
      ground at the measured altitude
    - heights_m: Measured heights of the cameras
    - gsd_m: Ground sample distance of the matched images
    - interval_s: Time between the images
    """

    first: Points2
    second: Points2
    heights_m: tuple[float, float]
    gsd_m: float
    interval_s: float


def track_grid(
    first: BinnedView, second: BinnedView, velocity_m_s: Vector2, sun_direction: Vector3, options: DimesOptions
) -> GroundTracks:
    """Track a grid of templates on the common ground, from the positions that a velocity (east, north) predicts.

    Both views are rectified with the full camera model, the second one shifted by the predicted displacement. Templates
    lie in both images and outside of the zero-phase spot, like those of the published algorithm.
    """
    gsd, side = overlap.search_geometry(first, second, options).gsd_m, options.grid_template_px
    shift = velocity_m_s * (second.time_s - first.time_s)
    shifts = ((first, np.zeros(2)), (second, shift))
    outlines = [
        ground_view.ground_from_pixels(view, overlap.border_pixels(view.size), options.max_off_nadir_rad)[0] + offset
        for view, offset in shifts
    ]
    low = np.max([outline.min(axis=0) for outline in outlines], axis=0)
    high = np.min([outline.max(axis=0) for outline in outlines], axis=0)
    per_side = max(int((high - low).max() / gsd) // side, 1)
    size, centre = per_side * side, 0.5 * (low + high)
    templates, window = (rectification.rectify_patch(view, centre - offset, size, gsd) for view, offset in shifts)
    spline = WindowSpline((0, 0), (size, size), spline_coefficients(window))
    corners = side * np.stack(np.divmod(np.arange(per_side**2), per_side), axis=-1)
    rows, columns = ((corners + 0.5 * (side - size)) * gsd).T
    ground = centre + np.column_stack([columns, -rows])
    usable = np.all([_is_usable(view, ground - offset, gsd, sun_direction, options) for view, offset in shifts], axis=0)
    points, shifts_px = [], []
    for (row, column), point in zip(corners[usable], ground[usable], strict=True):
        template = templates[row : row + side, column : column + side]
        match = register_template(template, spline, np.array([row, column], dtype=np.float64), "shift")
        if match is not None and match.score >= options.min_peak:
            points.append(point)
            shifts_px.append([match.corner[1] - column, row - match.corner[0]])
    matched = np.array(points).reshape(-1, 2)
    return GroundTracks(
        first=matched,
        second=matched - shift + gsd * np.array(shifts_px).reshape(-1, 2),
        heights_m=(float(first.centre[2]), float(second.centre[2])),
        gsd_m=gsd,
        interval_s=second.time_s - first.time_s,
    )


def _is_usable(view: BinnedView, ground: Points2, gsd_m: float, sun_direction: Vector3, options: DimesOptions) -> Flags:
    """Whether templates around ground points lie in a view and outside of its zero-phase spot."""
    outline = ground_view.square_outline((0.5 * options.grid_template_px + MARGIN_PX) * gsd_m, 3)
    squares = ground[:, None] + outline
    inside = ground_view.inside_frame(view, squares, options.border_px, options.max_off_nadir_rad)
    outside = outside_zero_phase(view, squares, sun_direction, options.zero_phase_radius_rad)
    return np.asarray((inside & outside).all(axis=1))
