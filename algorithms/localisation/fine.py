"""Fine stage: matching of small templates of the map around landmarks in one image.

A template is the map as the camera would see it from the estimated pose: the rays of a square of image pixels around
the predicted landmark are intersected with the map's elevation, and the map's appearance is averaged over each pixel.
Template and image have the working scale: the image is binned so that a pixel at the nadir is about one map pixel.
Normalised correlation finds the template's displacement in whole pixels, and least-squares registration refines it.
A common correction of position and attitude explains the displacements of correct matches; others are rejected.

If the uncertainty of the pose requires a large search window, an acquisition step first corrects the pose by fewer
landmarks, in an image that is binned further.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from marsyard.algorithms.arrays import Points2, Points3, Vector, Vector3
from marsyard.algorithms.image.peaks import biquadratic_offset, highest_peak
from marsyard.algorithms.image.registration import MARGIN_PX, RegistrationLimits, register_template
from marsyard.algorithms.localisation import map_sampling
from marsyard.algorithms.localisation.interface import MapProduct
from marsyard.algorithms.localisation.landmarks import Landmarks, visible_landmarks
from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.algorithms.localisation.pose_fit import PoseFit, fit_pose, pose_jacobian
from marsyard.algorithms.localisation.posed_image import PosedImage, binning_factor
from marsyard.sim.camera import CameraModel

#: Assumed standard deviation of a displacement per axis, working pixels, for the weight of the prior.
_NOISE_PX = 0.3
#: Minimum standard deviation of the position in this prior, metres: it must be positive.
_MIN_POSITION_SD_M = 1e-3
#: Residuals up to this multiple of the fine stage's limit are accepted in an acquisition step, whose linear model has
#: an error of some tenths of a pixel.
_ACQUISITION_TOLERANCE = 1.5


@dataclass(frozen=True)
class LandmarkMatches:
    """Landmarks of the map found in one image. Pixels are those of the delivered image.

    - points_m: positions in the world frame, as on the map
    - measured_px: measured positions in the image (u, v)
    - scores: normalised correlations
    - residuals_px: measured positions minus those predicted after the common correction of the pose
    - working_pixel: pixels of the delivered image per pixel of the working scale
    - attempted: number of landmarks that were searched
    - accepted: number of those with an accepted score and peak, before the geometric check
    - translation_m, rotation_rad: the common correction of position and attitude, world axes
    """

    points_m: Points3
    measured_px: Points2
    scores: Vector
    residuals_px: Points2
    working_pixel: int
    attempted: int
    accepted: int
    translation_m: Vector3
    rotation_rad: Vector3

    def __len__(self) -> int:
        return len(self.points_m)


@dataclass(frozen=True)
class _SearchResult:
    """Landmarks searched at one scale.

    - indices: in the map's landmarks
    - predicted_px, displacements_px: predicted position, and measured minus predicted position, pixels of this scale
    - accepted: whether the score is high enough and the peak inside the window
    - camera: camera of the binned image in the world frame
    - factor: pixels of the delivered image per pixel of this scale
    """

    indices: Int[np.ndarray, "n"]
    predicted_px: Points2
    displacements_px: Points2
    scores: Vector
    accepted: Bool[np.ndarray, "n"]
    camera: CameraModel
    factor: int


def match_landmarks(
    image: PosedImage, landmarks: Landmarks, map_product: MapProduct, position_sd_m: Vector3, options: LvsOptions
) -> LandmarkMatches:
    """Match the landmarks of a map in one image; without enough consistent landmarks, the result has no match.

    - position_sd_m: standard deviations of the estimated position (east, north, up), metres
    """
    ground_m = map_sampling.elevation_at(map_product, image.position_m[:2])
    height_m = max(float(image.world_camera.c[2]) - ground_m, 1.0)
    factor = binning_factor(image, height_m, map_product.pixel_m)
    # a prior with the state's attitude would remove the landmarks that show its error; the filter tests the attitude
    prior_sd = np.append(np.maximum(position_sd_m, _MIN_POSITION_SD_M), np.full(3, options.fit_attitude_sd_rad))
    sigma_px = np.hypot(
        float(np.max(position_sd_m)) / (height_m * image.camera.pixel_angle_rad),
        options.attitude_sd_rad / image.camera.pixel_angle_rad,
    )
    half_px = options.search_sigmas_fine * float(sigma_px) / factor
    corrected, extra_binning = image, _acquisition_factor(image, factor, half_px, options)
    if half_px > options.min_half_width_px:
        # templates rendered from a wrong position are distorted, which biases the match: correct the pose first, even
        # if no extra binning is needed
        half = min(int(np.ceil(half_px / extra_binning)) + 1, 2 * options.max_half_width_px)
        search = _search_landmarks(corrected, landmarks, map_product, factor * extra_binning, half, True, options)
        fit = _fit_correction(corrected, landmarks, search, prior_sd, _ACQUISITION_TOLERANCE, options)
        if fit is None:
            return _no_matches(factor, search)
        corrected = corrected.correct(fit.translation_m, fit.rotation_rad)
        half_px = 0.0
    half = int(np.clip(np.ceil(half_px), options.min_half_width_px, options.max_half_width_px))
    search = _search_landmarks(corrected, landmarks, map_product, factor, half, False, options)
    fit = _fit_correction(corrected, landmarks, search, prior_sd, 1.0, options)
    return _no_matches(factor, search) if fit is None else _build_matches(image, corrected, landmarks, search, fit)


def _acquisition_factor(image: PosedImage, factor: int, half_px: float, options: LvsOptions) -> int:
    """Additional binning that reduces the search half width to the maximum, as far as the image's size permits."""
    extra_binning = 1
    columns, rows = image.camera.size
    while half_px / extra_binning > options.max_half_width_px:
        total = 2 * extra_binning * factor
        if columns % total or rows % total or min(columns, rows) // total < options.min_working_px:
            break
        extra_binning *= 2
    return extra_binning


