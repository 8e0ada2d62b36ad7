"""Rectified and radiometrically corrected patches of a view (section II.A).

The virtual camera looks straight down. Its pixels are squares of ground, `gsd_m` on a side, in the plane at the
measured altitude; rows run south and columns east. Both views of a pair are rectified to the same virtual camera,
assuming no horizontal motion: a patch is identified by the ground point in its middle, east and north of the camera's
nadir point. The paper uses a homography; here each point passes through the full camera model, with a cubic spline
between pixels.

Dark current is not corrected, as in the paper. It is a ramp along the columns: over the 31 rows of a template 0.05
counts at -34 deg C (flight) and 2.5 counts at 0 deg C (field test), below a pixel's noise of 6 and without effect on
velocities even over terrain of 2 % contrast. At +23 deg C it is 36 counts: over terrain of 2 % contrast few tracks are
valid and no velocity is reported; over terrain of 15 % contrast errors double to 0.07 m/s.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from marsyard.algorithms.dimes.binning import View, pixels_from_ground
from marsyard.algorithms.image.frame_transfer import remove_frame_transfer
from marsyard.algorithms.image.kernels import cubic as kernels

#: Minimum response for the division.
MIN_RESPONSE = 0.02


def correct_patch(view: View, rows: slice, columns: slice) -> Float[np.ndarray, "_ _"]:
    """Part of the view without frame-transfer ramp and fall-off, counts, float64."""
    exposed = remove_frame_transfer(view.signal[:, columns], view.calibration, view.rows_summed)
    return np.asarray(exposed[rows] / np.maximum(view.flat_field[rows, columns], MIN_RESPONSE))


#: Margin of pixels for the spline coefficients; pixels beyond change them by 1e-6.
SPLINE_MARGIN = 10


def ground_lattice(centre: Float[np.ndarray, "2"], side_px: int, gsd_m: float) -> Float[np.ndarray, "side side 2"]:
    """Ground points (east, north) of the pixels of a square patch about `centre`, metres."""
    steps = (np.arange(side_px) - 0.5 * (side_px - 1)) * gsd_m
    lattice = np.empty((side_px, side_px, 2))
    lattice[..., 0] = centre[0] + steps
    lattice[..., 1] = (centre[1] - steps)[:, np.newaxis]
    return lattice


def _pixel_range(smallest: float, largest: float, size: int) -> slice:
    """Whole pixels around values from `smallest` to `largest`, with the spline's margin, within 0 .. size."""
    low, high = max(int(smallest - SPLINE_MARGIN), 0), min(int(largest + SPLINE_MARGIN + 1), size)
    return slice(min(low, size - 1), max(high, 1))


def rectify_patch(
    view: View, centre: Float[np.ndarray, "2"], side_px: int, gsd_m: float
) -> Float[np.ndarray, "side side"]:
    """The corrected patch of `side_px` pixels about the ground point `centre` (east, north), counts.

    Points outside the image take its border value, invisible points that of the upper left corner; candidates exclude
    both.
    """
    pixels, visible = pixels_from_ground(view, ground_lattice(centre, side_px, gsd_m))
    columns, rows = view.size
    left, right, top, bottom = kernels.hold(pixels, visible, columns, rows)
    in_rows, in_columns = _pixel_range(top, bottom, rows), _pixel_range(left, right, columns)
    patch = correct_patch(view, in_rows, in_columns)
    coefficients = ndimage.spline_filter(patch, order=3, mode="mirror")
    values = np.empty((side_px, side_px))
    kernels.sample(coefficients, pixels, in_rows.start, in_columns.start, values)
    return values
