"""A velocity estimator in Python, to be named by its path: the mean shift of the second picture against the third.

    cd docs/examples
    marsyard run dimes-gusev --algorithm velocity_estimator:MedianShift --algorithm dimes

Templates around the middle of the second picture are looked for in the third, near where the inertial velocity puts
them; each match gives a velocity over a level plane. The median is reported, with a covariance from their scatter.
"""

from __future__ import annotations

import cv2
import numpy as np

from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome
from marsyard.sim.measurements import DescentMeasurements

HALF = (20, 5)  # of a template: columns, rows
REACH = (48, 14)  # of its search around the expected place
LEAST_CORRELATION = 0.6
LEAST_TRACKS = 3
LEAST_VARIANCE_M2_S2 = 0.01  # what attitude errors leave even where all templates agree


class MedianShift:
    """Implements `marsyard.algorithms.interface.VelocityEstimator`; made without arguments."""

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """The median velocity of the templates that were found."""
        velocities = _velocities(measurements)
        if len(velocities) < LEAST_TRACKS:
            return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None)
        scatter = 1.4826 * np.median(np.abs(velocities - np.median(velocities, axis=0)), axis=0)
        # the median of n has pi / 2 times the variance of their mean
        variance = 0.5 * np.pi * scatter**2 / len(velocities) + LEAST_VARIANCE_M2_S2
        return VelocityEstimate(
            VelocityOutcome.VALID, np.median(velocities, axis=0), covariance_m2_s2=np.diag(variance)
        )


def _velocities(measurements: DescentMeasurements) -> np.ndarray:
    second, third = (measurements.images[k].counts.astype(np.float32) for k in (1, 2))
    interval = measurements.images[2].time_s - measurements.images[1].time_s
    expected = -measurements.interval_velocities_m_s[1] * interval
    rows, columns = second.shape
    found = []
    for row in range(rows // 6, rows - HALF[1] - 1, rows // 6):
        for column in range(columns // 6, columns - HALF[0] - 1, columns // 6):
            place = np.array([column, row])
            on_ground = _ground(measurements, 1, place)
            guess = _pixel(measurements, 2, on_ground + expected)
            match = _match(second, third, place, guess)
            if match is not None:
                found.append((on_ground - _ground(measurements, 2, match))[:2] / interval)
    return np.array(found).reshape(-1, 2)


def _match(second: np.ndarray, third: np.ndarray, place: np.ndarray, guess: np.ndarray) -> np.ndarray | None:
    """The pixel of the best match in the third picture; None where there is none."""
    if not np.all(np.isfinite(guess)):
        return None
    template = second[place[1] - HALF[1] : place[1] + HALF[1] + 1, place[0] - HALF[0] : place[0] + HALF[0] + 1]
    corner = np.rint(guess).astype(int) - np.array(HALF) - np.array(REACH)
    corner = np.maximum(corner, 0)
    end = np.rint(guess).astype(int) + np.array(HALF) + np.array(REACH) + 1
    window = third[corner[1] : max(end[1], 0), corner[0] : max(end[0], 0)]
    if window.shape[0] < template.shape[0] or window.shape[1] < template.shape[1] or template.std() < 1.0:
        return None
    scores = cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED)
    _, best, _, at = cv2.minMaxLoc(scores)
    return np.array(at) + corner + np.array(HALF) if np.isfinite(best) and best >= LEAST_CORRELATION else None


def _ground(measurements: DescentMeasurements, number: int, pixel: np.ndarray) -> np.ndarray:
    """Where on the level ground a pixel looks, from the body, world axes, metres."""
    rotation = measurements.attitudes[number].world_from_body
    ray = rotation.apply(measurements.images[number].camera.rays(pixel.astype(np.float64))[1])
    return np.asarray(ray * (measurements.altitudes[number].altitude_m / -ray[2]))


def _pixel(measurements: DescentMeasurements, number: int, point: np.ndarray) -> np.ndarray:
    """Where a point of the ground is seen; NaN where it is not."""
    level = np.array([point[0], point[1], -measurements.altitudes[number].altitude_m])
    body = measurements.attitudes[number].world_from_body.inv().apply(level)
    pixel, ahead = measurements.images[number].camera.project(body)
    return np.asarray(pixel) if np.all(ahead) else np.full(2, np.nan)
