"""Second implementation of the simulation that derives the threshold of DIMES' IMU check, by first-order errors.

The IMU check compares the change of velocity between the two image pairs, measured by tracks, with the change that the
inertial unit (IMU) measures. The length of the difference of the two changes is the discrepancy, m/s. DIMES accepts a
velocity if the discrepancy is below a threshold (`DimesOptions.imu_threshold_m_s`).

`benchmarks.threshold_derivation` derives this threshold by a Monte Carlo simulation: it draws descents with random
errors of instruments and matches, and computes the discrepancy of correct tracks. The threshold must accept 99.5 % of
the descents. That simulation uses DIMES' own ground intersection, template grid, combination of tracks and camera
models. This module repeats it without these parts, so that an error in one of them is detected. Templates are at random
positions with feasible overlap, cameras are slopes of rays, and each error changes the velocity by its partial
derivative. Both implementations use the distributions of `ThresholdInputs`.

Let s be the slope of a ray (horizontal over downward), H the height and T the time between images. A feature is located
at H s. Relative errors a of both heights, rotations e of both attitudes and a height h of the feature change the
velocity of a track from view 1 to view 2 by

    (H1 a1 s1 - H2 a2 s2 + H1 d(e1, s1) - H2 d(e2, s2) + h (s1 - s2)) / T,

where d(e, s) is the change of a slope s by the rotation e of its ray.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from benchmarks.threshold_derivation import ThresholdInputs

#: Descent camera binned to 256 x 256: focal length over pixel pitch, and pixels from centre to edge.
FOCAL_PX, HALF_PX = 14.67e-3 / 48e-6, 127.5
#: Template side, minimum distance of two templates and margin of the search window, in pixels, as in the field test
#: paper and `DimesOptions`.
TEMPLATE_PX, MIN_DISTANCE_PX, MARGIN_PX = 31, 31.0, 4
#: Maximum off-nadir angle of ground that is used (`DimesOptions.max_off_nadir_rad`), degrees.
MAX_OFF_NADIR_DEG = 55.0
#: Number of random template positions per pair; with fewer than two usable ones, the pair has no feasible overlap. The
#: minimum width of the overlap is not checked: templates hardly fit into a smaller one.
CANDIDATES = 200
#: Maximum error of a correct velocity, m/s (requirement DIMES-VEL).
REQUIRED_M_S = 5.0


@dataclass(frozen=True)
class VelocityErrors:
    """Velocity errors of simulated descents, m/s, axes east and north; the true values cancel in a discrepancy.

    - tracks_m_s: errors of the velocities of correct tracks by descent, pair and template, shape (n, 2, 2, 2)
    - imu_m_s: error of the change of velocity that the IMU measures, shape (n, 2)
    """

    tracks_m_s: Float[np.ndarray, "n 2 2 2"]
    imu_m_s: Float[np.ndarray, "n 2"]

    @classmethod
    def draw(cls, inputs: ThresholdInputs, descents: int, rng: np.random.Generator) -> VelocityErrors:
        """Draw the errors of descents with feasible overlap for two templates in each pair."""
        tracks = np.empty((descents, 2, 2, 2))
        for number in range(descents):
            while (errors := _draw_descent_errors(inputs, rng)) is None:
                pass
            tracks[number] = errors
        return cls(tracks, inputs.imu_sd_m_s * rng.standard_normal((descents, 2)))

    def one_track_discrepancies_m_s(self) -> Float[np.ndarray, " n"]:
        """Compute the discrepancy of each descent for one correct track in each pair."""
        return np.asarray(np.linalg.norm(self.tracks_m_s[:, 1, 0] - self.tracks_m_s[:, 0, 0] - self.imu_m_s, axis=-1))

    def two_track_discrepancies_m_s(self) -> Float[np.ndarray, " n"]:
        """Compute the minimum discrepancy of each descent for two correct tracks in each pair (four combinations)."""
        return np.asarray(_discrepancies(self.tracks_m_s, self.imu_m_s).min(axis=(1, 2)))

    def correct_and_rejected_fractions(
        self, templates: int, track_error_range_m_s: tuple[float, float], threshold_m_s: float, rng: np.random.Generator
    ) -> tuple[float, float]:
        """Add an error to one track of each descent; return the fractions of correct and of rejected velocities.

        The error has a random direction and a length in `track_error_range_m_s`. The velocity is that of the second
        pair in the combination with the minimum discrepancy. It is rejected if this discrepancy reaches
        `threshold_m_s`, and correct if it is accepted with an error of at most `REQUIRED_M_S`.
        """
        tracks = self.tracks_m_s[:, :, :templates].copy()
        n = len(tracks)
        angle, size = rng.uniform(0.0, 2.0 * np.pi, n), rng.uniform(*track_error_range_m_s, n)
        wrong_errors = np.column_stack([size * np.cos(angle), size * np.sin(angle)])
        tracks[np.arange(n), rng.integers(2, size=n), rng.integers(templates, size=n)] += wrong_errors
        discrepancies = _discrepancies(tracks, self.imu_m_s).reshape(n, -1)
        second = tracks[np.arange(n), 1, discrepancies.argmin(axis=1) % templates]
        is_accepted = discrepancies.min(axis=1) < threshold_m_s
        is_correct = is_accepted & (np.linalg.norm(second, axis=1) <= REQUIRED_M_S)
        return float(is_correct.mean()), float(np.mean(~is_accepted))


def _discrepancies(
    tracks: Float[np.ndarray, "n 2 templates 2"], imu: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n templates templates"]:
    """Compute the discrepancies, m/s, of all combinations of a track of the first (rows) and second pair (columns)."""
    change = tracks[:, 1, None, :] - tracks[:, 0, :, None] - imu[:, None, None]
    return np.asarray(np.linalg.norm(change, axis=-1))


def _draw_descent_errors(inputs: ThresholdInputs, rng: np.random.Generator) -> Float[np.ndarray, "2 2 2"] | None:
    """Draw velocity errors by pair and template; None if a pair has no two templates that the next image shows."""
    heights, interval = np.array(inputs.altitudes_m), inputs.interval_s
    attitudes = [_draw_attitude(inputs, rng) for _ in heights]
    speed, course = inputs.max_speed_m_s * np.sqrt(rng.uniform()), rng.uniform(0.0, 2.0 * np.pi)
    displacement = interval * speed * np.array([np.cos(course), np.sin(course)])
    height_errors = inputs.common_altitude_sd * rng.standard_normal() + inputs.altitude_sd * rng.standard_normal(3)
    rotations = _draw_attitude_errors(inputs, rng)
    errors = np.empty((2, 2, 2))
    for pair in range(2):
        slopes = _draw_templates(attitudes[pair : pair + 2], heights[pair : pair + 2], inputs, rng)
        if slopes is None:
            return None
        (h1, h2), (a1, a2), (e1, e2) = (values[pair : pair + 2] for values in (heights, height_errors, rotations))
        second_slopes = (h1 * slopes - displacement) / h2
        if not _is_inside(attitudes[pair + 1], second_slopes, 0.0).all():
            return None
        relief = inputs.feature_height_sd_m * rng.standard_normal((2, 1))
        position_errors = h1 * (a1 * slopes + _rotate_slopes(e1, slopes)) - h2 * (
            a2 * second_slopes + _rotate_slopes(e2, second_slopes)
        )
        errors[pair] = (position_errors + relief * (slopes - second_slopes)) / interval
    return np.asarray(errors + inputs.match_sd_m_s * rng.standard_normal((2, 2, 2)))


def _draw_attitude(inputs: ThresholdInputs, rng: np.random.Generator) -> Rotation:
    """Draw an attitude with coning, nodding and random heading according to `ThresholdInputs`."""
    heading = Rotation.from_rotvec([0.0, 0.0, rng.uniform(0.0, 2.0 * np.pi)])
    tilts = []
    for limit_deg in (inputs.max_cone_deg, inputs.max_nod_deg):
        azimuth = rng.uniform(0.0, 2.0 * np.pi)
        axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        tilts.append(Rotation.from_rotvec(np.radians(limit_deg) * rng.uniform() * axis))
    return tilts[0] * tilts[1] * heading


def _draw_attitude_errors(inputs: ThresholdInputs, rng: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    """Draw the rotation of each measured attitude relative to the true attitude, radians, world axes."""
    common_error = np.radians(inputs.common_attitude_sd_deg) * rng.standard_normal(3)
    independent_errors = np.radians(inputs.attitude_sd_deg) * rng.standard_normal((3, 3))
    return np.asarray(common_error + independent_errors)


def _rotate_slopes(error: Float[np.ndarray, "3"], slopes: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Compute the first-order change of slopes if their rays are rotated by a small vector."""
    rays = np.column_stack([slopes, -np.ones(len(slopes))])
    change = np.cross(error, rays)
    return np.asarray(change[:, :2] + slopes * change[:, 2:])


