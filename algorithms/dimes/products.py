"""Conversion of DIMES' intermediate products to plain arrays, for storage and figures.

Figures are those of Johnson et al., "Field Testing of the MER DIMES".
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from marsyard.algorithms.dimes.details import DimesDetails, PairDetails
from marsyard.algorithms.dimes.ground_view import ground_from_pixels, pixels_from_ground
from marsyard.algorithms.dimes.validity import ValidityCheck

#: Columns of the stored array `tracks`.
TRACK_COLUMNS = (
    "pair", "template", "template_u", "template_v", "match_u", "match_v", "contrast", "peak", "peak_width",
    "second_peak_ratio", "valid", "velocity_east_m_s", "velocity_north_m_s", "ground_east_m", "ground_north_m",
    *(f"failed_{check.name.lower()}" for check in ValidityCheck),
)  # fmt: skip
#: Points along a side of the lattice for rectified figures: enough to draw a perspective image up to the horizon.
LATTICE_POINTS = 49
#: Pixels along a side of an image whose ground points are its footprint.
FOOTPRINT_POINTS = 17
#: Off-nadir limit of figures: slightly more than DIMES uses.
FIGURE_OFF_NADIR_RAD = float(np.deg2rad(60.0))


class RectifiedLattice(NamedTuple):
    """Sampling lattice of the virtual camera's image of a pair, for Figs. 7-9; rows run south.

    - frame_m: (east, north, step), metres: the upper left point relative to the nadir point, and the spacing
    - earlier_pixels, later_pixels: pixels (u, v) of both images at the lattice points; NaN if invisible
    """

    frame_m: Float[np.ndarray, "3"]
    earlier_pixels: Float[np.ndarray, "n n 2"]
    later_pixels: Float[np.ndarray, "n n 2"]


def rectified_lattice(pair: PairDetails) -> RectifiedLattice:
    """Build the sampling lattice of a pair over the footprints of both images."""
    footprints = []  # ground points of a lattice of pixels of each image
    for view in pair.views:
        u, v = np.meshgrid(*(np.linspace(0.0, 1.0, FOOTPRINT_POINTS) * (size - 1.0) for size in view.size))
        ground, _ = ground_from_pixels(view, np.column_stack([u.ravel(), v.ravel()]), FIGURE_OFF_NADIR_RAD)
        footprints.append(ground)
    low, high = np.min(footprints, axis=(0, 1)), np.max(footprints, axis=(0, 1))
    step = float((high - low).max()) / (LATTICE_POINTS - 1)
    centre = 0.5 * (low + high)
    offsets = (np.arange(LATTICE_POINTS) - 0.5 * (LATTICE_POINTS - 1)) * step
    ground = np.stack(np.meshgrid(centre[0] + offsets, centre[1] - offsets), axis=-1)
    pixels = []
    for view in pair.views:
        view_pixels, visible = pixels_from_ground(view, ground)
        pixels.append(np.where(visible[..., None], view_pixels, np.nan))
    return RectifiedLattice(np.array([ground[0, 0, 0], ground[0, 0, 1], step]), *pixels)


def dimes_products(details: DimesDetails) -> dict[str, Any]:
    """Convert the details to plain arrays, for storage and figures.

    Keys: `tracks` (one row per track) with `tracks_columns`; `template_<pair>_<k>`, `window_<pair>_<k>` and
    `match_<pair>_<k>` (row, column) for every track; `overlap_<pair>` (pixels of the earlier image) and
    `zero_phase_<pair>` (pixels of both images); `gsd_<pair>` (metres); `rectified_frame_<pair>` and
    `rectified_<pair>_<side>` (see `rectified_lattice`; side 0 is the earlier image); `combinations` (first, second,
    discrepancy_m_s) with `combinations_columns`, and `selected` (first, second; empty for none). Widths are in
    rectified pixels, contrasts per binned pixel, pixels (u, v) binned, ground in metres (see `DimesTrack`);
    `failed_...` are 0 or 1.
    """
    selected = () if details.selected is None else (details.selected.first, details.selected.second)
    rows = []
    for track in details.tracks:
        metrics, vectors = track.metrics, (*track.velocity_m_s, *track.ground_m)
        metric_values = (metrics.contrast, metrics.peak, metrics.peak_width_px, metrics.second_peak_ratio)
        failed = (check in track.failed for check in ValidityCheck)
        pixel_values = (*track.template_pixel, *track.match_pixel)
        rows.append([track.pair, track.index, *pixel_values, *metric_values, track.valid, *vectors, *failed])
    combination_rows = [
        [combination.first, combination.second, combination.discrepancy_m_s] for combination in details.combinations
    ]
    products: dict[str, Any] = {
        "tracks": np.array(rows, dtype=np.float64).reshape(-1, len(TRACK_COLUMNS)),
        "tracks_columns": list(TRACK_COLUMNS),
        "combinations": np.array(combination_rows, dtype=np.float64).reshape(-1, 3),
        "combinations_columns": ["first", "second", "discrepancy_m_s"],
        "selected": np.array(selected, dtype=np.float64),
    }
    for number, pair in enumerate(details.pairs):
        products[f"overlap_{number}"] = pair.overlap_polygon
        products[f"zero_phase_{number}"] = pair.zero_phase_pixels
        products[f"gsd_{number}"] = np.array([pair.gsd_m])
        frame, *lattices = rectified_lattice(pair)
        products[f"rectified_frame_{number}"] = frame
        for side, pixels in enumerate(lattices):
            products[f"rectified_{number}_{side}"] = pixels
    for track in details.tracks:
        for kind in ("template", "window", "match"):
            products[f"{kind}_{track.pair}_{track.index}"] = getattr(track, kind)
    return products
