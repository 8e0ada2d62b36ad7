"""Monte Carlo derivation of the threshold of the IMU check: discrepancy of correct tracks from the IMU.

The field test paper (section II.B) uses "a velocity threshold established through Monte Carlo simulation". This
simulation is geometric. It draws attitudes, altitudes and features. The true cameras project a feature into the images,
the measured cameras intersect its rays with the ground, and the resulting velocities are compared as in DIMES. Image
content is modelled only as an error of the match. Errors of altitude, attitude and IMU have the standard deviations of
the simulated instruments (`benchmarks.simulated_instruments`).

The threshold is the smallest multiple of `step_m_s` that accepts the fraction `accepted_fraction` of descents with one
correct track in each pair, the minimum for DIMES. `benchmarks.dimes_threshold` stores the result.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from marsyard.algorithms.dimes.ground_view import ground_from_pixels
from marsyard.algorithms.dimes.options import DimesOptions
from marsyard.algorithms.dimes.overlap import best_candidates, search_geometry, template_candidates
from marsyard.algorithms.dimes.validity import rank_combinations
from marsyard.algorithms.dimes.views import BinnedView
from marsyard.sim.camera import Cahv, CameraModel
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import DetectorCalibration


@dataclass(frozen=True)
class ThresholdInputs:
    """Distributions of the Monte Carlo simulation; standard deviations are of normal distributions.

    - descents: number of descents with feasible overlap for two templates in each pair
    - seed: seed of the generator
    - altitudes_m, interval_s: altitudes of the three images and time between them (field test paper, section III.C:
      2000, 1700 and 1400 m)
    - max_speed_m_s: horizontal velocities are uniform over the disc of this radius (paper: 30 m/s)
    - max_cone_deg, max_nod_deg: maximum tilt by coning (paper: 30 deg) and by nodding (60 deg/s at a period of 1.2 s:
      11.5 deg); tilts are uniform up to the maximum in any direction, independent in each image; rotation about the
      vertical is uniform
    - common_altitude_sd, altitude_sd: relative error of an altitude: common to all images, and independent (noise of
      the radar, and relief)
    - common_attitude_sd_deg, attitude_sd_deg: attitude error per axis: common to all images (star reference and gyro
      drift through entry), and independent (error of the time tag at the body rate)
    - feature_height_sd_m: height of features relative to the level that the altimeter measures (relief)
    - match_sd_m_s: velocity error of a track per axis due to the match (0.03 px with the noise of the flight camera:
      0.05 m/s)
    - imu_sd_m_s: error per axis of the velocity change of the IMU (gravity and the common tilt)
    - accepted_fraction: fraction of descents with one correct track in each pair that must pass the check
    - step_m_s: step to which the threshold is rounded up
    """

    descents: int = 10_000
    seed: int = 2004
    altitudes_m: tuple[float, float, float] = (2000.0, 1719.0, 1438.0)
    interval_s: float = 3.75
    max_speed_m_s: float = 30.0
    max_cone_deg: float = 30.0
    max_nod_deg: float = 11.5
    common_altitude_sd: float = 0.0038
    altitude_sd: float = 0.0024
    common_attitude_sd_deg: float = 0.80
    attitude_sd_deg: float = 0.017
    feature_height_sd_m: float = 20.0
    match_sd_m_s: float = 0.1
    imu_sd_m_s: float = 0.25
    accepted_fraction: float = 0.995
    step_m_s: float = 0.1


#: Velocity errors of correct tracks in m/s, by pair and template, axes east and north.
TrackErrors = Float[np.ndarray, "descents 2 2 2"]

#: Image and calibration of `BinnedView`, which the geometric simulation does not use.
_EMPTY_IMAGE = np.zeros((256, 256), dtype=np.float32)
#: Sun below the horizon, so that no template is masked.
_NO_SUN = np.array([0.0, 0.0, -1.0])
_CALIBRATION = DetectorCalibration(_EMPTY_IMAGE, 1.0, 0.0, 0.0, 1, 0.0, 1)


def descent_camera() -> CameraModel:
    """Descent camera binned to 256 x 256, without distortion, which would change the errors by less than 1 %."""
    return Cahv.from_focal_length(
        focal_m=14.67e-3,
        pixel_pitch_m=48e-6,
        size=(256, 256),
        axis=np.array([0.0, 0.0, -1.0]),
        right=np.array([1.0, 0.0, 0.0]),
    )


def draw_correct_track_errors(inputs: ThresholdInputs, rng: np.random.Generator) -> TrackErrors:
    """Draw the velocity errors of two correct tracks per pair for `inputs.descents` descents with feasible overlap."""
    camera, options = descent_camera(), DimesOptions()
    tracks: list[Float[np.ndarray, "2 2 2"]] = []
    while len(tracks) < inputs.descents:
        errors = _draw_descent_errors(inputs, camera, options, rng)
        if errors is not None:
            tracks.append(errors)
    return np.stack(tracks)


def _draw_descent_errors(
    inputs: ThresholdInputs, camera: CameraModel, options: DimesOptions, rng: np.random.Generator
) -> Float[np.ndarray, "2 2 2"] | None:
    """Draw the velocity errors of one descent; None if a pair has no two templates that the next image shows."""
    true_views, measured_views = _draw_views(inputs, camera, rng)
    # the square root makes the density uniform over the disc
    velocity = inputs.max_speed_m_s * np.sqrt(rng.uniform()) * _draw_direction(rng)
    errors = np.empty((2, 2, 2))
    for pair in range(2):
        first, second = measured_views[pair], measured_views[pair + 1]
        candidates = template_candidates(first, second, search_geometry(first, second, options), options)
        scores = rng.uniform(size=len(candidates.pixels))
        indices = best_candidates(scores, candidates.pixels, candidates.preference, 2, options.exclusion_px)
        if len(indices) < 2:
            return None
        heights = inputs.feature_height_sd_m * rng.standard_normal(2)
        displacement_m = velocity * inputs.interval_s
        pixels = _project_features(
            true_views[pair], true_views[pair + 1], candidates.pixels[indices], heights, displacement_m
        )
        if np.any((pixels < 0.0) | (pixels > np.array(second.size) - 1.0)):
            return None
        ground, _ = ground_from_pixels(second, pixels, options.max_off_nadir_rad)
        errors[pair] = (candidates.ground[indices] - ground - displacement_m) / inputs.interval_s
    return np.asarray(errors + inputs.match_sd_m_s * rng.standard_normal((2, 2, 2)))


def _project_features(
    first: BinnedView,
    second: BinnedView,
    pixels: Float[np.ndarray, "n 2"],
    heights_m: Float[np.ndarray, " n"],
    displacement_m: Float[np.ndarray, "2"],
) -> Float[np.ndarray, "n 2"]:
    """Project features from pixels of the first true camera to pixels (u, v) of the second.

    `heights_m` are the heights of the features; `displacement_m` is the camera's horizontal motion (east, north).
    """
    origins, rays = first.camera.rays(pixels)
    features = origins + rays * ((heights_m - origins[:, 2]) / rays[:, 2])[:, None]
    features[:, :2] -= displacement_m
    return np.asarray(second.camera.project(features)[0])


def _draw_views(
    inputs: ThresholdInputs, camera: CameraModel, rng: np.random.Generator
) -> tuple[list[BinnedView], list[BinnedView]]:
    """Draw three true views and three measured views of a descent."""
    common_error = np.radians(inputs.common_attitude_sd_deg) * rng.standard_normal(3)
    common_scale = 1.0 + inputs.common_altitude_sd * rng.standard_normal()
    true_views, measured_views = [], []
    for number, altitude in enumerate(inputs.altitudes_m):
        attitude = _draw_attitude(inputs, rng)
        independent_error = np.radians(inputs.attitude_sd_deg) * rng.standard_normal(3)
        error = Rotation.from_rotvec(common_error + independent_error)
        height = altitude * (common_scale + inputs.altitude_sd * rng.standard_normal())
        time = number * inputs.interval_s
        true_views.append(_create_view(camera, attitude, altitude, time))
        measured_views.append(_create_view(camera, error * attitude, height, time))
    return true_views, measured_views


def _draw_attitude(inputs: ThresholdInputs, rng: np.random.Generator) -> Rotation:
    """Draw a true attitude: tilts by coning and nodding, and a random heading."""
    tilts = (
        np.radians(limit) * rng.uniform() * np.array([*_draw_direction(rng), 0.0])
        for limit in (inputs.max_cone_deg, inputs.max_nod_deg)
    )
    cone, nod = (Rotation.from_rotvec(tilt) for tilt in tilts)
    return cone * nod * Rotation.from_euler("z", rng.uniform(0.0, 360.0), degrees=True)


def _create_view(camera: CameraModel, attitude: Rotation, altitude_m: float, time_s: float) -> BinnedView:
    """Create a view without an image, from a camera in the body frame."""
    centre = np.array([0.0, 0.0, altitude_m])
    placed = camera.transform(rigid(attitude, centre))
    return BinnedView(_EMPTY_IMAGE, _EMPTY_IMAGE, placed, centre, _NO_SUN, time_s, _CALIBRATION, 1)


def _draw_direction(rng: np.random.Generator) -> Float[np.ndarray, "2"]:
    """Draw a horizontal unit vector."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


