"""Intermediate products of DIMES.

Figures are those of Johnson et al., "Field Testing of the MER DIMES".
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

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
