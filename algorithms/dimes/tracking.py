"""One template: rectify, correlate, refine, and turn the shift into a velocity (section II.A)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from marsyard.algorithms.dimes.binning import View
from marsyard.algorithms.dimes.details import PairDetails, Track
from marsyard.algorithms.dimes.ground import pixels_from_ground
from marsyard.algorithms.dimes.options import DimesOptions
from marsyard.algorithms.dimes.overlap import (
    SearchGeometry,
    overlap_polygon,
    search_geometry,
    template_candidates,
    zero_phase_pixel,
)
from marsyard.algorithms.dimes.rectification import rectified_patch
from marsyard.algorithms.dimes.selection import select_templates
from marsyard.algorithms.dimes.validity import failed_checks, track_metrics
from marsyard.algorithms.image.alignment import refine_shift
from marsyard.algorithms.image.correlation import pseudo_normalized_correlation
from marsyard.algorithms.image.peak import Peak, biquadratic_offset, highest_peak


def match_corner(
    template: Float[np.ndarray, "n n"],
    window: Float[np.ndarray, "w w"],
    surface: Float[np.ndarray, "s s"],
    peak: Peak,
    options: DimesOptions,
) -> Float[np.ndarray, "2"]:
    """Row and column in the window of the matched template's upper left pixel, refined as the options say."""
    whole = np.array([peak.row, peak.column], dtype=np.float64)
    if not options.subpixel:
        return whole
    start = whole + biquadratic_offset(surface, peak)
    aligned = refine_shift(template, window, start) if options.align and not peak.on_border else None
    return start if aligned is None else aligned


def camera_displacement(corner: Float[np.ndarray, "2"], geometry: SearchGeometry) -> Float[np.ndarray, "2"]:
    """Horizontal displacement (east, north) of the camera between the pictures, metres.

    A ground point at r1 from the point below the first camera is found at r2 from the point below the second; the
    camera moved by r1 - r2. The template's middle is r1; the window is centred on the same offset, so that r2 - r1 is
    the shift from the window's middle times the ground distance of a pixel, with rows running south.
    """
    shift = corner - geometry.search_px
    return np.asarray(geometry.gsd_m * np.array([-shift[1], shift[0]]))


def track_template(
    first: View,
    second: View,
    geometry: SearchGeometry,
    place: tuple[int, int],
    pixel: Float[np.ndarray, "2"],
    ground: Float[np.ndarray, "2"],
    contrast: float,
    options: DimesOptions,
) -> Track:
    """Follows the template at `pixel` of the first view, over the ground point `ground`; `place` is (pair, index)."""
    template = rectified_patch(first, ground, geometry.template_px, geometry.gsd_m)
    window = rectified_patch(second, ground, geometry.window_px, geometry.gsd_m)
    surface = pseudo_normalized_correlation(template, window)
    peak = highest_peak(surface)
    corner = match_corner(template, window, surface, peak, options)
    metrics = track_metrics(contrast, surface, peak, options)
    displacement = camera_displacement(corner, geometry)
    match_pixel, _ = pixels_from_ground(second, ground - displacement)
    return Track(
        pair=place[0],
        index=place[1],
        template_pixel=pixel,
        match_pixel=match_pixel,
        ground_m=ground,
        template=template,
        window=window,
        match=corner + 0.5 * (geometry.template_px - 1),
        surface=surface,
        metrics=metrics,
        failed=failed_checks(metrics, options),
        velocity_m_s=displacement / (second.time_s - first.time_s),
    )


def track_pair(
    pair: int, first: View, second: View, sun_direction: Float[np.ndarray, "3"], options: DimesOptions
) -> PairDetails:
    """Selects and follows the templates of one pair of views."""
    geometry = search_geometry(first, second, options)
    candidates = template_candidates(first, second, geometry, sun_direction, options)
    chosen, contrasts = select_templates(first, candidates, options)
    return PairDetails(
        overlap_polygon=overlap_polygon(first, second, options),
        zero_phase_pixels=np.stack([zero_phase_pixel(view, sun_direction) for view in (first, second)]),
        gsd_m=geometry.gsd_m,
        candidates=len(candidates.pixels),
        tracks=tuple(
            track_template(
                first,
                second,
                geometry,
                (pair, index),
                candidates.pixels[candidate],
                candidates.ground[candidate],
                float(contrast),
                options,
            )
            for index, (candidate, contrast) in enumerate(zip(chosen, contrasts, strict=True))
        ),
        views=(first, second),
    )
