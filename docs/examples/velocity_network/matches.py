"""Matches of ground templates between the last two images of a descent, and the inputs of the network.

Both images are resampled to one grid on level ground, around the position that the inertial velocity predicts.
Each template of the earlier image is correlated with the later image. The maximum of the correlation is a match.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from marsyard.algorithms.image.frame_transfer import remove_frame_transfer
from marsyard.sim.measurements import DescentMeasurements, DetectorImage

GRID = 320  # cells along each side of the grid
CELL = 0.003  # size of a cell, as a fraction of the altitude: 4.2 m at 1400 m
HALF_TEMPLATE = 12  # half of the side of a template, cells
SEARCH = 72  # maximum distance from the predicted position, cells
SPACING = 24  # distance between templates, cells
HALF_SURFACE = 8  # half of the side of the correlation surface around its maximum, cells
SURFACE_SIZE = 2 * HALF_SURFACE + 1
MIN_VARIATION_DN = 1.0  # minimum standard deviation of the counts of an image
MIN_CONTRAST = 1e-3  # minimum standard deviation of a template, divided by the mean of the image


@dataclass(frozen=True)
class Matches:
    """Matches of one case.

    - surfaces: correlation around each maximum, shape (n, 17, 17), float32; -1 outside of the search window
    - features: maximum of the correlation, and its maximum outside of the surface, shape (n, 2), float32
    - velocities_m_s: velocity over level ground of each match, east and north, shape (n, 2)
    """

    surfaces: np.ndarray
    features: np.ndarray
    velocities_m_s: np.ndarray


def find_matches(measurements: DescentMeasurements) -> Matches:
    """Match all templates; without an altitude or an overlap there are no matches."""
    interval_s = measurements.images[-1].time_s - measurements.images[-2].time_s
    inertial_m_s = measurements.interval_velocities_m_s[-1]
    cell_m = CELL * measurements.altitudes[-1].altitude_m
    surfaces, features, velocities = [], [], []
    for template, window, is_visible in _cut_templates(measurements, cell_m, interval_s):
        correlation = np.where(is_visible, cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED), -1.0)
        row, column = np.unravel_index(np.argmax(correlation), correlation.shape)
        padded = np.pad(correlation, HALF_SURFACE, constant_values=-1.0)
        surface = padded[row : row + SURFACE_SIZE, column : column + SURFACE_SIZE].copy()
        padded[row : row + SURFACE_SIZE, column : column + SURFACE_SIZE] = -1.0
        shift = np.array([column, row]) + _refine_maximum(surface) - SEARCH
        surfaces.append(surface)
        features.append([correlation[row, column], padded.max()])
        # the ground moves opposite to the camera
        velocities.append(inertial_m_s[:2] - shift * cell_m / interval_s)
    return Matches(
        np.array(surfaces, np.float32).reshape(-1, SURFACE_SIZE, SURFACE_SIZE),
        np.array(features, np.float32).reshape(-1, 2),
        np.array(velocities).reshape(-1, 2),
    )


def network_inputs(matches: Matches) -> np.ndarray:
    """Return one row per match: the surface, then both maxima; shape (n, 291), float32."""
    return np.concatenate([matches.surfaces.reshape(-1, SURFACE_SIZE**2), matches.features], axis=1)


def _refine_maximum(surface: np.ndarray) -> np.ndarray:
    """Return the offset (column, row) of the maximum from the central cell, by parabolas through three values."""
    centre = HALF_SURFACE
    offsets = []
    for before, after in (
        (surface[centre, centre - 1], surface[centre, centre + 1]),
        (surface[centre - 1, centre], surface[centre + 1, centre]),
    ):
        curvature = before + after - 2.0 * surface[centre, centre]
        # at the border of the search window the offset is unknown
        is_inside = curvature < 0.0 and min(before, after) > -1.0
        offsets.append(0.5 * (before - after) / curvature if is_inside else 0.0)
    return np.clip(offsets, -0.5, 0.5)


def _cut_templates(measurements: DescentMeasurements, cell_m: float, interval_s: float):
    """Yield each template of the earlier image and its search window in the later image."""
    earlier, later = measurements.images[-2:]
    altitudes_m = [altitude.altitude_m for altitude in measurements.altitudes[-2:]]
    rotations = [attitude.world_from_body for attitude in measurements.attitudes[-2:]]
    centre = _ground_centre(measurements)
    # a constant image shows the pattern of the flat field only
    has_texture = min(earlier.counts.std(), later.counts.std()) >= MIN_VARIATION_DN
    if centre is None or not has_texture or not np.all(np.isfinite(altitudes_m)):
        return
    axis = (np.arange(GRID) - 0.5 * (GRID - 1)) * cell_m
    ground = np.stack(np.broadcast_arrays(centre[0] + axis[None, :], centre[1] + axis[:, None]), axis=-1)
    displaced = ground - measurements.interval_velocities_m_s[-1, :2] * interval_s
    first, first_is_visible = _resample(earlier, rotations[0], ground, altitudes_m[0])
    second, second_is_visible = _resample(later, rotations[1], displaced, altitudes_m[1])
    # positions at which a template is inside of the later image; the search continues outside of the grid
    square = np.ones((2 * HALF_TEMPLATE + 1,) * 2, np.uint8)
    is_candidate = np.pad(cv2.erode(second_is_visible.astype(np.uint8), square, borderValue=0) > 0, SEARCH)
    second = np.pad(second, SEARCH, mode="edge")
    for row in range(HALF_TEMPLATE, GRID - HALF_TEMPLATE, SPACING):
        for column in range(HALF_TEMPLATE, GRID - HALF_TEMPLATE, SPACING):
            square_of_template = _square(row, column, HALF_TEMPLATE)
            template = first[square_of_template]
            positions = is_candidate[_square(row + SEARCH, column + SEARCH, SEARCH)]
            if first_is_visible[square_of_template].all() and positions.any() and template.std() > MIN_CONTRAST:
                yield template, second[_square(row + SEARCH, column + SEARCH, SEARCH + HALF_TEMPLATE)], positions


def _square(row: int, column: int, half: int) -> tuple[slice, slice]:
    return slice(row - half, row + half + 1), slice(column - half, column + half + 1)


def _ground_centre(measurements: DescentMeasurements) -> np.ndarray | None:
    """Return the point of level ground at the centre of the earlier image, relative to the body; None at the sky."""
    camera = measurements.images[-2].camera
    ray = camera.rays(0.5 * (np.array(camera.size, dtype=np.float64) - 1.0))[1]
    ray = measurements.attitudes[-2].world_from_body.apply(ray)
    return ray[:2] * measurements.altitudes[-2].altitude_m / -ray[2] if ray[2] < 0.0 else None


def _resample(image: DetectorImage, world_from_body, ground: np.ndarray, altitude_m: float):
    """Return the brightness at ground points, divided by the mean of the image, and which points are visible.

    `ground` contains metres east and north of the body, shape (rows, columns, 2).
    """
    points = np.concatenate([ground, np.full((*ground.shape[:2], 1), -altitude_m)], axis=-1)
    body = world_from_body.inv().apply(points.reshape(-1, 3)).reshape(points.shape)
    pixels, is_in_front = image.camera.project(body)
    calibration = image.calibration
    signal = (image.counts - calibration.offset_dn) / calibration.flat_field
    signal = remove_frame_transfer(signal, calibration, calibration.rows_summed)
    brightness = (signal / max(signal.mean(), 1.0)).astype(np.float32)
    column, row = np.moveaxis(np.nan_to_num(pixels, nan=-1e4).astype(np.float32), -1, 0)
    is_visible = is_in_front & image.camera.in_frame(pixels)
    return cv2.remap(brightness, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), is_visible
