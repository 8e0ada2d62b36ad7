"""Rectification: patches of a view as a virtual camera would see them that looks straight down (section II.A).

The virtual camera's pixels are squares of ground, `gsd_m` on a side, in the plane at the altitude measured with the
view; rows run from north to south and columns from west to east. Both views of a pair are rectified to the same virtual
camera on the assumption of no horizontal motion: a patch is named by the ground point in its middle, east and north of
the point below the camera that took the picture. What the paper does by a homography is done here point by point
through the full camera model, with a cubic spline between pixels.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from marsyard.algorithms.dimes.binning import View
from marsyard.algorithms.dimes.ground import pixels_from_ground
from marsyard.algorithms.dimes.radiometry import corrected_patch
from marsyard.algorithms.image.kernels import cubic as kernels

#: Pixels around the samples that the spline's coefficients are computed from; what is beyond changes them by 1e-6.
SPLINE_MARGIN = 10


def ground_lattice(centre: Float[np.ndarray, "2"], side_px: int, gsd_m: float) -> Float[np.ndarray, "side side 2"]:
    """Ground points (east, north) of the pixels of a square patch about `centre`, shape (side, side, 2), metres."""
    steps = (np.arange(side_px) - 0.5 * (side_px - 1)) * gsd_m
    lattice = np.empty((side_px, side_px, 2))
    lattice[..., 0] = centre[0] + steps
    lattice[..., 1] = (centre[1] - steps)[:, np.newaxis]
    return lattice


def _span(least: float, largest: float, size: int) -> slice:
    """Whole pixels around values from `least` to `largest`, with the spline's margin, within 0 .. size."""
    low, high = max(int(least - SPLINE_MARGIN), 0), min(int(largest + SPLINE_MARGIN + 1), size)
    return slice(min(low, size - 1), max(high, 1))


def rectified_patch(
    view: View, centre: Float[np.ndarray, "2"], side_px: int, gsd_m: float
) -> Float[np.ndarray, "side side"]:
    """The patch of `side_px` pixels about the ground point `centre` (east, north), radiometrically corrected, counts.

    Only what the patch needs is corrected and interpolated. Points out of the picture take the value of its border;
    points that the camera cannot see take its upper left corner's. (Candidates are chosen so that there are none.)
    """
    pixels, visible = pixels_from_ground(view, ground_lattice(centre, side_px, gsd_m))
    columns, rows = view.size
    left, right, top, bottom = kernels.hold(pixels, visible, columns, rows)
    in_rows, in_columns = _span(top, bottom, rows), _span(left, right, columns)
    patch = corrected_patch(view, in_rows, in_columns)
    coefficients = ndimage.spline_filter(patch, order=3, mode="mirror")
    values = np.empty((side_px, side_px))
    kernels.sample(coefficients, pixels, in_rows.start, in_columns.start, values)
    return values
