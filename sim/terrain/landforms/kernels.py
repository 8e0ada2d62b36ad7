"""Compiled kernels of the landforms. Grids are periodic squares whose side is a power of two; all work in place."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from marsyard.sim.terrain.kernels import Array, Level, bspline_weights, collapse

Grid = NDArray[np.float32]
Line = NDArray[np.float32]
#: Depth of the notches in a crater's rim over its height, per relative displacement of its outline.
NOTCHES = 8.0


class Bedforms(NamedTuple):
    """A train of dunes: wavenumbers of the plane wave, rad/m, RMS height of crest over trough, slope of the slip face,
    logarithm of crests' albedo over troughs'.
    """

    wave_x: float
    wave_y: float
    crest_m: float
    steepest: float
    contrast: float


@njit(cache=True)
def add_refined(fine: Grid, coarse: Grid) -> None:
    """Add a cubic B-spline from a grid of half as many samples along each side, exactly."""
    side = coarse.shape[0]
    row = np.empty(side, dtype=np.float32)
    eighth, six_eighths, half = np.float32(0.125), np.float32(0.75), np.float32(0.5)
    for i in range(2 * side):
        k = i // 2
        here = coarse[k]
        after = coarse[(k + 1) % side]
        if i % 2 == 0:
            before = coarse[k - 1]
            for j in range(side):
                row[j] = eighth * (before[j] + after[j]) + six_eighths * here[j]
        else:
            for j in range(side):
                row[j] = half * (here[j] + after[j])
        out = fine[i]
        for j in range(side - 1):
            out[2 * j] += eighth * (row[j - 1] + row[j + 1]) + six_eighths * row[j]
            out[2 * j + 1] += half * (row[j] + row[j + 1])
        out[2 * side - 2] += eighth * (row[side - 2] + row[0]) + six_eighths * row[side - 1]
        out[2 * side - 1] += half * (row[side - 1] + row[0])


@njit(cache=True)
def stamp_craters(height: Grid, tone: Grid, spacing: float, craters: Array, reach: float) -> None:
    """Add bowls, rims and ejecta of craters to height and to the logarithm of albedo, in order.

    `craters` has rows (x, y, radius, depth below the surroundings, rim height, rounding of the rim in metres, filled
    fraction of the depth, tone of the ejecta, tone of the floor, then three pairs of cosine and sine terms of the
    outline for two, three and five lobes, and the phase of the rays). The outline's lobes also notch the rim.
    """
    mask = height.shape[0] - 1
    for n in range(craters.shape[0]):
        x, y, radius, depth, rim, rounding, fill, bright, floor = craters[n, :9]
        c2, s2, c3, s3, c5, s5, phase = craters[n, 9:]
        extent = reach * radius * 1.1
        cos_7, sin_7 = math.cos(phase), math.sin(phase)
        cos_12, sin_12 = math.cos(2.3 * phase), math.sin(2.3 * phase)
        # the bowl before it was filled
        bottom = depth / (1.0 - fill)
        soft_floor = 0.25 * fill * bottom + 1e-9
        for i in range(math.ceil((y - extent) / spacing), math.floor((y + extent) / spacing) + 1):
            dy = i * spacing - y
            for j in range(math.ceil((x - extent) / spacing), math.floor((x + extent) / spacing) + 1):
                dx = j * spacing - x
                d = math.sqrt(dx * dx + dy * dy)
                if d >= extent:
                    continue
                c, s = dx / max(d, 1e-9), dy / max(d, 1e-9)
                # cosines and sines of twice, three and five times the azimuth
                cc, ss = c * c - s * s, 2.0 * c * s
                ccc, sss = cc * c - ss * s, ss * c + cc * s
                c5t, s5t = ccc * cc - sss * ss, sss * cc + ccc * ss
                lobes = c2 * cc + s2 * ss + c3 * ccc + s3 * sss + c5 * c5t + s5 * s5t
                r = d / (radius * (1.0 + lobes))
                if r >= reach:
                    continue
                outside = max(r, 0.6)
                fade = min((reach - r) / (reach - 1.0), 1.0)
                blanket = rim * max(1.0 + NOTCHES * lobes, 0.0) / (outside * outside * outside) * fade
                rays = 0.0
                if r > 1.0:
                    # seven and twelve rays: cosines of 7 and 12 times the azimuth, each with a phase
                    c7t, s7t = c5t * cc - s5t * ss, s5t * cc + c5t * ss
                    rays = c7t * cos_7 - s7t * sin_7
                    rays += (c7t * c5t - s7t * s5t) * cos_12 - (s7t * c5t + c7t * s5t) * sin_12
                    blanket *= 1.0 + 0.25 * rays * min(2.0 * (r - 1.0), 1.0)
                change = blanket
                # outside, the bowl's wall continues so steeply that it soon rises above the blanket
                if r <= 1.0 or (rim + bottom) * r * r - bottom < blanket + rounding:
                    bowl = (rim + bottom) * r**2.2 - bottom
                    if fill > 0.0:
                        # the higher of bowl and floor, rounded where they meet
                        meeting = max(soft_floor - abs(bowl + depth), 0.0)
                        bowl = max(bowl, -depth) + meeting * meeting / (4.0 * soft_floor)
                    overlap = max(rounding - abs(bowl - blanket), 0.0)
                    change = min(bowl, blanket) - overlap * overlap / (4.0 * max(rounding, 1e-9))
                row, column = i & mask, j & mask
                height[row, column] += change
                if bright != 0.0:
                    light = fade * fade * (1.0 + 0.5 * rays) if r > 1.0 else 1.0
                    tone[row, column] += bright * max(light, 0.0)
                if floor != 0.0 and r < 1.1:
                    # even over the floor, gone at the rim
                    tone[row, column] += floor * min(max((1.1 - r) / 0.5, 0.0), 1.0)


@njit(cache=True)
def stamp_cover(factors: Grid, spacing: float, craters: Array, reach: float) -> None:
    """Multiply a factor of fine relief by the smoothness of filled crater floors and the roughness of fresh ejecta.

    `craters` has rows (x, y, radius, factor on the floor, factor on the ejecta).
    """
    mask = factors.shape[0] - 1
    for n in range(craters.shape[0]):
        x, y, radius, floor, ejecta = craters[n]
        extent = reach * radius
        for i in range(math.ceil((y - extent) / spacing), math.floor((y + extent) / spacing) + 1):
            dy = i * spacing - y
            for j in range(math.ceil((x - extent) / spacing), math.floor((x + extent) / spacing) + 1):
                dx = j * spacing - x
                r = math.sqrt(dx * dx + dy * dy) / radius
                if r < 1.0:
                    factors[i & mask, j & mask] *= floor + (ejecta - floor) * r * r * r * r
                elif r < reach:
                    factors[i & mask, j & mask] *= 1.0 + (ejecta - 1.0) * (reach - r) / (reach - 1.0)


@njit(cache=True)
def stamp_streaks(tone: Grid, spacing: float, streaks: Array) -> None:
    """Add wind tails to the logarithm of albedo: rows (x, y, half width, length, cosine and sine downwind, tone).

    A tail begins at (x, y), widens downwind and fades to its end and its sides.
    """
    mask = tone.shape[0] - 1
    for n in range(streaks.shape[0]):
        x, y, half, length, c, s, colour = streaks[n]
        wide = 1.6 * half
        reach_x = max(c * length, 0.0) + wide, max(-c * length, 0.0) + wide
        reach_y = max(s * length, 0.0) + wide, max(-s * length, 0.0) + wide
        for i in range(math.ceil((y - reach_y[1]) / spacing), math.floor((y + reach_y[0]) / spacing) + 1):
            dy = i * spacing - y
            for j in range(math.ceil((x - reach_x[1]) / spacing), math.floor((x + reach_x[0]) / spacing) + 1):
                dx = j * spacing - x
                p = (c * dx + s * dy) / length
                if p <= 0.0 or p >= 1.0:
                    continue
                q = (c * dy - s * dx) / (half * (0.8 + 0.8 * p))
                if abs(q) < 1.0:
                    side = 1.0 - q * q
                    tone[i & mask, j & mask] += colour * side * side * (1.0 - p) * min(p * length / half, 1.0)


@njit(cache=True, inline="always")
def _arctan2(x: float, y: float) -> float:
    """Arctangent of y / x in its quadrant to 1e-7, by the polynomial of Cephes' atanf; without branches or calls."""
    wide, high = abs(x), abs(y)
    larger = max(wide, high, 1e-30)
    ratio = min(wide, high) / larger
    is_reduced = ratio > 0.41421356237309503
    a = (ratio - 1.0) / (ratio + 1.0) if is_reduced else ratio
    b = a * a
    angle = (((8.05374449538e-2 * b - 1.38776856032e-1) * b + 1.99777106478e-1) * b - 3.33329491539e-1) * b * a + a
    angle += 0.25 * math.pi if is_reduced else 0.0
    angle = 0.5 * math.pi - angle if high > wide else angle
    angle = math.pi - angle if x < 0.0 else angle
    return -angle if y < 0.0 else angle


