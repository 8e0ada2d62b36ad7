"""Patches cut out of a picture at positions between pixels, magnified and rolled, by quintic splines.

OpenCV's warps place samples up to 0.05 px wrong; a tracker that replaces its template at each step adds such errors up.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from marsyard.algorithms.image.alignment import SURROUND, spline_coefficients
from marsyard.algorithms.image.kernels import quintic as kernels


def similarity_patch(
    image: Float[np.ndarray, "rows columns"],
    centre: Float[np.ndarray, "2"],
    side: int,
    magnification: float = 1.0,
    roll_rad: float = 0.0,
) -> Float[np.ndarray, "side side"]:
    """The square of `side` pixels about `centre` of the picture after it is magnified and rolled about that point.

    Parameters
    ----------
    image
        The picture; what lies outside it is mirrored about its last pixels.
    centre
        Column and row (u, v) of what comes to lie in the middle, within the picture.
    side
        Pixels along each side of the patch.
    magnification
        How much larger things become; below 1 they shrink (unfiltered: meant for steps down to about 0.7).
    roll_rad
        How far they turn, clockwise as seen.

    Raises
    ------
    ValueError
        If the centre is not in the picture.
    """
    turned = np.zeros((2, 5))
    turned[:, :2] = [[np.cos(roll_rad), -np.sin(roll_rad)], [np.sin(roll_rad), np.cos(roll_rad)]]
    turned /= magnification
    reach = int(np.ceil(0.5 * (side - 1) * np.abs(turned).sum(axis=1).max())) + SURROUND
    place = centre[::-1]
    near = np.floor(place).astype(int) - reach
    far = near + 2 * reach + 2
    inside = image[max(near[0], 0) : max(far[0], 0), max(near[1], 0) : max(far[1], 0)]
    beyond = [(max(-a, 0), max(b - n, 0)) for a, b, n in zip(near, far, image.shape, strict=True)]
    region = np.pad(inside, beyond, mode="reflect") if np.any(beyond) else inside
    values = np.empty(side * side)
    row, column = place - near
    if not kernels.sample(spline_coefficients(region), side, row, column, turned, values):
        raise ValueError(f"the middle of a patch, {centre}, is not in the picture of {image.shape[::-1]} pixels")
    return values.reshape(side, side)
