"""Compiled kernels of the landforms of the wind. Grids are periodic squares with a power of two as side."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from marsyard.sim.terrain.kernels import Array, Grid, Level, bspline_weights, collapse

#: Maximum strength of the modulation, whose RMS is 1, for the height of a crest (assumed).
MAX_STRENGTH = 1.6
#: Minimum and maximum fraction of the wavelength under the slip face.
MIN_SLIP, MAX_SLIP = 0.01, 0.5
GridRow = NDArray[np.float32]


class Bedforms(NamedTuple):
    """A train of dunes.

    - wave_x, wave_y: wavenumbers of the plane wave, rad/m
    - height_m: RMS height of the crests above the troughs, metres
    - slip_face_slope: slope of the slip face, metres per metre
    - contrast: natural logarithm of the albedo of crests divided by that of troughs
    - sharpness: weight of a stoss slope that steepens up to the crest; the rest is round near the crest
    """

    wave_x: float
    wave_y: float
    height_m: float
    slip_face_slope: float
    contrast: float
    sharpness: float


@njit(cache=True, inline="always")
def _arctan2(x: float, y: float) -> float:
    """Arctangent of y / x in its quadrant to 1e-7, by the polynomial of Cephes' atanf; without branches or calls."""
    abs_x, abs_y = abs(x), abs(y)
    larger = max(abs_x, abs_y, 1e-30)
    ratio = min(abs_x, abs_y) / larger
    # for ratios above tan(pi / 8) the polynomial approximates the angle minus pi / 4
    is_reduced = ratio > 0.41421356237309503
    a = (ratio - 1.0) / (ratio + 1.0) if is_reduced else ratio
    b = a * a
    angle = (((8.05374449538e-2 * b - 1.38776856032e-1) * b + 1.99777106478e-1) * b - 3.33329491539e-1) * b * a + a
    angle += 0.25 * math.pi if is_reduced else 0.0
    angle = 0.5 * math.pi - angle if abs_y > abs_x else angle
    angle = math.pi - angle if x < 0.0 else angle
    return -angle if y < 0.0 else angle


# Without Python's check for a division by zero, and without calls, the loop is compiled to vector instructions.
@njit(cache=True, error_model="numpy")
def _add_row_of_dunes(
    height: GridRow,
    log_albedo: GridRow,
    real: Array,
    imaginary: Array,
    first_phase: float,
    spacing: float,
    dunes: Bedforms,
) -> None:
    """Add dunes along a row from the complex modulation at its samples and the plane wave's phase at the first one."""
    phase_step, rms_height, contrast = dunes.wave_x * spacing, dunes.height_m, dunes.contrast
    sharpness = dunes.sharpness
    wave = math.sqrt(dunes.wave_x * dunes.wave_x + dunes.wave_y * dunes.wave_y)
    # the upper half of the slip face is plane, the lower half concave: it is 4/3 as long as a plane face;
    # the length of the slip face is expressed as a fraction of the wavelength
    slip_per_height = 4.0 / 3.0 * wave / (2.0 * math.pi * dunes.slip_face_slope)
    for j in range(height.shape[0]):
        strength = math.sqrt(real[j] * real[j] + imaginary[j] * imaginary[j])
        crest_height = rms_height * min(strength, MAX_STRENGTH)
        cycles = (first_phase + j * phase_step + _arctan2(real[j], imaginary[j])) / (2.0 * math.pi)
        # position in the wavelength, 0 and 1 at the troughs; v and w: position on the stoss slope and on the slip face
        u = cycles - np.floor(cycles)
        slip = min(max(slip_per_height * crest_height, MIN_SLIP), MAX_SLIP)
        v = u / (1.0 - slip)
        stoss = 0.25 * v + 0.75 * v * v * (3.0 - 2.0 * v)
        stoss += sharpness * (v * v * (0.4 + 0.6 * v) - stoss)
        w = (1.0 - u) / slip
        slip_face = 4.0 / 3.0 * w - 1.0 / 3.0 if w > 0.5 else 4.0 / 3.0 * w * w
        shape = stoss if u < 1.0 - slip else slip_face
        height[j] += crest_height * shape
        # coarse grains lie on sharp crests only
        grains = shape + sharpness * (shape * shape * shape - shape)
        log_albedo[j] += contrast * (grains - 0.5) * min(strength, 1.0)


@njit(cache=True)
def add_dunes(height: Grid, log_albedo: Grid, spacing: float, modulation: Level, dunes: Bedforms) -> None:
    """Add transverse dunes: a gentle stoss slope up to the crest, a slip face, a concave apron.

    The dunes are a plane wave multiplied by a smooth complex amplitude of unit mean square: its argument shifts the
    phase, its modulus scales the height. `modulation` contains the B-spline coefficients of this amplitude, real and
    imaginary, on a grid of the same extent that is not finer. Crests end and fork where the amplitude is zero.
    """
    side, cells = height.shape[0], modulation.shape[0]
    step = side // cells
    weights = np.empty((step, 4))
    for k in range(step):
        weights[k] = bspline_weights(k / step)[0]
    row_spline, real, imaginary = np.empty((cells, 2)), np.empty(side), np.empty(side)
    for i in range(side):
        # along one row the modulation is a spline in x only
        collapse(modulation, i / step, row_spline)
        for j in range(cells):
            value0, value1, value2, value3 = (
                row_spline[j - 1],
                row_spline[j],
                row_spline[(j + 1) % cells],
                row_spline[(j + 2) % cells],
            )
            for k in range(step):
                a, b, c, d = weights[k]
                real[j * step + k] = a * value0[0] + b * value1[0] + c * value2[0] + d * value3[0]
                imaginary[j * step + k] = a * value0[1] + b * value1[1] + c * value2[1] + d * value3[1]
        _add_row_of_dunes(height[i], log_albedo[i], real, imaginary, dunes.wave_y * i * spacing, spacing, dunes)


@njit(cache=True)
def cast_lee(height: Grid, shift: float, drop: float) -> Grid:
    """Compute the surface below which the wind leaves sand, for a wind towards larger rows: the ground or its lee.

    The lee of the row before continues `shift` columns to the right, at most one, and `drop` lower. It spreads to its
    sides with the weights of a quadratic B-spline. A second pass makes it periodic.
    """
    side = height.shape[0]
    mask = side - 1
    lee = height.copy()
    whole = round(shift)
    part = np.float32(shift - whole)
    half, fall = np.float32(0.5), np.float32(drop)
    left = half * (half + part) * (half + part)
    right = half * (half - part) * (half - part)
    middle = np.float32(1.0) - left - right
    padded = np.empty(side + 4, dtype=np.float32)
    for i in range(1, 2 * side):
        row = lee[i & mask]
        padded[2:-2] = lee[(i - 1) & mask]
        padded[:2], padded[-2:] = padded[-4:-2], padded[2:4]
        first = padded[1 - whole :]
        for j in range(side):
            row[j] = max(row[j], left * first[j] + middle * first[j + 1] + right * first[j + 2] - fall)
    return lee
