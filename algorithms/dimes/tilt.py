"""Correction of the tilt that is common to the attitudes of all images, by the inclination of the ground in the images.

In the frame of the measured attitudes, a common attitude error tilts the ground. Tracks show this: if the camera moves
by (t, t_z), the image of a point at (x, y) (position divided by the height) moves by about
``-(1 + a x + b y) (t + t_z (x, y)) / height`` on ground with the gradient (a, b). The quadratic terms distinguish an
inclination from a velocity. The ground of a landing site is level except for its slope. Its inclination is therefore a
measurement of the tilt.

A maximum a posteriori fit to many tracks of both pairs (first and second image, second and third image) estimates the
inclination, the displacements, and errors of altitudes and of single attitudes. The part of the inclination that the
priors assign to the attitudes corrects the velocity: a tilt makes part of the vertical velocity appear as horizontal
velocity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import optimize, special

from marsyard.algorithms.arrays import Flags, Points2, Vector, Vector2, Vector3
from marsyard.algorithms.dimes import ground_view, overlap, rectification
from marsyard.algorithms.dimes.options import DimesOptions
from marsyard.algorithms.dimes.views import BinnedView
from marsyard.algorithms.image.registration import WindowSpline, register_template, spline_coefficients

#: Distance of templates from the border of both images, pixels: range of the registration and support of its spline.
MARGIN_PX = 4
#: Unknowns of the fit, and numbers of unknowns in its parts, which `Unknowns` names.
State = Float[np.ndarray, "18"]
_PART_SIZES = (2, 4, 3, 9)
#: Minimum number of tracks in each pair. With fewer tracks outliers cannot be recognised.
MIN_TRACKS = 8
#: Residuals of more than this number of standard deviations are outliers.
OUTLIER_SIGMAS = 3.5
#: Number of fits: outliers displace the first one, and enlarge the standard deviation of the second one.
FITS = 3
#: Probability of the chi-square tests: one correct answer in a thousand is not corrected, or refused.
ACCEPTED_PROBABILITY = 0.999


@dataclass(frozen=True)
class GroundTracks:
    """Tracks of a grid of templates in one pair of views.

    - first, second: Matched ground points (east, north) relative to the nadir point of each view, metres, on level
      ground at the measured altitude
    - heights_m: Measured heights of the cameras
    - gsd_m: Ground sample distance of the matched images
    - interval_s: Time between the images
    """

    first: Points2
    second: Points2
    heights_m: tuple[float, float]
    gsd_m: float
    interval_s: float


def track_grid(first: BinnedView, second: BinnedView, velocity_m_s: Vector2, options: DimesOptions) -> GroundTracks:
    """Track a grid of templates on the common ground, from the positions that a velocity (east, north) predicts.

    Both views are rectified with the full camera model, the second one shifted by the predicted displacement. Templates
    lie in both images and outside of the zero-phase spot, like those of the published algorithm.
    """
    gsd, side = overlap.search_geometry(first, second, options).gsd_m, options.grid_template_px
    shift = velocity_m_s * (second.time_s - first.time_s)
    shifts = ((first, np.zeros(2)), (second, shift))
    outlines = [
        ground_view.ground_from_pixels(view, overlap.border_pixels(view.size), options.max_off_nadir_rad)[0] + offset
        for view, offset in shifts
    ]
    low = np.max([outline.min(axis=0) for outline in outlines], axis=0)
    high = np.min([outline.max(axis=0) for outline in outlines], axis=0)
    per_side = max(int((high - low).max() / gsd) // side, 1)
    size, centre = per_side * side, 0.5 * (low + high)
    templates, window = (rectification.rectify_patch(view, centre - offset, size, gsd) for view, offset in shifts)
    spline = WindowSpline((0, 0), (size, size), spline_coefficients(window))
    corners = side * np.stack(np.divmod(np.arange(per_side**2), per_side), axis=-1)
    rows, columns = ((corners + 0.5 * (side - size)) * gsd).T
    ground = centre + np.column_stack([columns, -rows])
    usable = np.all([_is_usable(view, ground - offset, gsd, options) for view, offset in shifts], axis=0)
    points, shifts_px = [], []
    for (row, column), point in zip(corners[usable], ground[usable], strict=True):
        template = templates[row : row + side, column : column + side]
        match = register_template(template, spline, np.array([row, column], dtype=np.float64), "shift")
        if match is not None and match.score >= options.min_peak:
            points.append(point)
            shifts_px.append([match.corner[1] - column, row - match.corner[0]])
    matched = np.array(points).reshape(-1, 2)
    return GroundTracks(
        first=matched,
        second=matched - shift + gsd * np.array(shifts_px).reshape(-1, 2),
        heights_m=(float(first.centre[2]), float(second.centre[2])),
        gsd_m=gsd,
        interval_s=second.time_s - first.time_s,
    )


def _is_usable(view: BinnedView, ground: Points2, gsd_m: float, options: DimesOptions) -> Flags:
    """Whether templates around ground points lie in a view and outside of its zero-phase spot."""
    half_m = (0.5 * options.grid_template_px + MARGIN_PX) * gsd_m
    squares = ground[:, None] + ground_view.square_outline(half_m, overlap.OUTLINE_POINTS)
    inside = ground_view.inside_frame(view, squares, options.border_px, options.max_off_nadir_rad)
    outside = ground_view.outside_zero_phase(view, squares, options.zero_phase_radius_rad)
    return np.asarray((inside & outside).all(axis=1))


@dataclass(frozen=True)
class GroundFit:
    """Ground and motion in the frame of the measured attitudes, fitted to the tracks of both pairs.

    - inclination: Horizontal components of the upward normal of the ground (east, north), its vertical component is 1:
      the negative gradient of the ground
    - displacements_m: Displacement of the camera in each pair (east, north, up)
    - corrections: Corrections of the measurements divided by their prior standard deviations: three relative altitudes,
      and three rotations (x, y, z) of each image
    - tracks: Number of tracks of each pair without outliers
    """

    inclination: Vector2
    displacements_m: Float[np.ndarray, "2 3"]
    corrections: Float[np.ndarray, "12"]
    tracks: tuple[int, int]

    @property
    def agrees_with_instruments(self) -> bool:
        """Whether the corrections are within the errors of the instruments (chi-square test)."""
        return _is_accepted(self.corrections)


class Unknowns(NamedTuple):
    """Parts of a state: inclination, horizontal displacement of each pair, corrections of each image's measurements.

    Altitudes have relative corrections, attitudes rotation vectors (x, y, z).
    """

    inclination: Vector2
    displacements_m: Float[np.ndarray, "2 2"]
    altitudes: Vector3
    attitudes_rad: Float[np.ndarray, "3 3"]

    @classmethod
    def unpack(cls, state: State) -> Unknowns:
        """Return views of the parts of a state."""
        inclination, displacements, altitudes, attitudes = np.split(state, np.cumsum(_PART_SIZES[:-1]))
        return cls(inclination, displacements.reshape(2, 2), altitudes, attitudes.reshape(3, 3))


def predict_matches(state: State, pair: int, tracks: GroundTracks) -> tuple[Points2, Vector3]:
    """Predict the second ground points of the tracks of a pair (0 or 1), and the displacement of the camera."""
    unknowns, heights, images = Unknowns.unpack(state), np.array(tracks.heights_m), slice(pair, pair + 2)
    distances = heights * (1.0 + unknowns.altitudes[images])  # from the plane, along its normal
    rotations, horizontal = unknowns.attitudes_rad[images], unknowns.displacements_m[pair]
    normal = np.array([*unknowns.inclination, 1.0]) / np.sqrt(1.0 + unknowns.inclination @ unknowns.inclination)
    up = (distances[1] - distances[0] - normal[:2] @ horizontal) / normal[2]
    displacement = np.array([*horizontal, up])
    rays = _rotate(np.column_stack([tracks.first, np.full(len(tracks.first), -heights[0])]), rotations[0])
    points = rays * (-distances[0] / (rays @ normal))[:, np.newaxis] - displacement
    seen = _rotate(points, -rotations[1])
    return -heights[1] * seen[:, :2] / seen[:, 2:], displacement


def _rotate(vectors: Float[np.ndarray, "n 3"], rotation: Vector3) -> Float[np.ndarray, "n 3"]:
    """Rotate vectors by a small rotation vector, to first order."""
    x, y, z = rotation
    return np.asarray(vectors @ np.array([[1.0, z, -y], [-z, 1.0, x], [y, -x, 1.0]]))


def fit_ground(pairs: Sequence[GroundTracks], velocities_m_s: Sequence[Vector2], options: DimesOptions) -> GroundFit:
    """Fit ground and motion to the tracks of both pairs, from initial velocities (east, north).

    The standard deviation of the tracks is `DimesOptions.track_sd_px`, or that of the residuals (from their median) if
    it is larger. The fit is repeated without outliers. Each pair must have at least one track.
    """
    inclination_sd = np.hypot(options.tilt_sd_rad, options.slope_sd_rad)
    # the displacements have no prior
    scale = np.repeat([inclination_sd, 1.0, options.altitude_sd, options.attitude_sd_rad], _PART_SIZES)

    def track_residuals(state: State) -> list[Float[np.ndarray, "_ 2"]]:
        return [(pair.second - predict_matches(state, k, pair)[0]) / pair.gsd_m for k, pair in enumerate(pairs)]

    def fit(start: State, inliers: Sequence[Bool[np.ndarray, "_"]], sd_px: float) -> State:
        def residuals(state: State) -> Vector:
            tracks = [r[kept].ravel() / sd_px for r, kept in zip(track_residuals(state), inliers, strict=True)]
            prior = Unknowns.unpack(state / scale)
            return np.concatenate([*tracks, prior.inclination, prior.altitudes, prior.attitudes_rad.ravel()])

        return np.asarray(optimize.least_squares(residuals, start, x_scale=scale, method="lm").x)

    # start with level ground, the initial velocities, and no corrections
    no_inclination, _, *no_corrections = (np.zeros(size) for size in _PART_SIZES)
    displacements_m = [velocity * pair.interval_s for velocity, pair in zip(velocities_m_s, pairs, strict=True)]
    state = np.concatenate([no_inclination, *displacements_m, *no_corrections])
    inliers, sd_px = [np.ones(len(pair.first), dtype=bool) for pair in pairs], options.track_sd_px
    for _ in range(FITS):
        state = fit(state, inliers, sd_px)
        residuals = track_residuals(state)
        # median of absolute values of a normal distribution: 0.674 standard deviations
        sd_px = max(float(np.median(np.abs(np.concatenate(residuals)))) / 0.674, options.track_sd_px)
        inliers = [np.hypot(*r.T) < OUTLIER_SIGMAS * sd_px for r in residuals]
    displacements = np.stack([predict_matches(state, k, pair)[1] for k, pair in enumerate(pairs)])
    counts = (int(inliers[0].sum()), int(inliers[1].sum()))
    fitted = Unknowns.unpack(state / scale)
    corrections = np.concatenate([fitted.altitudes, fitted.attitudes_rad.ravel()])
    return GroundFit(Unknowns.unpack(state).inclination, displacements, corrections, counts)


def is_plausible(inclination: Vector2, options: DimesOptions) -> bool:
    """Whether the priors of tilt and slope explain an inclination (chi-square test)."""
    return _is_accepted(inclination / np.hypot(options.tilt_sd_rad, options.slope_sd_rad))


def _is_accepted(normalised: Vector) -> bool:
    """Chi-square test of values divided by their standard deviations (without `scipy.stats`: its import is slow)."""
    limit = 2.0 * special.gammaincinv(0.5 * len(normalised), ACCEPTED_PROBABILITY)
    return bool(normalised @ normalised <= limit)


def expected_attitude_error(inclination: Vector2, options: DimesOptions) -> Vector3:
    """Expected rotation vector (world axes) from true to measured attitudes, for an inclination of the ground.

    It is the fraction of the inclination that the prior variance of the tilt has in the variance of the inclination.
    The error about the vertical is unknown and expected to be 0.
    """
    tilt_variance, slope_variance = options.tilt_sd_rad**2, options.slope_sd_rad**2
    east, north = tilt_variance / (tilt_variance + slope_variance) * inclination
    return np.array([-north, east, 0.0])


def levelled_velocity(fit: GroundFit, interval_s: float, attitude_error_rad: Vector3) -> Vector2:
    """Horizontal velocity (east, north) of the second pair, corrected for an attitude error to first order, m/s."""
    displacement = fit.displacements_m[1]
    return np.asarray((displacement - np.cross(attitude_error_rad, displacement))[:2] / interval_s)
