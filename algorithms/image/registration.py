"""Registration and resampling of templates by quintic splines, to hundredths of a pixel.

Fits of a surface to a correlation peak are biased towards whole pixels (up to about 0.09 px for the biquadratic);
OpenCV's warps misplace samples by up to 0.05 px. Gauss-Newton registration of the images, with a spline of high order
between pixels, has no such bias. A pure shift is biased where the image is stretched relative to the
template, by up to tenths of a pixel; a linear map removes that bias. A round surface seen from another height bends the
image; a quadratic map removes that bias.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from jaxtyping import Float
from scipy import ndimage
from scipy.interpolate import BSpline

from marsyard.algorithms.arrays import Patch, Raster, Vector2
from marsyard.algorithms.image.kernels import quintic
from marsyard.algorithms.image.kernels import registration as kernels

ORDER: Final = 5
#: Step that ends the shift refinement; the next step is smaller by a factor of ten or more.
ALIGNMENT_TOLERANCE_PX = 1e-3
#: Margin of pixels for the spline; pixels beyond shift the result by less than 1e-4 px.
SURROUND = 12
_TAPS = np.arange(ORDER + 1) - ORDER // 2
_BASIS = BSpline.basis_element(np.arange(ORDER + 2) - (ORDER + 1) / 2.0, extrapolate=False)
_SLOPE = _BASIS.derivative()


def spline_coefficients(image: Raster) -> Raster:
    """Coefficients of the quintic spline through the image; borders mirror about their last pixels."""
    return np.asarray(ndimage.spline_filter(image, order=ORDER, output=np.float64, mode="mirror"))


def shifted_patch(coefficients: Raster, corner: Vector2, shape: tuple[int, int]) -> Float[np.ndarray, "3 n m"]:
    """The patch of `shape` with its upper left pixel at `corner` (row, column), and its derivatives by row and column.

    All pixels share the fraction of the shift: the spline is a separable filter of six taps. The patch must lie at
    least three pixels inside the image.
    """
    integer_part = np.floor(corner)
    places = (corner - integer_part)[:, np.newaxis] - _TAPS
    taps = np.stack([_BASIS(places), _SLOPE(places)])
    samples = np.empty((3, *shape))
    quintic.sample_with_derivatives(
        coefficients, int(integer_part[0]), int(integer_part[1]), taps[:, 0], taps[:, 1], samples
    )
    return samples


def refine_shift(
    template: Float[np.ndarray, "n m"], window: Raster, corner: Vector2, iterations: int = 6, reach: float = 1.5
) -> Vector2 | None:
    """Refine the corner (row, column) of a template in the window to hundredths of a pixel.

    Minimises ``sum (A - gain B)^2`` over shift and gain, A and B less their means, from `corner` by Gauss-Newton. None
    if it moves more than `reach` pixels, comes within three pixels of the window's border, or the normal equations are
    singular.
    """
    near = np.maximum(np.floor(corner).astype(int) - SURROUND, 0)
    far = np.floor(corner).astype(int) + np.array(template.shape) + SURROUND
    region = window[near[0] : far[0], near[1] : far[1]]
    coefficients = spline_coefficients(region)
    last = np.array(region.shape) - np.array(template.shape) - 4.0
    a = template - template.mean()
    start = corner - near
    position = start
    for _ in range(iterations):
        if np.hypot(*(position - start)) > reach or np.any(position < 3.0) or np.any(position > last):
            return None
        samples = shifted_patch(coefficients, position, (template.shape[0], template.shape[1]))
        b = samples[0] - samples[0].mean()
        energy = float(np.sum(b * b))
        gain = float(np.sum(a * b)) / energy if energy > 0.0 else 0.0
        slopes = samples[1:].reshape(2, -1)
        jacobian = gain * (slopes - slopes.mean(axis=1, keepdims=True))
        normal = jacobian @ jacobian.T
        if gain <= 0.0 or np.linalg.det(normal) <= 1e-10 * np.trace(normal) ** 2:
            return None
        step = np.linalg.solve(normal, jacobian @ (a - gain * b).ravel())
        position = position + step
        if np.hypot(*step) < ALIGNMENT_TOLERANCE_PX:
            break
    return position + near if np.hypot(*(position - start)) <= reach else None


#: Model of the registration: shift; with a linear map; with a quadratic map of the offsets.
Warp = Literal["shift", "stretch", "bend"]
_ORDERS: dict[Warp, int] = {"shift": 0, "stretch": 1, "bend": 2}
#: Step that ends the registration; the remaining error is less than 1e-3 px.
REGISTRATION_TOLERANCE_PX = 3e-3
#: Minimum pivot of the normal equations with unit diagonal; below, the texture does not separate the unknowns.
SINGULAR = 1e-4


@dataclass(frozen=True)
class Limits:
    """Limits of a registration.

    - shift_px: Largest displacement of the middle
    - stretch: Largest entry of the linear map's difference from the identity, and of the bend at the template's border
    - steps: Maximum number of steps; four to six are usual
    """

    shift_px: float = 1.5
    stretch: float = 0.35
    steps: int = 12


#: Default limits.
LIMITS = Limits()


@dataclass(frozen=True)
class Registration:
    """Best match: corner (row, column in the window) of the unwarped template, and normalised correlation."""

    corner: Vector2
    score: float


@dataclass(frozen=True)
class SplinePart:
    """Part of a window about a template: first row and column, those after its last, quintic spline coefficients."""

    near: tuple[int, int]
    far: tuple[int, int]
    coefficients: Raster


def build_spline(window: Raster, corner: Vector2, side: int, known: SplinePart | None = None) -> SplinePart:
    """The spline about a template of `side` pixels with its upper left one at `corner` (row, column).

    Returns `known`, of the same window, if it is the same part.
    """
    first = np.maximum(np.floor(corner).astype(int) - SURROUND, 0)
    last = np.ceil(corner).astype(int) + side + SURROUND
    near, far = (int(first[0]), int(first[1])), (int(last[0]), int(last[1]))
    if known is not None and (known.near, known.far) == (near, far):
        return known
    return SplinePart(near, far, spline_coefficients(window[near[0] : far[0], near[1] : far[1]]))


def register_template(
    template: Patch, window: Raster | SplinePart, corner: Vector2, warp: Warp, limits: Limits = LIMITS
) -> Registration | None:
    """Register a template in a window, or in the part of it about `corner`, from `corner` (row, column).

    Minimises ``sum (B(c + M d + Q(d)) - gain A(d) - offset)^2`` over the middle c, gain, offset and, as `warp` allows,
    the matrix M (else the identity) and the quadratic form Q (else zero); A is the template over offsets d from its
    middle, B the window by quintic splines. Inverse compositional method (Baker & Matthews 2004). None if it leaves the
    limits or the window, does not converge, or the texture does not determine the unknowns.
    """
    half = 0.5 * (len(template) - 1)
    part = window if isinstance(window, SplinePart) else build_spline(window, corner, len(template))
    near = np.array(part.near)
    start = corner - near + half
    bounds = (limits.shift_px, limits.stretch, limits.steps)
    done, row, column, score = kernels.register(
        template, part.coefficients, start[0], start[1], _ORDERS[warp], bounds, REGISTRATION_TOLERANCE_PX, SINGULAR
    )
    return Registration(np.array([row, column]) - half + near, score) if done else None


def similarity_patch(
    image: Raster, centre: Vector2, side: int, magnification: float = 1.0, roll_rad: float = 0.0
) -> Float[np.ndarray, "side side"]:
    """The square of `side` pixels about `centre` of the magnified and rolled image.

    - image: Image, mirrored about its last pixels outside
    - centre: Column and row (u, v) of the middle, within the image
    - magnification: Scale factor; unfiltered, meant for factors down to about 0.7
    - roll_rad: Rotation, clockwise as seen

    Raises ValueError if the centre is outside the image.
    """
    linear = np.zeros((2, 5))
    linear[:, :2] = [[np.cos(roll_rad), -np.sin(roll_rad)], [np.sin(roll_rad), np.cos(roll_rad)]]
    linear /= magnification
    reach = int(np.ceil(0.5 * (side - 1) * np.abs(linear).sum(axis=1).max())) + SURROUND
    position = centre[::-1]
    near = np.floor(position).astype(int) - reach
    far = near + 2 * reach + 2
    inside = image[max(near[0], 0) : max(far[0], 0), max(near[1], 0) : max(far[1], 0)]
    beyond = [(max(-a, 0), max(b - n, 0)) for a, b, n in zip(near, far, image.shape, strict=True)]
    region = np.pad(inside, beyond, mode="reflect") if np.any(beyond) else inside
    values = np.empty(side * side)
    row, column = position - near
    if not quintic.sample(spline_coefficients(region), side, row, column, linear, values):
        raise ValueError(f"the middle of a patch, {centre}, is not in the picture of {image.shape[::-1]} pixels")
    return values.reshape(side, side)
