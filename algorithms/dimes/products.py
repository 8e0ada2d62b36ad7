"""Intermediate products of DIMES, and their conversion to plain arrays for storage and figures.

Figures are those of Johnson et al., "Field Testing of the MER DIMES".
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from marsyard.algorithms.dimes.ground_view import ground_from_pixels, pixels_from_ground
from marsyard.algorithms.dimes.tilt import GroundFit
from marsyard.algorithms.dimes.validity import Combination, TrackMetrics, ValidityCheck
from marsyard.algorithms.dimes.views import BinnedView


@dataclass(frozen=True)
class DimesTrack:
    """Template tracked from the earlier to the later image of a pair.

    - pair, index: Pair (0: images 1 and 2; 1: images 2 and 3) and number of the template in it, best contrast first
    - template_pixel: Template centre, (u, v) in the earlier binned image
    - match_pixel: Matched template centre, (u, v) in the later binned image; NaN if outside the camera's view
    - ground_m: Template centre on the ground, (east, north) of the earlier nadir point. The window's centre has the
      same offset from the later nadir point.
    - template, window: Rectified and corrected patches, counts, north up
    - match: Row and column in `window` of the matched template's centre
    - surface: Correlation at every shift; its centre is zero motion. It is -1 where the later image does not show the
      complete template.
    - failed: Validity checks that the track failed
    - velocity_m_s: Mean velocity of the camera over the pair (east, north); also given for invalid tracks
    """

    pair: int
    index: int
    template_pixel: Float[np.ndarray, "2"]
    match_pixel: Float[np.ndarray, "2"]
    ground_m: Float[np.ndarray, "2"]
    template: Float[np.ndarray, "n n"]
    window: Float[np.ndarray, "w w"]
    match: Float[np.ndarray, "2"]
    surface: Float[np.ndarray, "s s"]
    metrics: TrackMetrics
    failed: tuple[ValidityCheck, ...]
    velocity_m_s: Float[np.ndarray, "2"]

    @property
    def valid(self) -> bool:
        """Whether every check passed."""
        return not self.failed


@dataclass(frozen=True)
class PairDetails:
    """Intermediate products of one pair of consecutive images.

    - overlap_polygon: Outline (u, v) in the earlier image of the later image's footprint at zero horizontal motion
    - zero_phase_pixels: Anti-solar point (zero phase angle) in both images (u, v); NaN if invisible
    - gsd_m: Ground sample distance of rectified pixels
    - tracks: All tracks, valid or not
    - views: Earlier and later binned image
    """

    overlap_polygon: Float[np.ndarray, "n 2"]
    zero_phase_pixels: Float[np.ndarray, "2 2"]
    gsd_m: float
    tracks: tuple[DimesTrack, ...]
    views: tuple[BinnedView, BinnedView]


@dataclass(frozen=True)
class DimesDetails:
    """Intermediate products of `DimesEstimator`, returned as `VelocityEstimate.details`.

    - pairs: Both pairs of images; empty for unusable times, altitudes or attitudes
    - combinations: All combinations of valid tracks, best agreement with the IMU first
    - selected: The combination of the reported velocity, or None
    - ground: Fit of ground and motion that corrects the velocity for the common tilt; None without this correction
    """

    pairs: tuple[PairDetails, ...]
    combinations: tuple[Combination, ...]
    selected: Combination | None
    ground: GroundFit | None = None

    @property
    def tracks(self) -> tuple[DimesTrack, ...]:
        """The tracks of both pairs."""
        return tuple(track for pair in self.pairs for track in pair.tracks)


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


def rectified_lattice(pair: PairDetails) -> tuple[Float[np.ndarray, "3"], list[Float[np.ndarray, "n n 2"]]]:
    """Build the lattice that samples the virtual camera's image of a pair over both footprints, for Figs. 7-9.

    Returns (east, north, step), metres: the upper left point relative to the nadir point, and the spacing; and the
    pixels (u, v) of the earlier and the later image at the lattice points, NaN if invisible. Rows run south.
    """
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
    return np.array([ground[0, 0, 0], ground[0, 0, 1], step]), pixels


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
        frame, lattices = rectified_lattice(pair)
        products[f"rectified_frame_{number}"] = frame
        for side, pixels in enumerate(lattices):
            products[f"rectified_{number}_{side}"] = pixels
    for track in details.tracks:
        for kind in ("template", "window", "match"):
            products[f"{kind}_{track.pair}_{track.index}"] = getattr(track, kind)
    return products
