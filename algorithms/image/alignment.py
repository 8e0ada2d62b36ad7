"""Alignment of a template within a window to hundredths of a pixel: Gauss-Newton on quintic splines.

Fits of a surface to a correlation peak lean towards whole pixels (up to about 0.09 px for the biquadratic). Aligning
the pictures themselves, with the window interpolated by a spline of high order, has no such lean.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float
from scipy import ndimage
from scipy.interpolate import BSpline

from marsyard.algorithms.image.kernels import quintic as kernels

ORDER: Final = 5
#: A step below this, pixels, ends the iteration; the one that would follow is smaller by a factor of ten or more.
TOLERANCE = 1e-3
#: Pixels around the start that the spline is computed from; what is beyond shifts the result by less than 1e-4 px.
SURROUND = 12
_TAPS = np.arange(ORDER + 1) - ORDER // 2
_BASIS = BSpline.basis_element(np.arange(ORDER + 2) - (ORDER + 1) / 2.0, extrapolate=False)
_SLOPE = _BASIS.derivative()


def spline_coefficients(image: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows columns"]:
    """Coefficients of the quintic spline through the picture; borders mirror about their last pixels."""
    return np.asarray(ndimage.spline_filter(image, order=ORDER, output=np.float64, mode="mirror"))


def shifted_patch(
    coefficients: Float[np.ndarray, "rows columns"], corner: Float[np.ndarray, "2"], shape: tuple[int, int]
) -> Float[np.ndarray, "3 n m"]:
    """The patch of `shape` with its upper left pixel at `corner` (row, column), and its derivatives by row and column.

    All pixels share the fraction of the shift, so the spline is a separable filter of six taps. The patch must lie at
    least three pixels inside the picture.
    """
    whole = np.floor(corner)
    places = (corner - whole)[:, np.newaxis] - _TAPS
    taps = np.stack([_BASIS(places), _SLOPE(places)])
    taken = np.empty((3, *shape))
    kernels.shifted(coefficients, int(whole[0]), int(whole[1]), taps[:, 0], taps[:, 1], taken)
    return taken


def refine_shift(
    template: Float[np.ndarray, "n m"],
    window: Float[np.ndarray, "rows columns"],
    corner: Float[np.ndarray, "2"],
    iterations: int = 6,
    reach: float = 1.5,
) -> Float[np.ndarray, "2"] | None:
    """Corner (row, column) in the window at which the template matches best, to hundredths of a pixel.

    Minimises ``sum (A - gain B)^2`` over shift and gain, A and B less their means, from `corner` by Gauss-Newton. None
    when it leaves the circle of `reach` pixels about the start, when the patch comes within three pixels of the
    window's border, or when the normal equations are singular.
    """
    near = np.maximum(np.floor(corner).astype(int) - SURROUND, 0)
    far = np.floor(corner).astype(int) + np.array(template.shape) + SURROUND
    region = window[near[0] : far[0], near[1] : far[1]]
    coefficients = spline_coefficients(region)
    room = np.array(region.shape) - np.array(template.shape) - 4.0
    a = template - template.mean()
    start = corner - near
    place = start
    for _ in range(iterations):
        if np.hypot(*(place - start)) > reach or np.any(place < 3.0) or np.any(place > room):
            return None
        step = _step(a, shifted_patch(coefficients, place, (template.shape[0], template.shape[1])))
        if step is None:
            return None
        place = place + step
        if np.hypot(*step) < TOLERANCE:
            break
    return place + near if np.hypot(*(place - start)) <= reach else None


def _step(a: Float[np.ndarray, "n m"], taken: Float[np.ndarray, "3 n m"]) -> Float[np.ndarray, "2"] | None:
    """One Gauss-Newton step of the shift (row, column), the gain solved for at once; see `shifted_patch`."""
    b = taken[0] - taken[0].mean()
    energy = float(np.sum(b * b))
    gain = float(np.sum(a * b)) / energy if energy > 0.0 else 0.0
    if gain <= 0.0:
        return None
    slopes = taken[1:].reshape(2, -1)
    jacobian = gain * (slopes - slopes.mean(axis=1, keepdims=True))
    normal = jacobian @ jacobian.T
    if np.linalg.det(normal) <= 1e-10 * np.trace(normal) ** 2:
        return None
    return np.asarray(np.linalg.solve(normal, jacobian @ (a - gain * b).ravel()))