def _draw_templates(
    attitudes: list[Rotation], heights: Float[np.ndarray, "2"], inputs: ThresholdInputs, rng: np.random.Generator
) -> Float[np.ndarray, "2 2"] | None:
    """Draw the slopes of two templates in the first view and the overlap region; None if there are none."""
    pixels = rng.uniform(-HALF_PX, HALF_PX, (CANDIDATES, 2))
    rays = attitudes[0].apply(np.column_stack([pixels / FOCAL_PX, -np.ones(CANDIDATES)]))
    down = -rays[:, 2]
    is_usable = down > np.cos(np.radians(MAX_OFF_NADIR_DEG)) * np.linalg.norm(rays, axis=1)
    pixels, slopes = pixels[is_usable], rays[is_usable, :2] / down[is_usable, None]
    gsd_m = heights[1] / FOCAL_PX
    search_px = np.ceil(inputs.max_speed_m_s * inputs.interval_s / gsd_m) + MARGIN_PX
    half_sides_m = 0.5 * TEMPLATE_PX * gsd_m, (0.5 * TEMPLATE_PX + search_px) * gsd_m
    is_feasible = _is_inside(attitudes[0], slopes, half_sides_m[0] / heights[0])
    second_slopes = slopes * heights[0] / heights[1]
    is_feasible &= _is_inside(attitudes[1], second_slopes, 0.0)
    # templates whose complete search window is in the second image precede others that fit, and these precede the rest
    preference = np.sum([_is_inside(attitudes[1], second_slopes, half / heights[1]) for half in half_sides_m], axis=0)
    order = [k for k in np.argsort(-preference, kind="stable") if is_feasible[k]]
    pixels, slopes = pixels[order], slopes[order]
    if len(pixels) == 0:
        return None
    distant = np.flatnonzero(np.abs(pixels - pixels[0]).max(axis=1) >= MIN_DISTANCE_PX)
    return None if distant.size == 0 else np.asarray(slopes[[0, distant[0]]])


def _is_inside(attitude: Rotation, slopes: Float[np.ndarray, "n 2"], half: float) -> Bool[np.ndarray, " n"]:
    """Whether ground squares around slopes are inside the frame; `half` is half the side divided by the height."""
    inside = np.ones(len(slopes), dtype=bool)
    for corner in ((-half, -half), (-half, half), (half, -half), (half, half)):
        body = attitude.inv().apply(np.column_stack([slopes + np.array(corner), -np.ones(len(slopes))]))
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = FOCAL_PX * body[:, :2] / -body[:, 2:]
        inside &= (body[:, 2] < 0.0) & np.all(np.abs(pixels) <= HALF_PX, axis=1)
    return inside
