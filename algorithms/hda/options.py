"""Options of the hazard detection, with the reasons for their defaults."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from types import MappingProxyType
from typing import Any

import numpy as np


class SurfaceFrame(Enum):
    """Source of the vertical direction (paper: section II.D). The azimuth always comes from the on-board pose.

    Inclinometers, attitude of the on-board filter, or the normal of a robust plane through the points. The map of the
    last source is level on average.
    """

    INCLINOMETER = "inclinometers"
    STATE = "filter"
    PLANE = "plane"


class TrackSeed(Enum):
    """Start of the search for a feature in the second image, and of the motion estimation.

    Unchanged: the position in the first image, and zero motion ("no knowledge of the motion between frames is assumed",
    section II.A). Poses: the position of level ground at the measured range, and the motion, by the on-board poses.
    """

    NOTHING = "unchanged"
    POSE = "poses"


@dataclass(frozen=True)
class HdaOptions:
    """Options of the hazard detection and avoidance (sections are those of 'Vision Guided Landing').

    The defaults are the published algorithm, with assumed values where the paper gives none.

    - template_half_px: Half width t of the sparse tracker's templates and of the interest window: 2 t + 1 pixels (Table
      I: 11 x 11)
    - window_half_px: Half width w of the search window of a feature. None: the expected displacement of the features
      (section II.A), which the limits of the image pairs and the camera determine
      (`marsyard.algorithms.hda.tracking.window_half_px`). The example of Table I, 81 x 81 px, is 40.
    - max_baseline_fraction: Limit of the image pairs: baseline divided by range
    - max_tilt_change_rad, max_roll_change_rad, max_height_change_fraction: Limits of the image pairs: rotation about an
      axis in the image plane and about the optical axis, and change of height divided by height. The defaults are those
      at which the tracker works (section II.A).
    - block_px: Side of the blocks; the best feature of each block is used. 64 px give 80 blocks in 640 x 480 pixels,
      and 50 to 70 tracks; the paper had 59.
    - min_eigenvalue: Minimum eigenvalue lambda_t of Eq. 2, for the mean over the template instead of the sum, squared
      counts per squared pixel. An image of noise only, one count rms, has about 0.2.
    - min_track_correlation: Minimum correlation (Eq. 3) of a track at the finest level. Without `align`, wrong tracks
      over rocks have correlations up to 0.8; correct tracks have at least 0.6 if the camera heights differ by 20 %.
    - min_aligned_correlation: Minimum correlation of the aligned track with the warped template. Over 25 rendered pairs
      at the paper's limits, 99 % of the correct tracks of each pair have at least 0.91. Two thirds of the wrong tracks,
      most of which left the image, have less than 0.88.
    - track_seed: Start of the search for a feature in the second image, and of the motion estimation
    - align: Whether Gauss-Newton alignment with an affine warp follows the biquadratic fit of the paper. The fit has a
      bias towards whole pixels of up to 0.09 px and neglects rotation and scale. A track that cannot be aligned is
      rejected: over rocks, at small changes of the view, only 6 of 276 such tracks were correct. Of 1,199 aligned
      tracks 4 were wrong; the others had errors of up to 0.2 px, with a median of 0.004 px.
    - min_tracks: Minimum number of tracks. Five tracks determine a motion; more are needed to detect outliers.
    - robust_px: Scale of Cauchy's cost of a residual, pixels: the standard deviation of correct tracks
    - max_residual_px: Residual above which a track is an outlier
    - min_inlier_fraction: Minimum fraction of inliers among the tracks of an accepted motion
    - min_parallax_px: Minimum median shift of the features by translation alone. Tracks have errors of 0.1 px, so that
      depth errors exceed 5 % at a smaller shift.
    - depth_margin: Relative margin added to the features' depth range (section II.C: 0.2 to 0.4)
    - grid_px: Spacing of the grid of pixels that are matched for structure
    - refine_grid: Whether the spacing is reduced until the grid resolves the narrowest hazard
      (`marsyard.algorithms.hda.structure.grid_spacing_px`). Section II.C: "it could be set automatically based on the
      size of the helicopter (or lander) and the pixel resolution".
    - resample_second: Whether the second image is resampled to the orientation and the scale of the first before the
      structure matches: a window then shows the same ground in both
    - filter_images: Whether both images are smoothed and their local mean is subtracted before the structure matches
      (`marsyard.algorithms.hda.preparation`)
    - search_half_px: Half width of the windows compared along epipolar segments, pixels
    - min_match_correlation: Minimum correlation (Eq. 3) of a structure match
    - max_forward_backward_px: Maximum forward-backward error, pixels: each structure match is matched back from the
      second image to the first, and rejected if it ends farther from its start. None: no check, as in the paper. Both
      searches use whole pixels near a line, with errors of up to 0.7 px.
    - min_points: Minimum number of points for an elevation map
    - surface_frame: Source of the vertical direction
    - lander_diameter_m: Diameter of the lander: side of the squares for plane fits, and unit of the dilation of hazards
      (section III). Helicopter: 2 m.
    - plane_trials: Random triples of points for the least-median-of-squares plane of a footprint. If half of the points
      are not on the plane, 30 trials find it in 98 % of footprints; if 30 % are not, in all but 3 in a million.
    - refine_planes: Whether each plane is refined by least squares over its inliers (Rousseeuw & Leroy 1987)
    - max_slope_rad, max_roughness_m: Limits of the lander, set by the user (section III)
    - hazard_growth, unknown_growth: Without `check_footprints`, dilation of hazards, and of borders and holes of the
      map, in lander diameters. The paper uses 1 for hazards. For cells "near" borders 0.5 is assumed: at a smaller
      distance, part of the lander would be on unmapped ground.
    - check_footprints: Whether the safe landing map is that of a plane fitted to the footprint at each cell, with a
      margin for the map's resolution (`marsyard.algorithms.hda.hazards.classify_footprints`). The paper interpolates
      planes and slopes between fixed squares, and enlarges hazards by the lander's diameter. Over curved ground the
      distance from this interpolated surface is half of the distance from a plane.
    - narrowest_hazard: Ratio of base width to height of the narrowest hazard. Rocks have heights of up to 0.65 widths
      (Golombek & Rapp 1997: 0.5, with a variation of one third).
    - margin_deviations: Safety margin of `check_footprints`, in standard deviations of the map's noise, the vertical
      and the map's position
    - match_error_px: Minimum error of a structure match: the biquadratic's bias towards whole pixels is up to 0.09 px
    - level_error_rad: Standard deviation of the vertical, including the map's tilt due to the motion's error. It also
      displaces the map by this angle times the depth, 0.1 m at 11 m.
    - seed: Seed of the random triples, the same for every map: the result depends only on the measurements
    """

    template_half_px: int = 5
    window_half_px: int | None = None
    max_baseline_fraction: float = 0.2
    max_tilt_change_rad: float = float(np.deg2rad(20.0))
    max_roll_change_rad: float = float(np.deg2rad(10.0))
    max_height_change_fraction: float = 0.2
    block_px: int = 64
    min_eigenvalue: float = 1.0
    min_track_correlation: float = 0.6
    min_aligned_correlation: float = 0.88
    track_seed: TrackSeed = TrackSeed.NOTHING
    align: bool = False
    min_tracks: int = 12
    robust_px: float = 0.1
    max_residual_px: float = 1.0
    min_inlier_fraction: float = 0.5
    min_parallax_px: float = 2.0
    depth_margin: float = 0.3
    grid_px: int = 8
    refine_grid: bool = False
    resample_second: bool = False
    filter_images: bool = False
    search_half_px: int = 5
    min_match_correlation: float = 0.7
    max_forward_backward_px: float | None = None
    min_points: int = 100
    surface_frame: SurfaceFrame = SurfaceFrame.INCLINOMETER
    lander_diameter_m: float = 2.0
    plane_trials: int = 30
    refine_planes: bool = False
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
        for name, minimum in ((name, minimum) for minimum, names in _NAMES_BY_MINIMUM.items() for name in names):
            if getattr(self, name) is not None and not getattr(self, name) >= minimum:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least {minimum}")
        for name in _POSITIVE_NAMES:
            if getattr(self, name) is not None and not getattr(self, name) > 0.0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be positive")
        if not self.max_slope_rad < np.pi / 2:
            raise ValueError(f"max_slope_rad is {self.max_slope_rad}; it must be below pi/2")
        for name in ("depth_margin", "max_height_change_fraction"):
            if not getattr(self, name) < 1.0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be below 1")
        if not self.max_tilt_change_rad < np.pi / 2:
            raise ValueError(f"max_tilt_change_rad is {self.max_tilt_change_rad}; it must be below pi/2")


#: Names of the options by their minimum value.
_NAMES_BY_MINIMUM = {
    0: (
        "depth_margin", "hazard_growth", "unknown_growth", "margin_deviations", "match_error_px", "level_error_rad",
        "seed", "max_baseline_fraction", "max_tilt_change_rad", "max_roll_change_rad", "max_height_change_fraction",
    ),
    1: ("grid_px", "search_half_px", "plane_trials"),
    2: ("template_half_px", "window_half_px", "block_px"),
    4: ("min_points",),
    6: ("min_tracks",),
}  # fmt: skip
#: Names of the options that must be positive.
_POSITIVE_NAMES = (
    "robust_px", "max_forward_backward_px", "narrowest_hazard", "max_residual_px", "lander_diameter_m",
    "max_slope_rad", "max_roughness_m",
)  # fmt: skip


#: Options of `hda-plus` that differ from the published algorithm.
IMPROVEMENTS: Mapping[str, Any] = MappingProxyType(
    {
        "track_seed": TrackSeed.POSE,
        "align": True,
        "max_forward_backward_px": 1.5,
        "refine_grid": True,
        "resample_second": True,
        "filter_images": True,
        "refine_planes": True,
        "check_footprints": True,
    }
)