# Without Python's check for a division by zero, and without calls, the loop is compiled to vector instructions.
@njit(cache=True, error_model="numpy")
def _add_row_of_dunes(
    height: Line, tone: Line, real: Array, imaginary: Array, first_phase: float, spacing: float, dunes: Bedforms
) -> None:
    """Add dunes along a row, given the modulation at its samples and the plane wave's phase at the first."""
    phase_step, crest, contrast = dunes.wave_x * spacing, dunes.crest_m, dunes.contrast
    wave = math.sqrt(dunes.wave_x * dunes.wave_x + dunes.wave_y * dunes.wave_y)
    # the face falls along a line over its first half, then levels out: 4/3 as long as were it straight
    slip_of_height = 4.0 / 3.0 * wave / (2.0 * math.pi * dunes.steepest)
    for j in range(height.shape[0]):
        strength = math.sqrt(real[j] * real[j] + imaginary[j] * imaginary[j])
        high = crest * min(strength, 1.6)
        turns = (first_phase + j * phase_step + _arctan2(real[j], imaginary[j])) / (2.0 * math.pi)
        u = turns - np.floor(turns)
        slip = min(max(slip_of_height * high, 0.01), 0.5)
        v = u / (1.0 - slip)
        stoss = 0.25 * v + 0.75 * v * v * (3.0 - 2.0 * v)
        w = (1.0 - u) / slip
        face = 4.0 / 3.0 * w - 1.0 / 3.0 if w > 0.5 else 4.0 / 3.0 * w * w
        shape = stoss if u < 1.0 - slip else face
        height[j] += high * shape
        tone[j] += contrast * (shape - 0.5) * min(strength, 1.0)


