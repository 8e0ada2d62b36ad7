"""Rectification and correction of patches of descent images for DIMES and its baselines.

The virtual camera looks straight down. Its pixels are squares of ground, `gsd_m` on a side, in the plane at the
measured altitude; rows run south and columns east. Both views of a pair are rectified to the same virtual camera,
assuming no horizontal motion. A patch is identified by the ground point at its centre, east and north of the camera's
nadir point. The paper (Johnson et al., "Field Testing of the MER DIMES", section II.A) uses a homography. This module
can also project each point with the full camera model. It interpolates between pixels by a cubic spline.

Dark current is not corrected, as in the paper. It is a ramp along the columns. Over the 31 rows of a template it is
0.05 counts at -34 deg C (flight) and 2.5 counts at 0 deg C (field test). Both are below a pixel's noise of 6 counts and
do not affect velocities, even over terrain of 2 % contrast. At +23 deg C the ramp is 36 counts: over terrain of 2 %
contrast few tracks are valid and no velocity is reported; over terrain of 15 % contrast errors double to 0.07 m/s.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from marsyard.algorithms.arrays import Vector2
from marsyard.algorithms.dimes.ground_view import pixels_from_ground
from marsyard.algorithms.dimes.views import BinnedView
from marsyard.algorithms.image.frame_transfer import remove_frame_transfer

#: Lower limit of the flat field before division.
MIN_RESPONSE = 0.02
#: Margin of the spline around a patch, pixels. The influence of a pixel decreases by 2 - sqrt(3) = 0.268 per pixel:
#: pixels outside the margin change the result by about 1e-6 of their value.
SPLINE_MARGIN = 10


def correct_patch(view: BinnedView, rows: slice, columns: slice) -> Float[np.ndarray, "_ _"]:
    """Correct part of a view for the frame-transfer smear and the flat field, counts, float64."""
    exposure_signal = remove_frame_transfer(view.signal[:, columns], view.calibration, view.rows_summed)
    return np.asarray(exposure_signal[rows] / np.maximum(view.flat_field[rows, columns], MIN_RESPONSE))


def ground_lattice(centre: Vector2, side_px: int, gsd_m: float) -> Float[np.ndarray, "side side 2"]:
    """Ground points (east, north) of the pixels of a square patch around `centre`, metres."""
    steps = (np.arange(side_px) - 0.5 * (side_px - 1)) * gsd_m
    lattice = np.empty((side_px, side_px, 2))
    lattice[..., 0] = centre[0] + steps
    lattice[..., 1] = (centre[1] - steps)[:, np.newaxis]
    return lattice


def _pixel_range(smallest: float, largest: float, size: int) -> slice:
    """Slice of whole pixels from `smallest` to `largest` with the spline's margin, clipped to 0 .. size."""
    low, high = max(int(smallest - SPLINE_MARGIN), 0), min(int(largest + SPLINE_MARGIN + 1), size)
    return slice(min(low, size - 1), max(high, 1))


def homography_lattice(
    view: BinnedView, lattice: Float[np.ndarray, "side side 2"]
) -> tuple[Float[np.ndarray, "side side 2"], Bool[np.ndarray, "side side"]]:
    """Map a lattice of ground points to pixels by the homography of its corners, which are projected exactly.

    Returns pixels and visibility like `pixels_from_ground`; if one corner is invisible, all points are.
    """
    corners, visible = pixels_from_ground(view, lattice[[0, 0, -1, -1], [0, -1, 0, -1]])
    flags = np.full(lattice.shape[:2], bool(visible.all()))
    if not visible.all():
        return np.zeros(lattice.shape), flags
    last = lattice.shape[0] - 1.0
    square = np.array([[0.0, 0.0], [last, 0.0], [0.0, last], [last, last]], dtype=np.float32)
    homography = cv2.getPerspectiveTransform(square, corners.astype(np.float32))
    steps = np.arange(lattice.shape[0], dtype=np.float64)
    positions = np.stack(np.meshgrid(steps, steps), axis=-1)
    return cv2.perspectiveTransform(positions, homography), flags


def rectify_patch(
    view: BinnedView, centre: Vector2, side_px: int, gsd_m: float, *, full_camera: bool = True
) -> Float[np.ndarray, "side side"]:
    """Rectify and correct a patch of `side_px` pixels around the ground point `centre` (east, north), counts.

    Each pixel is projected with the full camera model, or mapped by the homography of the patch's corners.
    Points outside the image get the value of the nearest border pixel. Points that the camera model cannot project get
    the value of the image's upper left pixel. Template candidates contain no such points.
    """
    lattice = ground_lattice(centre, side_px, gsd_m)
    pixels, visible = pixels_from_ground(view, lattice) if full_camera else homography_lattice(view, lattice)
    columns, rows = view.size
    u, v = np.moveaxis(np.where(visible[..., None], np.clip(pixels, 0.0, [columns - 1.0, rows - 1.0]), 0.0), -1, 0)
    row_range, column_range = _pixel_range(v.min(), v.max(), rows), _pixel_range(u.min(), u.max(), columns)
    patch = correct_patch(view, row_range, column_range)
    positions = [v - row_range.start, u - column_range.start]
    return np.asarray(ndimage.map_coordinates(patch, positions, order=3, mode="mirror"))