@dataclass(frozen=True)
class Discrepancies:
    """Discrepancies of correct combinations of tracks from the IMU, m/s.

    - one_track: one correct track in each pair, shape (descents,)
    - two_tracks: minimum of the four combinations of two correct tracks in each pair, shape (descents,)
    """

    one_track: Float[np.ndarray, " descents"]
    two_tracks: Float[np.ndarray, " descents"]


def discrepancies(errors: TrackErrors, imu_sd_m_s: float, rng: np.random.Generator) -> Discrepancies:
    """Compute the discrepancies in DIMES' check for correct tracks with these errors."""
    imu = imu_sd_m_s * rng.standard_normal((len(errors), 1, 1, 2))
    combinations = np.linalg.norm(errors[:, 1, None, :, :] - errors[:, 0, :, None, :] - imu, axis=-1)
    return Discrepancies(one_track=combinations[:, 0, 0], two_tracks=combinations.min(axis=(1, 2)))


def threshold_m_s(
    discrepancies_m_s: Float[np.ndarray, " descents"], accepted_fraction: float, step_m_s: float
) -> float:
    """Return the smallest multiple of the step that exceeds this fraction of the discrepancies."""
    # remove the rounding error of the product
    return round(step_m_s * float(np.ceil(np.quantile(discrepancies_m_s, accepted_fraction) / step_m_s)), 9)


