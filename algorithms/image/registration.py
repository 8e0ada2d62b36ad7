"""Registration and resampling of templates by quintic splines, with errors of hundredths of a pixel.

Surface fits to a correlation peak are biased towards whole pixels (up to about 0.09 px for the biquadratic). OpenCV's
warps displace samples by up to 0.05 px. Gauss-Newton registration of images interpolated by a high-order spline has no
such bias. A pure-shift model is biased by up to tenths of a pixel if the image is stretched relative to the template; a
linear map removes this bias. A curved surface seen from another position is also distorted quadratically; a quadratic
map removes the bias due to this distortion.
"""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from marsyard.algorithms.arrays import Patch, Raster, Vector2
from marsyard.algorithms.image.kernels import registration as kernels

#: Degree of the splines.
ORDER: Final = 5
#: Margin around a patch for its spline; pixels outside it change the result by less than 1e-4 px.
MARGIN_PX = 12
#: Model of the registration: shift; shift and linear map; shift, linear and quadratic map of the offsets.
Warp = Literal["shift", "stretch", "bend"]
_ORDERS: dict[Warp, int] = {"shift": 0, "stretch": 1, "bend": 2}
#: Step length below which the registration ends; the remaining error is less than 1e-3 px.
REGISTRATION_TOLERANCE_PX = 3e-3
#: Minimum pivot of the normal equations with unit diagonal; below it the texture does not determine the unknowns.
MIN_PIVOT = 1e-4


def spline_coefficients(image: Raster) -> Raster:
    """Compute the coefficients of the quintic spline through the image, mirrored at its outermost pixels."""
    return np.asarray(ndimage.spline_filter(image, order=ORDER, output=np.float64, mode="mirror"))


@dataclass(frozen=True)
class RegistrationLimits:
    """Limits of a registration.

    - shift_px: Largest displacement of the template's centre from its start
    - stretch: Largest entry of the linear map minus the identity, and of the quadratic map at the template's border
    - steps: Maximum number of steps (typical: four to six)
    """

    shift_px: float = 1.5
    stretch: float = 0.35
    steps: int = 12


#: Default limits.
LIMITS = RegistrationLimits()


@dataclass(frozen=True)
class Registration:
    """Registered template: position (row, column) of its upper left pixel without the warp; normalised correlation."""

    corner: Vector2
    score: float


@dataclass(frozen=True)
class WindowSpline:
    """Quintic spline of the pixels of a window around a template, from `start` to `stop` (row, column), exclusive."""

    start: tuple[int, int]
    stop: tuple[int, int]
    coefficients: Raster


def build_spline(window: Raster, corner: Vector2, side: int, previous: WindowSpline | None = None) -> WindowSpline:
    """Build the spline around a template of `side` pixels with its upper left pixel at `corner` (row, column).

    Returns `previous`, a spline of the same window, if it covers the same pixels.
    """
    low = np.maximum(np.floor(corner).astype(int) - MARGIN_PX, 0)
    high = np.ceil(corner).astype(int) + side + MARGIN_PX
    start, stop = (int(low[0]), int(low[1])), (int(high[0]), int(high[1]))
    if previous is not None and (previous.start, previous.stop) == (start, stop):
        return previous
    return WindowSpline(start, stop, spline_coefficients(window[start[0] : stop[0], start[1] : stop[1]]))


def register_template(
    template: Patch, window: Raster | WindowSpline, corner: Vector2, warp: Warp, limits: RegistrationLimits = LIMITS
) -> Registration | None:
    """Register a template in a window, or in its spline around `corner`, starting from `corner` (row, column).

    Minimises ``sum (B(c + M d + Q(d)) - gain A(d) - offset)^2`` over the centre c, gain, offset and, depending on
    `warp`, the matrix M (otherwise the identity) and the quadratic form Q (otherwise zero). A is the template at
    offsets d from its centre, B the window's quintic spline. Inverse compositional method (Baker & Matthews 2004). None
    if the limits are exceeded, the template leaves the window, the iteration does not converge, or the texture does not
    determine the unknowns.
    """
    half = 0.5 * (len(template) - 1)
    spline = window if isinstance(window, WindowSpline) else build_spline(window, corner, len(template))
    low = np.array(spline.start)
    start = corner - low + half
    max_values = (limits.shift_px, limits.stretch, limits.steps)
    converged, row, column, score = kernels.register(
        template, spline.coefficients, *start, _ORDERS[warp], max_values, REGISTRATION_TOLERANCE_PX, MIN_PIVOT
    )
    return Registration(np.array([row, column]) - half + low, score) if converged else None


def similarity_patch(
    image: Raster, centre: Vector2, side: int, magnification: float = 1.0, roll_rad: float = 0.0
) -> Float[np.ndarray, "side side"]:
    """Resample a square of `side` pixels around `centre` from the magnified and rolled image.

    - image: Image, mirrored at its outermost pixels
    - centre: Column and row (u, v) of the square's centre, within the image
    - magnification: Scale factor, at least about 0.7, because no low-pass filter is applied
    - roll_rad: Rotation, clockwise in the image

    Raises ValueError if the centre is outside the image.
    """
    position = centre[::-1]  # row and column
    if not (np.all(position >= 0.0) and np.all(position <= np.array(image.shape) - 1.0)):
        raise ValueError(f"the centre of a patch, {centre}, is outside the image of {image.shape[::-1]} pixels")
    # coefficients of y, x, and of the quadratic terms, which are zero
    warp = np.zeros((2, 5))
    warp[:, :2] = [[np.cos(roll_rad), -np.sin(roll_rad)], [np.sin(roll_rad), np.cos(roll_rad)]]
    warp /= magnification
    margin = int(np.ceil(0.5 * (side - 1) * np.abs(warp).sum(axis=1).max())) + MARGIN_PX
    start = np.floor(position).astype(int) - margin
    stop = start + 2 * margin + 2
    valid_region = image[max(start[0], 0) : max(stop[0], 0), max(start[1], 0) : max(stop[1], 0)]
    padding = [
        (max(-low, 0), max(high - extent, 0)) for low, high, extent in zip(start, stop, image.shape, strict=True)
    ]
    region = np.pad(valid_region, padding, mode="reflect") if np.any(padding) else valid_region
    values = np.empty(side * side)
    row, column = position - start
    kernels.sample(spline_coefficients(region), side, row, column, warp, values)
    return values.reshape(side, side)
