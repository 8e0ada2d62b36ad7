"""Options of map-relative localisation's image matching (coarse and fine stage), with the sources of their defaults."""

from dataclasses import dataclass, field

import numpy as np

from marsyard.algorithms.localisation.inertial_state import ImuErrorModel


@dataclass(frozen=True)
class LvsOptions:
    """Options of the coarse and the fine matching stage.

    Sources: "published" is Johnson et al., "The Lander Vision System for Mars 2020 Entry Descent and Landing" (AAS GNC
    2017); other values are assumed, or derived as stated.

    Both stages:

    - max_off_nadir_rad: Ground at larger off-nadir angles is not used (assumed). At 55 deg a pixel covers three times
      as much ground along the line of sight as at the nadir.
    - attitude_sd_rad: Standard deviation of the attitude error per axis, for search ranges (assumed)

    Coarse stage:

    - coarse_binning: Map pixels per coarse pixel (published: 6 m to 12 m)
    - coarse_images: Number of images (published: 3)
    - patches_per_image: Number of large patches in each image (published: 5)
    - patch_px: Side of a patch, coarse pixels (assumed: 1.15 km); reduced if the footprint is small
    - min_patch_px: Smallest side of a patch (assumed)
    - search_radius_m: Largest horizontal offset searched (published: 3.2 km)
    - search_sigmas: Search radius in standard deviations of the position, up to `search_radius_m` (assumed)
    - coarse_min_score: Minimum normalised correlation of a consistent patch (assumed). Shaded relief under suns 40 deg
      apart in azimuth has 0.7, under suns 50 deg apart and with less albedo contrast 0.6.
    - coarse_tolerance_m: Largest difference of a patch's offset from the candidate when patches are rectified to a
      plane (assumed). Relief of 200 m at 35 deg off nadir shifts a patch by 140 m.
    - relief_tolerance_m: The same when patches are rectified to the map's elevation (assumed)
    - coarse_candidates: Number of candidate offsets that are verified with the map's elevation (assumed)
    - alternative_score: A patch supports a candidate if its correlation there is at least this fraction of its maximum
      over the search area. A fix is ambiguous if the patches have a second maximum above this fraction (assumed)
    - min_consistent_patches: Minimum number of consistent patches. The same ground is matched once per image, so that
      seven of 15 patches cover at least three areas: one coincidence gives three, two give six.
    - max_second_support: Largest ratio of the support of the second candidate to that of the first; the support is the
      sum of the scores of the consistent patches (assumed)

    - patch_outlier_probability: Probability to remove a correct patch from the consistent ones, by its residual from
      the prediction of the others (assumed; the value for a landmark in `state_updates`)
    - false_refusal: Probability to refuse a correct coarse fix because its patches do not fit the stated errors of
      state, altitudes and map (assumed; the value for a position in `state_updates`)

    Fine stage:

    - max_landmarks: Landmarks matched in one image (published: up to 150)
    - acquisition_landmarks: Landmarks in an acquisition step at reduced scale (assumed)
    - landmark_spacing_px: Side of the cells with one landmark each, map pixels (assumed)
    - landmark_support_px: Side of the square over which a landmark's interest is computed, map pixels (assumed)
    - min_interest: Minimum Harris interest of a landmark divided by the map's mean, per map pixel (assumed)
    - template_px: Side of a template, odd, pixels of the working scale, which are about one map pixel (assumed)
    - search_sigmas_fine: Search half width in standard deviations of the predicted pixel (assumed)
    - min_half_width_px, max_half_width_px: Limits of the search half width, working pixels. Above the minimum an
      acquisition step comes first, above the maximum at a reduced scale (assumed)
    - min_working_px: Smallest side of a working image in the acquisition step (assumed)
    - min_score: Minimum normalised correlation of a landmark (assumed)
    - max_residual_px: Largest residual from the common correction of position and attitude, working pixels (assumed:
      a map distortion of about one pixel)
    - fit_attitude_sd_rad: Standard deviation of the rotation in the common correction (assumed). A dozen landmarks
      determine the rotation to about 1 mrad. This value is a hundred times larger, so that landmarks are not rejected
      because the attitude is wrong by more than the state's covariance allows; that error is found by the filter.
    - min_matches: Minimum number of consistent landmarks; with fewer, no match is reported. The correction has six
      unknowns, and wrong matches are within the tolerance by chance (assumed)
    - min_inlier_fraction: Minimum fraction of consistent landmarks of those with an accepted score. Of wrong matches,
      uniform over a window of half width 5 px, 8 % are consistent with a given correction (assumed)

    Navigation (assumed):

    - coarse_altitudes: Number of last altitudes that update the state after the coarse stage
    - imu: Errors of the inertial unit, for the filter
    - landmark_sd_px: Standard deviation of a landmark per axis, working pixels
    - common_fraction: Standard deviation of the map error that is common to all landmarks of an image, as a fraction of
      the standard deviations of the map's distortion and elevation
    - calibration_sd_rad: Standard deviation of the error of all lines of sight by the calibration and alignment of the
      camera, per axis: half a pixel of the image centre, and 0.02 deg
    - correlated_images: Number of images whose common errors are equal. The filter treats these errors as independent
      between images, and multiplies their variance by this number instead
    - altitude_sd: Relative standard deviation of an altitude
    - max_failures: Number of successive images without an update after which the coarse stage is repeated
    - max_position_sd_m: Largest standard deviation of a reported horizontal position
    - max_update_age_s: Largest time since the last image whose landmarks updated the state, for a reported position.
      It is the filter's memory: the state that the update corrected is then no longer stored. An image without a match
      keeps the position until then, because the covariance contains the propagated errors; an image whose landmarks
      contradict the state does not.
    - sift_map_features, sift_sd_m: Number of features of the map, and standard deviation of a position, of the baseline
      `marsyard.algorithms.localisation.baselines.FeatureEstimator`
    """

    max_off_nadir_rad: float = float(np.deg2rad(55.0))
    attitude_sd_rad: float = 2e-3

    coarse_binning: int = 2
    coarse_images: int = 3
    patches_per_image: int = 5
    patch_px: int = 96
    min_patch_px: int = 32
    search_radius_m: float = 3200.0
    search_sigmas: float = 3.5
    coarse_min_score: float = 0.4
    coarse_tolerance_m: float = 150.0
    relief_tolerance_m: float = 60.0
    coarse_candidates: int = 4
    alternative_score: float = 0.9
    min_consistent_patches: int = 7
    max_second_support: float = 0.6
    patch_outlier_probability: float = 1e-3
    false_refusal: float = 1e-4

    max_landmarks: int = 150
    acquisition_landmarks: int = 60
    landmark_spacing_px: int = 8
    landmark_support_px: int = 11
    min_interest: float = 0.002
    template_px: int = 17
    search_sigmas_fine: float = 3.5
    min_half_width_px: int = 4
    max_half_width_px: int = 12
    min_working_px: int = 96
    min_score: float = 0.5
    max_residual_px: float = 1.2
    fit_attitude_sd_rad: float = 0.1
    min_matches: int = 12
    min_inlier_fraction: float = 0.4

    coarse_altitudes: int = 8
    imu: ImuErrorModel = field(default_factory=ImuErrorModel)
    landmark_sd_px: float = 0.3
    common_fraction: float = 0.5
    calibration_sd_rad: float = 1e-3
    correlated_images: int = 10
    altitude_sd: float = 0.02
    max_failures: int = 3
    max_position_sd_m: float = 15.0
    max_update_age_s: float = 5.0
    sift_map_features: int = 20000
    sift_sd_m: float = 20.0

    def __post_init__(self) -> None:
        if self.template_px < 5 or self.template_px % 2 == 0:
            raise ValueError(f"template_px is {self.template_px}; it must be odd and at least 5")
        if not 0.0 < self.max_off_nadir_rad < np.pi / 2:
            raise ValueError(f"max_off_nadir_rad is {self.max_off_nadir_rad}; it must lie between 0 and pi/2")
        for name in (
            "coarse_binning", "coarse_images", "patches_per_image", "max_landmarks", "acquisition_landmarks",
            "landmark_spacing_px", "coarse_altitudes",
        ):  # fmt: skip
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least 1")