@dataclass(frozen=True)
class WrongTrackOutcomes:
    """Outcomes of the IMU check for descents with one wrong track, as fractions of the descents.

    - correct: reported velocity within the requirement
    - rejected: no reported velocity
    - wrong: reported velocity outside the requirement
    """

    correct: float
    rejected: float
    wrong: float


def simulate_wrong_track(
    errors: Float[np.ndarray, "descents 2 templates 2"],
    track_error_range_m_s: tuple[float, float],
    threshold_m_s: float,
    imu_sd_m_s: float,
    rng: np.random.Generator,
    required_m_s: float = 5.0,
) -> WrongTrackOutcomes:
    """Simulate the check with one wrong track.

    Its error has a random direction and a size within `track_error_range_m_s`. The wrong track is drawn at random.
    With one template per pair in `errors`, it is the only track of its pair.
    """
    counts = np.zeros(3)
    for tracks in errors:
        pair, template = rng.integers(2), rng.integers(tracks.shape[1])
        changed_tracks = tracks.copy()
        changed_tracks[pair, template] += rng.uniform(*track_error_range_m_s) * _draw_direction(rng)
        imu_change = np.zeros((2, 3))
        imu_change[1, :2] = imu_sd_m_s * rng.standard_normal(2)
        first, second = (list(enumerate(pair_tracks)) for pair_tracks in changed_tracks)
        best = rank_combinations(first, second, imu_change)[0]
        if not best.discrepancy_m_s < threshold_m_s:
            counts[1] += 1
        else:
            counts[0 if np.hypot(*changed_tracks[1, best.second]) <= required_m_s else 2] += 1
    correct, rejected, wrong = counts / len(errors)
    return WrongTrackOutcomes(float(correct), float(rejected), float(wrong))
