"""What DIMES did, for figures and diagnosis: all that the paper's Figs. 7-9 show."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from algorithms.dimes.consistency import Combination
from algorithms.dimes.validity import TrackMetrics, ValidityCheck


@dataclass(frozen=True)
class Track:
    """One template followed from the earlier to the later picture of a pair.

    Attributes
    ----------
    pair, index
        Pair (0: pictures 1 and 2; 1: pictures 2 and 3) and number of the template in it, best contrast first.
    template_pixel
        Middle of the template, (u, v) in the pair's earlier binned picture.
    match_pixel
        Where it was found, (u, v) in the later binned picture; NaN where that cannot be said.
    template, window
        Rectified and corrected patches, counts, north up: shapes (template_px, template_px), (window_px, window_px).
    match
        Row and column in `window` of the matched template's middle.
    surface
        Correlation at every shift; shape (2 search_px + 1,) twice, its middle is no motion.
    metrics, failed
        The validity metrics and the checks that they fail.
    velocity_m_s
        Mean velocity of the camera over the pair (east, north), m/s, also of invalid tracks.
    """

    pair: int
    index: int
    template_pixel: Float[np.ndarray, "2"]
    match_pixel: Float[np.ndarray, "2"]
    template: Float[np.ndarray, "n n"]
    window: Float[np.ndarray, "w w"]
    match: Float[np.ndarray, "2"]
    surface: Float[np.ndarray, "s s"]
    metrics: TrackMetrics
    failed: tuple[ValidityCheck, ...]
    velocity_m_s: Float[np.ndarray, "2"]

    @property
    def valid(self) -> bool:
        """Whether every check was passed."""
        return not self.failed


@dataclass(frozen=True)
class PairDetails:
    """One pair of pictures.

    Attributes
    ----------
    overlap_polygon
        Outline (u, v) in the earlier picture of what the later one sees, were there no horizontal motion.
    zero_phase_pixels
        Middle of the zero-phase spot (u, v) in the earlier and in the later picture, shape (2, 2); NaN if not seen.
    gsd_m
        Ground distance between rectified pixels, metres.
    candidates
        Number of places on the coarse grid that had room for template and window.
    tracks
        The templates tracked, valid or not.
    """

    overlap_polygon: Float[np.ndarray, "n 2"]
    zero_phase_pixels: Float[np.ndarray, "2 2"]
    gsd_m: float
    candidates: int
    tracks: tuple[Track, ...]


@dataclass(frozen=True)
class DimesDetails:
    """Everything that DIMES found on the way to its answer.

    Attributes
    ----------
    pairs
        Both pairs of pictures; none where times, altitudes or attitudes made no sense.
    combinations
        All combinations of valid tracks, best agreement with the IMU first.
    chosen
        The combination whose second-pair velocity is reported, or None.
    """

    pairs: tuple[PairDetails, ...]
    combinations: tuple[Combination, ...]
    chosen: Combination | None

    @property
    def tracks(self) -> tuple[Track, ...]:
        """The tracks of both pairs."""
        return tuple(track for pair in self.pairs for track in pair.tracks)


TRACK_COLUMNS = (
    "pair",
    "template",
    "template_u",
    "template_v",
    "match_u",
    "match_v",
    "contrast",
    "peak",
    "peak_width",
    "second_peak_ratio",
    "valid",
    "velocity_east_m_s",
    "velocity_north_m_s",
)


def _track_row(track: Track) -> list[float]:
    m = track.metrics
    return [
        float(track.pair),
        float(track.index),
        *map(float, track.template_pixel),
        *map(float, track.match_pixel),
        m.contrast,
        m.peak,
        m.peak_width_px,
        m.second_peak_ratio,
        float(track.valid),
        *map(float, track.velocity_m_s),
    ]


def dimes_products(details: DimesDetails) -> dict[str, Any]:
    """The details as plain arrays, for storage and figures.

    Keys: `tracks` (one row a track) with `tracks_columns`; `template_<pair>_<k>`, `window_<pair>_<k>` and
    `match_<pair>_<k>` (row, column) for every track; `overlap_<pair>` and `zero_phase_<pair>` (pixels of the earlier
    picture, and for the spot of the later one too); `combinations` (first, second, discrepancy_m_s) with
    `combinations_columns`. Widths are in rectified pixels, contrasts per binned pixel, pixels (u, v) binned.
    """
    rows = [_track_row(track) for track in details.tracks]
    found = [[c.first, c.second, c.discrepancy_m_s] for c in details.combinations]
    products: dict[str, Any] = {
        "tracks": np.array(rows, dtype=np.float64).reshape(-1, len(TRACK_COLUMNS)),
        "tracks_columns": list(TRACK_COLUMNS),
        "combinations": np.array(found, dtype=np.float64).reshape(-1, 3),
        "combinations_columns": ["first", "second", "discrepancy_m_s"],
    }
    for number, pair in enumerate(details.pairs):
        products[f"overlap_{number}"] = pair.overlap_polygon
        products[f"zero_phase_{number}"] = pair.zero_phase_pixels
    for track in details.tracks:
        name = f"{track.pair}_{track.index}"
        products[f"template_{name}"] = track.template
        products[f"window_{name}"] = track.window
        products[f"match_{name}"] = track.match
    return products