@njit(cache=True)
def add_dunes(height: Grid, tone: Grid, spacing: float, modulation: Level, dunes: Bedforms) -> None:
    """Add transverse dunes: a gentle stoss up to the crest, a slip face, a concave apron.

    The phase is that of the plane wave times a smooth complex modulation of unit mean square: control values of the
    same extent as the grid, on one no finer. Where the modulation vanishes crests end and fork, and the dunes have no
    height.
    """
    side, cells = height.shape[0], modulation.shape[0]
    step = side // cells
    weights = np.empty((step, 4))
    for k in range(step):
        weights[k] = bspline_weights(k / step)[:4]
    along, real, imaginary = np.empty((cells, 2)), np.empty(side), np.empty(side)
    for i in range(side):
        # on one row the modulation is a spline of x alone
        collapse(modulation, i / step, along)
        for j in range(cells):
            before, here, after, beyond = along[j - 1], along[j], along[(j + 1) % cells], along[(j + 2) % cells]
            for k in range(step):
                a, b, c, d = weights[k]
                real[j * step + k] = a * before[0] + b * here[0] + c * after[0] + d * beyond[0]
                imaginary[j * step + k] = a * before[1] + b * here[1] + c * after[1] + d * beyond[1]
        _add_row_of_dunes(height[i], tone[i], real, imaginary, dunes.wave_y * i * spacing, spacing, dunes)


@njit(cache=True)
def stamp_lobes(height: Grid, tone: Grid, spacing: float, lobes: Array, warp_x: Grid, warp_y: Grid) -> None:
    """Stack lava lobes: each a plateau with a steep, crenulated margin and a slightly sunken middle.

    `lobes` has rows (x, y, half length, half width, thickness, cosine and sine of its direction, tone). The warps are
    displacements in half widths that make the outlines irregular. Every lobe covers the tone of those below.
    """
    mask = height.shape[0] - 1
    for n in range(lobes.shape[0]):
        x, y, along, across, thick, c, s, colour = lobes[n]
        reach_x = 1.3 * (along * abs(c) + across * abs(s)) + 0.5 * across
        reach_y = 1.3 * (along * abs(s) + across * abs(c)) + 0.5 * across
        for i in range(math.ceil((y - reach_y) / spacing), math.floor((y + reach_y) / spacing) + 1):
            row = i & mask
            for j in range(math.ceil((x - reach_x) / spacing), math.floor((x + reach_x) / spacing) + 1):
                column = j & mask
                dx = j * spacing - x + warp_x[row, column] * across
                dy = i * spacing - y + warp_y[row, column] * across
                p = (c * dx + s * dy) / along
                q = (c * dy - s * dx) / across
                far = p * p + q * q
                if far >= 1.0:
                    continue
                edge = 1.0 - (far * far) * (far * far)
                height[row, column] += thick * edge * (0.65 + 0.35 * far)
                tone[row, column] += (colour - tone[row, column]) * edge