def _search_landmarks(
    image: PosedImage,
    landmarks: Landmarks,
    map_product: MapProduct,
    factor: int,
    half: int,
    acquisition: bool,
    options: LvsOptions,
) -> _SearchResult:
    """Search landmarks in windows of half width `half` around their predictions, in an image binned by `factor`.

    An acquisition searches fewer landmarks and omits the least-squares registration.
    """
    working = image.bin(factor)
    camera = working.world_camera
    ground_m = map_sampling.elevation_at(map_product, image.position_m[:2])
    margin_px = options.template_px // 2 + half + 1
    count = options.acquisition_landmarks if acquisition else options.max_landmarks
    indices, predicted = visible_landmarks(
        landmarks, working, camera, ground_m, margin_px, count, options.max_off_nadir_rad
    )
    corners = np.rint(predicted).astype(np.int64) - options.template_px // 2
    points = landmarks.points_m[indices]
    templates, inside = render_templates(camera, corners, points[:, 2], map_product, options.template_px)
    displacements = np.zeros((len(indices), 2))
    scores = np.full(len(indices), -1.0)
    for k in np.flatnonzero(inside):
        match = _match_template(templates[k], working.radiance, corners[k], half, acquisition, options)
        if match is not None:
            displacements[k], scores[k] = match
    return _SearchResult(indices, predicted, displacements, scores, scores >= options.min_score, camera, factor)


def render_templates(
    camera: CameraModel, corners: Int[np.ndarray, "n 2"], elevations_m: Vector, map_product: MapProduct, side: int
) -> tuple[Float32[np.ndarray, "n side side"], Bool[np.ndarray, "n"]]:
    """Render squares of image pixels from the map; also return whether all their ground lies inside the map.

    - camera: camera model in the world frame
    - corners: pixels (column, row) of the squares' upper left pixels
    - elevations_m: elevation of the ground in each square, where the intersection with the rays starts
    """
    if not len(corners):
        return np.zeros((0, side, side), dtype=np.float32), np.zeros(0, dtype=np.bool_)
    steps = np.arange(side, dtype=np.float64)
    pixels = corners[:, np.newaxis, np.newaxis, :] + np.stack(np.meshgrid(steps, steps), axis=-1)
    origins, directions = camera.rays(pixels.reshape(len(corners), side * side, 2))
    ground = map_sampling.intersect_elevation(map_product, origins, directions, elevations_m[:, np.newaxis])
    inside = np.asarray(np.all(map_sampling.inside_map(map_product, ground), axis=1))
    positions = map_sampling.map_pixels(map_product, ground).reshape(len(corners), side, side, 2)
    appearance = map_product.appearance
    cells = np.abs(np.diff(positions, axis=2)).max(axis=-1)
    # large cells: the map is averaged over a box, of odd side; the four samples average over the rest of the cell
    size = 2 * int(float(np.median(cells)) / 4.0) + 1
    appearance = cv2.blur(appearance, (size, size)) if size > 1 else appearance
    return map_sampling.sample_averages(appearance, positions), inside


