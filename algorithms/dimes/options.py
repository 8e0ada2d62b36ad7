"""Options of DIMES, with the reasons for their defaults."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np


@dataclass(frozen=True)
class DimesOptions:
    """Options of the DIMES estimator (paper: section II of 'Field Testing of the MER DIMES').

    The defaults are the published algorithm, with assumed values where the paper gives none.

    - binned_size: Columns and rows of the binned image (paper: 256 x 256)
    - max_speed_m_s: Largest horizontal speed expected (paper: 30 m/s). The search range is this speed times the time
      between the images, 112.5 m in 3.75 s. The overlap of a pair must be at least as wide (paper: 110 m).
    - search_margin_px: Additional search range on each side, rectified pixels. Attitude and altitude errors also shift
      the match (0.3 deg between two images is 9 m, 1.6 px, at 1700 m), and a peak must not lie on the border.
    - template_px: Side of the rectified template, odd. 31 px is 172 m at 1700 m.
    - max_off_nadir_rad: Ground at larger off-nadir angles is not used. At 55 deg a pixel covers three times as much
      ground along the line of sight as at the nadir, and an altitude error shifts the ground by 1.4 times the error.
    - border_px: Distance of templates and windows from the image border, binned pixels, for spline interpolation and
      the lens distortion of a window's sides.
    - zero_phase_radius_rad: Angle from the anti-solar point within which the ground is masked. The opposition surge of
      soils has a half width of a few degrees; the shadow of lander and parachute is smaller than 1 deg. Outside 4 deg
      the surge is smooth over a template, and subtracting the local mean removes most of it.
    - grid_step_px: Spacing of the coarse grid of candidate templates, binned pixels of the first image: a quarter of a
      template
    - templates_per_pair: Templates selected in each pair of images (paper: 2)
    - exclusion_px: Minimum distance (in column or row, binned pixels) between template centres, so that the templates
      do not overlap and fail independently.
    - subpixel: Whether the correlation peak is refined to sub-pixel accuracy by a quadratic fit (not specified for
      DIMES in the paper; the hazard detection of the same authors has this fit)
    - min_contrast: Minimum Harris interest of a template divided by its mean signal, per binned pixel. Images of noise
      only, at the flight camera's signal-to-noise ratio of 102, have 0.0022 to 0.0029.
    - min_peak: Minimum correlation at the peak, derived on random terrains of 0.2 to 15 % contrast with that noise. On
      terrain with detail, wrong matches had peaks below 0.28. On terrain without detail they had up to 0.64; the
      second-peak check rejects them (ratios of 0.83 or more). Correct matches of at least 0.45 have velocity errors of
      about 0.5 m/s rms (3 m/s on terrain without detail).
    - max_peak_width_px: Largest full width of the peak at three quarters of its height, rectified pixels. At the lowest
      accepted peak, tracks of this width have errors of about 2.5 m/s rms, half of the requirement. Single straight
      edges have wider peaks.
    - max_second_peak_ratio: Largest ratio of the second-highest local maximum to the peak. On terrain with detail 98 %
      of correct matches are below 0.8. Wrong matches with an accepted peak had 0.83 or more; repetitive terrain has
      nearly 1.
    - second_peak_exclusion_px: Local maxima within this distance of the peak belong to it. 3 px are 16.7 m at 1700 m,
      4.4 m/s: an error of this size is within the requirement of 5 m/s.
    - imu_threshold_m_s: Largest horizontal discrepancy between the velocity change of a combination of tracks and that
      of the IMU. Derived by Monte Carlo (`benchmarks.threshold_derivation`, stored in `imu_threshold.json`; see
      `docs/adr/0008-threshold-of-the-imu-check.md`): the discrepancy is smaller in 99.5 % of descents with one correct
      track in each pair and the errors of the simulated instruments.
    - correct_tilt: Whether the inclination of the ground corrects the velocity for the common tilt of the attitudes
      (`marsyard.algorithms.dimes.tilt`). The options below belong to this correction.
    - grid_template_px: Side and spacing of its templates, rectified pixels: about 60 tracks in each pair
    - track_sd_px: Minimum standard deviation of its tracks. Errors of neighbouring tracks are correlated: calibration
      of the distortion (0.3 px of the full image, 0.08 px binned) and relief (10 m move a track by 0.05 px).
    - tilt_sd_rad: Standard deviation per horizontal axis of the attitude error common to all images: 0.89 to 0.94 deg
      in simulated descents (Gusev and Meridiani, calibration seed 5406)
    - slope_sd_rad: Standard deviation per axis of the slope of the ground over the overlap, about 1 km. Selected MER
      landing sites have slopes below 2 deg over 1.2 km (Anderson et al. 2003, JGR 108(E12) 8084). 99.7 % of slopes are
      smaller than 2 deg if the standard deviation is 0.59 deg.
    - altitude_sd, attitude_sd_rad: Standard deviations of the relative altitude and of the attitude per axis,
      independent for each image: 0.24 % and 0.017 deg in simulated descents (`imu_threshold.json`). Half of the
      alignment error of the camera (0.02 deg) is added, because it rotates with the body between the images.
    """

    binned_size: tuple[int, int] = (256, 256)
    max_speed_m_s: float = 30.0
    search_margin_px: int = 4
    template_px: int = 31
    max_off_nadir_rad: float = float(np.deg2rad(55.0))
    border_px: float = 3.0
    zero_phase_radius_rad: float = float(np.deg2rad(4.0))
    grid_step_px: int = 8
    templates_per_pair: int = 2
    exclusion_px: float = 31.0
    subpixel: bool = True
    min_contrast: float = 0.003
    min_peak: float = 0.45
    max_peak_width_px: float = 16.0
    max_second_peak_ratio: float = 0.8
    second_peak_exclusion_px: float = 3.0
    imu_threshold_m_s: float = 3.5
    correct_tilt: bool = False
    grid_template_px: int = 21
    track_sd_px: float = 0.1
    tilt_sd_rad: float = float(np.deg2rad(0.9))
    slope_sd_rad: float = float(np.deg2rad(0.59))
    altitude_sd: float = 0.0024
    attitude_sd_rad: float = float(np.deg2rad(0.02))

    def __post_init__(self) -> None:
        if self.template_px < 5 or self.template_px % 2 == 0:
            raise ValueError(f"template_px is {self.template_px}; it must be odd and at least 5")
        if self.search_margin_px < 1:
            raise ValueError(f"search_margin_px is {self.search_margin_px}; it must be at least 1")
        if self.grid_step_px < 1 or self.templates_per_pair < 1:
            raise ValueError("grid_step_px and templates_per_pair must be at least 1")
        if not 0.0 < self.max_off_nadir_rad < np.pi / 2:
            raise ValueError(f"max_off_nadir_rad is {self.max_off_nadir_rad}; it must lie between 0 and pi/2")


#: Options of `dimes-plus` that differ from the published algorithm.
IMPROVEMENTS: Mapping[str, Any] = MappingProxyType({"correct_tilt": True})
