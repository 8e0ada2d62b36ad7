"""Patches cut out of a picture at positions between pixels, magnified and rolled, by quintic splines.

OpenCV's warps place samples up to 0.05 px wrong; a tracker that replaces its template at each step adds such errors up.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from algorithms.image.alignment import ORDER, SURROUND, spline_coefficients


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
    """
    reach = 0.5 * (side - 1)
    across, down = np.meshgrid(np.arange(side) - reach, np.arange(side) - reach)
    cosine, sine = np.cos(roll_rad) / magnification, np.sin(roll_rad) / magnification
    u = centre[0] + cosine * across + sine * down
    v = centre[1] - sine * across + cosine * down
    near = [max(int(np.floor(x.min())) - SURROUND, 0) for x in (v, u)]
    far = [min(int(np.ceil(x.max())) + SURROUND + 1, n) for x, n in zip((v, u), image.shape, strict=True)]
    coefficients = spline_coefficients(image[near[0] : far[0], near[1] : far[1]])
    return np.asarray(
        ndimage.map_coordinates(coefficients, [v - near[0], u - near[1]], order=ORDER, prefilter=False, mode="mirror")
    )
