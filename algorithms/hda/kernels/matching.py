"""Kernels of 'Vision Guided Landing': correlation tracker (section II.A) and search on epipolar segments (II.C)."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Image = NDArray[np.float32]
Array = NDArray[np.float64]

#: Sum of the variances of two patches (squared counts) up to which they count as textureless, with a correlation of 0;
#: rounding errors in uniform patches are smaller.
MIN_VARIANCE = 1e-6


@njit(cache=True)
def correlation(first: Image, second: Image, r1: int, c1: int, r2: int, c2: int, half: int) -> float:
    """Correlation (Eq. 3, section II.A) of two patches, each minus its mean: twice the covariance / sum of variances.

    The patches have the half width `half` and the centres (r1, c1) and (r2, c2).
    """
    sum_a, sum_b, sum_aa, sum_bb, sum_ab = 0.0, 0.0, 0.0, 0.0, 0.0
    # Subtract the centre value first to avoid cancellation in the variances.
    centre_a = np.float64(first[r1, c1])
    centre_b = np.float64(second[r2, c2])
    # unsigned indices are faster, because they need no test for negative values
    top, left, width = np.uint64(r1 - half), np.uint64(c1 - half), np.uint64(2 * half + 1)
    second_top, second_left = np.uint64(r2 - half), np.uint64(c2 - half)
    for i in range(width):
        for j in range(width):
            a = first[top + i, left + j] - centre_a
            b = second[second_top + i, second_left + j] - centre_b
            sum_a += a
            sum_b += b
            sum_aa += a * a
            sum_bb += b * b
            sum_ab += a * b
    n = (2 * half + 1) ** 2
    energy = sum_aa - sum_a * sum_a / n + sum_bb - sum_b * sum_b / n
    return 0.0 if energy <= MIN_VARIANCE * n else 2.0 * (sum_ab - sum_a * sum_b / n) / energy


@njit(cache=True)
def fit_biquadratic_peak(z: Array) -> tuple[float, float, float]:
    """Row, column and value of the maximum of a quadratic least-squares fit to 3 x 3 values (section II.A).

    The position is relative to the centre, clamped to [-1, 1]. If the fit has no maximum, the centre and its value are
    returned.
    """
    # gradient (gr, gc) and second derivatives (rr, cc, rc) of the quadratic
    gr, gc, rr, cc, rc, mean = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(3):
        for j in range(3):
            r, c, v = i - 1.0, j - 1.0, z[i, j]
            mean += v / 9.0
            gr += v * r / 6.0
            gc += v * c / 6.0
            rr += v * (r * r - 2.0 / 3.0)
            cc += v * (c * c - 2.0 / 3.0)
            rc += v * r * c / 4.0
    determinant = rr * cc - rc * rc
    if rr >= 0.0 or determinant <= 0.0:
        return 0.0, 0.0, z[1, 1]
    row = min(max(-(cc * gr - rc * gc) / determinant, -1.0), 1.0)
    column = min(max(-(rr * gc - rc * gr) / determinant, -1.0), 1.0)
    centre_value = mean - (rr + cc) / 3.0
    value = centre_value + gr * row + gc * column + 0.5 * (rr * row * row + cc * column * column) + rc * row * column
    return row, column, value


@njit(cache=True)
def window_fits(image: Image, row: int, column: int, radius: int) -> bool:
    """Whether a window of half width `radius` around a pixel lies inside the image."""
    return bool(radius <= row < image.shape[0] - radius and radius <= column < image.shape[1] - radius)


@njit(cache=True)
def find_best_match(
    first: Image, second: Image, r1: int, c1: int, row: int, column: int, half: int, radius: int
) -> tuple[int, int, float]:
    """Row, column and value of the highest correlation within `radius` of (row, column); -2 if no window fits."""
    best_row, best_column, best = row, column, -2.0
    for i in range(row - radius, row + radius + 1):
        for j in range(column - radius, column + radius + 1):
            if window_fits(second, i, j, half):
                value = correlation(first, second, r1, c1, i, j, half)
                if value > best:
                    best_row, best_column, best = i, j, value
    return best_row, best_column, best


@njit(cache=True)
def find_best_shifts(
    first: Image, second: Image, positions: NDArray[np.int64], shifts: NDArray[np.int64], half: int, radius: int
) -> tuple[NDArray[np.int64], Array]:
    """Shift of highest correlation within `radius` of the initial shift of each position (row, column).

    Returns also this correlation; it is -2 if no window lies inside the image.
    """
    new_shifts = shifts.copy()
    values = np.full(positions.shape[0], -2.0)
    for k in range(positions.shape[0]):
        r, c = positions[k, 0], positions[k, 1]
        if not window_fits(first, r, c, half):
            continue
        i, j, values[k] = find_best_match(first, second, r, c, r + shifts[k, 0], c + shifts[k, 1], half, radius)
        new_shifts[k, 0], new_shifts[k, 1] = i - r, j - c
    return new_shifts, values


@njit(cache=True)
def refine_peak(
    first: Image, second: Image, r1: int, c1: int, r2: int, c2: int, half: int
) -> tuple[float, float, float]:
    """Row, column and value of the biquadratic correlation peak around (r2, c2); NaN if a window does not fit."""
    if not (window_fits(first, r1, c1, half) and window_fits(second, r2, c2, half + 1)):
        return math.nan, math.nan, math.nan
    z = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            z[i, j] = correlation(first, second, r1, c1, r2 + i - 1, c2 + j - 1, half)
    row, column, value = fit_biquadratic_peak(z)
    # A least-squares fit underestimates a peak that is one pixel wide.
    return r2 + row, c2 + column, max(value, z[1, 1])


@njit(cache=True)
def refine_positions(
    first: Image, second: Image, positions: NDArray[np.int64], shifts: NDArray[np.int64], half: int
) -> tuple[Array, Array]:
    """Sub-pixel matches (u, v) in the second image and their correlations (II.A, II.C); NaN if no window fits.

    `positions` and `shifts` are whole rows and columns; the matches are searched next to their sum.
    """
    pixels = np.empty((positions.shape[0], 2))
    values = np.empty(positions.shape[0])
    for k in range(positions.shape[0]):
        r, c = positions[k, 0], positions[k, 1]
        row, column, values[k] = refine_peak(first, second, r, c, r + shifts[k, 0], c + shifts[k, 1], half)
        pixels[k, 0], pixels[k, 1] = column, row
    return pixels, values


@njit(cache=True)
def sum_absolute_differences(
    first: NDArray[np.uint16], second: NDArray[np.uint16], r1: int, c1: int, r2: int, c2: int, half: int, max_sum: int
) -> int:
    """Sum of absolute differences (Eq. 9, section II.C) of two windows; stops when the sum exceeds `max_sum`."""
    # unsigned indices are faster, because they need no test for negative values
    top, left, width = np.uint64(r1 - half), np.uint64(c1 - half), np.uint64(2 * half + 1)
    second_top, second_left = np.uint64(r2 - half), np.uint64(c2 - half)
    total = 0
    for i in range(width):
        for j in range(width):
            difference = np.int64(first[top + i, left + j]) - np.int64(second[second_top + i, second_left + j])
            total += int(abs(difference))
        if total > max_sum:
            break
    return total


@njit(cache=True)
def match_along_epipolar_segments(
    first: NDArray[np.uint16],
    second: NDArray[np.uint16],
    pixels: NDArray[np.int64],
    starts: Array,
    ends: Array,
    half: int,
) -> NDArray[np.int64]:
    """Find the match of each pixel (u, v) on its epipolar segment in the second image (section II.C).

    The match is the pixel of minimum sum of absolute differences (Eq. 9). The tested pixels are one pixel apart along
    the longer axis of the segment, rounded to whole pixels. All windows must lie inside the image.
    """
    best_pixels = np.empty_like(pixels)
    fraction = 0.5  # position of the previous pixel's match on its segment
    for k in range(pixels.shape[0]):
        du, dv = ends[k, 0] - starts[k, 0], ends[k, 1] - starts[k, 1]
        steps = max(math.ceil(max(abs(du), abs(dv))), 1)
        best = 2**62  # larger than any sum
        # the first test, at the previous pixel's position, only gives a limit that ends most of the other sums early
        for test in range(-1, steps + 1):
            n = test if test >= 0 else np.int64(np.rint(fraction * steps))
            u = np.int64(np.rint(starts[k, 0] + du * n / steps))
            v = np.int64(np.rint(starts[k, 1] + dv * n / steps))
            value = sum_absolute_differences(first, second, pixels[k, 1], pixels[k, 0], v, u, half, best)
            if test < 0:
                best = value + 1
            elif value < best:
                best, fraction = value, n / steps
                best_pixels[k, 0], best_pixels[k, 1] = u, v
    return best_pixels
