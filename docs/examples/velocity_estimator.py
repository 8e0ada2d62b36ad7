"""A velocity estimator as a Python class: the median shift of templates between the second and the third image.

    cd docs/examples
    marsyard run dimes-gusev --algorithm velocity_estimator:MedianShift --algorithm dimes

Templates of the second image are searched in the third image, around the position predicted by the inertial velocity.
Each match gives a velocity over level ground. The answer is the median velocity, with a covariance from the scatter.
"""

import cv2
import numpy as np

from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome
from marsyard.sim.measurements import DescentMeasurements

HALF_SIZE_PX = (20, 5)  # half of a template: columns, rows
SEARCH_PX = (48, 14)  # maximum distance from the predicted position: columns, rows
MIN_CORRELATION = 0.6
MIN_TRACKS = 3  # minimum number of matched templates
MIN_VARIANCE_M2_S2 = 0.01  # due to attitude errors, which are common to all templates


class MedianShift:
    """Estimator that follows `marsyard.algorithms.interface.VelocityEstimator`; created without arguments."""

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """Return the median velocity of the matched templates."""
        velocities = _measure_velocities(measurements)
        if len(velocities) < MIN_TRACKS:
            return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None)
        # for a normal distribution, the standard deviation is 1.4826 times the median absolute deviation
        scatter = 1.4826 * np.median(np.abs(velocities - np.median(velocities, axis=0)), axis=0)
        # the variance of the median of n values is pi / 2 times that of their mean
        variance = 0.5 * np.pi * scatter**2 / len(velocities) + MIN_VARIANCE_M2_S2
        return VelocityEstimate(
            VelocityOutcome.VALID, np.median(velocities, axis=0), covariance_m2_s2=np.diag(variance)
        )


def _measure_velocities(measurements: DescentMeasurements) -> np.ndarray:
    """Measure the velocity of each matched template, shape (n, 2), m/s east and north."""
    second, third = (measurements.images[number].counts.astype(np.float32) for number in (1, 2))
    interval_s = measurements.images[2].time_s - measurements.images[1].time_s
    # motion of the ground relative to the body between the images
    displacement = -measurements.interval_velocities_m_s[1] * interval_s
    rows, columns = second.shape
    # templates on a grid with a spacing of one sixth of the image
    velocities = []
    for row in range(rows // 6, rows - HALF_SIZE_PX[1] - 1, rows // 6):
        for column in range(columns // 6, columns - HALF_SIZE_PX[0] - 1, columns // 6):
            pixel = np.array([column, row])
            ground = _intersect_ground(measurements, 1, pixel)
            predicted_pixel = _project(measurements, 2, ground + displacement)
            matched_pixel = _match_template(second, third, pixel, predicted_pixel)
            if matched_pixel is not None:
                velocities.append((ground - _intersect_ground(measurements, 2, matched_pixel))[:2] / interval_s)
    return np.array(velocities).reshape(-1, 2)


def _match_template(
    second: np.ndarray, third: np.ndarray, pixel: np.ndarray, predicted_pixel: np.ndarray
) -> np.ndarray | None:
    """Return the pixel (column, row) of the best match in the third image; None without a match."""
    if not np.all(np.isfinite(predicted_pixel)):
        return None
    columns, rows = HALF_SIZE_PX
    template = second[pixel[1] - rows : pixel[1] + rows + 1, pixel[0] - columns : pixel[0] + columns + 1]
    corner = np.rint(predicted_pixel).astype(int) - np.array(HALF_SIZE_PX) - np.array(SEARCH_PX)
    corner = np.maximum(corner, 0)
    end = np.rint(predicted_pixel).astype(int) + np.array(HALF_SIZE_PX) + np.array(SEARCH_PX) + 1
    window = third[corner[1] : max(end[1], 0), corner[0] : max(end[0], 0)]
    if window.shape[0] < template.shape[0] or window.shape[1] < template.shape[1] or template.std() < 1.0:
        return None
    scores = cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED)
    _, score, _, location = cv2.minMaxLoc(scores)
    is_match = np.isfinite(score) and score >= MIN_CORRELATION
    return np.array(location) + corner + np.array(HALF_SIZE_PX) if is_match else None


def _intersect_ground(measurements: DescentMeasurements, number: int, pixel: np.ndarray) -> np.ndarray:
    """Return the intersection of a pixel's ray with level ground, relative to the body, world axes, metres."""
    rotation = measurements.attitudes[number].world_from_body
    ray = rotation.apply(measurements.images[number].camera.rays(pixel.astype(np.float64))[1])
    return np.asarray(ray * (measurements.altitudes[number].altitude_m / -ray[2]))


def _project(measurements: DescentMeasurements, number: int, point: np.ndarray) -> np.ndarray:
    """Return the pixel of a ground point relative to the body; NaN if the point is not visible."""
    ground_point = np.array([point[0], point[1], -measurements.altitudes[number].altitude_m])
    point_body = measurements.attitudes[number].world_from_body.inv().apply(ground_point)
    pixel, is_in_front = measurements.images[number].camera.project(point_body)
    return np.asarray(pixel) if np.all(is_in_front) else np.full(2, np.nan)