def _match_template(
    template: Float32[np.ndarray, "side side"],
    radiance: Float32[np.ndarray, "rows columns"],
    corner: Int[np.ndarray, "2"],
    half: int,
    acquisition: bool,
    options: LvsOptions,
) -> tuple[Float[np.ndarray, "2"], float] | None:
    """Displacement (u, v) of a template from `corner`, and its correlation; None if it is not found in the window."""
    side = len(template)
    low_column, low_row = int(corner[0]) - half, int(corner[1]) - half
    window = radiance[low_row : low_row + side + 2 * half, low_column : low_column + side + 2 * half]
    # differences from the means keep the precision of float32 sums
    centred = template - template.mean()
    surface = cv2.matchTemplate(window - window.mean(), centred, cv2.TM_CCOEFF_NORMED).astype(np.float64)
    peak = highest_peak(surface)
    if peak.on_border or not peak.value >= options.min_score:
        return None
    if acquisition:
        row, column = np.array([peak.row, peak.column]) + biquadratic_offset(surface, peak)
        return np.array([column - half, row - half]), peak.value
    start_row, start_column = max(low_row + peak.row - MARGIN_PX, 0), max(low_column + peak.column - MARGIN_PX, 0)
    start = np.array([start_row, start_column], dtype=np.float64)
    region = radiance[
        start_row : low_row + peak.row + side + MARGIN_PX, start_column : low_column + peak.column + side + MARGIN_PX
    ]
    position = np.array([low_row + peak.row, low_column + peak.column]) - start
    registration = register_template(
        np.ascontiguousarray(centred, dtype=np.float64), region, position, "shift", RegistrationLimits()
    )
    if registration is None:
        return None
    row, column = registration.corner + start
    return np.array([column - corner[0], row - corner[1]]), float(registration.score)


def _fit_correction(
    image: PosedImage,
    landmarks: Landmarks,
    search: _SearchResult,
    prior_sd: Float[np.ndarray, "6"],
    tolerance: float,
    options: LvsOptions,
) -> PoseFit | None:
    """Fit the common correction to the accepted matches; None if too few are consistent.

    `prior_sd` are standard deviations of position (m) and attitude (rad); the residual limit is multiplied by
    `tolerance`.
    """
    accepted = search.accepted
    count = int(np.count_nonzero(accepted))
    if count < options.min_matches:
        return None
    jacobian = pose_jacobian(search.camera, image.position_m, landmarks.points_m[search.indices[accepted]])
    fit = fit_pose(
        jacobian, search.displacements_px[accepted], prior_sd, _NOISE_PX, tolerance * options.max_residual_px
    )
    consistent = int(np.count_nonzero(fit.consistent))
    enough = consistent >= max(options.min_matches, options.min_inlier_fraction * count)
    return fit if enough else None


def _build_matches(
    image: PosedImage, corrected: PosedImage, landmarks: Landmarks, search: _SearchResult, fit: PoseFit
) -> LandmarkMatches:
    """Convert the consistent matches to pixels of the delivered image; the correction is relative to `image`."""
    rows = np.flatnonzero(search.accepted)[fit.consistent]
    points = landmarks.points_m[search.indices[rows]]
    factor = search.factor
    working_px = search.predicted_px[rows] + search.displacements_px[rows]
    rotation = (corrected.world_from_body * image.world_from_body.inv()).as_rotvec()
    return LandmarkMatches(
        points_m=points,
        measured_px=factor * (working_px + 0.5) - 0.5,
        scores=search.scores[rows],
        residuals_px=factor * fit.residuals_px[fit.consistent],
        working_pixel=factor,
        attempted=len(search.indices),
        accepted=int(np.count_nonzero(search.accepted)),
        translation_m=corrected.position_m - image.position_m + fit.translation_m,
        rotation_rad=rotation + fit.rotation_rad,
    )


def _no_matches(factor: int, search: _SearchResult) -> LandmarkMatches:
    """Return the result of a search whose matches are too few or inconsistent."""
    points, pixels = np.empty((0, 3)), np.empty((0, 2))
    accepted = int(np.count_nonzero(search.accepted))
    attempted = len(search.indices)
    return LandmarkMatches(points, pixels, np.empty(0), pixels, factor, attempted, accepted, np.zeros(3), np.zeros(3))
