"""Every number of the hazard detection that could have been another one, with why it is what it is."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np


class SurfaceFrame(Enum):
    """Where the direction of gravity comes from (paper: section II.D). Azimuth always comes from the on-board pose."""

    INCLINOMETER = "the inclinometers"
    STATE = "the on-board filter's attitude"
    PLANE = "a robust plane through the points: the ground is taken to have no mean slope"


class TrackSeed(Enum):
    """Where the search for a feature in the second picture begins."""

    NOTHING = "where it was in the first picture, as the paper has it"
    POSE = "where level ground at the measured range would move it by the on-board poses"


@dataclass(frozen=True)
class HdaOptions:
    """Options of the hazard detection and avoidance (sections are those of 'Vision Guided Landing').

    - template_half_px: Half width t of the sparse tracker's templates and of the interest window: 2 t + 1 pixels (Table
      I: 11 x 11)
    - window_half_px: Half width w of the window in which a feature is looked for (Table I: 81 x 81)
    - block_px: Side of the blocks of which each gives its best feature. 64 px give 80 blocks on 640 x 480, and 50 to 70
      tracks; the paper had 59.
    - min_eigenvalue: Least eigenvalue lambda_t of Eq. 2, for the template's mean instead of its sum, squared counts per
      squared pixel. Noise of one count alone has about 0.2.
    - min_track_correlation: Least correlation (Eq. 3) of a track at the finest level. Without `align` wrong tracks over
      rocks have up to 0.8, and right ones of pictures whose heights differ by a fifth go down to 0.6.
    - min_aligned_correlation: Least correlation of the aligned track with the template, stretched as it was found to
      be. Over 25 rendered pairs, at the paper's limits, 99 % of right tracks of each pair have 0.91 and more; of the
      wrong ones, most of which left the picture, two in three have less than 0.88.
    - track_seed: Where the search begins
    - align: Whether the top of the biquadratic (all that the paper has) is followed by Gauss-Newton alignment over an
      affine warp. The biquadratic leans towards whole pixels, by up to 0.09 px, and knows nothing of rotation and
      scale. A track that cannot be aligned is not accepted: over rocks, at small changes, 6 of 276 such tracks were
      right; of 1,199 that could be 4 were wrong and the others right to 0.2 px, with a median of 0.004 px.
    - min_tracks: Least number of tracks: five are needed for a motion; more make outliers stand out
    - robust_px: Scale of Cauchy's cost of a residual, pixels: the spread of good tracks
    - max_residual_px: Residual above which a track is an outlier
    - min_inlier_share: Least share of the tracks that must not be outliers for the motion to be believed
    - min_parallax_px: Least median shift of the features by translation alone. Tracks are right to 0.1 px: below this,
      depths would be wrong by more than 5 %.
    - depth_margin: Share by which the bounds of depth are widened beyond the features' (section II.C: 0.2 to 0.4)
    - grid_px: Spacing of the grid of structure pixels
    - search_half_px: Half width of the windows compared along epipolar segments
    - min_match_correlation: Least correlation (Eq. 3) of a structure match.
    - max_return_px: Beyond the paper: each structure match is looked for again, from the second picture in the first,
      and dropped if it comes out farther than this, from where it started. None: no such check, as the paper has it.
      Both searches go by whole pixels beside a line, each up to 0.7 px off.
    - min_points: Least number of points for an elevation map
    - surface_frame: Where the direction of gravity comes from
    - lander_diameter_m: Side of the lander's footprint; hazards grow by it (section III). The helicopter is 2 m long.
    - plane_trials: Random triples of points of which the best makes the least-median-of-squares plane of a footprint.
      With half of the points off the plane 30 trials find it in 98 % of footprints, with 30 % in all but 3 in a
      million.
    - refine_planes: Whether each plane is fitted once more by least squares to the points that it explains (Rousseeuw &
      Leroy 1987)
    - max_slope_rad, max_roughness_m: What the lander can stand on; the user's to set (section III)
    - hazard_growth, unknown_growth: By how many diameters hazards, and borders and holes of the map, are grown. The
      paper has 1 for hazards; "near" borders is taken as half of one: the lander would stand on ground that was not
      seen.
    - check_footprints: Whether places that the paper's maps call safe must also be safe for the plane of their own
      footprint, with a margin for what the map does not see (`marsyard.algorithms.hda.hazards`). The paper
      interpolates planes and slopes between fixed squares: over curved ground the distance from that is half of the
      distance from a plane.
    - narrowest_hazard: Width at its foot of the narrowest hazard over its height. Rocks are up to 0.65 as tall as wide
      (Golombek & Rapp 1997: 0.5, with the spread of a third that rocks have).
    - margin_deviations: Standard deviations of the map's noise, and of the vertical, that a place must be within the
      limits by
    - match_error_px: Least error of a structure match: the biquadratic leans towards whole pixels by up to 0.09 px
    - level_error_rad: Standard deviation of the vertical that slopes are measured from, with what the motion's error
      tilts the map by
    - seed: Of the random triples, the same for every map: the answer is a function of the measurements
    """

    template_half_px: int = 5
    window_half_px: int = 40
    block_px: int = 64
    min_eigenvalue: float = 1.0
    min_track_correlation: float = 0.6
    min_aligned_correlation: float = 0.88
    track_seed: TrackSeed = TrackSeed.NOTHING
    align: bool = True
    min_tracks: int = 12
    robust_px: float = 0.1
    max_residual_px: float = 1.0
    min_inlier_share: float = 0.5
    min_parallax_px: float = 2.0
    depth_margin: float = 0.3
    grid_px: int = 8
    search_half_px: int = 5
    min_match_correlation: float = 0.7
    max_return_px: float | None = None
    min_points: int = 100
    surface_frame: SurfaceFrame = SurfaceFrame.INCLINOMETER
    lander_diameter_m: float = 2.0
    plane_trials: int = 30
    refine_planes: bool = True
    max_slope_rad: float = float(np.deg2rad(15.0))
    max_roughness_m: float = 0.2
    hazard_growth: float = 1.0
    unknown_growth: float = 0.5
    check_footprints: bool = False
    narrowest_hazard: float = 1.5
    margin_deviations: float = 2.0
    match_error_px: float = 0.1
    level_error_rad: float = float(np.deg2rad(0.5))
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in _MINIMA.items():
            if not getattr(self, name) >= least:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least {least}")
        for name in _POSITIVE:
            if getattr(self, name) is not None and not getattr(self, name) > 0.0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be positive")
        if not self.max_slope_rad < np.pi / 2:
            raise ValueError(f"max_slope_rad is {self.max_slope_rad}; it must be below pi/2")
        if not self.depth_margin < 1.0:
            raise ValueError(f"depth_margin is {self.depth_margin}; it must be below 1")


_MINIMA = {
    "template_half_px": 2,
    "window_half_px": 2,
    "block_px": 2,
    "min_tracks": 6,
    "depth_margin": 0.0,
    "grid_px": 1,
    "search_half_px": 1,
    "min_points": 4,
    "plane_trials": 1,
    "hazard_growth": 0.0,
    "unknown_growth": 0.0,
    "margin_deviations": 0.0,
    "match_error_px": 0.0,
    "level_error_rad": 0.0,
    "seed": 0,
}
_POSITIVE = (
    "robust_px",
    "max_return_px",
    "narrowest_hazard",
    "max_residual_px",
    "lander_diameter_m",
    "max_slope_rad",
    "max_roughness_m",
)