@njit(cache=True)
def add_cracks(
    height: Grid, tone: Grid, spacing: float, points: Array, cell: float, width: float, depth: float, contrast: float
) -> None:
    """Add polygonal cracks: the borders between the Voronoi cells of one point in each square of a periodic grid.

    `points` has shape (count, count, 2): the position of each point within its square, from 0 to 1.
    """
    count = points.shape[0]
    # the points' positions, with those beyond the border
    positions = np.empty((count + 2, count + 2, 2))
    for row in range(-1, count + 1):
        for column in range(-1, count + 1):
            x, y = points[row % count, column % count]
            positions[row + 1, column + 1, 0], positions[row + 1, column + 1, 1] = column + x, row + y
    for i in range(height.shape[0]):
        y = i * spacing / cell
        row = int(y)
        for j in range(height.shape[0]):
            x = j * spacing / cell
            column = int(x)
            nearest, nx, ny = 1e9, 0.0, 0.0
            second, sx, sy = 1e9, 0.0, 0.0
            for di in range(3):
                for dj in range(3):
                    dx = positions[row + di, column + dj, 0] - x
                    dy = positions[row + di, column + dj, 1] - y
                    far = dx * dx + dy * dy
                    if far < nearest:
                        second, sx, sy = nearest, nx, ny
                        nearest, nx, ny = far, dx, dy
                    elif far < second:
                        second, sx, sy = far, dx, dy
            apart = math.sqrt((sx - nx) ** 2 + (sy - ny) ** 2)
            border = 0.5 * (second - nearest) / max(apart, 1e-6) * cell
            if border < width:
                strength = 1.0 - border / width
                height[i, j] -= depth * strength
                tone[i, j] += contrast * strength


@njit(cache=True)
def cut_channels(cut: Grid, spacing: float, discs: Array, sharpness: float) -> None:
    """Cut channels, rows of discs (x, y, half width, depth), each ``depth (1 - (d / w)**sharpness)`` deep."""
    mask = cut.shape[0] - 1
    for n in range(discs.shape[0]):
        x, y, half, depth = discs[n]
        for i in range(math.ceil((y - half) / spacing), math.floor((y + half) / spacing) + 1):
            dy = i * spacing - y
            for j in range(math.ceil((x - half) / spacing), math.floor((x + half) / spacing) + 1):
                dx = j * spacing - x
                far = math.sqrt(dx * dx + dy * dy) / half
                if far < 1.0:
                    deep = depth * (1.0 - far**sharpness)
                    if deep > cut[i & mask, j & mask]:
                        cut[i & mask, j & mask] = deep


@njit(cache=True)
def raise_cones(
    height: Grid, cover: Grid, spacing: float, apexes: Array, slope: float, concavity: float, rounding: float
) -> None:
    """Add the union of cones with rows (x, y, radius) that flatten towards their toes; `cover` is 1 on them.

    A cone is ``slope R / concavity (1 - r / R)**concavity`` high: `slope` steep at its apex, which is rounded.
    """
    side = height.shape[0]
    period = side * spacing
    for i in range(side):
        for j in range(side):
            total = 0.0
            for n in range(apexes.shape[0]):
                dx, dy = abs(j * spacing - apexes[n, 0]), abs(i * spacing - apexes[n, 1])
                dx, dy = min(dx, period - dx), min(dy, period - dy)
                far = math.sqrt(dx * dx + dy * dy + rounding * rounding) - rounding
                rest = 1.0 - far / apexes[n, 2]
                if rest > 0.0:
                    z = slope * apexes[n, 2] / concavity * rest**concavity
                    # the highest, rounded where two meet
                    total += z**8
            if total > 0.0:
                z = total**0.125
                height[i, j] += z
                cover[i, j] = min(z / (0.02 * slope * apexes[0, 2]), 1.0)


@njit(cache=True)
def pack(height: Grid, albedo: Grid, scale: float, samples: Level) -> None:
    """Interleave height and albedo; the albedo is scaled and limited to 1."""
    for i in range(height.shape[0]):
        for j in range(height.shape[0]):
            samples[i, j, 0] = height[i, j]
            samples[i, j, 1] = min(scale * albedo[i, j], 1.0)
