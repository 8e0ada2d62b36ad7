"""Where a template may lie: overlap of two views, room for template and window, zero-phase spot (section II.A)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from marsyard.algorithms.dimes.binning import View
from marsyard.algorithms.dimes.ground import (
    ground_from_pixels,
    inside_frame,
    pixel_angle_rad,
    pixels_from_ground,
    square,
    square_outline,
)
from marsyard.algorithms.dimes.options import DimesOptions


@dataclass(frozen=True)
class SearchGeometry:
    """Sizes of template and search window of a pair, in the virtual camera that looks straight down.

    Attributes
    ----------
    gsd_m
        Ground distance between rectified pixels: what one binned pixel of the second view covers at its nadir, metres.
    template_px
        Side of the template, rectified pixels.
    search_px
        Largest shift searched in each direction, rectified pixels.
    """

    gsd_m: float
    template_px: int
    search_px: int

    @property
    def window_px(self) -> int:
        """Side of the search window, rectified pixels."""
        return self.template_px + 2 * self.search_px

    @property
    def template_half_m(self) -> float:
        """From the template's middle to the outer edge of its pixels, metres."""
        return 0.5 * self.template_px * self.gsd_m

    @property
    def window_half_m(self) -> float:
        """From the window's middle to the outer edge of its pixels, metres."""
        return 0.5 * self.window_px * self.gsd_m


def search_geometry(first: View, second: View, options: DimesOptions) -> SearchGeometry:
    """Sizes from the second view's height, its pixels' angle, the time between pictures and the largest speed."""
    gsd = float(second.centre[2]) * pixel_angle_rad(second)
    reach_m = options.max_speed_m_s * (second.time_s - first.time_s)
    return SearchGeometry(gsd, options.template_px, int(np.ceil(reach_m / gsd)) + options.search_margin_px)


def border_pixels(size: tuple[int, int], per_side: int = 8) -> Float[np.ndarray, "n 2"]:
    """Points along the border of a picture of `size` (columns, rows), corners included, in order around it."""
    columns, rows = size
    steps = np.arange(per_side) / per_side
    u, v = columns - 1.0, rows - 1.0
    top = np.column_stack([steps * u, np.zeros(per_side)])
    right = np.column_stack([np.full(per_side, u), steps * v])
    bottom = np.column_stack([(1.0 - steps) * u, np.full(per_side, v)])
    left = np.column_stack([np.zeros(per_side), (1.0 - steps) * v])
    return np.concatenate([top, right, bottom, left])


def overlap_polygon(first: View, second: View, options: DimesOptions) -> Float[np.ndarray, "n 2"]:
    """The second view's border cast to the ground and seen in the first view, were there no horizontal motion.

    Pixels (u, v) of the first view, in order around the polygon; points that the first camera cannot see are left out.
    """
    ground, _ = ground_from_pixels(second, border_pixels(second.size), options.max_off_nadir_rad)
    pixels, visible = pixels_from_ground(first, ground)
    return np.asarray(pixels[visible])


def grid_pixels(size: tuple[int, int], step: int) -> Float[np.ndarray, "n 2"]:
    """The coarse grid of candidate pixels (u, v) of a picture of `size` (columns, rows), centred in it, row by row."""
    u, v = (np.arange((n - 1) % step // 2, n, step, dtype=np.float64) for n in size)
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


def anti_solar_direction(sun_direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Unit vector from the lander to the middle of the zero-phase spot: away from the sun, world axes."""
    length = float(np.linalg.norm(sun_direction))
    return -np.asarray(sun_direction, dtype=np.float64) / (length if length > 0.0 else 1.0)


def zero_phase_pixel(view: View, sun_direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "2"]:
    """Pixel (u, v) of the middle of the zero-phase spot, in or out of frame; NaN where the camera cannot see it."""
    away = 1e7 * anti_solar_direction(sun_direction)
    pixels, visible = view.camera.project((view.centre + away)[None, :])
    return np.asarray(pixels[0]) if visible[0] else np.full(2, np.nan)


def outside_zero_phase(
    view: View, ground: Float[np.ndarray, "*shape 2"], sun_direction: Float[np.ndarray, "3"], radius_rad: float
) -> Bool[np.ndarray, "*shape"]:
    """Whether ground points (east, north) are seen further than `radius_rad` from the anti-solar direction."""
    spot = anti_solar_direction(sun_direction)
    height = view.centre[2]
    ranges = np.sqrt(ground[..., 0] ** 2 + ground[..., 1] ** 2 + height**2)
    along = ground[..., 0] * spot[0] + ground[..., 1] * spot[1] - height * spot[2]
    return np.asarray(along < np.cos(radius_rad) * ranges)


@dataclass(frozen=True)
class Candidates:
    """Places for a template: pixels (u, v) of the first view, their ground points, and which are preferred.

    All have room for template and window and show no zero-phase spot in the template at zero motion; the preferred have
    none anywhere in the search window either.
    """

    pixels: Float[np.ndarray, "n 2"]
    ground: Float[np.ndarray, "n 2"]
    preferred: Bool[np.ndarray, "n"]


def template_candidates(
    first: View,
    second: View,
    geometry: SearchGeometry,
    sun_direction: Float[np.ndarray, "3"],
    options: DimesOptions,
) -> Candidates:
    """All places of the coarse grid where a template may lie."""
    limit = options.max_off_nadir_rad
    pixels = grid_pixels(first.size, options.grid_step_px)
    ground, seen = ground_from_pixels(first, pixels, limit)
    pixels, ground = pixels[seen], ground[seen]
    for view, half in ((second, 0.0), (first, geometry.template_half_m), (second, geometry.window_half_m)):
        outline = square_outline(half, 3) if half > 0.0 else np.zeros((1, 2))
        room = inside_frame(view, ground[:, None] + outline, options.border_px, limit).all(axis=1)
        pixels, ground = pixels[room], ground[room]

    def dark(view: View, half_m: float, per_side: int) -> Bool[np.ndarray, "n"]:
        points = ground[:, None] + square(half_m, per_side)
        outside = outside_zero_phase(view, points, sun_direction, options.zero_phase_radius_rad)
        return np.asarray(outside.all(axis=1))

    clear = dark(first, geometry.template_half_m, 4) & dark(second, geometry.template_half_m, 4)
    preferred = dark(second, geometry.window_half_m, 7)
    return Candidates(pixels[clear], ground[clear], preferred[clear])
