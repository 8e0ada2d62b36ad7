"""Estimators of the motion of image patches: symmetric Gauss-Newton, and fits to the peak of the correlation.

They validate the renderer and share no code with the algorithms under test.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import ndimage
from scipy.interpolate import BSpline

#: Side and half width of a patch, pixels.
PATCH, HALF = 31, 15
#: Standard deviation of the smoothing of both images, pixels.
SIGMA_PX = 1.0
#: Minimum distance of a patch's centre from the image border: half width, shift and support of the quintic spline.
MARGIN = HALF + 6


@cache
def _quintic_spline() -> tuple[BSpline, BSpline]:
    """Quintic B-spline with its centre at 0, and its derivative."""
    basis = BSpline.basis_element(np.arange(-3.0, 4.0), extrapolate=False)
    return basis, basis.derivative()


def _spline_weights(shift: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Integer part of shifts, and weights of the six neighbouring spline coefficients with their derivatives."""
    integer = np.floor(shift).astype(int)
    distance = (shift - integer)[:, None] - np.arange(-2.0, 4.0)
    value, slope = _quintic_spline()
    return integer, np.nan_to_num(value(distance)), np.nan_to_num(slope(distance))


class SmoothImage:
    """Image smoothed by a Gaussian of one pixel, interpolated by a quintic spline."""

    def __init__(self, image: np.ndarray) -> None:
        smooth_image = ndimage.gaussian_filter(image.astype(np.float64), SIGMA_PX)
        self._coefficients = ndimage.spline_filter(smooth_image, order=5)

    def patches(self, centres: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values of patches around `centres` + `shift` (both (u, v), shape (n, 2)), and their derivatives by u and v.

        Shapes (n, PATCH, PATCH) and (n, 2, PATCH, PATCH).
        """
        # weights of values (wu, wv) and of derivatives (du, dv)
        columns, wu, du = _spline_weights(shift[:, 0])
        rows, wv, dv = _spline_weights(shift[:, 1])
        first_row = (centres[:, 1] + rows - HALF - 2)[:, None] + np.arange(PATCH + 5)
        first_column = (centres[:, 0] + columns - HALF - 2)[:, None] + np.arange(PATCH + 5)
        block = self._coefficients[first_row[:, :, None], first_column[:, None, :]]
        row_windows = sliding_window_view(block, 6, axis=2)
        row_value = np.einsum("nrck,nk->nrc", row_windows, wu)
        row_slope = np.einsum("nrck,nk->nrc", row_windows, du)
        column_windows = sliding_window_view(row_value, 6, axis=1)
        value = np.einsum("nrck,nk->nrc", column_windows, wv)
        slope_v = np.einsum("nrck,nk->nrc", column_windows, dv)
        slope_u = np.einsum("nrck,nk->nrc", sliding_window_view(row_slope, 6, axis=1), wv)
        return value, np.stack([slope_u, slope_v], axis=1)


@dataclass(frozen=True)
class Shifts:
    """Result of symmetric Gauss-Newton estimation.

    - motion_px: motion (u, v) of each patch from the first image to the second, shape (n, 2)
    - response: derivative of the estimate (second axis) with respect to the motion of each pixel (last axis), shape
      (n, 2, PATCH, PATCH, 2); the expected estimate is the sum of the pixel motions with these weights
    """

    motion_px: np.ndarray
    response: np.ndarray

    def expected(self, motion: np.ndarray) -> np.ndarray:
        """Expected estimate for the true motion of each pixel, shape (n, PATCH, PATCH, 2)."""
        return np.einsum("nirck,nrck->ni", self.response, motion)


def symmetric_shifts(first: SmoothImage, second: SmoothImage, centres: np.ndarray, iterations: int = 8) -> Shifts:
    """Estimate shifts d with ``first(x - d / 2) = gain * second(x + d / 2) + offset`` per patch by least squares."""
    count = len(centres)
    shift = np.zeros((count, 2))
    gain, offset = np.ones(count), np.zeros(count)
    for _ in range(iterations):
        a, slope_a = first.patches(centres, -0.5 * shift)
        b, slope_b = second.patches(centres, 0.5 * shift)
        residual = a - gain[:, None, None] * b - offset[:, None, None]
        jacobian = 0.5 * (slope_a + gain[:, None, None, None] * slope_b)
        design = np.concatenate(
            [jacobian.reshape(count, 2, -1), b.reshape(count, 1, -1), np.ones((count, 1, PATCH * PATCH))], axis=1
        )
        normal = design @ design.transpose(0, 2, 1)
        step = np.linalg.solve(normal, (design @ residual.reshape(count, -1, 1)))[..., 0]
        shift += np.clip(step[:, :2], -0.5, 0.5)
        gain += step[:, 2]
        offset += step[:, 3]
        if np.abs(step[:, :2]).max() < 1e-5:
            break
    solver = np.linalg.solve(normal, design)[:, :2].reshape(count, 2, PATCH, PATCH)
    response = solver[..., None] * jacobian.transpose(0, 2, 3, 1)[:, None]
    return Shifts(shift, response)


def peak_fits(first: np.ndarray, second: np.ndarray, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Estimate shifts (u, v) by three-point parabolas along each axis, and by a quadric through 3 x 3 values.

    Both fit the peak of the normalised correlation over shifts of up to two pixels.
    """
    offsets = np.arange(-HALF, HALF + 1)
    rows, columns = centres[:, 1, None] + offsets, centres[:, 0, None] + offsets
    template = _normalise(first[rows[:, :, None], columns[:, None, :]])
    surface = np.empty((len(centres), 5, 5))
    for i in range(5):
        for j in range(5):
            shifted_patches = _normalise(second[(rows + i - 2)[:, :, None], (columns + j - 2)[:, None, :]])
            surface[:, i, j] = np.sum(template * shifted_patches, axis=(1, 2))
    best = surface[:, 1:4, 1:4].reshape(len(centres), -1).argmax(axis=1)
    top, left = best // 3, best % 3
    neighbours = np.arange(3)
    z = surface[
        np.arange(len(centres))[:, None, None],
        (top[:, None] + neighbours)[:, :, None],
        (left[:, None] + neighbours)[:, None, :],
    ]
    integer = np.stack([left, top], axis=-1) - 1.0
    lines = np.stack([z[:, 1, :], z[:, :, 1]], axis=1)
    parabola = 0.5 * (lines[..., 0] - lines[..., 2]) / (lines[..., 0] - 2.0 * lines[..., 1] + lines[..., 2])
    return integer + parabola, integer + _fit_quadric(z)


def _normalise(patches: np.ndarray) -> np.ndarray:
    """Subtract the mean of each patch and divide by its norm."""
    deviation = patches - patches.mean(axis=(1, 2), keepdims=True, dtype=np.float64)
    return deviation / np.sqrt(np.sum(deviation**2, axis=(1, 2), keepdims=True))


def _fit_quadric(z: np.ndarray) -> np.ndarray:
    """Maximum (u, v) of the least-squares quadric through 3 x 3 values."""
    v, u = np.mgrid[-1.0:2.0, -1.0:2.0]
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1).reshape(9, 6)
    # coefficients of u, v, u^2, u v and v^2
    _, bu, bv, uu, uv, vv = np.linalg.pinv(terms) @ z.reshape(-1, 9).T
    determinant = 4.0 * uu * vv - uv**2
    return np.stack([(uv * bv - 2.0 * vv * bu) / determinant, (uv * bu - 2.0 * uu * bv) / determinant], axis=-1)
